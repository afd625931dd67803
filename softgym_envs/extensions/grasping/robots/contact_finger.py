"""One finger whose contact points are tied to a driven frame: the building block of grippers.

A finger that holds a rigid object (thesis, sec. 4.3.2) touches it at three points, whose triangle stays rigid. Eight
numbers therefore describe its state: the shortening of its two cables and the pose of the triangle. When all eight are
driven, the finger's energy is a function of them, and its derivatives are the tensions of the cables and the wrench
that the object exerts. The energy of a gripper of rotated and shifted copies is the sum of such functions
(`softgym_envs.extensions.grasping.held_fingers`), so one learned model serves every finger of every gripper.

That energy is not convex. A finger that is pulled and pushed at once is stable while its cables and pose are held, or
in a gripper, but would buckle under constant forces: under random commands, two thirds of the fingers of the
three-finger gripper have a ``W`` between actuators that is not positive definite.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from softgym_envs.extensions.beams.pose import Pose
from softgym_envs.extensions.grasping.robots.grippers import STRAIGHT, FingerRobot
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.base import Actuator
from softgym_envs.robots.capabilities import Learning
from softgym_envs.robots.soft_finger import TIP_RADIUS


class ContactFinger(FingerRobot):
    """A two-cable finger whose three contact points are tied to a frame that is driven in all six directions.

    The actuators are the two cables, then the displacement x, y, z [m] of the frame's origin from rest and its rotation
    rx, ry, rz, the components of ``sin(angle) * axis`` [1]; see `softgym_envs.mechanics.constraints.Pose`. Their
    ranges cover 96 % of the states on paths of grippers of two to five fingers, and those of 1+1 fingers turn furthest;
    the finger that presses a button rotates further (up to 90 degrees). The effector is the tip.

    Args:
        **options: options of `FingerRobot`.
    """

    name = "contact_finger"
    effectors = ("tip",)
    placements = ((STRAIGHT, (0.0, 0.0, 0.0)),)
    cable_range = (-0.002, 0.020)
    learning = Learning(stiffness_variable="young_modulus", convex=False)
    #: Name, smallest and largest value, and unit of the coordinates of the pose.
    pose_ranges = (
        ("x", -0.011, 0.011, "m"),
        ("y", -0.010, 0.012, "m"),
        ("z", -0.004, 0.026, "m"),
        ("rx", -0.36, 0.44, "1"),
        ("ry", -0.68, 0.68, "1"),
        ("rz", -0.44, 0.44, "1"),
    )
    #: The pose depends on the cables: in the three-finger gripper its mean is about the first number, plus these slopes
    #: [1/m] times the sum and the difference of the two shortenings, ...
    pose_means = (
        ("x", 0.0, 0.0, -0.64),
        ("y", 0.001, 0.07, -0.14),
        ("z", 0.001, 0.52, -0.04),
        ("rx", 0.17, -6.8, 0.4),
        ("ry", 0.0, 0.5, 13.5),
        ("rz", 0.0, 0.2, -13.3),
    )
    #: ... and 99 % of the poses are within this distance of the mean.
    pose_spread = (0.0045, 0.0065, 0.0035, 0.25, 0.28, 0.16)
    #: Origin of the frame from the middle of the contact points [m]. A finger bends about a point far above
    #: them. With the origin at their middle, sideways motion and rotation are strongly correlated; with this origin, y
    #: and rx, and x and ry, are nearly independent in a gripper, so a box contains few poses that never occur.
    origin = (0.0, 0.0, 0.030)

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        pose = tuple(
            Actuator(name, low, high, 0.05 * (high - low), unit, unilateral=False)
            for name, low, high, unit in self.pose_ranges
        )
        self.actuators = (*self.actuators, *pose)
        self.effort_scale = np.array([20.0, 20.0, 2.0, 2.0, 10.0, 0.2, 0.2, 0.05])

    def object_rest(self, design: Mapping[str, float]) -> np.ndarray:
        """Return the middle of the tip."""
        return self.finger.tip(design)

    def object_frame(self, design: Mapping[str, float]) -> np.ndarray:
        """Return the origin of the frame to which the contact points are tied [m], shape (3,)."""
        return self.finger.contact_points(design).mean(axis=0) + self.origin

    def displacements(self, fractions: np.ndarray) -> np.ndarray:
        """Return cables anywhere in their ranges with poses near the mean for these cables; others do not occur."""
        found = super().displacements(fractions)
        one, other = found[:, 0], found[:, 1]
        rest, mean, skew = np.array([row[1:] for row in self.pose_means]).T
        middle = rest + np.outer(one + other, mean) + np.outer(one - other, skew)
        spread = (2.0 * fractions[:, 2:] - 1.0) * self.pose_spread
        found[:, 2:] = np.clip(middle + spread, self.lower[2:], self.upper[2:])
        return found

    def attach_object(self, model: MechanicalModel, design: Mapping[str, float], frame: int | None) -> None:
        """Tie the contact points to the frame and drive it; the effector is the tip."""
        assert frame is not None
        self.tie_contacts(model, frame)
        for component, (name, *_) in enumerate(self.pose_ranges):
            model.add("a", Pose(name, frame, component, model.nodes))
        tip, reference = self.finger.tip(design), self.finger.tip(self.finger.reference_design)
        model.add("e", Point("tip", self.material_point(model, 0, tip, reference, radius=TIP_RADIUS)))
