"""An agent on top of the inverse QP: it adds to the QP's action what the QP does not know.

Residual reinforcement learning: Johannink et al., 2019; Silver et al., 2018.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from agents.baselines import InverseQPAgent, make_controller
from softgym_envs.control import InverseQP
from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.condensation import CondensedModel

__all__ = ["ResidualQP", "VectorResidualQP"]


class ResidualQP(gymnasium.ActionWrapper):
    """Does ``clip(action of the QP + share * action, -1, 1)`` in a single environment, on any backend.

    Args:
        env: a `SoftRobotEnv`, wrapped or not.
        share: of the agent's action.
    """

    def __init__(self, env: gymnasium.Env, share: float) -> None:
        super().__init__(env)
        self.share = share
        self._qp = InverseQPAgent()

    def action(self, action: np.ndarray) -> np.ndarray:
        """Return the action that is done, shape (n_a,)."""
        return np.clip(self._qp(None, self.unwrapped) + self.share * np.asarray(action), -1.0, 1.0)


class VectorResidualQP(gymnasium.vector.VectorActionWrapper):
    """The same on the batched surrogate environment: one QP a row, on one batch of condensed models.

    Args:
        env: a `SoftRobotVectorEnv`.
        share: of the agent's actions.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv, share: float) -> None:
        super().__init__(env)
        self.share = share
        batch: Any = env.unwrapped
        self._batch = batch
        self._controllers: list[InverseQP] = [make_controller(batch.robot, batch.task) for _ in range(env.num_envs)]

    def actions(self, actions: np.ndarray) -> np.ndarray:
        """Return the actions that are done, shape (num_envs, n_a)."""
        return np.clip(self._qp_actions() + self.share * np.asarray(actions), -1.0, 1.0)

    def _qp_actions(self) -> np.ndarray:
        env = self._batch
        models, goals, previous = env.condensed, env.goals, env.command
        commands = previous.copy()
        for i, controller in enumerate(self._controllers):
            if not previous[i].any():  # an episode begins
                controller = self._controllers[i] = make_controller(env.robot, env.task)
            model = CondensedModel(models.compliance[i], models.free[i], models.effort[i], models.roles)
            try:
                commands[i] = controller.solve(model, goals[i], previous[i], env.slack[i])
            except ConvergenceError:  # a QP that fails holds still
                pass
        return env.spaces.action(commands, previous)
