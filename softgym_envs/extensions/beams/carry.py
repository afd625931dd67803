"""Carry: move the effector as far to the right as possible."""

from __future__ import annotations

import numpy as np

from softgym_envs.envs.arrays import Array, namespace
from softgym_envs.envs.tasks.base import Kinematics, Load, Random, Task, check_force, check_length
from softgym_envs.robots.base import Robot


class RandomPush(Load):
    """A push on the effector in a random direction.

    Args:
        largest: largest force [N]; each is drawn uniformly.
        steps: control steps that it lasts.
        window: it begins at a random step among this many first control steps.
    """

    def __init__(self, largest: float, steps: int, window: int) -> None:
        self.largest, self.steps, self.window = largest, steps, window
        self._force, self._first = np.zeros(3), 0

    def begin(self, rng: np.random.Generator) -> None:
        direction = rng.standard_normal(3)
        self._force = rng.uniform(0.0, self.largest) * direction / np.linalg.norm(direction)
        self._first = int(rng.integers(self.window))

    def at(self, step: int) -> np.ndarray | None:
        return self._force if self._first <= step < self._first + self.steps else None


class Carry(Task):
    """A goal far to the right (+x) that slow motions do not reach; only x counts (thesis, sec. 5.3).

    With a mass at the effector, momentum may carry it further than a straight motion to the goal. An episode succeeds
    if the effector ends beyond the goal or within the robot's goal tolerance of it; the reward goes on growing beyond.

    Args:
        robot: the robot.
        distance: how far to the right of the rest position the goal is [m].
        push: largest force on the effector [N] of a push in a random direction; 0 for none.
        push_steps: control steps that a push lasts.
        push_window: the push begins at a random step among this many first control steps.
    """

    name = "carry"
    horizon = 1

    def __init__(
        self,
        robot: Robot,
        *,
        distance: float = 0.1,
        push: float = 0.0,
        push_steps: int = 4,
        push_window: int = 40,
    ) -> None:
        super().__init__(robot)
        check_length(distance, "distance", robot)
        if not (np.isfinite(push) and push >= 0.0):
            raise ValueError(f"push = {push} N must be non-negative and finite")
        check_force(push, "push", robot)
        if push_steps < 1 or push_window < 1:
            raise ValueError(f"push_steps = {push_steps} and push_window = {push_window} must be at least 1")
        self.axes = np.array([1.0, 0.0, 0.0])
        self.goal: Array = robot.effector_rest + np.array([distance, 0.0, 0.0])
        self.load = RandomPush(push, push_steps, push_window) if push > 0.0 else None

    def sample(self, rng: Random, count: int, kinematics: Kinematics) -> Array:
        return namespace(self.goal).tile(self.goal, (count, 1, 1))

    def distance(self, effector: Array, goal: Array) -> Array:
        return (goal[..., 0] - effector[..., 0]).clip(min=0.0)

    def reward_terms(self, distance: Array, effort_share: Array) -> dict[str, Array]:
        """Return the factors of the reward, each in [0, 1].

        * **distance term**: `0.5 (1 - d / sqrt(d^2 + s^2))`, where `d` is how far the effector falls short of the goal
          along x, negative beyond it, and `s` is the robot's `workspace_scale`. It is 0.5 at the goal and grows all the
          way to the right.
        * **effort term**: `1 - 0.05 * mean effort / scale`.

        Args:
            distance: goal minus effector along x [m], negative beyond the goal, shape (...).
            effort_share: mean actuator effort over its scale, shape (...).
        """
        scale = self.robot.workspace_scale
        ahead = 0.5 - 0.5 * distance / namespace(distance).sqrt(distance * distance + scale * scale)
        return {"distance": ahead, "effort": super().reward_terms(distance, effort_share)["effort"]}

    def rate(self, effector: Array, goal: Array, effort_share: Array) -> tuple[Array, dict[str, Array], Array]:
        shortfall = goal[..., 0] - effector[..., 0]
        terms = self.reward_terms(shortfall, effort_share)
        return shortfall.clip(min=0.0), terms, self.reward(terms)
