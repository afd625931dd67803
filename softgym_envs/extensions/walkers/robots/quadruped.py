"""The quadruped: a rigid trunk on four soft legs, each bent and stretched by two fibre-reinforced chambers.

Nothing holds it but the ground. It walks along x. The design is our own, of the size of small silicone walkers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.extensions.beams.chamber import Chamber
from softgym_envs.extensions.beams.skins import box_skin, tube_skin
from softgym_envs.extensions.walkers.robots.mobile import MobileRobot
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.contact.obstacles import Obstacle, Plane
from softgym_envs.mechanics.elements.rigid import box_inertia
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.actuator import Actuator
from softgym_envs.robots.capabilities import View

LEGS = {"front_left": (1.0, 1.0), "front_right": (1.0, -1.0), "rear_left": (-1.0, 1.0), "rear_right": (-1.0, -1.0)}
"""Sides of the legs, along x and y."""
OVERHANG = 8e-3
"""By how much the trunk reaches beyond the axes of its legs, along x and y [m]."""
TRUNK_HEIGHT = 16e-3
"""[m]."""
CHAMBER_OFFSET, CHAMBER_RADIUS = 0.5625, 0.375
"""Distance of the chambers from the axis of a leg and their radius, in radii of the leg."""
CORNERS = 8
"""Corners of the section of a leg as it touches the ground."""
PERIOD = 10
"""Control steps of a period of the trot."""
TROT = 2.0e-8
"""Volume by which it swings and stretches a leg [m3]."""
START = 0.95
"""Gap below the feet where the search for the equilibrium begins, in distances of contact."""


class Quadruped(MobileRobot):
    """A trunk on four legs of silicone with a chamber before and one behind the axis of each.

    Equal volumes stretch a leg, different ones bend it forwards or backwards.

    Args:
        elements: quadratic beam elements of a leg.
        friction: coefficient of friction of the ground.
        slope: by how much the ground rises along x [rad].
        gravity: acceleration [m/s2].
        **options: options of `Robot`.
    """

    name = "quadruped"
    effectors = ("trunk",)
    size = 0.1
    made_of_beams = True
    goal_axes = np.array([1.0, 1.0, 0.0])
    goal_tolerance = 0.01
    mirrored_actuators = (2, 3, 0, 1, 6, 7, 4, 5)
    view = View(turned=True, at_rest=True, follows=0, way=2.0)
    workspace_scale = 0.04

    def __init__(
        self,
        *,
        elements: int = 4,
        friction: float = 0.8,
        slope: float = 0.0,
        gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
        **options: Any,
    ) -> None:
        super().__init__(gravity=gravity, **options)
        if not isinstance(elements, int) or elements < 2:
            raise ValueError(f"elements = {elements!r} is out of bounds; allowed: integers from 2")
        if not (np.isfinite(friction) and friction > 0.0):
            raise ValueError(f"friction = {friction} must be finite and positive")
        steepest = math.atan(friction)
        if not abs(slope) < steepest:
            raise ValueError(
                f"slope = {slope} rad is out of bounds; allowed: below {steepest:.3g} rad, from where on a friction of "
                f"{friction:g} does not hold the robot"
            )
        self.elements = elements
        self.friction = float(friction)
        self.slope = float(slope)
        self.design_space = DesignSpace(
            DesignVariable("leg_length", 0.040, 0.080, 0.055, "m", "length of a leg"),
            DesignVariable("leg_radius", 0.006, 0.010, 0.008, "m", "radius of its section"),
            DesignVariable("stance", 0.030, 0.050, 0.042, "m", "distance of the legs from the middle, along x"),
            DesignVariable("track", 0.020, 0.035, 0.025, "m", "distance of the legs from the middle, along y"),
            DesignVariable("lean", -0.25, 0.25, 0.0, "rad", "angle by which the feet stand behind the hips"),
            DesignVariable("trunk_mass", 0.030, 0.100, 0.050, "kg", "mass of the trunk with valves and battery"),
            DesignVariable("young_modulus", 3.0e5, 1.2e6, 6.0e5, "Pa", "stiffness of the silicone", log=True),
        )
        length = self.design_space["leg_length"].baseline
        height = length + 0.5 * TRUNK_HEIGHT + START * self.contact_distance
        self.effector_rest = _turned(-self.slope) @ [0.0, 0.0, height]
        self.actuators = tuple(
            Actuator(f"{leg}_{side}", -3.0e-8, 6.0e-8, 1.5e-8, unit="m3", unilateral=False)
            for leg in LEGS
            for side in ("rear", "front")
        )
        self.effort_scale = np.full(len(self.actuators), 3.0e4)

    def assemble(self, design: Mapping[str, float]) -> MechanicalModel:
        """Put the trunk on its legs, with the feet just above the ground."""
        radius, length, mass = design["leg_radius"], design["leg_length"], design["trunk_mass"]
        lean, rise = design["lean"], _turned(-self.slope)
        reach = length * math.cos(lean) + radius * abs(math.sin(lean)) + 0.5 * TRUNK_HEIGHT
        builder = ModelBuilder(gravity=self.gravity, floating=True)
        middle = rise @ [0.0, 0.0, reach + START * self.contact_distance]
        trunk = builder.add_frame(middle, rise)
        half = np.array([design["stance"] + OVERHANG, design["track"] + OVERHANG, 0.5 * TRUNK_HEIGHT])
        builder.add_mass(trunk, mass, box_inertia(mass, half))
        inertia = 0.25 * math.pi * radius**4
        section = Section(math.pi * radius**2, (inertia, inertia), 2.0 * inertia, (0.9, 0.9))
        # The first director runs down the leg, the second one forwards.
        directors = rise @ _turned(lean) @ np.column_stack([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
        for x, y in LEGS.values():
            hip = middle + rise @ [design["stance"] * x, design["track"] * y, -0.5 * TRUNK_HEIGHT]
            places = hip + np.linspace(0.0, length, 2 * self.elements + 1)[:, None] * directors[:, 0]
            frames = [builder.add_frame(p, directors, on=trunk if k == 0 else None) for k, p in enumerate(places)]
            builder.add_element(
                Beam, frames, section=section, young_modulus=design["young_modulus"], poisson_ratio=0.45, density=1070.0
            )
        model = builder.build()
        angles = 2.0 * np.pi * np.arange(CORNERS) / CORNERS
        outline = radius * np.column_stack([np.cos(angles), np.sin(angles)])
        beams = [block for block in model.blocks if isinstance(block, Beam)]
        for leg, beam in enumerate(beams):
            for actuator, side in zip(self.actuators[2 * leg : 2 * leg + 2], (-1.0, 1.0), strict=True):
                line = beam.line(range(self.elements), (side * CHAMBER_OFFSET * radius, 0.0), model.nodes)
                model.add("a", Chamber(actuator.name, [line], math.pi * (CHAMBER_RADIUS * radius) ** 2))
            model.skins.append(tube_skin(beam, model.nodes, outline))
        model.add("e", Point("trunk", EmbeddedPoints.in_frame(trunk, np.zeros(3), model.nodes)))
        model.skins.append(box_skin(trunk, half.tolist(), model.nodes))
        return model

    def own_obstacles(self, model: MechanicalModel, design: Mapping[str, float]) -> Sequence[Obstacle]:
        normal = _turned(-self.slope)[:, 2].tolist()
        return (Plane((0.0, 0.0, 0.0), normal, friction=self.friction, name="ground"),)

    def reference_gait(self) -> np.ndarray:
        """Trot, shape (10, 8): diagonal legs swing and stretch together, the other two half a period later."""
        phase = 2.0 * np.pi * np.arange(PERIOD)[:, None] / PERIOD + np.pi * np.array([0.0, 1.0, 1.0, 0.0])
        swing, stretch = np.sin(phase), 0.5 * (1.0 + np.cos(phase))
        return TROT * np.stack([stretch - swing, stretch + swing], axis=2).reshape(PERIOD, -1)

    def steered_gait(self, turn: float, gait: np.ndarray | None = None) -> np.ndarray:
        """A gait with shorter swings, or swings backwards, on the side to which the robot turns; default the trot."""
        rear, front = np.moveaxis((self.reference_gait() if gait is None else gait).reshape(-1, len(LEGS), 2), 2, 0)
        swing, stretch = 0.5 * (front - rear), 0.5 * (front + rear)
        middle, sides = swing.mean(axis=0), np.array([y for _, y in LEGS.values()])
        swing = middle + (swing - middle) * (1.0 - 2.0 * (turn * sides).clip(min=0.0))
        return np.stack([stretch - swing, stretch + swing], axis=2).reshape(len(swing), -1)

    def reference_path(self, count: int = 30) -> np.ndarray:
        """Straight ahead by two lengths of the trunk, shape (count, 3)."""
        along = _turned(-self.slope)[:, 0]
        return self.effector_rest + np.linspace(0.0, 2.0 * self.size, count)[:, None] * along


def _turned(angle: float) -> np.ndarray:
    """Rotation about the y axis by an angle [rad], from z towards x."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
