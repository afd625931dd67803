"""The crawler: a soft body with four soft legs that lies flat on the ground, after the multigait soft robot.

Shepherd et al. (2011) cast it in silicone on a layer that bends and does not stretch, with a network of chambers in the
body and in each leg. A chamber under pressure curls its part downwards, so that the robot arches and creeps along x.
Length and plan are those of the model of that robot in SofaGym (Schegg et al. 2023).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.extensions.beams.chamber import Chamber
from softgym_envs.extensions.beams.skins import tube_skin
from softgym_envs.extensions.walkers.robots.mobile import MobileRobot
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.contact.obstacles import Obstacle, Plane
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.actuator import Actuator
from softgym_envs.robots.capabilities import View

LEGS = {"front_left": (1.0, 1.0), "front_right": (1.0, -1.0), "rear_left": (-1.0, 1.0), "rear_right": (-1.0, -1.0)}
"""Sides of the legs, along x and y."""
BODY_WIDTH = 25e-3
"""[m]."""
LEG_OFFSET = 10.7e-3
"""Distance of the roots of the legs from the middle plane [m]."""
LAYER, LAYER_MODULUS = 1e-3, 5e6
"""Thickness [m] and Young's modulus [Pa] of the layer that hardly stretches."""
CHAMBER_WIDTH, CHAMBER_HEIGHT = 0.6, 0.5
"""Sides of the chambers, in widths and heights of their part; they lie in the middle of its height."""
PERIOD = 25
"""Control steps of a period of the undulation."""
START = 0.95
"""Gap below the robot where the search for the equilibrium begins, in distances of contact."""


