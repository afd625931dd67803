"""Residual learning: environments in which the agent's action corrects that of the inverse QP or another agent.

Johannink et al., Residual reinforcement learning for robot control, 2019.
Silver et al., Residual policy learning, 2018.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

from softgym_envs.agents.baselines import make_baseline, make_controller
from softgym_envs.envs.vector_env import SoftRobotVectorEnv


class ResidualQP(gymnasium.ActionWrapper):
    """Single environment whose action is ``clip(QP action + scale * agent action, -1, 1)``, on any backend.

    Args:
        env: a `SoftRobotEnv`, wrapped or not.
        scale: factor of the agent's action.
        on: agent that is corrected, see `make_baseline`.
    """

    def __init__(self, env: gymnasium.Env, scale: float, on: str = "qp") -> None:
        super().__init__(env)
        self.scale, self.on = scale, on
        self._qp: Callable[[Any, Any], np.ndarray] = make_baseline(on)

    def __getstate__(self) -> dict[str, Any]:
        return _without_qp(self)

    def __setstate__(self, kept: dict[str, Any]) -> None:
        self.__dict__.update(kept)
        self._qp = make_baseline(self.on)

    def action(self, action: np.ndarray) -> np.ndarray:
        """Return the action for the wrapped environment, shape (n_a,)."""
        return np.clip(self._qp(None, self.unwrapped) + self.scale * np.asarray(action), -1.0, 1.0)


class BatchQP:
    """Inverse QP of every row of the batched surrogate environment, on one batch of condensed models.

    Args:
        env: the environment.
    """

    def __init__(self, env: SoftRobotVectorEnv) -> None:
        self._env = env
        self._controller = make_controller(env.robot, env.task)

    def __call__(self) -> np.ndarray:
        """Return actions for the present states, shape (num_envs, n_a); rows without a solution hold the command."""
        env = self._env
        commands = self._controller.solve_batch(env.condensed, env.observed_goals, env.command, env.slack)
        return env.spaces.action(commands, env.command)


class VectorResidualQP(gymnasium.vector.VectorActionWrapper):
    """`ResidualQP` of the batched surrogate environment.

    Args:
        env: a `SoftRobotVectorEnv`.
        scale: factor of the agent's actions.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv, scale: float) -> None:
        super().__init__(env)
        self.scale = scale
        self._qp = BatchQP(env.unwrapped)  # type: ignore[arg-type]

    def __getstate__(self) -> dict[str, Any]:
        return _without_qp(self)

    def __setstate__(self, kept: dict[str, Any]) -> None:
        self.__dict__.update(kept)
        self._qp = BatchQP(self.env.unwrapped)  # type: ignore[arg-type]

    def actions(self, actions: np.ndarray) -> np.ndarray:
        """Return the actions for the wrapped environment, shape (num_envs, n_a)."""
        return np.clip(self._qp() + self.scale * np.asarray(actions), -1.0, 1.0)


def _without_qp(wrapper: ResidualQP | VectorResidualQP) -> dict[str, Any]:
    """Return the attributes of a wrapper that can be pickled; a copy makes a QP of its own."""
    return {name: value for name, value in vars(wrapper).items() if name != "_qp"}
