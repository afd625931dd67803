"""Goal-conditioned observations, for learners with hindsight experience replay."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces


class GoalObservation(gymnasium.Wrapper):
    """Observations as dictionaries of ``observation``, ``achieved_goal`` and ``desired_goal``, with `compute_reward`.

    Goals are in units of ``spaces.position_scale``; ``observation`` has the other parts, without goal and error.
    Rewards are those of `compute_reward`, so that stored and relabelled transitions are rated alike.

    Args:
        env: an environment whose reward depends on goal, effector and efforts alone.
        effort: rate efforts too, as the environment does. `compute_reward` then reads them in ``info``:
            stable-baselines3's ``HerReplayBuffer`` needs ``copy_info_dict=True``. By default rewards are those of an
            actuation without effort, at most 5 % larger.

    Raises:
        ValueError: for a task whose goal moves in an episode, or that rates more of the state.
    """

    def __init__(self, env: gymnasium.Env, *, effort: bool = False) -> None:
        super().__init__(env)
        self._effort = effort
        inner: Any = env.unwrapped
        self._task, self._spaces = inner.task, inner.spaces
        task = self._task
        if task.horizon != 1 or task.needs_state or task.load or task.sensors:
            raise ValueError(
                f"task '{self._task.name}' has no goal-conditioned interface: its goal moves, or it rates more than "
                "the goal and the effector; allowed: tasks such as 'reach'"
            )
        parts = self._spaces.slices
        size = self._spaces.observation_space.shape[0]
        hidden = np.arange(size)
        self._kept = np.delete(hidden, np.r_[hidden[parts["goal"]], hidden[parts["error"]]])
        goal = spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.observation_space = spaces.Dict(
            {
                "observation": spaces.Box(-1.0, 1.0, (len(self._kept),), np.float32),
                "achieved_goal": goal,
                "desired_goal": goal,
            }
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        return self._split(observation), info

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        observation, _, terminated, truncated, info = self.env.step(action)
        parts = self._split(observation)
        reward = self.compute_reward(parts["achieved_goal"], parts["desired_goal"], info)
        return parts, reward, terminated, truncated, info

    def _split(self, observation: np.ndarray) -> dict[str, np.ndarray]:
        parts = self._spaces.slices
        return {
            "observation": observation[self._kept],
            "achieved_goal": observation[parts["effector"]].copy(),
            "desired_goal": observation[parts["goal"]].copy(),
        }

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> Any:
        """Return the rewards of steps that achieved some goals, for other desired goals.

        Args:
            achieved_goal: as in observations, shape (3,) or (B, 3).
            desired_goal: as in observations, shape (3,) or (B, 3).
            info: that of the step, or a sequence of B, read only if efforts are rated.

        Returns:
            One reward, or rewards (B,).
        """
        share = np.zeros(1)
        if self._effort:
            infos = [info] if isinstance(info, dict) else info
            share = self._spaces.effort_share(np.array([one["effort"] for one in infos]))
        scale = self._spaces.position_scale
        achieved, desired = (np.atleast_2d(goal).astype(float) * scale for goal in (achieved_goal, desired_goal))
        reward = self._task.rate(achieved, desired, share)[2]
        return reward if np.ndim(achieved_goal) == 2 else float(reward[0])
