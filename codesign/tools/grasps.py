"""Configuration of the grasps over which a design tool averages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from softgym_envs.config import Config
from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.robots.contact_aided_finger import ContactAidedFinger
from softgym_envs.robots.grasping import Grasp, GraspObject, evaluate_grasp


class GraspConfig(Config):
    """An object in front of a contact-aided finger, and how far the finger closes on it."""

    kind: Literal["plane", "hexagon", "horizontal_hexagon", "sphere"] = "plane"
    distance: float = Field(default=30.1e-3, gt=0.0, description="from the outer side of the foot to the object [m]")
    height: float = Field(default=50e-3, description="of the middle of the object above the feet [m]")
    size: float = Field(default=60e-3, gt=0.0, description="between flat sides of a prism, diameter of a sphere [m]")
    friction: float = Field(default=0.85, ge=0.0, description="between finger and object")
    self_friction: float = Field(default=0.85, ge=0.0, description="between surfaces of the finger")
    angle: float = Field(default=math.radians(30.0), gt=0.0, lt=math.pi, description="largest of the servo [rad]")
    angles: int = Field(default=40, ge=1, description="number of angles, evenly spaced")

    def evaluate(self, robot: ContactAidedFinger, design: Mapping[str, float]) -> Grasp:
        """Close a finger of a design on the object.

        Raises:
            InfeasibleDesign: if the finger cannot be built, or crosses itself or the object at rest.
            ConvergenceError: if an angle has no equilibrium.
        """
        place = {name: getattr(self, name) for name in ("kind", "distance", "height", "size", "friction")}
        found = evaluate_grasp(
            robot,
            design,
            GraspObject(**place),
            angle=self.angle,
            angles=self.angles,
            self_friction=self.self_friction,
        )
        if found.status == "infeasible":
            raise InfeasibleDesign(found.reason)
        if found.status == "no equilibrium":
            raise ConvergenceError(found.reason)
        return found
