"""Backends of arms of modules, whose learned parts are elements: the solvers of finite elements on few unknowns."""

from __future__ import annotations

from collections.abc import Mapping

from softgym_envs.backends.fem import FEMBackend
from softgym_envs.extensions.modules.modular_arm import ModularArm
from softgym_envs.extensions.paths.hybrid import PathHybridBackend


class ModularBackend(FEMBackend):
    """An arm of learned modules, with six unknowns for each port, whatever the body of the robot is.

    Args:
        robot: the arm.
        design: first design; missing variables take their baseline.
    """

    def __init__(self, robot: ModularArm, design: Mapping[str, float] | None = None) -> None:
        super().__init__(robot.with_body("superelements"), design)


class ModularHybridBackend(PathHybridBackend):
    """An arm of learned modules where they are trusted, elsewhere finite elements of the whole body.

    Args:
        robot: the arm.
        design: first design; missing variables take their baseline.
    """

    def __init__(self, robot: ModularArm, design: Mapping[str, float] | None = None) -> None:
        self._start(robot, ModularBackend(robot, design))
