"""The swimmer: a soft, tapered body in a viscous fluid, bent by pairs of fibre-reinforced chambers beside its axis.

Nothing holds it, and it weighs nothing in the fluid. It swims along x, head first. The design is our own: the fluid is
silicone oil, in which inertia of the fluid does not count at this size and speed (the Reynolds number of its sideways
strokes is below 0.3), so that resistive force theory holds.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.walkers.fluid import slender_drag
from softgym_envs.extensions.walkers.robots.mobile import MobileRobot
from softgym_envs.extensions.walkers.robots.tapered import add_chambers, lay_body
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.actuator import Actuator
from softgym_envs.robots.capabilities import View

SEGMENTS = 4
"""Pairs of chambers along the body."""
PERIOD = 20
"""Control steps of a period of the plain gait."""
STROKE = 3.5e-8
"""Volume by which its chambers change [m3]."""


class Swimmer(MobileRobot):
    """A tapered body with a chamber on each side of its axis in every segment, and a tail without.

    Opposite changes of the volumes of a segment bend it to one side; equal ones stretch it.

    Args:
        elements: quadratic beam elements of a segment; the tail has as many.
        viscosity: of the fluid [Pa s].
        gravity: acceleration beyond what the fluid carries [m/s2].
        **options: options of `Robot`.
    """

    name = "swimmer"
    effectors = ("middle",)
    size = 0.15
    made_of_beams = True
    goal_axes = np.array([1.0, 1.0, 0.0])
    goal_tolerance = 0.01
    mirrored_actuators = tuple(k ^ 1 for k in range(2 * SEGMENTS))
    workspace_scale = 0.04

    def __init__(
        self,
        *,
        elements: int = 1,
        viscosity: float = 3.0,
        gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        **options: Any,
    ) -> None:
        super().__init__(gravity=gravity, **options)
        if not isinstance(elements, int) or elements < 1:
            raise ValueError(f"elements = {elements!r} is out of bounds; allowed: integers from 1")
        if not (np.isfinite(viscosity) and viscosity > 0.0):
            raise ValueError(f"viscosity = {viscosity} Pa s must be finite and positive")
        self.elements = elements
        self.view = View(axes=(2, 0, 1), at_rest=True, follows=4 * ((SEGMENTS + 1) * elements), way=0.2)
        self.viscosity = float(viscosity)
        self.design_space = DesignSpace(
            DesignVariable("length", 0.100, 0.200, 0.150, "m", "length of the body"),
            DesignVariable("radius", 0.0065, 0.009, 0.007, "m", "radius of the head"),
            DesignVariable("taper", 0.8, 1.0, 0.9, "1", "radius of the end of the tail over that of the head"),
            DesignVariable("tail", 0.1, 0.5, 0.2, "1", "part of the length without chambers"),
            DesignVariable("young_modulus", 5.0e4, 5.0e5, 1.0e5, "Pa", "stiffness of the silicone", log=True),
        )
        self.effector_rest = np.zeros(3)
        self.actuators = tuple(
            Actuator(f"{k + 1}_{side}", -5.0e-8, 5.0e-8, 1.5e-8, unit="m3", unilateral=False)
            for k in range(SEGMENTS)
            for side in ("left", "right")
        )
        self.effort_scale = np.full(len(self.actuators), 3.0e4)

    def assemble(self, design: Mapping[str, float]) -> MechanicalModel:
        """Lay the body along x with its middle at the origin."""
        length, radius, taper = design["length"], design["radius"], design["taper"]
        builder = ModelBuilder(gravity=self.gravity, floating=True)
        # From head to tail: the first director runs backwards, the second one to the left.
        turn = np.column_stack([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
        frames, radii = lay_body(
            builder,
            design,
            (0.5 * length, 0.0, 0.0),
            turn,
            segments=SEGMENTS,
            elements=self.elements,
            young_modulus=design["young_modulus"],
            poisson_ratio=0.45,
            density=970.0,
            drag=slender_drag(self.viscosity, length, 0.5 * radius * (1.0 + taper)),
        )
        model = builder.build()
        middle = frames[len(frames) // 2]
        add_chambers(model, radii, self.actuators, self.elements)
        model.add("e", Point("middle", EmbeddedPoints.in_frame(middle, np.zeros(3), model.nodes)))
        return model

    def place(self, nodes: np.ndarray) -> np.ndarray:
        """Return the centroid of the axis [m], shape (3,): the middle swings, the centroid hardly does."""
        axis = nodes[::4]
        lengths = np.linalg.norm(np.diff(axis, axis=0), axis=1)
        return lengths @ (0.5 * (axis[:-1] + axis[1:])) / lengths.sum()

    def reference_gait(self) -> np.ndarray:
        """A wave of one length of the body that runs from head to tail, shape (20, 8)."""
        phase = 2.0 * np.pi * (np.arange(PERIOD)[:, None] / PERIOD - np.arange(SEGMENTS) / (SEGMENTS + 1))
        bend = STROKE * np.sin(phase)
        return np.stack([bend, -bend], axis=2).reshape(PERIOD, -1)

    def reference_path(self, count: int = 30) -> np.ndarray:
        """Straight ahead by two thirds of the body, shape (count, 3)."""
        return self.effector_rest + np.linspace(0.0, 0.1, count)[:, None] * [1.0, 0.0, 0.0]
