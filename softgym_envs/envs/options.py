"""Options that all environments share, and the robot, task and spaces that follow from them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from numbers import Integral
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.vector import AutoresetMode

from softgym_envs.backends.batch import BatchBackend
from softgym_envs.backends.one_by_one import OneByOne
from softgym_envs.backends.registry import batch_class, check_backend, make_backend, takes_option
from softgym_envs.backends.time_steps import shared_options
from softgym_envs.designs import Design, DesignSpace
from softgym_envs.envs.plant import Plants
from softgym_envs.envs.spaces import AgentSpaces
from softgym_envs.envs.tasks.base import Task
from softgym_envs.envs.tasks.registry import make_task
from softgym_envs.errors import DesignError, unknown_name
from softgym_envs.robots.base import Robot
from softgym_envs.robots.registry import make_robot
from softgym_envs.wording import brief

if TYPE_CHECKING:
    from softgym_envs.envs.registration import RobotSource, TaskSource


@dataclass(frozen=True, kw_only=True)
class EnvironmentOptions:
    """Keyword options of `SoftRobotEnv`, `SoftRobotVectorEnv` and `TorchVectorEnv`.

    Attributes:
        design: body of every episode unless `reset` gets another one; missing variables take their baseline.
        sample_design: draw the body at each reset: True for all variables, or their names.
        design_in_observation: include the body in the observation: True for all variables, or their names.
        action_mode: ``"increment"`` or ``"absolute"``, see `AgentSpaces`.
        robot_options: options of the robot.
        task_options: options of the task.
        backend_options: options of the backend; in batched environments ``weights`` and ``members``.
        plant: how the robot differs from its model: a number, or a range that each reset draws from, for attributes of
            `Plant`; ``{}`` for no difference, None for that of the environment's ID.
        defaults: options of the environment's ID, which those above override one by one; its ``backend_options`` apply
            to its ``backend`` only, except whether and how bodies move.
    """

    design: Mapping[str, float] | None = None
    sample_design: bool | Sequence[str] = False
    design_in_observation: bool | Sequence[str] = False
    action_mode: str = "increment"
    robot_options: Mapping[str, Any] | None = None
    task_options: Mapping[str, Any] | None = None
    backend_options: Mapping[str, Any] | None = None
    plant: Mapping[str, Any] | None = None
    defaults: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        for name in ("robot_options", "task_options", "backend_options", "plant"):
            value = getattr(self, name)
            if not (value is None or isinstance(value, Mapping)):
                raise ValueError(f"{name} = {brief(value)} must be a mapping from names to values")

    @classmethod
    def check(cls, options: Mapping[str, Any], *, own: Sequence[str] = ()) -> EnvironmentOptions:
        """Return the options in a mapping.

        Args:
            options: name to value.
            own: further options that a user may give the environment, for the message.

        Raises:
            ValueError: for an unknown name, or a value of the wrong kind.
        """
        names = [field.name for field in fields(cls)]
        for name in options:
            if name not in names:
                # `defaults` is not the user's: the ID of the environment fills it in.
                allowed = ["robot", "task", "backend", *own, *(each for each in names if each != "defaults")]
                raise ValueError(unknown_name("environment option", name, allowed))
        return cls(**options)


@dataclass(frozen=True)
class Setup:
    """The parts of an environment, resolved from its options.

    Attributes:
        robot: the robot.
        task: the task.
        backend: name of the backend.
        backend_options: its options.
        design: complete design of episodes for which no other body is given or sampled.
        sampled: variables that are drawn at each reset.
        shown: variables in the observation.
        action_mode: see `AgentSpaces`.
        plants: plants to draw from; None for the model itself.
    """

    robot: Robot
    task: Task
    backend: str
    backend_options: dict[str, Any]
    design: Design
    sampled: tuple[str, ...]
    shown: tuple[str, ...]
    action_mode: str
    plants: Plants | None = None

    @property
    def batched(self) -> bool:
        """Whether many of these environments step together in one call."""
        return self._batch_class is not None

    @property
    def _batch_class(self) -> type[BatchBackend] | None:
        if task_by_row(self.task) or (self.plants is not None and self.plants.change_cables):
            return None
        return batch_class(self.backend, self.robot, self.backend_options)

    def make_backend(self, count: int, *, alone: bool = False) -> BatchBackend:
        """Return the physics of ``count`` bodies, which step together where they can.

        Args:
            count: number of bodies.
            alone: each body has a backend of its own in any case.
        """
        together: Any = None if alone else self._batch_class
        if together is not None:
            made: BatchBackend = together(self.robot, np.tile(self.design.array, (count, 1)), **self.backend_options)
            return made
        make = partial(make_backend, self.backend, self.robot, **self.backend_options)
        return OneByOne(make, [self.design] * count)

    def spaces(self, *, moving: bool = False) -> AgentSpaces:
        """Return the agent's spaces; with ``moving``, observations include the effector's velocity."""
        return AgentSpaces(
            self.robot,
            action_mode=self.action_mode,
            design_names=self.shown,
            axes=self.task.axes,
            moving=moving,
            goal_scale=self.task.goal_scale,
            error_scale=self.task.error_scale,
            sensors=0 if self.task.sensors is None else self.task.sensors.count,
        )


def set_up(robot: RobotSource | None, task: TaskSource, backend: str | None, options: EnvironmentOptions) -> Setup:
    """Make the robot and the task of an environment, and resolve its other options.

    Args:
        robot: registry name, ``"module:class"``, class or object.
        task: registry name, ``"module:class"``, class or object.
        backend: name; None for the surrogate where weights ship for the robot, else FEM.
        options: all others.

    Raises:
        ValueError: for a missing robot or a wrong option.
        DesignError: for a malformed design or an unknown variable.
    """
    defaults = options.defaults or {}
    if robot is None:
        raise ValueError("robot is missing; allowed: a registered name, 'module:class', a class or an object")
    robot_options = {**defaults.get("robot_options", {}), **(options.robot_options or {})}
    made = make_robot(robot, **robot_options)
    backend_options = dict(options.backend_options or {})
    if backend is None:
        backend = default_backend(made, backend_options)
    usual = defaults.get("backend_options", {})
    if backend != defaults.get("backend"):  # of other backends, those that move bodies too do so
        usual = shared_options(usual)
    # Without motion, its options have no effect; some backends always move bodies, in steps of their own.
    if backend_options.get("dynamics", True) is False or not takes_option(backend, made, "dynamics"):
        usual = {name: value for name, value in usual.items() if name not in shared_options(usual)}
    backend_options = {**usual, **backend_options}
    check_backend(backend, made, backend_options)
    space = made.design_space
    plant = defaults.get("plant") if options.plant is None else options.plant
    if plant:
        plant = {name: backend_options[name] for name in ("cable_friction",) if name in backend_options} | {**plant}
        if "cable_compliance" in backend_options and "cable_compliance" not in plant:
            stretch = np.broadcast_to(backend_options["cable_compliance"], (len(made.actuators),)).tolist()
            plant["cable_compliance"] = dict(zip((a.name for a in made.actuators), stretch, strict=True))
    return Setup(
        robot=made,
        task=make_task(task, made, **{**defaults.get("task_options", {}), **(options.task_options or {})}),
        backend=backend,
        backend_options=backend_options,
        design=_fixed_design(space, options.design),
        sampled=design_names(space, options.sample_design, "sample_design"),
        shown=design_names(space, options.design_in_observation, "design_in_observation"),
        action_mode=options.action_mode,
        plants=Plants.check(plant or None, made, backend, moving=bool(backend_options.get("dynamics", False))),
    )


def default_backend(robot: Robot, backend_options: Mapping[str, Any]) -> str:
    """Return ``"surrogate"`` where weights are given or ship for the robot, else ``"fem"``."""
    from softgym_envs.surrogate.pretrained import ships_weights

    return "surrogate" if "weights" in backend_options or ships_weights(robot) else "fem"


def _fixed_design(space: DesignSpace, design: Mapping[str, float] | None) -> Design:
    """Return the body of all episodes.

    Raises:
        DesignError: for a malformed design, or a list of them.
    """
    if isinstance(design, list | tuple) and design and isinstance(design[0], Mapping):
        raise DesignError(
            f"design is one body for all episodes, got {len(design)}; give a body for each sub-environment in "
            "reset(options={'design': [...]})"
        )
    return space.complete(design)


def design_names(space: DesignSpace, choice: bool | Sequence[str], option: str) -> tuple[str, ...]:
    """Return the variables in an option that is False, True (all variables) or a list of names.

    Raises:
        DesignError: for an unknown or repeated name, or another kind of value.
    """
    if isinstance(choice, bool):
        return space.names if choice else ()
    if isinstance(choice, str) or not isinstance(choice, Iterable):
        example = choice if isinstance(choice, str) else space.names[0]
        raise DesignError(f"{option} = {choice!r} must be True, False or a list of names, such as [{example!r}]")
    if not all(isinstance(name, str) for name in choice):
        raise DesignError(f"{option} = {brief(choice)} must be True, False or a list of names")
    names = tuple(space[name].name for name in choice)
    if len(set(names)) < len(names):
        raise DesignError(f"{option} = {list(names)} must differ from each other")
    return names


def check_autoreset(mode: AutoresetMode | str) -> AutoresetMode:
    """Return the mode of a name, such as ``"NextStep"``.

    Raises:
        ValueError: for an unknown name.
    """
    try:
        return AutoresetMode(mode)
    except ValueError:
        allowed = ", ".join(repr(other.value) for other in AutoresetMode)
        raise ValueError(f"autoreset_mode = {mode!r} is unknown; allowed: {allowed}") from None


def take_reset_mask(options: Mapping[str, Any] | None, count: int) -> tuple[np.ndarray, dict[str, Any]]:
    """Return which of ``count`` sub-environments to reset (indices), and the options without ``reset_mask``.

    Raises:
        ValueError: for a mask of another kind, or one without True.
    """
    rest = dict(options or {})
    mask = np.asarray(rest.pop("reset_mask", np.ones(count, dtype=bool)))
    if mask.shape != (count,) or mask.dtype != bool or not mask.any():
        raise ValueError(f"reset_mask must be {count} booleans, at least one of them True, got {mask.tolist()}")
    return np.flatnonzero(mask), rest


def check_seeds(seed: int | Sequence[int | None] | None, count: int) -> list[int | None]:
    """Return the seeds of ``count`` sub-environments, as Python's integers: an integer stands for it and the next ones.

    Raises:
        ValueError: for another number of seeds, or one that is neither None nor a non-negative integer.
    """
    many = isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str)
    seeds: list[Any] = list(seed) if many else [seed]  # type: ignore[arg-type]
    if not all(one is None or (isinstance(one, Integral) and int(one) >= 0) for one in seeds):
        raise ValueError(f"seed = {seed!r} must be a non-negative integer, None or a list of {count} of them")
    if many and len(seeds) != count:
        raise ValueError(f"seed must be an integer, None or a list of {count}, got {len(seeds)} seeds")
    integers = [None if one is None else int(one) for one in seeds]
    if many:
        return integers
    return [None if integers[0] is None else integers[0] + k for k in range(count)]


def check_reset_options(options: Mapping[str, Any] | None) -> tuple[Any, Any]:
    """Return ``design`` and ``goal`` from the options of `reset`; None where missing.

    Raises:
        ValueError: for an unknown option, or anything but a mapping.
    """
    if options is not None and not isinstance(options, Mapping):
        raise ValueError(f"options of reset = {brief(options)} must be a mapping of 'design' and 'goal', or None")
    options = options or {}
    for name in options:
        if name not in ("design", "goal"):
            raise ValueError(f"unknown reset option '{name}'; allowed: design, goal")
    return options.get("design"), options.get("goal")


def check_design_option(design: Any, count: int) -> list[Any] | None:
    """Return the bodies of ``count`` sub-environments from the option ``design`` of `reset`; None for the same body.

    Raises:
        ValueError: unless it is None, one mapping or a list of ``count``.
    """
    if design is None or isinstance(design, Mapping):
        return None
    if not isinstance(design, Sequence) or isinstance(design, str):
        raise ValueError(f"design must be one body or a list of {count}, got {design!r}")
    if len(design) != count:
        raise ValueError(f"design must be one body or a list of {count}, got {len(design)}")
    return list(design)


def complete_bodies(
    space: DesignSpace,
    design: Mapping[str, float] | Sequence[Mapping[str, float]],
    base: Mapping[str, float],
    rows: np.ndarray,
) -> np.ndarray:
    """Return bodies of sub-environments, shape (len(rows), len(space)).

    Args:
        space: design space of the robot.
        design: one body, or one for each row.
        base: values of variables that are missing.
        rows: numbers of the sub-environments.

    Raises:
        DesignError: for a malformed body, with its row where there are several.
    """
    if isinstance(design, Mapping):
        return np.tile(space.complete(design, base).array, (len(rows), 1))
    bodies = np.empty((len(rows), len(space)))
    for k, (row, body) in enumerate(zip(rows.tolist(), design, strict=True)):
        try:
            bodies[k] = space.complete(body, base).array
        except DesignError as error:
            raise DesignError(f"sub-environment {row}: {error}") from None
    return bodies


def check_counts(num_envs: int, max_episode_steps: int | None) -> None:
    """Raise ValueError for numbers of sub-environments or steps that are not positive integers."""
    limit = 1 if max_episode_steps is None else max_episode_steps  # None is no limit
    for name, value in (("num_envs", num_envs), ("max_episode_steps", limit)):
        if not isinstance(value, Integral) or isinstance(value, bool) or value < 1:
            raise ValueError(f"{name} = {value!r} must be an integer of at least 1")


def task_by_row(task: Task) -> str:
    """Return what a task does with single bodies rather than with arrays of many, for a message; empty for nothing."""
    if task.load is not None:
        return "pushes the robot"
    if task.sensors is not None:
        return "shows sensors"
    return "reads whole mechanical states" if task.needs_state else ""
