"""Metrics of grasps: a contact-aided finger closes on objects, over which metrics are averaged."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, TypeAdapter

from softgym_envs.codesign.metrics.metric import metric
from softgym_envs.codesign.metrics.sources import Source, needs_fem
from softgym_envs.config import Config
from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.extensions.grasping.grasps import Grasp, GraspObject, evaluate_grasp
from softgym_envs.extensions.grasping.robots.contact_aided_finger import ContactAidedFinger

if TYPE_CHECKING:
    from softgym_envs.extensions.design.bodies import Body
    from softgym_envs.robots.base import Robot


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


_GRASPS: TypeAdapter[tuple[GraspConfig, ...]] = TypeAdapter(Annotated[tuple[GraspConfig, ...], Field(min_length=1)])


def _settings(data: Any) -> tuple[GraspConfig, ...]:
    return (GraspConfig(),) if data is None else _GRASPS.validate_python(data)


def _refuse(robot: Robot, backend: str) -> str:
    lacking = "" if isinstance(robot, ContactAidedFinger) else f"robot 'contact_aided_finger', got '{robot.name}'"
    return needs_fem(robot, backend) or lacking


def _close(body: Body) -> list[Grasp]:
    assert isinstance(body.robot, ContactAidedFinger)
    return [grasp.evaluate(body.robot, body.variables) for grasp in body.settings["grasps"]]


GRASPS = Source("grasps", _close, _refuse, _settings)
"""All grasps of a contact-aided finger; their settings are a list of `GraspConfig`."""


@metric("N", "maximize", GRASPS)
def grip_force(grasps: Sequence[Grasp]) -> float:
    """Return the largest force on the object along x (thesis, eq. 3.10), the mean over the grasps."""
    return sum(grasp.contact_force for grasp in grasps) / len(grasps)


@metric("m", "minimize", GRASPS)
def grip_resistance(grasps: Sequence[Grasp]) -> float:
    """Return the smallest torque per force on the object (thesis, eq. 3.11), the mean over the grasps."""
    return sum(grasp.grasp_resistance for grasp in grasps) / len(grasps)


@metric("N m", "minimize", GRASPS)
def grip_energy(grasps: Sequence[Grasp]) -> float:
    """Return the sum of torque times angle over all angles (thesis, eq. 3.13), the mean over the grasps."""
    return sum(grasp.grasp_energy for grasp in grasps) / len(grasps)
