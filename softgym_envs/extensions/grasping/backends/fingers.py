"""Backends of grippers of one learned finger: the solvers of finite elements on a body with few unknowns."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from softgym_envs.backends.fem import FEMBackend
from softgym_envs.designs import Design
from softgym_envs.errors import WeightsError
from softgym_envs.extensions.grasping.held_fingers import CABLES, HeldFingers, LearnedFinger
from softgym_envs.extensions.grasping.robots.composed_gripper import ComposedGripper
from softgym_envs.extensions.paths.hybrid import PathHybridBackend
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.equilibrium import Equilibrium
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.surrogate.domain import share_at_bounds
from softgym_envs.surrogate.pretrained import pretrained_model

TOLERANCE = 1e-6
"""Of equilibria [m]: a hundredth of what learned fingers may put an object off. Closer ones cost half as much again."""


class FingersBackend(FEMBackend):
    """Equilibria of a gripper of learned fingers, with exact ``W``.

    The equations are those of finite elements. A state is trusted if the fingers are within the cables and poses that
    they learned, the equilibrium is stable, and the differences of the ensemble's forces hardly move the object. These
    say least where some cables pull all the way and others hang slack: there the uncertainty has a factor of its own.

    Args:
        robot: the gripper, which touches nothing but what it holds.
        design: first design; missing variables take their baseline.
        weights: folder of the weights of the finger; default the shipped ones.

    Raises:
        WeightsError: if there are no weights of the finger on this mesh, they are damaged, or the gripper may touch
            something.
    """

    takes_touch = False

    def __init__(
        self, robot: ComposedGripper, design: Mapping[str, float] | None = None, weights: str | Path | None = None
    ) -> None:
        if robot.may_touch:
            raise WeightsError(
                f"robot '{robot.name}': learned fingers touch nothing, got obstacles or self_contact; use backend='fem'"
            )
        model = pretrained_model(robot.one_part(), weights)
        self._learned = robot.of_parts({"finger": LearnedFinger(model)})
        self._slack_corners = float(model.card.get("calibration", {}).get("slack_corners", 1.0))
        super().__init__(robot, design)

    def _build(self, design: Design) -> MechanicalModel:
        return self._learned.build(design)

    def _uncertainty(self, equilibrium: Equilibrium, command: np.ndarray) -> float:
        found, robot = super()._uncertainty(equilibrium, command), self.robot
        (fingers,) = (block for block in self.model.blocks if isinstance(block, HeldFingers))
        own = slice(CABLES * fingers.count)  # not those that pull springs
        if not equilibrium.slack[own].any():
            return found
        middle, half = 0.5 * (robot.upper + robot.lower), 0.5 * (robot.upper - robot.lower)
        return found * self._slack_corners ** float(share_at_bounds(command[own], middle[own], half[own]))

    def _solver(self, model: MechanicalModel) -> Statics:
        statics = super()._solver(model)
        statics.tolerance = TOLERANCE
        return statics


class FingersHybridBackend(PathHybridBackend):
    """A gripper of learned fingers where they are trusted, elsewhere finite elements of the whole body.

    Args:
        robot: the gripper.
        design: first design; missing variables take their baseline.
        weights: folder of the weights of the finger; default the shipped ones.
    """

    def __init__(
        self, robot: ComposedGripper, design: Mapping[str, float] | None = None, weights: str | Path | None = None
    ) -> None:
        self._start(robot, FingersBackend(robot, design, weights))
