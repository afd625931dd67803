"""The table of tasks. A new task of the suite needs its own file and one row here."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from softgym_envs.registry import Registry

if TYPE_CHECKING:
    from softgym_envs.envs.tasks.base import Task
    from softgym_envs.robots.base import Robot

TASKS = Registry(
    "task",
    {
        "reach": "softgym_envs.envs.tasks.reach:Reach",
        "track": "softgym_envs.envs.tasks.track:Track",
    },
    base="softgym_envs.envs.tasks.base:Task",
    group="softgym_envs.tasks",
)
"""All tasks by name: those of the suite, of installed packages, and those added by `register_task`."""


def make_task(task: str | type[Task] | Task, robot: Robot, **options: object) -> Task:
    """Return a task for a robot.

    Args:
        task: registered name, path ``"module:class"``, class, or a task made for this robot, which is returned
            unchanged.
        robot: the robot.
        **options: options of the task, see its class.

    Raises:
        ValueError: for an unknown name, an unknown, missing or wrong option, or a task made for another robot.
    """
    made: Task = TASKS.make(task, robot, **options)
    if made.robot is not robot:
        raise ValueError(f"task '{made.name}' was made for another robot; make both with the same robot object")
    return made


def register_task(name_or_class: Any = None, task: str | type[Task] | None = None) -> Any:
    """Make a task of your own available by name, to environments, studies and the command line.

    Used as a decorator (``@register_task`` or ``@register_task("press")``) or as a call (``register_task(Press)``,
    ``register_task("press", "my_package.press:Press")``). As for `register_robot`, worker processes find the task by
    its path or by an entry point of the group ``softgym_envs.tasks``.

    Args:
        name_or_class: name, or a class whose attribute ``name`` is the name.
        task: the class, or ``"module:class"`` to import it when it is used.

    Returns:
        The class, or a decorator that takes the class.

    Raises:
        ValueError: for a class that is not a task, or a name that is missing or taken.
    """
    return TASKS.register(name_or_class, task)
