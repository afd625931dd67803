"""Backends of robots that consist of learned parts: the solvers of finite elements on a body with few unknowns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.backends.backend import PointForce, State
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.designs import Design
from softgym_envs.extensions.beams.parts.trust import judge
from softgym_envs.extensions.beams.parts.weights import of_learned_parts
from softgym_envs.extensions.paths.hybrid import PathHybridBackend
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.dynamics import Motion
from softgym_envs.mechanics.solvers.equilibrium import SATURATED, Equilibrium
from softgym_envs.robots.base import Robot


class PartsBackend(FEMBackend):
    """States of a robot of learned parts: static equilibria with exact ``W``, or motion in time.

    The equations are those of finite elements, and so are servos that saturate at their ``max_effort``. In motion the
    mass of a part is spread along the line between its ends, and damping is that of its stiffness at the start of each
    time step. A state is trusted if its parts are within the poses and loads that they learned, the body resists
    enough while its actuators are held, there and on the way there, and the errors of the parts hardly move the
    effectors.

    Args:
        robot: the robot, which touches nothing.
        design: first design; missing variables take their baseline.
        weights: folder of the weights of the part; default the shipped ones.
        dynamics: as for `FEMBackend`.
        control_step: likewise [s].
        time_step: likewise [s].
        mass_damping: likewise [1/s].
        stiffness_damping: likewise [s].

    Raises:
        WeightsError: if the weights are missing, damaged or of another part.
        ValueError: for a robot that may touch something.
    """

    takes_touch = False

    def __init__(
        self,
        robot: Robot,
        design: Mapping[str, float] | None = None,
        weights: str | Path | None = None,
        *,
        dynamics: bool = False,
        control_step: float = 0.05,
        time_step: float = 0.01,
        mass_damping: float = 0.0,
        stiffness_damping: float = 0.01,
    ) -> None:
        self._learned, self.part = of_learned_parts(robot, weights)
        super().__init__(
            robot, design, dynamics=dynamics, control_step=control_step, time_step=time_step,
            mass_damping=mass_damping, stiffness_damping=stiffness_damping,
        )  # fmt: skip

    @classmethod
    def batch_class(cls, robot: Robot, options: Mapping[str, object]) -> str | None:
        return None

    def reset(self, design: Mapping[str, float] | None = None) -> State:
        self._begins = True
        try:
            return super().reset(design)
        finally:
            self._begins = False

    def _build(self, design: Design) -> MechanicalModel:
        return self._learned.build(design)

    def touch(self, load: PointForce | None) -> None:
        if load is not None:
            raise ValueError("learned parts take no forces on their surface; allowed: backend='fem'")
        super().touch(None)

    def _state(
        self, equilibrium: Equilibrium, command: np.ndarray, motion: Motion | None = None, *, still: bool = False
    ) -> State:
        state = super()._state(equilibrium, command, motion, still=still)
        held = np.abs(state.effort) < self.largest_efforts * SATURATED
        before = 0 if self._begins else self.state.distrust
        judged = judge(
            self._statics, self.robot, equilibrium.x, equilibrium.effort, held, limit=self.part.limit, before=before
        )
        return replace(state, uncertainty=judged.uncertainty, distrust=judged.distrust)


class PartsHybridBackend(PathHybridBackend):
    """A robot of learned parts where they are trusted, elsewhere finite elements on the mesh that they learned.

    Args:
        robot: the robot, which touches nothing.
        design: first design; missing variables take their baseline.
        weights: folder of the weights of the part; default the shipped ones.
        dynamics: as for `FEMBackend`.
        control_step: likewise [s].
        time_step: likewise [s].
        mass_damping: likewise [1/s].
        stiffness_damping: likewise [s].

    Raises:
        WeightsError: if the weights are missing, damaged or of another part.
        ValueError: for a robot that may touch something.
    """

    def __init__(
        self,
        robot: Robot,
        design: Mapping[str, float] | None = None,
        weights: str | Path | None = None,
        *,
        dynamics: bool = False,
        control_step: float = 0.05,
        time_step: float = 0.01,
        mass_damping: float = 0.0,
        stiffness_damping: float = 0.01,
    ) -> None:
        motion: dict[str, Any] = {
            "dynamics": dynamics, "control_step": control_step, "time_step": time_step,
            "mass_damping": mass_damping, "stiffness_damping": stiffness_damping,
        }  # fmt: skip
        self.moving = dynamics
        self._start(robot, PartsBackend(robot, design, weights, **motion), **motion)
