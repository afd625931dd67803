"""The whip: a soft, tapered trunk that hangs from its base and swings a payload in a plane.

The design is our own. Pairs of fibre-reinforced chambers beside its axis bend two segments forwards and backwards; the
tail without chambers follows. It is too weak to lift what it throws: it has to swing it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.walkers.robots.mobile import RhythmicRobot
from softgym_envs.extensions.walkers.robots.tapered import add_chambers, lay_body
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.elements.rigid import sphere_inertia
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.actuator import Actuator
from softgym_envs.robots.capabilities import View

SEGMENTS = 2
"""Pairs of chambers along the body."""
GRIPPER_MASS, GRIPPER_RADIUS = 0.010, 0.010
"""Of the part at the end that holds the payload [kg, m]."""
STROKE, SWINGS, THROW = 3e-8, 2.0, 30
"""Volume by which chambers change in the plain throw [m3], its swings, and its duration [control steps]."""


class Whip(RhythmicRobot):
    """A trunk that hangs, bends in the plane of x and z, and holds a payload at its end.

    Opposite changes of the volumes of a segment bend it to one side; equal ones stretch it. No chamber holds or draws
    more than 100 kPa: below, its fluid would boil.

    Args:
        elements: quadratic beam elements of a segment; the tail has as many.
        payload: mass at the end [kg].
        gravity: acceleration [m/s2].
        **options: options of `Robot`.
    """

    name = "whip"
    effectors = ("tip",)
    size = 0.25
    made_of_beams = True
    goal_axes = np.array([1.0, 0.0, 1.0])
    view = View(turned=True, way=2.0)
    workspace_scale = 0.1

    def __init__(
        self,
        *,
        elements: int = 2,
        payload: float = 0.020,
        gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
        **options: Any,
    ) -> None:
        super().__init__(gravity=gravity, **options)
        if not isinstance(elements, int) or elements < 1:
            raise ValueError(f"elements = {elements!r} is out of bounds; allowed: integers from 1")
        if not (np.isfinite(payload) and payload >= 0.0):
            raise ValueError(f"payload = {payload} kg must be finite and not negative")
        self.elements, self.payload = elements, float(payload)
        self.design_space = DesignSpace(
            DesignVariable("length", 0.200, 0.350, 0.250, "m", "length of the body"),
            DesignVariable("radius", 0.009, 0.015, 0.012, "m", "radius of the base"),
            DesignVariable("taper", 0.5, 1.0, 0.8, "1", "radius of the end over that of the base"),
            DesignVariable("tail", 0.1, 0.6, 0.3, "1", "part of the length without chambers"),
            DesignVariable("young_modulus", 1.0e5, 1.0e6, 3.0e5, "Pa", "stiffness of the silicone", log=True),
        )
        self.effector_rest = np.array([0.0, 0.0, -0.25])
        self.actuators = tuple(
            Actuator(f"{k + 1}_{side}", -2.5e-7, 2.5e-7, 5.0e-8, unit="m3", unilateral=False, max_effort=1.0e5)
            for k in range(SEGMENTS)
            for side in ("front", "back")
        )
        self.effort_scale = np.full(len(self.actuators), 5.0e4)

    def assemble(self, design: Mapping[str, float]) -> MechanicalModel:
        """Hang the body from the origin along -z."""
        builder = ModelBuilder(gravity=self.gravity)
        # From base to tip: the first director runs down, the second one ahead.
        turn = np.column_stack([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
        frames, radii = lay_body(
            builder,
            design,
            (0.0, 0.0, 0.0),
            turn,
            segments=SEGMENTS,
            elements=self.elements,
            fixed=True,
            young_modulus=design["young_modulus"],
            poisson_ratio=0.45,
            density=1070.0,
        )
        builder.add_mass(frames[-1], GRIPPER_MASS, sphere_inertia(GRIPPER_MASS, GRIPPER_RADIUS), self.payload)
        model = builder.build()
        add_chambers(model, radii, self.actuators, self.elements)
        model.add("e", Point("tip", EmbeddedPoints.in_frame(frames[-1], np.zeros(3), model.nodes)))
        return model

    def reference_gait(self) -> np.ndarray:
        """Both segments swing backwards and forwards together until the payload is let go, shape (30, 4)."""
        bend = STROKE * np.sin(2.0 * math.pi * SWINGS * np.arange(THROW) / THROW)
        return np.tile(np.stack([-bend, bend], axis=1), SEGMENTS)

    def reference_path(self, count: int = 30) -> np.ndarray:
        """Forwards and up on a circle about the base, by 0.5 rad, shape (count, 3)."""
        angle = np.linspace(0.0, 0.5, count)
        return 0.25 * np.column_stack([np.sin(angle), np.zeros(count), -np.cos(angle)])
