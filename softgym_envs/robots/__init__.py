"""Robots: one readable file each, and a registry to add your own."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.robots.base import Actuator as Actuator
    from softgym_envs.robots.base import MeshedRobot as MeshedRobot
    from softgym_envs.robots.base import Robot as Robot
    from softgym_envs.robots.cable_trunk import CableTrunk as CableTrunk
    from softgym_envs.robots.contact_finger import ContactFinger as ContactFinger
    from softgym_envs.robots.diamond import Diamond as Diamond
    from softgym_envs.robots.geometry.export import export_body as export_body
    from softgym_envs.robots.geometry.moulds import export_moulds as export_moulds
    from softgym_envs.robots.grippers import PressFinger as PressFinger
    from softgym_envs.robots.grippers import ThreeFingerGripper as ThreeFingerGripper
    from softgym_envs.robots.grippers import TwoFingerGripper as TwoFingerGripper
    from softgym_envs.robots.registry import ROBOTS as ROBOTS
    from softgym_envs.robots.registry import make_robot as make_robot
    from softgym_envs.robots.registry import register_robot as register_robot
    from softgym_envs.robots.sensorized_finger import SensorizedFinger as SensorizedFinger
    from softgym_envs.robots.soft_finger import SoftFinger as SoftFinger
    from softgym_envs.robots.stiff_flop import StiffFlop as StiffFlop
    from softgym_envs.robots.tetrapod import Tetrapod as Tetrapod

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "base": ["Actuator", "MeshedRobot", "Robot"],
        "cable_trunk": ["CableTrunk"],
        "contact_finger": ["ContactFinger"],
        "diamond": ["Diamond"],
        "geometry.export": ["export_body"],
        "geometry.moulds": ["export_moulds"],
        "grippers": ["PressFinger", "ThreeFingerGripper", "TwoFingerGripper"],
        "registry": ["ROBOTS", "make_robot", "register_robot"],
        "sensorized_finger": ["SensorizedFinger"],
        "soft_finger": ["SoftFinger"],
        "stiff_flop": ["StiffFlop"],
        "tetrapod": ["Tetrapod"],
    },
)
