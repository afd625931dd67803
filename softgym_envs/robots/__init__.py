"""Robots: one readable file each. A new robot needs its file and one row in `ROBOTS`."""

from __future__ import annotations

import inspect
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from softgym_envs.robots.robot import Robot

__all__ = ["ROBOTS", "make_robot"]

ROBOTS: dict[str, str] = {
    "finger": "softgym_envs.robots.soft_finger:SoftFinger",
}
"""Registry: name to ``module:class``, imported when used."""


def make_robot(name: str, **options: object) -> Robot:
    """Return a robot by its registry name.

    Raises:
        ValueError: for an unknown name or a wrong option.
    """
    if name not in ROBOTS:
        raise ValueError(f"unknown robot '{name}'; allowed: {', '.join(ROBOTS)}")
    module, _, name_of_class = ROBOTS[name].partition(":")
    cls = getattr(import_module(module), name_of_class)
    try:
        inspect.signature(cls).bind(**options)
    except TypeError as error:
        raise ValueError(f"robot '{name}': {error}") from None
    return cls(**options)
