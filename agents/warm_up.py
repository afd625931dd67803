"""First steps of a training in which each episode goes to a random posture."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise

from softgym_envs.envs.spaces import AgentSpaces


class PostureSAC(SAC):
    """SAC that begins with random postures in place of random actions.

    Random increments of a command cancel each other, so a hand never closes far enough to touch anything. Until
    learning starts, each episode therefore draws one command, uniformly from the ranges of the actuators, goes there as
    fast as it may, and stays.

    Args:
        *args: as for `SAC`.
        spaces: layout of observations and actions.
        **kwargs: as for `SAC`.
    """

    def __init__(self, *args: Any, spaces: AgentSpaces, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._spaces = spaces
        self._postures = np.zeros((self.n_envs, len(spaces.lower)))

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the actions of all environments twice: as applied and as stored, which are the same in [-1, 1]."""
        if self.num_timesteps >= learning_starts:
            return super()._sample_action(learning_starts, action_noise, n_envs)
        spaces, random = self._spaces, self.action_space.np_random
        drawn = random.uniform(spaces.lower, spaces.upper, self._postures.shape)
        starts = np.asarray(self._last_episode_starts, dtype=bool)
        self._postures = np.where(starts[:, None], drawn, self._postures)
        observed = np.asarray(self._last_obs)[:, spaces.slices["command"]]
        actions = spaces.action(self._postures, spaces.middle + spaces.half_range * observed)
        return actions, actions

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: Any,
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        self._last_episode_starts = dones  # off-policy algorithms leave this as it was at the first reset
