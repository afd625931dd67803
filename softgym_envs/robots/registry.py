"""The table of robots. A new robot of the suite needs its own file and one row here."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from softgym_envs.registry import Registry

if TYPE_CHECKING:
    from softgym_envs.robots.base import Robot

ROBOTS = Registry(
    "robot",
    {
        "finger": "softgym_envs.robots.soft_finger:SoftFinger",
        "diamond": "softgym_envs.robots.diamond:Diamond",
        "cable_trunk": "softgym_envs.robots.cable_trunk:CableTrunk",
    },
    base="softgym_envs.robots.base:Robot",
    group="softgym_envs.robots",
)
"""All robots by name: those of the suite, of installed packages, and those added by `register_robot`."""


def make_robot(robot: str | type[Robot] | Robot, **options: object) -> Robot:
    """Return a robot.

    Args:
        robot: registered name, path ``"module:class"``, class, or a robot, which is returned unchanged.
        **options: options of the robot, see its class.

    Raises:
        ValueError: for an unknown name, or an unknown, missing or wrong option.
    """
    return ROBOTS.make(robot, **options)


def register_robot(name_or_class: Any = None, robot: str | type[Robot] | None = None) -> Any:
    """Make a robot of your own available by name, to environments, studies and the command line.

    Used as a decorator (``@register_robot`` or ``@register_robot("arm")``) or as a call (``register_robot(Arm)``,
    ``register_robot("arm", Arm)``, ``register_robot("arm", "my_package.arm:Arm")``). Worker
    processes do not run your script: use the path ``"my_package.arm:Arm"`` as the robot's name there, or list the
    robots of your package as entry points of the group ``softgym_envs.robots``.

    Args:
        name_or_class: name, or a class whose attribute ``name`` is the name.
        robot: the class, or ``"module:class"`` to import it when it is used.

    Returns:
        The class, or a decorator that takes the class.

    Raises:
        ValueError: for a class that is not a robot or has no name, or a name that belongs to another robot.
    """
    return ROBOTS.register(name_or_class, robot)
