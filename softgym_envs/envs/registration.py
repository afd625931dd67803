"""Environment IDs. A new environment of the suite is one row."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from softgym_envs.errors import unknown_name
from softgym_envs.registry import Table

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec

    from softgym_envs.envs.tasks.base import Task
    from softgym_envs.robots.base import Robot

    RobotSource = str | type[Robot] | Robot
    TaskSource = str | type[Task] | Task


@dataclass(frozen=True)
class EnvironmentRow:
    """What an environment ID stands for: a robot, a task, a time limit and default options.

    Attributes:
        robot: registry name, ``"module:class"``, class or object; None if it must be passed to ``gymnasium.make``.
        task: registry name, ``"module:class"``, class or object.
        max_episode_steps: time limit.
        backend: name of the backend; None for the surrogate where weights ship for the robot, else FEM.
        robot_options: options of the robot.
        task_options: options of the task.
        backend_options: options of that backend; those of `backends.time_steps.shared_options` also of all others that
            take them, and of no backend that does not.
        plant: how the robot differs from its model, as the option of environments.
    """

    robot: RobotSource | None
    task: TaskSource
    max_episode_steps: int
    backend: str | None = None
    robot_options: Mapping[str, Any] = field(default_factory=dict)
    task_options: Mapping[str, Any] = field(default_factory=dict)
    backend_options: Mapping[str, Any] = field(default_factory=dict)
    plant: Mapping[str, Any] = field(default_factory=dict)

    @property
    def defaults(self) -> dict[str, Any]:
        """Default options in the form in which environments take them.

        They are passed as one option because ``gymnasium.make`` replaces whole mappings: the user's ``robot_options``
        would otherwise replace all of these.
        """
        options = ("robot_options", "task_options", "backend_options", "plant")
        return {"defaults": {"backend": self.backend, **{name: dict(getattr(self, name)) for name in options}}}

    def spec(self, id: str) -> EnvSpec:
        """Return Gymnasium's specification of the environment, under an ID."""
        from gymnasium.envs.registration import EnvSpec

        return EnvSpec(
            id=id,
            entry_point="softgym_envs.envs.env:SoftRobotEnv",
            vector_entry_point="softgym_envs.envs.parallel:make_batch",
            max_episode_steps=self.max_episode_steps,
            kwargs={"robot": self.robot, "task": self.task, "backend": self.backend, **self.defaults},
        )


def environment_row(
    robot: str, task: str, max_episode_steps: int, backend: str = "surrogate", **options: Any
) -> EnvironmentRow:
    """Return the row of an environment that runs on the surrogate by default; see `EnvironmentRow`."""
    return EnvironmentRow(robot, task, max_episode_steps, backend, **options)


DYNAMIC = {"dynamics": True}

ENVIRONMENTS: dict[str, EnvironmentRow] = {
    "SoftGym/FingerReach-v0": environment_row("finger", "reach", 50),
    "SoftGym/FingerTrack-v0": environment_row("finger", "track", 100),
    "SoftGym/DiamondReach-v0": environment_row("diamond", "reach", 50),
    # Without cables that push, part of the published circle is out of reach.
    "SoftGym/DiamondTrack-v0": environment_row("diamond", "track", 100, robot_options={"unilateral": False}),
    "SoftGym/CableTrunkReach-v0": environment_row("cable_trunk", "reach", 50),
    "SoftGym/CableTrunkTrack-v0": environment_row("cable_trunk", "track", 100),
}
"""All environments of a robot with a task, by ID; `register_environment` and installed packages add to them."""

INSTALLED = Table("table of environments", {}, group="softgym_envs.environments")
"""Tables like `ENVIRONMENTS` of installed packages: their entry points are ``name = "module:rows"``."""


GENERIC_ENVIRONMENTS: dict[str, EnvironmentRow] = {
    "SoftGym/Reach-v0": EnvironmentRow(None, "reach", 50),
    "SoftGym/Track-v0": EnvironmentRow(None, "track", 100),
}
"""IDs of a task for any robot, which is an option: ``gymnasium.make("SoftGym/Reach-v0", robot=MyRobot)``."""


def find_row(id: str) -> EnvironmentRow:
    """Return the row of an environment ID.

    Raises:
        ValueError: for an unknown ID.
    """
    row = ENVIRONMENTS.get(id) or GENERIC_ENVIRONMENTS.get(id)
    if row is None:
        raise ValueError(unknown_name("environment", id, [*ENVIRONMENTS, *GENERIC_ENVIRONMENTS]))
    return row


def register_environment(
    id: str,
    *,
    robot: RobotSource,
    task: TaskSource,
    max_episode_steps: int | None = None,
    backend: str | None = None,
    robot_options: Mapping[str, Any] | None = None,
    task_options: Mapping[str, Any] | None = None,
    backend_options: Mapping[str, Any] | None = None,
) -> None:
    """Register an environment ID of your own with Gymnasium, the command line and studies.

    In other processes the ID exists only if they import the module that registers it.

    Args:
        id: such as ``"MyLab/ArmReach-v0"``.
        robot: registry name, ``"module:class"``, class or object.
        task: registry name, ``"module:class"``, class or object.
        max_episode_steps: time limit; default that of the task.
        backend: name of the backend; None for the surrogate where weights ship for the robot, else FEM.
        robot_options: options of the robot.
        task_options: options of the task.
        backend_options: options of the backend.

    Raises:
        ValueError: for an ID that is taken or an unknown robot or task.
    """
    import gymnasium

    from softgym_envs.envs.tasks.registry import TASKS
    from softgym_envs.robots.registry import ROBOTS

    if id in gymnasium.registry:
        raise ValueError(f"environment '{id}' is already registered")
    ROBOTS.class_of(robot)
    kind = TASKS.class_of(task)
    steps = kind.max_episode_steps if max_episode_steps is None else max_episode_steps
    row = EnvironmentRow(robot, task, steps, backend, robot_options or {}, task_options or {}, backend_options or {})
    _register(row.spec(id))
    ENVIRONMENTS[id] = row


def register_environments() -> None:
    """Register all rows with Gymnasium, those of installed packages included.

    Raises:
        ValueError: for an ID that two packages claim.
    """
    import gymnasium

    for name, rows in INSTALLED.items():
        for id, row in rows.items():
            if ENVIRONMENTS.setdefault(id, row) is not row:
                raise ValueError(f"environment '{id}' of {INSTALLED.place(name)} is already registered: rename it")
    for id, row in {**ENVIRONMENTS, **GENERIC_ENVIRONMENTS}.items():
        if id not in gymnasium.registry:
            _register(row.spec(id))


def _register(spec: EnvSpec) -> None:
    import gymnasium

    gymnasium.register(
        id=spec.id,
        entry_point=spec.entry_point,
        vector_entry_point=spec.vector_entry_point,
        max_episode_steps=spec.max_episode_steps,
        # The tests run Gymnasium's checks. In Gymnasium 1.4, the passive ones fail in the step after a first reset that
        # refused a design.
        disable_env_checker=True,
        kwargs=spec.kwargs,
    )
