"""Grippers whose fingers hold a rigid object by friction, and can drop it.

They have the fingers and the objects of `softgym_envs.extensions.grasping.robots.grippers`. There, ball joints tie the
object to the fingers, as published. Here the object has a mass, stands on a stand, and is held by nothing but contact.
No published scene has this, so that the first body warns of how much the linear elements of the default mesh lock.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from softgym_envs.designs import DesignVariable
from softgym_envs.extensions.beams.prism import RoundedPrism
from softgym_envs.extensions.beams.skins import box_skin
from softgym_envs.extensions.grasping.robots.grippers import STRAIGHT, TURNED, FingerRobot, ThreeFingerGripper
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.contact.obstacles import Obstacle
from softgym_envs.mechanics.elements.rigid import box_inertia
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.capabilities import Learning

ROUNDING = 2e-3
"""Radius of the edges of the objects and of the stand [m]."""
INSET = 4.5e-3
"""Distance of the stand's sides from those of the object above it [m], so that the fingers do not touch the stand."""
STAND_HEIGHT = 40e-3


class FrictionGripper(FingerRobot):
    """Fingers around a free rigid box on a stand.

    Close the fingers slowly: friction depends on the path, and each control step is one increment of it. Statics finds
    the states in which the object is at rest, on the stand or in the grip. It finds none while the object falls: then a
    step fails to converge. Use ``dynamics=True`` to see it fall.

    Args:
        friction: coefficient of friction between the object and the fingers.
        object_mass: [kg].
        stand_friction: coefficient of friction between the object and its stand.
        gravity: acceleration [m/s2].
        **options: options of `FingerRobot`.
    """

    holds_by_contact = True
    #: Pulled further, the fingers press the object so much that it turns out of the grip.
    cable_range = (0.0, 0.008)
    learning = Learning(convex=False)  # the weight of the object does not scale with Young's modulus

    def __init__(
        self,
        *,
        friction: float = 0.6,
        object_mass: float = 0.050,
        stand_friction: float = 0.4,
        gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
        **options: Any,
    ) -> None:
        for name, value in (("friction", friction), ("object_mass", object_mass), ("stand_friction", stand_friction)):
            if not (np.isfinite(value) and value >= 0.0):
                raise ValueError(f"robot '{self.name}': {name} = {value} must be finite and not negative")
        if object_mass == 0.0:
            raise ValueError(f"robot '{self.name}': object_mass = 0 kg must be positive")
        self.friction = float(friction)
        self.object_mass = float(object_mass)
        self.stand_friction = float(stand_friction)
        super().__init__(gravity=gravity, **options)

    def half_extents_of(self, design: Mapping[str, float]) -> tuple[float, float, float]:
        """Return half the size of the object [m]."""
        raise NotImplementedError

    def object_frame(self, design: Mapping[str, float]) -> np.ndarray:
        return self.object_rest(design)

    def add_object(self, assembly: ModelBuilder, design: Mapping[str, float]) -> int:
        frame = assembly.add_frame(self.object_frame(design))
        assembly.add_mass(
            frame, self.object_mass, box_inertia(self.object_mass, np.array(self.half_extents_of(design)))
        )
        return frame

    def attach_object(self, model: MechanicalModel, design: Mapping[str, float], frame: int | None) -> None:
        """Give the object its surface; the effector is its centre."""
        assert frame is not None
        self._frame = frame
        model.add("e", Point(self.effectors[0], EmbeddedPoints.in_frame(frame, np.zeros(3), model.nodes)))
        model.skins.append(box_skin(frame, self.half_extents_of(design), model.nodes, divisions=6))

    def own_obstacles(self, model: MechanicalModel, design: Mapping[str, float]) -> list[Obstacle]:
        """Return the object, which moves with its frame, and the stand below it."""
        half = self.half_extents_of(design)
        top = self.object_rest(design) - [0.0, 0.0, half[2] + 0.9 * self.contact_distance]
        stand = RoundedPrism.box(
            (half[0] - INSET, half[1] - INSET, 0.5 * STAND_HEIGHT),
            ROUNDING,
            centre=(top - [0.0, 0.0, 0.5 * STAND_HEIGHT]).tolist(),
            name="stand",
            friction=self.stand_friction,
        )
        held = RoundedPrism.box(half, ROUNDING, name=self.effectors[0], friction=self.friction, frame=self._frame)
        return [held, stand]


class TwoFingerFrictionGripper(FrictionGripper):
    """Two fingers that face each other and grasp a bar between their last segments.

    Args: as for `FrictionGripper`.
    """

    name = "two_finger_friction_gripper"
    effectors = ("bar",)
    placements = ((STRAIGHT, (0.0, 0.0, 0.0)), (TURNED, (0.0, 0.080, 0.0)))
    goal_axes = np.array([0.0, 1.0, 1.0])
    goal_tolerance = 5e-4
    half_width = 10e-3

    def variables(self) -> tuple[DesignVariable, ...]:
        """Return the variables of the finger and the length of the bar."""
        bar = DesignVariable("bar_length", 0.030, 0.0345, 0.034, "m", "length of the bar, from finger to finger")
        return (*super().variables(), bar)

    def object_rest(self, design: Mapping[str, float]) -> np.ndarray:
        """Middle of the bar, between the last segments."""
        return np.array([0.0, 0.040, -2.5 * design["length"]])

    def half_extents_of(self, design: Mapping[str, float]) -> tuple[float, float, float]:
        return self.half_width, 0.5 * design["bar_length"], self.half_width


class ThreeFingerFrictionGripper(FrictionGripper, ThreeFingerGripper):
    """Three fingers that grasp the cube of the thesis (sec. 4.3.2) by friction: one pushes along +y, two along -y.

    Args: as for `FrictionGripper`.
    """

    name = "three_finger_friction_gripper"

    def half_extents_of(self, design: Mapping[str, float]) -> tuple[float, float, float]:
        return self.half_extents
