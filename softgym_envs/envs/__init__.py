"""Environments: a robot, a task and a backend behind the Gymnasium interface, one at a time or many at once."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.envs.env import SoftRobotEnv as SoftRobotEnv
    from softgym_envs.envs.tasks.base import Task as Task

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "env": ["SoftRobotEnv"],
        "tasks.base": ["Task"],
    },
)
