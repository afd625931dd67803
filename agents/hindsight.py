"""Hindsight experience replay: an episode that missed its goal shows how to reach the positions that it visited."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from softgym_envs.envs.spaces import AgentSpaces
from softgym_envs.envs.tasks.base import Task


class HindsightBuffer(ReplayBuffer):
    """Replay buffer of flat observations that gives a share of the samples another goal (HER, strategy "future").

    The other goal is a position (for forces: a force) that was reached at or after the transition in the same episode;
    the task computes the reward for it (Andrychowicz et al., Hindsight experience replay, 2017). Their k goals for each
    stored transition correspond to a share of k / (k + 1). Samples whose later state is no goal of the task keep their
    own.

    Args:
        *args: as for `ReplayBuffer`.
        spaces: layout of the observations.
        task: the task that computes rewards; its goal must not move during an episode.
        share: share of samples with another goal.
        **kwargs: as for `ReplayBuffer`.

    Attributes:
        ends: for each stored transition, the position of the last one in its episode; -1 while the episode runs; shape
            (size, num_envs).

    Raises:
        ValueError: for a task whose goal moves, as later positions then belong to other goals, or that hides the
            effector.
    """

    def __init__(self, *args: Any, spaces: AgentSpaces, task: Task, share: float, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if task.horizon != 1:
            raise ValueError(f"hindsight = {share} needs a fixed goal, but task '{task.name}' moves it; allowed: 0")
        if task.sensors:
            raise ValueError(f"hindsight = {share} needs the effector, but task '{task.name}' hides it; allowed: 0")
        self.spaces, self.task, self.share = spaces, task, share
        self.ends = np.full((self.buffer_size, self.n_envs), -1, dtype=np.int64)

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Store one transition of every environment."""
        position = self.pos
        # The overwritten transition leaves its episode; the others of that episode keep their end.
        self.ends[position] = -1
        super().add(obs, next_obs, action, reward, done, infos)
        self._end(np.flatnonzero(done), position)

    def cut(self) -> None:
        """End all running episodes because the environments are about to be reset."""
        if self.pos > 0 or self.full:
            self._end(np.arange(self.n_envs), (self.pos - 1) % self.buffer_size)

    def _end(self, environments: np.ndarray, position: int) -> None:
        for column in environments:
            k = position
            for _ in range(self.buffer_size):
                if self.ends[k, column] != -1 or not (self.full or k < self.pos):
                    break
                self.ends[k, column] = position
                k = (k - 1) % self.buffer_size

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        columns = np.random.randint(0, self.n_envs, len(batch_inds))  # noqa: NPY002 - the generator of stable-baselines3
        ends = self.ends[batch_inds, columns]
        newest = (self.pos - 1) % self.buffer_size
        left = (np.where(ends < 0, newest, ends) - batch_inds) % self.buffer_size
        draws = np.random.random((2, len(batch_inds)))  # noqa: NPY002
        later = (batch_inds + (draws[0] * (left + 1)).astype(np.int64)) % self.buffer_size
        observations = self.observations[batch_inds, columns]
        following = self.next_observations[batch_inds, columns]
        rewards = self.rewards[batch_inds, columns].copy()

        # A reward of exactly zero marks a step without an equilibrium, whose reward is zero for every goal.
        reached = self.spaces.observed_effector(self.next_observations[later, columns])
        goals, allowed = self.task.hindsight_goals(reached)
        chosen = np.flatnonzero((draws[1] < self.share) & (rewards != 0.0) & allowed)
        goals = goals[chosen]
        observations[chosen] = self.spaces.with_goal(observations[chosen], goals)
        old = following[chosen]
        following[chosen] = self.spaces.with_goal(old, goals)
        effector, effort_share = self.spaces.observed_effector(old), self.spaces.observed_effort_share(old)
        # Factors that depend on the state alone are the same for both goals.
        before = self.task.rate(effector, self.spaces.observed_goal(old), effort_share)[2]
        rewards[chosen] *= self.task.rate(effector, goals, effort_share)[2] / before

        ended = self.dones[batch_inds, columns] * (1.0 - self.timeouts[batch_inds, columns])
        return ReplayBufferSamples(
            *(
                self.to_torch(values)
                for values in (
                    observations,
                    self.actions[batch_inds, columns],
                    following,
                    ended[:, None].astype(np.float32),
                    rewards[:, None],
                )
            )
        )
