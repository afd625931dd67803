"""Walk: go straight ahead on the ground, as fast as possible."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from softgym_envs.backends.backend import Ground, State
from softgym_envs.envs.tasks.base import Load, check_force, check_range
from softgym_envs.extensions.walkers.robots.mobile import MobileRobot
from softgym_envs.extensions.walkers.tasks.locomotion import Locomotion
from softgym_envs.mechanics.contact.contact import Contacts
from softgym_envs.quantities import QUANTITIES, check_quantity
from softgym_envs.robots.base import Robot
from softgym_envs.robots.checks import plausible_mass

STEEPEST = 0.5
"""Steepest slope that a task may have [rad]."""


class PayloadAndPush(Load):
    """A weight on the body all the time, and a push in a random horizontal direction.

    Args:
        mass: largest mass of the weight [kg]; each episode draws a part of it.
        gravity: acceleration [m/s2], shape (3,).
        push: largest force of the push [N].
        steps: control steps that it lasts.
        window: it is over before this number of control steps.
    """

    def __init__(self, mass: float, gravity: np.ndarray, push: float, steps: int, window: int) -> None:
        self.mass, self.gravity, self.push, self.steps, self.window = mass, gravity, push, steps, window
        self.carried, self._force, self._first = np.zeros(3), np.zeros(3), 0

    def begin(self, rng: np.random.Generator) -> None:
        self.carried = rng.uniform() * self.mass * self.gravity
        angle = rng.uniform(0.0, 2.0 * np.pi)
        self._force = rng.uniform(0.0, self.push) * np.array([np.cos(angle), np.sin(angle), 0.0])
        self._first = int(rng.integers(self.window - self.steps))

    def at(self, step: int) -> np.ndarray:
        return self.carried + self._force if self._first <= step < self._first + self.steps else self.carried


class Walk(Locomotion):
    """Go along x on the ground, as fast as possible; see `Locomotion`.

    The reward also charges the speed at which loaded points slip, so that scuttling on the spot gains nothing; a power
    is charged in proportion to the weight of the robot.

    Args:
        robot: a `MobileRobot` that touches the ground.
        pace: speed of the goal [sizes of the robot per second].
        slip: charge for the speed of slipping.
        drift: charge for the speed sideways.
        work: charge for work.
        payload: largest weight that the body carries, drawn in each episode [kg]; it has weight and no inertia.
        push: largest force on the body [N] of a push in a random horizontal direction; 0 for none.
        push_steps: control steps that a push lasts.
        friction: coefficient of friction of the ground, one number or a range from which each episode draws; default
            that of the robot.
        slope: angle by which the ground rises along x, likewise [rad].

    Raises:
        ValueError: for a robot that cannot walk, or a number out of bounds.
    """

    name = "walk"
    tallies = ("speed", "drift", "slip", "power")

    def __init__(
        self,
        robot: Robot,
        *,
        pace: float = 0.4,
        slip: float = 0.5,
        drift: float = 0.5,
        work: float = 0.1,
        payload: float = 0.0,
        push: float = 0.0,
        push_steps: int = 4,
        friction: float | Sequence[float] | None = None,
        slope: float | Sequence[float] = 0.0,
    ) -> None:
        if not isinstance(robot, MobileRobot) or not robot.may_touch:
            raise ValueError(f"task 'walk' needs a robot that moves about on the ground; '{robot.name}' does not")
        super().__init__(robot, pace=pace, slip=slip, drift=drift, work=work)
        if not 0.0 <= payload < np.inf:
            raise ValueError(f"payload = {payload} kg must be finite and not negative")
        if not 1 <= push_steps < self.max_episode_steps:
            raise ValueError(
                f"push_steps = {push_steps} is out of bounds; allowed: 1 to {self.max_episode_steps - 1} control steps"
            )
        check_force(push, "push", robot)
        high, example = plausible_mass(robot)
        check_quantity("mass", payload, "payload", high=high, example=example)
        self.friction = (
            None if friction is None else check_range("friction", friction, "", 0.01, QUANTITIES["friction"].high)
        )
        self.slope = check_range("slope", slope, "rad", -STEEPEST, STEEPEST)
        if self.friction is not None and max(map(abs, self.slope)) >= np.arctan(self.friction[0]):
            raise ValueError(
                f"slope = {slope} rad is too steep for friction = {friction}; allowed: below "
                f"{np.arctan(self.friction[0]):.3g} rad"
            )
        if push or payload:
            gravity = np.asarray(robot.gravity, dtype=float)
            self.load: PayloadAndPush | None = PayloadAndPush(
                payload, gravity, push, push_steps, self.max_episode_steps
            )
        self._touching: Contacts | None = None
        self._weight = 1.0

    def begin(self, rng: np.random.Generator) -> None:
        super().begin(rng)
        self._touching = None

    def draw_ground(self, rng: np.random.Generator) -> Ground | None:
        if self.friction is None and not any(self.slope):
            return None
        friction = None if self.friction is None else float(rng.uniform(*self.friction))
        angle, (x, y, z) = rng.uniform(*self.slope), self.robot.gravity
        c, s = np.cos(angle), np.sin(angle)
        gravity = np.array([c * x + s * z, y, c * z - s * x])
        if self.load is not None:
            self.load.gravity = gravity
        return Ground(friction=friction, gravity=gravity.tolist())

    def slipped(self, state: State) -> float:
        before, now = self._touching, state.contacts
        assert now is not None and now.number is not None
        self._touching = now
        if before is None:
            self._weight = float(np.linalg.norm(now.total.sum(axis=0)))
            return 0.0
        return _slipped(before, now)

    def power_scale(self, span: float) -> float:
        return self._weight * self.robot.size


def _slipped(before: Contacts, now: Contacts) -> float:
    """Return the mean way along the ground of the points that touch now and touched before [m].

    They are weighted by the forces on them then.
    """
    assert before.number is not None and now.number is not None
    _, old, new = np.intersect1d(before.number, now.number, assume_unique=True, return_indices=True)
    load = before.pressing[old]
    if not load.any():
        return 0.0
    return float(load @ np.linalg.norm((now.point[new] - before.point[old])[:, :2], axis=1) / load.sum())
