"""The interface of a task: it sees effectors, efforts and a goal, never a backend. All of it is batched."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np

from softgym_envs.registry import Registry
from softgym_envs.robots.base import Robot

__all__ = ["TASKS", "Task", "check_goals", "make_task", "tolerance"]

TASKS = Registry(
    "task",
    {
        "reach": "softgym_envs.envs.tasks.reach:Reach",
        "track": "softgym_envs.envs.tasks.track:Track",
        "carry": "softgym_envs.envs.tasks.carry:Carry",
    },
    base="softgym_envs.envs.tasks.base:Task",
    group="softgym_envs.tasks",
)
"""All tasks by name."""

Kinematics = Callable[[np.ndarray], np.ndarray]
"""Maps commands (B, n_a) to the effectors they lead to [m], shape (B, 3), for the present bodies."""


def tolerance(x: np.ndarray, bound: float, margin: float) -> np.ndarray:
    """Return 1 for ``x <= bound``, falling as 1 / (1 + 9 ((x - bound) / margin)^2): 0.1 at ``bound + margin``."""
    excess = np.maximum(x - bound, 0.0) / margin
    return 1.0 / (1.0 + 9.0 * excess * excess)


def check_goals(goals: object, name: str, leading: tuple[int, ...] = ()) -> np.ndarray:
    """Return goals [m] as an array (*leading, p, 3); a single point (*leading, 3) becomes a path of one.

    Raises:
        ValueError: for another shape or a value that is not finite.
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
    return array


class Task(ABC):
    """What a robot is to do.

    Attributes:
        name: registry name.
        axes: which coordinates of the effector count, 1 or 0, shape (3,).
        success_distance: distance below which a goal counts as reached [m].
        horizon: control steps a goal path describes; paths hold their last goal beyond it. 1 for a single goal.
    """

    #: It pushes the effector, so the backend must know forces.
    pushes = False

    name: str
    horizon: int

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.axes = np.asarray(robot.goal_axes, dtype=float)
        self.success_distance = robot.goal_tolerance

    @abstractmethod
    def sample(self, rng: np.random.Generator, count: int, kinematics: Kinematics) -> np.ndarray:
        """Draw the goals of ``count`` episodes: paths [m], shape (count, p, 3); p = 1 for a fixed goal."""

    def goals(self, paths: np.ndarray, counts: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """Goals [m] (B, 3) at control steps (B,) of paths (B, p, 3), which are spread over the horizon.

        Args:
            paths: goals of each episode; row b has ``counts[b] <= p`` of them.
            counts: shape (B,).
            steps: shape (B,).
        """
        if paths.shape[1] == 1:
            return paths[:, 0]
        index = np.minimum(steps * counts // self.horizon, counts - 1)
        return paths[np.arange(len(paths)), index]

    def check_paths(self, goals: object, leading: tuple[int, ...] = ()) -> np.ndarray:
        """Return the goals of episodes [m] as paths (*leading, p, 3).

        Raises:
            ValueError: for another shape, values that are not finite, or a path where the task has one goal.
        """
        paths = check_goals(goals, "goal", leading)
        if self.horizon == 1 and paths.shape[-2] > 1:
            raise ValueError(f"task '{self.name}' has one goal an episode, got a path of {paths.shape[-2]}")
        return paths

    def begin(self, rng: np.random.Generator) -> None:  # noqa: B027 - a hook, not a duty
        """Draw what else is random in an episode of a single environment; nothing by default."""

    def push(self, step: int) -> np.ndarray | None:
        """Force on the first effector during a control step [N], shape (3,), or None."""
        return None

    def distance(self, effector: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Distance [m] (...) of effectors to goals, each (..., 3), along the axes that count."""
        return np.linalg.norm(self.axes * (effector - goal), axis=-1)

    def reward_terms(self, distance: np.ndarray, effort_share: np.ndarray) -> dict[str, np.ndarray]:
        """Return the factors of the reward, each in [0, 1].

        Args:
            distance: effector to goal [m], shape (...).
            effort_share: mean actuator effort over its scale, shape (...).
        """
        close = 0.5 * tolerance(distance, 0.0, self.success_distance) + 0.5 * tolerance(
            distance, 0.0, self.robot.workspace_scale
        )
        return {"distance": close, "effort": 1.0 - 0.05 * np.clip(effort_share, 0.0, 1.0)}


def make_task(name: str, robot: Robot, **options: object) -> Task:
    """Return a task by its registry name.

    Raises:
        ValueError: for an unknown name or a wrong option.
    """
    return TASKS.make(name, robot, **options)
