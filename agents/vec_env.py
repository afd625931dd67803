"""Batched environments for stable-baselines3."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.vec_env import VecEnv


class SB3VecEnv(VecEnv):
    """Adapter from a `gymnasium.vector.VectorEnv`, in any autoreset mode, to a stable-baselines3 `VecEnv`.

    Episodes that end are reset in the same step, as stable-baselines3 expects it: by the environment, or, if it would
    do so in the next step or not at all, by the option ``reset_mask``.

    Options of `set_options` hold for one episode, as for stable-baselines3's own environments. A body for the whole
    training is an option ``design`` of the environment.
    """

    def __init__(self, env: VectorEnv) -> None:
        self.env = env
        self._same_step = env.metadata.get("autoreset_mode") == AutoresetMode.SAME_STEP
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions: np.ndarray | None = None
        self._seed: int | None = None
        #: Called at the end of each episode with the index of its sub-environment and its return.
        self.on_episode: Callable[[int, float], None] = lambda index, total: None

    def reset(self) -> np.ndarray:
        observation, info = self.env.reset(seed=self._seed, options=self._joined_options())
        self._seed = None
        self._reset_options()
        self.reset_infos = self._infos(info)
        self._return = np.zeros(self.num_envs)
        self._length = np.zeros(self.num_envs, dtype=np.int64)
        return observation

    def _joined_options(self) -> dict[str, Any]:
        """Return the options of all sub-environments as one mapping of bodies and goals."""
        first = self._options[0]
        if len(self._options) != self.num_envs or any(options.keys() != first.keys() for options in self._options):
            names = [sorted(options) for options in self._options]
            raise ValueError(f"options must be {self.num_envs} mappings with the same names, got names {names}")
        joined: dict[str, Any] = {name: [options[name] for options in self._options] for name in first}
        if "goal" in joined:
            joined["goal"] = np.stack([np.atleast_2d(goal) for goal in joined["goal"]])
        return joined

    def _infos(self, info: dict[str, Any]) -> list[dict[str, Any]]:
        """Return the present values of each sub-environment."""
        names = [name for name in info if not name.startswith(("_", "final_"))]
        if not names:
            return [{} for _ in range(self.num_envs)]
        return [dict(zip(names, row, strict=True)) for row in zip(*(info[name] for name in names), strict=True)]

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        self._seed = seed
        return [seed] * self.num_envs

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        observation, reward, terminated, truncated, info = self.env.step(self._actions)
        done = terminated | truncated
        self._return += reward
        self._length += 1
        infos = self._infos(info)
        ended = np.flatnonzero(done)
        final, last = infos, observation
        if len(ended) and self._same_step:
            final, last = self._infos(info["final_info"]), info["final_obs"]
        elif len(ended):
            last = observation.copy()
            observation, _ = self.env.reset(options={"reset_mask": done})
        for i in ended:
            infos[i] = final[i] | {
                "terminal_observation": last[i],
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                "episode": {"r": float(self._return[i]), "l": int(self._length[i])},
            }
            self.on_episode(int(i), float(self._return[i]))
            self._return[i] = 0.0
            self._length[i] = 0
        return observation, reward.astype(np.float32), done, infos

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        # stable-baselines3 reads render_mode from every environment; other attributes must exist.
        value = getattr(self.env, attr_name, None) if attr_name == "render_mode" else getattr(self.env, attr_name)
        return [value] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        result = getattr(self.env, method_name)(*method_args, **method_kwargs)
        return [result] * len(list(self._get_indices(indices)))

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))
