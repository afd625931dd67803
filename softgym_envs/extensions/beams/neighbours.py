"""Bodies beside a robot's design, for gradients of its motions by the design."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softgym_envs.extensions.beams.solver.design import Neighbours
from softgym_envs.robots.base import Robot

STEP = 1e-5
"""Distance of neighbours as a part of the range of a variable: round-off of the equations and the
curvature of contact then count alike, in the seventh digit or so."""


def neighbours_of(robot: Robot, design: Mapping[str, float] | None = None) -> Neighbours:
    """Return the neighbours of a design, within its bounds; missing variables take their baseline.

    Raises:
        DesignError: for a malformed design.
        InfeasibleDesign: if a neighbour cannot exist.
        ValueError: for bodies that compiled code cannot solve, or whose layout depends on the design.
    """
    space = robot.design_space
    low, high = (np.array([getattr(variable, end) for variable in space]) for end in ("low", "high"))
    values = space.complete(design).array
    return Neighbours.of(
        lambda each: robot.build(dict(zip(space.names, each.tolist(), strict=True))),
        values,
        STEP * (high - low),
        bounds=(low, high),
    )
