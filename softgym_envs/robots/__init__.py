"""Robots: one readable file each. A new robot needs its file and one row in `ROBOTS`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from softgym_envs.registry import make_registered

if TYPE_CHECKING:
    from softgym_envs.robots.base import Robot

__all__ = ["ROBOTS", "make_robot"]

ROBOTS: dict[str, str] = {
    "finger": "softgym_envs.robots.soft_finger:SoftFinger",
    "diamond": "softgym_envs.robots.diamond:Diamond",
    "cable_trunk": "softgym_envs.robots.cable_trunk:CableTrunk",
    "sensorized_finger": "softgym_envs.robots.sensorized_finger:SensorizedFinger",
    "trunk": "softgym_envs.robots.stiff_flop:StiffFlop",
    "contact_finger": "softgym_envs.robots.contact_finger:ContactFinger",
    "press_finger": "softgym_envs.robots.grippers:PressFinger",
    "two_finger_gripper": "softgym_envs.robots.grippers:TwoFingerGripper",
    "tetrapod": "softgym_envs.robots.tetrapod:Tetrapod",
    "three_finger_gripper": "softgym_envs.robots.grippers:ThreeFingerGripper",
}
"""Registry: name to ``module:class``, imported when used."""


def make_robot(name: str, **options: object) -> Robot:
    """Return a robot by its registry name.

    Raises:
        ValueError: for an unknown name or a wrong option.
    """
    return make_registered("robot", ROBOTS, name, **options)
