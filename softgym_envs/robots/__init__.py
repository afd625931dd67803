"""Robots: one readable file each, and a registry to add your own."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.robots.base import Actuator as Actuator
    from softgym_envs.robots.base import Robot as Robot
    from softgym_envs.robots.capabilities import Learning as Learning
    from softgym_envs.robots.gmsh_robot import GmshRobot as GmshRobot
    from softgym_envs.robots.registry import ROBOTS as ROBOTS

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "base": ["Actuator", "Robot"],
        "capabilities": ["Learning"],
        "gmsh_robot": ["GmshRobot"],
        "registry": ["ROBOTS"],
    },
)
