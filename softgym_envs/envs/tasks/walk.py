"""Walk: go straight ahead on the ground, as fast as possible."""

from __future__ import annotations

import numpy as np

from softgym_envs.backends.backend import State
from softgym_envs.envs.tasks.base import Load, check_force
from softgym_envs.envs.tasks.locomotion import Locomotion
from softgym_envs.mechanics.contact.contact import Contacts
from softgym_envs.robots.base import Robot


class PayloadAndPush(Load):
    """A weight on the body all the time, and a push in a random horizontal direction.

    Args:
        weight: largest weight [N], shape (3,); each episode draws a part of it.
        push: largest force of the push [N].
        steps: control steps that it lasts.
        window: it is over before this number of control steps.
    """

    def __init__(self, weight: np.ndarray, push: float, steps: int, window: int) -> None:
        self.weight, self.push, self.steps, self.window = weight, push, steps, window
        self.carried, self._force, self._first = np.zeros(3), np.zeros(3), 0

    def begin(self, rng: np.random.Generator) -> None:
        self.carried = rng.uniform() * self.weight
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
        robot: a robot with a `body_frame` that touches the ground.
        pace: speed of the goal [sizes of the robot per second].
        slip: charge for the speed of slipping.
        drift: charge for the speed sideways.
        work: charge for work.
        payload: largest weight that the body carries, drawn in each episode [kg]; it has weight and no inertia.
        push: largest force on the body [N] of a push in a random horizontal direction; 0 for none.
        push_steps: control steps that a push lasts.

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
    ) -> None:
        if robot.body_frame is None or not robot.may_touch:
            raise ValueError(f"task 'walk' needs a robot that moves about on the ground; '{robot.name}' does not")
        super().__init__(robot, pace=pace, slip=slip, drift=drift, work=work)
        if not 0.0 <= payload < np.inf:
            raise ValueError(f"payload = {payload} kg must be finite and not negative")
        if not 1 <= push_steps < self.max_episode_steps:
            raise ValueError(
                f"push_steps = {push_steps} is out of bounds; allowed: 1 to {self.max_episode_steps - 1} control steps"
            )
        check_force(push, "push", robot)
        check_force(9.81 * payload, "weight of the payload", robot)
        if push or payload:
            self.load = PayloadAndPush(payload * np.asarray(robot.gravity), push, push_steps, self.max_episode_steps)
        self._touching: Contacts | None = None
        self._weight = 1.0

    def begin(self, rng: np.random.Generator) -> None:
        super().begin(rng)
        self._touching = None

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
