"""Walk: go straight ahead, as fast as possible."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from softgym_envs.backends.backend import State
from softgym_envs.envs.arrays import Array
from softgym_envs.envs.tasks.base import DistanceScale, Kinematics, Load, Random, Sensors, Task, check_force
from softgym_envs.robots.base import Robot
from softgym_envs.units import effort_unit, present

SHORTEST = 1.0
"""Shortest time over which speeds are averaged [s]: at the start of an episode there is no second half yet."""


@dataclass(frozen=True)
class _Moment:
    """What the task remembers of a moment: sums are since the start of the episode."""

    time: float  # [s]
    place: np.ndarray  # of the body [m], shape (3,)
    slip: float  # path on which loaded points slipped, weighted by their forces [m]
    work: float  # that actuators did, without what they took back [J]
    points: np.ndarray  # that touch, by their numbers, shape (k,)
    at: np.ndarray  # their places [m], shape (k, 3)
    pressing: np.ndarray  # normal forces [N], shape (k,)
    displacement: np.ndarray  # of the actuators, shape (n_a,)
    effort: np.ndarray  # shape (n_a,)


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


class Pose(Sensors):
    """How the body stands and moves, and the efforts of the actuators.

    Args:
        robot: the robot.
        frame: row of its model with the origin of the frame that carries the body.
    """

    def __init__(self, robot: Robot, frame: int) -> None:
        self.frame, self.size = frame, robot.size
        self.effort_scale = np.asarray(robot.effort_scale, dtype=float)
        short, speed, unit = present(0.1 * robot.size, "m"), present(robot.size, "m/s"), robot.actuators[0].unit
        efforts = ", ".join(present(value, effort_unit(unit)) for value in sorted(set(self.effort_scale.tolist())))
        self.parts = tuple(
            (size, what, f"x / (1 + abs(x)) of it{over}", si)
            for size, what, over, si in (
                (1, "height of the body, against that at the start", f" over {short}", "m"),
                (1, "place of the body sideways, against that at the start", f" over {short}", "m"),
                (3, "vertical along the directors of the body", "", ""),
                (1, "first director sideways", "", ""),
                (3, "velocity of the body", f" over {speed}", "m/s"),
                (3, "angular velocity of the body", " over 1 rad/s", "rad/s"),
                (len(robot.actuators), "effort of each actuator", f" over {efforts}", effort_unit(unit)),
            )
        )
        self.count = sum(size for size, *_ in self.parts)
        self._start: np.ndarray | None = None

    def begin(self) -> None:
        self._start = None

    def readings(self, state: State) -> np.ndarray:
        assert state.nodes is not None
        row = self.frame
        place, axes = state.nodes[row], state.nodes[row + 1 : row + 4]
        if self._start is None:
            self._start = place.copy()
        speed = np.zeros((4, 3)) if state.motion is None else state.motion.velocity[row : row + 4]
        spin = 0.5 * np.cross(axes, speed[1:]).sum(axis=0)
        moved = (place - self._start)[[2, 1]] / (0.1 * self.size)
        pressed = state.effort / self.effort_scale
        return np.concatenate([moved, axes[:, 2], axes[:1, 1], speed[0] / self.size, spin, pressed])

    def further(self, readings: np.ndarray, new: bool) -> np.ndarray:
        return np.zeros(0)


class Walk(Task):
    """Go along x, as fast as possible.

    Goals are velocities (v, 0, 0) [m/s]; what is compared with them is the mean velocity over the second half of the
    episode so far. The distance is by how much that falls short of the goal ahead, and by how much it drifts sideways.
    Going faster than the goal is no error.

    The reward of a step is the speed ahead in sizes of the robot per second, less charges for the speed at which loaded
    points slip on the ground, for the speed sideways and for the work of the actuators (over the weight of the robot,
    in the same unit). No charge is negative, so rewards never add up to more than the way ahead: whoever rocks, falls
    over or scuttles on the spot gains nothing.

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
    max_episode_steps = 100
    agents = ("gait", "random")
    qp_agent = "gait"
    distance_scale = DistanceScale("shortfall", "mm/s", 1e3, goal_unit="m/s")
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
        super().__init__(robot)
        if robot.body_frame is None or not robot.may_touch:
            raise ValueError(f"task 'walk' needs a robot that moves about on the ground; '{robot.name}' does not")
        if not 0.0 < pace < np.inf:
            raise ValueError(f"pace = {pace} sizes per second must be positive and finite")
        for name, value, unit in (
            ("slip", slip, ""),
            ("drift", drift, ""),
            ("work", work, ""),
            ("payload", payload, " kg"),
        ):
            if not 0.0 <= value < np.inf:
                raise ValueError(f"{name} = {value}{unit} must be finite and not negative")
        if not 1 <= push_steps < self.max_episode_steps:
            raise ValueError(
                f"push_steps = {push_steps} is out of bounds; allowed: 1 to {self.max_episode_steps - 1} control steps"
            )
        self.pace, self.slip, self.drift, self.work = pace, slip, drift, work
        check_force(push, "push", robot)
        check_force(9.81 * payload, "weight of the payload", robot)
        if push or payload:
            self.load = PayloadAndPush(payload * np.asarray(robot.gravity), push, push_steps, self.max_episode_steps)
        self.sensors = Pose(robot, robot.body_frame)
        self.axes = np.array([1.0, 1.0, 0.0])
        self.success_distance = 0.1 * pace * robot.size
        self.goal_scale = self.measured_scale = robot.size
        self._moments: list[_Moment] = []
        self._weight = 1.0

    def sample(self, rng: Random, count: int, kinematics: Kinematics) -> Array:
        return np.tile([self.pace * self.robot.size, 0.0, 0.0], (count, 1, 1))

    def check_paths(self, goals: object, leading: tuple[int, ...] = ()) -> np.ndarray:
        """Return the wanted velocities of episodes [m/s] as an array (*leading, 1, 3).

        Raises:
            ValueError: for another shape, or a velocity that is not (v, 0, 0) with a positive and finite v.
        """
        array = np.asarray(goals, dtype=float)
        array = array[..., None, :] if array.shape == (*leading, 3) else array
        ahead = array.shape == (*leading, 1, 3) and np.isfinite(array).all() and (array[..., 0] > 0.0).all()
        if not ahead or array[..., 1:].any():
            raise ValueError(
                f"goal must be a velocity (v, 0, 0) [m/s] with v > 0 and finite, got {np.asarray(goals).tolist()}"
            )
        return array

    # -- what happens in an episode -----------------------------------------------------------------------------------

    def begin(self, rng: np.random.Generator) -> None:
        self._moments = []

    def record(self, state: State) -> None:
        row, contacts = self.robot.body_frame, state.contacts
        assert row is not None and state.nodes is not None and contacts is not None and contacts.number is not None
        time = 0.0 if state.motion is None else state.motion.time
        slip = work = 0.0
        if self._moments:
            last = self._moments[-1]
            if time <= last.time:  # the step has found no state
                return
            slip, work = last.slip + _slipped(last, contacts.number, contacts.point), last.work
            mean = 0.5 * (state.effort + last.effort)
            work += float((mean * (state.displacement - last.displacement)).clip(min=0.0).sum())
        else:
            self._weight = float(np.linalg.norm(contacts.total.sum(axis=0)))
        self._moments.append(
            _Moment(
                time, state.nodes[row].copy(), slip, work, contacts.number, contacts.point, contacts.pressing,
                state.displacement, state.effort,
            )
        )  # fmt: skip

    # -- what follows from it -----------------------------------------------------------------------------------------

    def _mean(self, shortest: float | None = None) -> tuple[np.ndarray, float, float]:
        """Return mean velocity [m/s] (3,), speed of slipping [m/s] and power [W] over the last part of an episode.

        Args:
            shortest: the last part is the second half, but not shorter than this [s]; None: the last step.
        """
        now = self._moments[-1]
        if len(self._moments) == 1:
            return np.zeros(3), 0.0, 0.0
        first, span = self._moments[-2], now.time - self._moments[-2].time
        if shortest is not None:
            span = max(0.5 * now.time, shortest)
            first = min(self._moments, key=lambda each: abs(each.time - (now.time - span)))
            span = max(now.time - first.time, shortest)
        return (now.place - first.place) / span, (now.slip - first.slip) / span, (now.work - first.work) / span

    def measure(self, state: State) -> np.ndarray:
        """Return the mean velocity [m/s] over the second half of the episode so far, shape (3,)."""
        return self._mean(SHORTEST)[0]

    def tally(self) -> dict[str, float]:
        """Return speeds ahead, sideways and of slipping [m/s], and the power [W], over the second half so far."""
        velocity, slip, power = self._mean(SHORTEST)
        return {"speed": float(velocity[0]), "drift": float(abs(velocity[1])), "slip": slip, "power": power}

    def distance(self, effector: Array, goal: Array) -> Array:
        short = (goal[..., 0] - effector[..., 0]).clip(min=0.0)
        return np.hypot(short, effector[..., 1] - goal[..., 1])

    def rate(self, effector: Array, goal: Array, effort_share: Array) -> tuple[Array, dict[str, Array], Array]:
        distance = self.distance(effector, goal)
        return distance, {}, np.zeros_like(distance)

    def state_terms(self, state: State) -> dict[str, float]:
        """Return the terms of the reward: speed ahead and charges [sizes of the robot per second]."""
        velocity, slip, power = self._mean()
        size = self.robot.size
        return {
            "speed": float(velocity[0]) / size,
            "slip": -self.slip * slip / size,
            "drift": -self.drift * float(abs(velocity[1])) / size,
            "work": -self.work * power / (self._weight * size),
        }

    def reward(self, terms: Mapping[str, Array]) -> Array:
        """Return the sum of the terms."""
        return np.sum(list(terms.values()), axis=0)


def _slipped(last: _Moment, points: np.ndarray, at: np.ndarray) -> float:
    """Return the mean way along the ground of the points that touch now and touched at the last moment [m].

    They are weighted by the forces on them then.
    """
    _, before, now = np.intersect1d(last.points, points, assume_unique=True, return_indices=True)
    load = last.pressing[before]
    if not load.any():
        return 0.0
    return float(load @ np.linalg.norm((at[now] - last.at[before])[:, :2], axis=1) / load.sum())