class Crawler(MobileRobot):
    """A body with two legs in front and two behind, with a chamber in each, above a layer that hardly stretches.

    Growing chambers bend their parts downwards.

    Args:
        elements: quadratic beam elements of the body, an even number, and of each leg.
        friction: coefficient of friction of the ground.
        gravity: acceleration [m/s2].
        contact_distance: gap to the ground below which there are forces [m].
        **options: options of `Robot`.
    """

    name = "crawler"
    effectors = ("middle",)
    size = 0.135
    made_of_beams = True
    goal_axes = np.array([1.0, 1.0, 0.0])
    goal_tolerance = 0.01
    mirrored_actuators = (0, 2, 1, 4, 3)
    workspace_scale = 0.04

    def __init__(
        self,
        *,
        elements: int = 2,
        friction: float = 0.7,
        gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
        contact_distance: float = 1e-3,
        **options: Any,
    ) -> None:
        super().__init__(gravity=gravity, contact_distance=contact_distance, **options)
        if not isinstance(elements, int) or elements < 2 or elements % 2:
            raise ValueError(f"elements = {elements!r} is out of bounds; allowed: even integers from 2")
        if not (np.isfinite(friction) and friction > 0.0):
            raise ValueError(f"friction = {friction} must be finite and positive")
        self.elements = elements
        self.friction = float(friction)
        self.view = View(turned=True, at_rest=True, follows=4 * elements, way=0.3)
        self.design_space = DesignSpace(
            DesignVariable("body_length", 0.040, 0.080, 0.059, "m", "length of the body between the roots of the legs"),
            DesignVariable("leg_length", 0.030, 0.060, 0.0405, "m", "length of a leg"),
            DesignVariable("leg_angle", 0.10, 0.80, 0.35, "rad", "angle of the legs with x, seen from above"),
            DesignVariable("leg_width", 0.010, 0.018, 0.013, "m", "width of a leg"),
            DesignVariable("height", 0.007, 0.012, 0.009, "m", "height of body and legs"),
            DesignVariable("young_modulus", 4.0e4, 2.0e5, 7.0e4, "Pa", "stiffness of the silicone", log=True),
        )
        self.effector_rest = np.array([0.0, 0.0, START * self.contact_distance])
        self.actuators = tuple(
            Actuator(name, 0.0, high, high / 10.0, unit="m3", unilateral=False)
            for name, high in (("body", 3.5e-7), *((leg, 1.8e-7) for leg in LEGS))
        )
        self.effort_scale = np.full(len(self.actuators), 3.0e4)

    def assemble(self, design: Mapping[str, float]) -> MechanicalModel:
        """Lay the robot on the ground, along x, with its middle above the origin."""
        half, height, modulus = 0.5 * design["body_length"], design["height"], design["young_modulus"]
        width, angle = design["leg_width"], design["leg_angle"]
        axis = neutral_height(height, modulus)
        middle = np.array([0.0, 0.0, axis + START * self.contact_distance])
        builder = ModelBuilder(gravity=self.gravity, floating=True)
        steps = np.linspace(0.0, 1.0, 2 * self.elements + 1)
        body = [builder.add_frame(middle + [place, 0.0, 0.0]) for place in half * (2.0 * steps - 1.0)]
        material: dict[str, Any] = {"young_modulus": modulus, "poisson_ratio": 0.45, "density": 1070.0}
        builder.add_element(Beam, body, section=layered(BODY_WIDTH, height, modulus), **material)
        for x, y in LEGS.values():
            along = np.array([x * math.cos(angle), y * math.sin(angle), 0.0])
            directors = np.column_stack([along, np.cross([0.0, 0.0, 1.0], along), [0.0, 0.0, 1.0]])
            root = middle + [x * half, y * LEG_OFFSET, 0.0]
            hub = body[-1] if x > 0.0 else body[0]
            frames = [
                builder.add_frame(root + place * along, directors, on=hub if k == 0 else None)
                for k, place in enumerate(design["leg_length"] * steps)
            ]
            builder.add_element(Beam, frames, section=layered(width, height, modulus), **material)
        model = builder.build()
        beams = [block for block in model.blocks if isinstance(block, Beam)]
        for actuator, beam, wide in zip(self.actuators, beams, [BODY_WIDTH, *4 * [width]], strict=True):
            line = beam.line(range(self.elements), (0.0, 0.5 * height - axis), model.nodes)
            area = CHAMBER_WIDTH * wide * CHAMBER_HEIGHT * height
            model.add("a", Chamber(actuator.name, [line], area))
            sides = 0.5 * wide * np.array([1.0, -1.0, -1.0, 1.0])
            outline = np.column_stack([sides, np.array([height, height, 0.0, 0.0]) - axis])
            model.skins.append(tube_skin(beam, model.nodes, outline))
        model.add("e", Point("middle", EmbeddedPoints.in_frame(body[self.elements], np.zeros(3), model.nodes)))
        return model

    def own_obstacles(self, model: MechanicalModel, design: Mapping[str, float]) -> Sequence[Obstacle]:
        return (Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), friction=self.friction, name="ground"),)

    def reference_gait(self) -> np.ndarray:
        """Undulation, shape (25, 5): front legs, body and rear legs bend a quarter period one after the other."""
        lag = np.array([0.25, 0.0, 0.0, 0.5, 0.5])
        return 0.39 * self.upper * (1.0 - np.cos(2.0 * np.pi * (np.arange(PERIOD)[:, None] / PERIOD - lag)))

    def reference_path(self, count: int = 30) -> np.ndarray:
        """Straight ahead by half the robot, shape (count, 3)."""
        return self.effector_rest + np.linspace(0.0, 0.5 * self.size, count)[:, None] * [1.0, 0.0, 0.0]


def neutral_height(height: float, modulus: float) -> float:
    """Height of the axis, about which bending stretches nothing on the whole, above the bottom of the layer [m]."""
    stiff, soft = LAYER_MODULUS * LAYER, modulus * (height - LAYER)
    return (stiff * 0.5 * LAYER + soft * 0.5 * (LAYER + height)) / (stiff + soft)


def layered(width: float, height: float, modulus: float) -> Section:
    """Section of silicone on the layer, in areas and second moments of silicone alone (transformed-section method)."""
    ratio, axis = LAYER_MODULUS / modulus, neutral_height(height, modulus)
    soft, stiff = width * (height - LAYER), ratio * width * LAYER
    upright = soft * ((height - LAYER) ** 2 / 12.0 + (0.5 * (LAYER + height) - axis) ** 2)
    upright += stiff * (LAYER**2 / 12.0 + (0.5 * LAYER - axis) ** 2)
    sideways = (soft + stiff) * width**2 / 12.0
    twist = Section.rectangle(width, height - LAYER).torsion + ratio * Section.rectangle(width, LAYER).torsion
    return Section(soft + stiff, (upright, sideways), twist, (5.0 / 6.0, 5.0 / 6.0), mass_area=width * height)
