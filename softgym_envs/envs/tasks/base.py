"""The Task base class: what a robot has to do, without regard to its physics."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from operator import mul
from typing import Any, Protocol

import numpy as np

from softgym_envs.backends.backend import Ground, State
from softgym_envs.envs.arrays import Array, namespace, pick_rows
from softgym_envs.errors import ConvergenceError
from softgym_envs.quantities import check_quantity
from softgym_envs.robots.base import Robot
from softgym_envs.robots.checks import plausible_force
from softgym_envs.wording import decimal

MAX_DRAWS = 50
"""Number of goals without an equilibrium that are drawn in turn before `draw_paths` gives up."""

Kinematics = Callable[[Array], Array]
"""Maps commands (B, n_a) to the effectors that they lead to [m], shape (B, 3), for the present bodies."""


class Random(Protocol):
    """Random numbers for tasks, whose first axis is that of the episodes: each draws from a generator of its own.

    Tensors have one generator for all (`TorchVectorEnv`).
    """

    def uniform(self, low: Any, high: Any, size: Any, /) -> Array:
        """Draw uniformly between ``low`` and ``high``, shape ``size`` = (count, ...)."""

    def integers(self, low: int, *, size: Any) -> Array:
        """Draw integers from 0 to ``low - 1``, shape ``size`` = (count, ...)."""


@dataclass(frozen=True)
class DistanceScale:
    """How people read the distances of a task.

    Attributes:
        name: what a distance is called: ``"distance"`` or ``"error"``.
        unit: unit that people read.
        factor: factor to that unit from what `Task.distance` returns.
        goal_unit: unit of goals; those in metres are places, which pictures show.
    """

    name: str
    unit: str
    factor: float
    goal_unit: str = "m"

    def text(self, distance: float, digits: int = 1) -> str:
        """Return a distance with its unit: ``"3.2 mm"``, or two significant digits if it is small: ``"0.028 mm"``."""
        return f"{decimal(self.factor * distance, digits)} {self.unit}"

    def limit_text(self, distance: float) -> str:
        """Return a distance that somebody chose, without needless zeros: ``"5 mm"``."""
        return f"{self.factor * distance:g} {self.unit}"


LENGTHS = DistanceScale("distance", "mm", 1e3)
SHARES_OF_FORCES = DistanceScale("error", "%", 1e2, goal_unit="N")


def tolerance(x: Array, margin: float) -> Array:
    """Return 1 for ``x`` = 0, falling as 1 / (1 + 9 (x / margin)^2): 0.1 at ``margin``."""
    share = x / margin
    return 1.0 / (1.0 + 9.0 * share * share)


def check_goals(goals: object, name: str, robot: Robot, leading: tuple[int, ...] = ()) -> np.ndarray:
    """Return goals [m] as an array (*leading, p, 3); a single point (*leading, 3) becomes a path of one.

    Args:
        goals: points or paths of points.
        name: name of the option, for messages.
        robot: the robot that the goals are for.
        leading: expected leading shape.

    Raises:
        ValueError: for another shape, a value that is not finite or a point far from the robot.
    """
    try:
        array = np.asarray(goals, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be points [m] of shape (3,) or (p, 3), got {goals!r}") from None
    n = len(leading)
    if array.shape == (*leading, 3):
        array = array[..., None, :]
    if array.ndim != n + 2 or array.shape[:n] != leading or array.shape[-1] != 3 or array.shape[-2] == 0:
        shape = "".join(f"{size}, " for size in leading)
        raise ValueError(f"{name} must have shape ({shape}3) or ({shape}p, 3), got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got {array.tolist()}")
    return robot.check_point(name, array)


def draw_paths(
    task: Task, rows: Array, random: Callable[[Array], Random], kinematics: Callable[[Array, Array], Array]
) -> Array:
    """Return the goals that a task draws for some rows, shape (len(rows), p, 3); rows with NaN are drawn again.

    Args:
        task: the task.
        rows: numbers of the rows.
        random: returns the random numbers of some rows.
        kinematics: maps rows and their commands (B, n_a) to effectors (B, 3) [m].

    Raises:
        ValueError: for paths of a wrong shape, or goals that are infinite.
        ConvergenceError: if `MAX_DRAWS` draws in a row have NaN.
    """
    paths = _drawn(task, rows, random, kinematics)
    for _ in range(MAX_DRAWS - 1):
        lost = namespace(paths).isnan(paths).any(-1).any(-1)
        if not lost.any():
            return paths
        paths[lost] = _drawn(task, rows[lost], random, kinematics)
    raise ConvergenceError(
        f"no goal can be drawn: {MAX_DRAWS} goals in a row of task '{task.name}' are NaN, as kinematics is for "
        "commands without an equilibrium",
        fraction=0.0,
    )


def _drawn(
    task: Task, rows: Array, random: Callable[[Array], Random], kinematics: Callable[[Array, Array], Array]
) -> Array:
    paths = task.sample(random(rows), len(rows), partial(kinematics, rows))
    shape, longest = tuple(paths.shape), 1 if task.horizon == 1 else np.inf
    if len(shape) != 3 or shape[0] != len(rows) or shape[2] != 3 or not 1 <= shape[1] <= longest:
        wanted = f"({len(rows)}, {'1' if longest == 1 else 'p'}, 3)"
        raise ValueError(
            f"sample of task '{task.name}', horizon = {task.horizon}, must return paths of shape {wanted}, got {shape}"
        )
    if namespace(paths).isinf(paths).any():
        raise ValueError(f"sample of task '{task.name}' returned a goal that is infinite")
    return paths


def check_length(value: float, name: str, robot: Robot) -> float:
    """Return a length [m] that goals are moved by.

    Raises:
        ValueError: for a value that is negative, not finite or far larger than the robot.
    """
    if not (np.isfinite(value) and value >= 0.0):
        raise ValueError(f"{name} = {value} m must be non-negative and finite")
    if value > 3.0 * robot.size:
        raise ValueError(
            f"{name} = {value} m is more than three times the size of robot '{robot.name}' ({robot.size:g} m); "
            "did you mean metres?"
        )
    return value


def check_range(name: str, given: float | Sequence[float], unit: str, low: float, high: float) -> tuple[float, float]:
    """Return the ends of a range from which each episode draws, given by two numbers or by one.

    Raises:
        ValueError: for anything else, or ends out of bounds.
    """
    unit = f" {unit}" if unit else ""
    try:
        ends = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        ends = np.full(3, np.nan)
    pair = np.broadcast_to(ends, 2) if ends.shape in ((), (2,)) else np.full(2, np.nan)
    if not low <= pair[0] <= pair[1] <= high:
        raise ValueError(
            f"{name} = {given}{unit} must be a number or a range (low, high); allowed: {low:g} to {high:g}{unit}"
        )
    return float(pair[0]), float(pair[1])


def check_force(value: float, name: str, robot: Robot) -> float:
    """Return a force [N] with which a task acts on a robot, or asks of it.

    Raises:
        ValueError: for a value that is negative, not finite or far beyond what the robot's actuators can do.
    """
    check_quantity("force", value, name, high=plausible_force(robot), example=f"for robot '{robot.name}'")
    if value < 0.0:
        raise ValueError(f"{name} = {value} N must be non-negative and finite")
    return float(value)


class Load(ABC):
    """A force on the robot in some control steps of an episode. Not every backend supports it.

    Attributes:
        on_body: it acts on a point of the body, otherwise on the first effector.
    """

    on_body: bool = False

    @abstractmethod
    def begin(self, rng: np.random.Generator) -> None:
        """Draw what is random in an episode."""

    @abstractmethod
    def at(self, step: int) -> Any:
        """Return what acts during a control step, or None.

        It is a force on the effector [N], shape (3,), or with ``on_body`` a `PointForce`.
        """


class Sensors(ABC):
    """What observations show in place of displacements, efforts and the effector.

    Attributes:
        count: number of values.
        parts: for each part of the readings its size, what it is, how it is scaled and its SI unit.
    """

    count: int
    parts: tuple[tuple[int, str, str, str], ...] = ()

    @abstractmethod
    def begin(self) -> None:
        """Forget the last episode."""

    @abstractmethod
    def readings(self, state: State) -> np.ndarray:
        """Return the readings of the sensors over their scale, without noise, shape (s,); s is at most ``count``."""

    @abstractmethod
    def further(self, readings: np.ndarray, new: bool) -> np.ndarray:
        """Return the other values that observations show, in [-1, 1], shape (``count`` - s,).

        Args:
            readings: commands and readings as observed now, in [-1, 1], shape (n_a + s,).
            new: whether these are new readings, and not the last ones again.
        """


#: Smallest reward whose logarithm is followed; below, gradients would be without bound.
SMALLEST_REWARD = 1e-6


class Task(ABC):
    """What a robot has to do: a task draws goals and rates how close a state is to the present goal.

    A task sees effectors, efforts and goals in SI units, always in batches, and never a backend. `TorchVectorEnv` calls
    a copy of the task whose arrays are tensors, so `sample`, `goals`, `distance` and `reward_terms` should compute with
    ``namespace(array)`` in place of ``numpy``. Tasks that do not are limited to the other environments.

    Attributes:
        name: registry name; default the name of the class in lower case.
        horizon: control steps that a path of goals covers; afterwards the last goal holds. 1 for a single goal.
        max_episode_steps: time limit of an episode if none is given.
        lookahead: control steps by which the observed goal is ahead of the rated one.
        load: what disturbs the robot in an episode; None for nothing.
        sensors: what observations show in place of displacements, efforts and the effector; None if they show these.
        agents: agents without training that the task is compared with.
        qp_agent: the agent that ``"qp"`` stands for; another one where an inverse QP on the effector cannot follow the
            goals.
        distance_scale: how people read distances, and the unit of goals.
        tallies: what `tally` counts; such values are in ``info`` and, at the ends of episodes, in evaluations.
        needs_state: whether the task reads whole mechanical states, one after the other, since it has methods of its
            own that take one: `measure`, `state_terms` or `is_failed`.
        robot: the robot.
        wanted: goals of the present episode, for tasks that remember anything of it, shape (p, 3).
        axes: coordinates of the effector that count, 1 or 0, shape (3,).
        success_distance: distance below which a goal counts as reached [m].
        goal_scale: unit of goals and of what is compared with them in observations [m].
        error_scale: distance to the goal that is observed as one half [m].
        measured_scale: unit of the noise of what is compared with goals [m]: the robot's size.
    """

    name: str
    horizon: int = 1
    max_episode_steps: int = 100
    lookahead: int = 0
    load: Load | None = None
    sensors: Sensors | None = None
    agents: tuple[str, ...] = ("qp", "qp_model", "qp_pi", "random")
    qp_agent: str = "qp"
    distance_scale: DistanceScale = LENGTHS
    tallies: tuple[str, ...] = ()
    needs_state: bool = False

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        of_states = ("measure", "state_terms", "is_failed")
        cls.needs_state = any(getattr(cls, name) is not getattr(Task, name) for name in of_states)

    def __init__(self, robot: Robot) -> None:
        if not hasattr(self, "name"):
            self.name = type(self).__name__.lower()
        self.robot = robot
        self.wanted = np.zeros((1, 3))
        self.axes: Array = np.asarray(robot.goal_axes, dtype=float)
        self.success_distance = robot.goal_tolerance
        self.goal_scale = 1.25 * robot.size
        self.measured_scale = robot.size
        self.error_scale = robot.workspace_scale / 2.5

    @abstractmethod
    def sample(self, rng: Random, count: int, kinematics: Kinematics) -> Array:
        """Draw the goals of ``count`` episodes: paths [m], shape (count, p, 3); p = 1 for a fixed goal.

        Episodes whose goals have NaN are drawn again.

        Args:
            rng: random numbers, with a generator for each episode: their first axis is ``count``.
            count: number of episodes.
            kinematics: maps commands (count, n_a) to effectors (count, 3) [m]; NaN for commands without an equilibrium.
        """

    def goals(self, paths: Array, counts: Array, steps: Array) -> Array:
        """Return the goals [m] (B, 3) at control steps (B,) of paths (B, p, 3), which are spread over the horizon.

        Args:
            paths: goals of each episode; row b has ``counts[b] <= p`` of them.
            counts: shape (B,).
            steps: shape (B,).
        """
        if paths.shape[1] == 1:
            return paths[:, 0]
        return pick_rows(paths, namespace(steps).minimum(steps * counts // self.horizon, counts - 1))

    def check_paths(self, goals: object, leading: tuple[int, ...] = ()) -> np.ndarray:
        """Return the goals of episodes [m] as paths (*leading, p, 3).

        Raises:
            ValueError: for another shape, values that are not finite, a goal far from the robot, or a path where the
                task has a single goal.
        """
        paths = check_goals(goals, "goal", self.robot, leading)
        if self.horizon == 1 and paths.shape[-2] > 1:
            raise ValueError(f"task '{self.name}' has one goal per episode, got a path of {paths.shape[-2]}")
        return paths

    def begin(self, rng: np.random.Generator) -> None:  # noqa: B027 - optional
        """Draw whatever else is random in an episode of a single environment; nothing by default."""

    def draw_ground(self, rng: np.random.Generator) -> Ground | None:
        """Return the ground on which a robot starts an episode, drawn with ``rng``; None for its own.

        It costs an equilibrium at each reset (15 ms for the quadruped), and neither a new body nor compilation.
        """
        return None

    def record(self, state: State) -> None:  # noqa: B027 - optional
        """Take note of a state, at the start of an episode and after each control step; nothing by default."""

    def tally(self) -> dict[str, float]:
        """Return what the episode amounts to so far, by the names in `tallies` [SI]."""
        return {}

    def measure(self, state: State) -> np.ndarray:
        """Return what is compared with the goal, shape (3,): the first effector [m] unless a task overrides it."""
        return state.effector[0]

    def drawn_goals(self, state: State, path: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return path (p, 3) and goal (3,) for a picture of a state [m].

        Goals that are not places are drawn where the effector is.
        """
        if self.distance_scale.goal_unit == "m":
            return path, goal
        return state.effector[:1], state.effector[0]

    def hindsight_goals(self, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the goals (B, 3) that measured values (B, 3) would have reached, and which may be goals (B,)."""
        return measured, np.ones(len(measured), dtype=bool)

    def is_failed(self, state: State) -> bool:
        """Whether the goal can no longer be reached, which terminates the episode; never by default."""
        return False

    def state_terms(self, state: State) -> dict[str, float]:
        """Return further terms of the reward; none by default."""
        return {}

    def reward(self, terms: Mapping[str, Array]) -> Array:
        """Return the reward that terms make: their product, unless a task says otherwise."""
        return reduce(mul, terms.values())

    def distance(self, effector: Array, goal: Array) -> Array:
        """Return the distance [m] (...) of effectors to goals, each (..., 3), along the axes that count."""
        error = self.axes * (effector - goal)
        return namespace(error).sqrt((error * error).sum(axis=-1))

    def reward_terms(self, distance: Array, effort_share: Array) -> dict[str, Array]:
        """Return the factors of the reward, each in [0, 1].

        Args:
            distance: effector to goal [m], shape (...).
            effort_share: mean actuator effort over its scale, shape (...).
        """
        near, far = self._nearness(distance)
        return {"distance": 0.5 * near + 0.5 * far, "effort": 1.0 - 0.05 * effort_share.clip(0.0, 1.0)}

    def _nearness(self, distance: Array) -> tuple[Array, Array]:
        return tolerance(distance, self.success_distance), tolerance(distance, self.robot.workspace_scale)

    def log_reward(self, distance: Array, effort_share: Array) -> Array:
        """Return what learners that follow derivatives ascend: the logarithm of the reward, with a slope everywhere.

        Between the success distance and the workspace scale the reward is nearly flat. So the logarithm of a mean that
        is arithmetic in the reward, of nearness on both scales, is replaced by that of the geometric mean. At the goal
        the two agree up to the third order in the distance.

        Args:
            distance: effector to goal [m], shape (...).
            effort_share: mean actuator effort over its scale, shape (...).
        """
        near, far = self._nearness(distance)
        log = namespace(distance).log
        reward = self.reward(self.reward_terms(distance, effort_share)).clip(SMALLEST_REWARD, None)
        return log(reward) + 0.5 * log(near * far) - log(0.5 * near + 0.5 * far)

    def rate(self, effector: Array, goal: Array, effort_share: Array) -> tuple[Array, dict[str, Array], Array]:
        """Return distances to the goal [m], the terms of the reward, and the reward.

        Args:
            effector: first effector [m], shape (..., 3).
            goal: goal [m], shape (..., 3).
            effort_share: mean actuator effort over its scale, shape (...).
        """
        distance = self.distance(effector, goal)
        terms = self.reward_terms(distance, effort_share)
        return distance, terms, self.reward(terms)
