"""Backends of grippers of one learned finger: the solvers of finite elements on a body with few unknowns."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from softgym_envs.backends.fem import FEMBackend
from softgym_envs.backends.hybrid_path import PathHybridBackend
from softgym_envs.designs import Design
from softgym_envs.errors import WeightsError
from softgym_envs.extensions.grasping.held_fingers import LearnedFinger
from softgym_envs.extensions.grasping.robots.composed_gripper import ComposedGripper
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.surrogate.pretrained import pretrained_model

TOLERANCE = 1e-6
"""Of equilibria [m]: a hundredth of what learned fingers may put an object off. Closer ones cost half as much again."""


class FingersBackend(FEMBackend):
    """Equilibria of a gripper of learned fingers, with exact ``W``.

    The equations are those of finite elements. A state is trusted if the fingers are within the cables and poses that
    they learned, the equilibrium is stable, and the differences of the ensemble's forces hardly move the object.

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
        super().__init__(robot, design)

    def _build(self, design: Design) -> MechanicalModel:
        return self._learned.build(design)

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
