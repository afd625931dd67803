"""The finite-element backend."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softgym_envs.backends.backend import Backend, State
from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.statics import Equilibrium, Statics
from softgym_envs.robots.robot import Robot

__all__ = ["FEMBackend"]


class FEMBackend(Backend):
    """Static equilibria of the finite-element model; exact ``W`` at every state.

    Args:
        robot: the family of bodies.
        design: first design; missing variables take their baseline.
    """

    model: MechanicalModel

    def __init__(self, robot: Robot, design: Mapping[str, float] | None = None) -> None:
        self.robot = robot
        self.design = {}
        self.reset(robot.design_space.complete(design))

    def reset(self, design: Mapping[str, float] | None = None) -> State:
        complete = self.design if design is None else self.robot.design_space.complete(design)
        if complete != self.design:
            model = self.robot.build(complete)
            statics = Statics(model)
            zero = np.zeros(len(self.robot.actuators))
            self._rest = self._state(statics.solve(zero, "effort"), zero)
            self.model, self._statics, self.design = model, statics, dict(complete)
        self.restore(self._rest)
        return self.state

    def step(self, command: np.ndarray, mode: str = "displacement") -> State:
        command = np.asarray(command, dtype=float)
        try:
            equilibrium = self._statics.solve(command, mode)
        except ConvergenceError:
            self.restore(self.state)
            raise
        self.state = self._state(equilibrium, command)
        return self.state

    def restore(self, state: State) -> None:
        assert state.nodes is not None
        self._statics.restore(state.nodes, np.concatenate([state.condensed.effort, state.bonds]))
        self.state = state

    def _state(self, equilibrium: Equilibrium, command: np.ndarray) -> State:
        condensed, slices = equilibrium.condensed, equilibrium.condensed.slices
        return State(
            command=command.copy(),
            displacement=equilibrium.delta[slices["a"]],
            effort=equilibrium.effort[slices["a"]],
            effector=equilibrium.delta[slices["e"]].reshape(-1, 3),
            slack=equilibrium.slack,
            condensed=condensed,
            nodes=equilibrium.x,
            bonds=equilibrium.effort[len(condensed.effort) :],
            stable=equilibrium.stable,
        )
