"""Throw: swing a payload and let it go, so that it lands as far ahead as possible."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from softgym_envs.backends.backend import Ground, State
from softgym_envs.envs.arrays import Array, namespace
from softgym_envs.envs.tasks.base import DistanceScale, Kinematics, Random, Sensors, Task, check_range
from softgym_envs.extensions.walkers.robots.mobile import MobileRobot
from softgym_envs.robots.base import Robot
from softgym_envs.robots.checks import plausible_mass
from softgym_envs.units import effort_unit, present

if TYPE_CHECKING:
    from softgym_envs.extensions.beams.rollout import Gain, Rollout
    from softgym_envs.mechanics.model import MechanicalModel

GRAVITY = 9.81
"""Acceleration in flight [m/s2]."""


def landing(place: np.ndarray, velocity: np.ndarray, floor: float) -> np.ndarray:
    """Return where a small body lands that flies without drag [m], shape (3,).

    Args:
        place: where it is let go [m], shape (3,); below the floor it flies from there as from the floor.
        velocity: [m/s], shape (3,).
        floor: height of the floor [m].
    """
    time = flight(place, velocity, floor)
    return np.array([place[0] + time * velocity[0], place[1] + time * velocity[1], floor])


def flight(place: np.ndarray, velocity: np.ndarray, floor: float) -> float:
    """Return how long the flight of `landing` takes [s]."""
    return float(velocity[2] + _speed_of_impact(place, velocity, floor)) / GRAVITY


def _speed_of_impact(place: np.ndarray, velocity: np.ndarray, floor: float) -> float:
    """Return with what vertical speed the body lands [m/s]."""
    return float(np.sqrt(velocity[2] ** 2 + 2.0 * GRAVITY * max(place[2] - floor, 0.0)))


class Swing(Sensors):
    """Where the effector is and how it moves, the efforts, and the time.

    Args:
        robot: the robot.
    """

    def __init__(self, robot: Robot) -> None:
        self.rest, self.size = robot.effector_rest, robot.size
        self.effort_scale = np.asarray(robot.effort_scale, dtype=float)
        unit = effort_unit(robot.actuators[0].unit)
        efforts = ", ".join(present(value, unit) for value in sorted(set(self.effort_scale.tolist())))
        length = present(robot.size, "m")
        self.parts = tuple(
            (size, what, f"x / (1 + abs(x)) of it over {over}", si)
            for size, what, over, si in (
                (3, "effector, from its place at rest", length, "m"),
                (3, "its velocity", f"{length} per 100 ms", "m/s"),
                (len(robot.actuators), "effort of each actuator", efforts, unit),
                (1, "time since the start", "1 s", "s"),
            )
        )
        self.count = sum(size for size, *_ in self.parts)

    def begin(self) -> None:
        """Nothing is kept."""

    def readings(self, state: State) -> np.ndarray:
        moved, motion = state.effector[0] - self.rest, state.motion
        velocity = np.zeros(3) if state.velocity is None else state.velocity[0]
        time = 0.0 if motion is None else motion.time
        return np.concatenate([moved / self.size, 0.1 * velocity / self.size, state.effort / self.effort_scale, [time]])

    def further(self, readings: np.ndarray, new: bool) -> np.ndarray:
        return np.zeros(0)


class Throw(Task):
    """Throw a payload along +x, as far as possible: the effector holds it and lets it go when the episode ends.

    Goals are places on the floor; what is compared with them is where the payload would land if it was let go now,
    after a flight without drag. The distance is by how much that falls short of the goal along x, or lands beside it.
    Throwing beyond the goal is no error.

    The reward of a step is by how much farther the payload would land than one step before, in sizes of the robot. The
    rewards of an episode add up to the range of its throw, so nothing but the last moment counts.

    The payload is part of the robot's inertia and weight. An episode in which it touches the floor has failed.

    Args:
        robot: a robot that hangs or stands above the floor, and whose first effector is in a rigid part.
        distance: where the goal is along x [m], one number or a range from which each episode draws.
        payload: mass of the payload [kg], likewise; default that of the robot.
        floor: height of the floor [m].

    Raises:
        ValueError: for a robot that moves about, without weight or below the floor, or a number out of bounds.
    """

    name = "throw"
    max_episode_steps = 30
    agents = ("gait", "random")
    qp_agent = "gait"
    distance_scale = DistanceScale("shortfall", "mm", 1e3)
    tallies = ("range",)

    def __init__(
        self,
        robot: Robot,
        *,
        distance: float | Sequence[float] = 0.5,
        payload: float | Sequence[float] | None = None,
        floor: float = -0.6,
    ) -> None:
        super().__init__(robot)
        gravity = np.asarray(robot.gravity, dtype=float)
        if isinstance(robot, MobileRobot) or not np.allclose(gravity, [0.0, 0.0, -GRAVITY]):
            raise ValueError(
                f"task 'throw' needs a mounted robot with gravity = (0, 0, -{GRAVITY}), got '{robot.name}' with "
                f"{tuple(gravity.tolist())}"
            )
        if not -20.0 * robot.size <= floor < robot.effector_rest[2]:
            raise ValueError(
                f"floor = {floor} m is out of bounds; allowed: {-20.0 * robot.size:g} to below the effector at rest, "
                f"{robot.effector_rest[2]:g} m"
            )
        self.reach = check_range("distance", distance, "m", 0.0, 40.0 * robot.size)
        self.payload = None if payload is None else check_range("payload", payload, "kg", 0.0, plausible_mass(robot)[0])
        self.floor = float(floor)
        self.axes = np.array([1.0, 1.0, 0.0])
        self.goal_scale = max(self.reach[1], abs(self.floor))
        self.success_distance = 0.05 * robot.size
        self.sensors = Swing(robot)
        self._range = self._gained = 0.0

    # -- episodes -----------------------------------------------------------------------------------------------------

    def sample(self, rng: Random, count: int, kinematics: Kinematics) -> Array:
        xp = namespace(self.axes)
        places = xp.zeros((count, 1, 3))
        places[..., 0] = rng.uniform(*self.reach, (count, 1))
        places[..., 2] = self.floor
        return places

    def check_paths(self, goals: object, leading: tuple[int, ...] = ()) -> np.ndarray:
        """Return the places of goals [m] as an array (*leading, 1, 3).

        Raises:
            ValueError: for another shape, or a place that is not finite, not on the floor or behind the robot.
        """
        array = np.asarray(goals, dtype=float)
        array = array[..., None, :] if array.shape == (*leading, 3) else array
        on_floor = array.shape == (*leading, 1, 3) and np.isfinite(array).all() and (array[..., 2] == self.floor).all()
        if on_floor and (array[..., 0] >= 0.0).all():
            return array
        raise ValueError(
            f"goal must be a place (x, y, {self.floor:g}) [m] on the floor with x >= 0, got {array.tolist()}"
        )

    def draw_ground(self, rng: np.random.Generator) -> Ground | None:
        return None if self.payload is None else Ground(payload=float(rng.uniform(*self.payload)))

    def begin(self, rng: np.random.Generator) -> None:
        self._range = self._gained = np.nan

    def record(self, state: State) -> None:
        now = self.measure(state)[0]
        # The payload lies still in the first state.
        self._gained = 0.0 if np.isnan(self._range) else now - self._range
        self._range = now

    def measure(self, state: State) -> np.ndarray:
        """Return where the payload would land if it was let go now [m], shape (3,)."""
        velocity = np.zeros(3) if state.velocity is None else state.velocity[0]
        return landing(state.effector[0], velocity, self.floor)

    def is_failed(self, state: State) -> bool:
        return bool(state.effector[0, 2] <= self.floor)

    def tally(self) -> dict[str, float]:
        """Return the range of the throw [m]."""
        return {"range": float(self._range)}

    # -- what it is worth ---------------------------------------------------------------------------------------------

    def distance(self, effector: Array, goal: Array) -> Array:
        xp = namespace(effector)
        short, beside = (goal - effector)[..., 0].clip(0.0, None), (goal - effector)[..., 1]
        return xp.sqrt(short * short + beside * beside)

    def rate(self, effector: Array, goal: Array, effort_share: Array) -> tuple[Array, dict[str, Array], Array]:
        distance = self.distance(effector, goal)
        return distance, {}, np.zeros_like(distance)

    def state_terms(self, state: State) -> dict[str, float]:
        """Return the term of the reward: how much farther the payload would land [sizes of the robot]."""
        return {"range": float(self._gained) / self.robot.size}

    def reward(self, terms: Mapping[str, Array]) -> Array:
        return terms["range"]

    def gain(self, rollout: Rollout, model: MechanicalModel, begin: int, drift: float) -> Gain:
        """Return the range of a throw at the end of a motion, less what it lands beside the goal, with derivatives.

        Args:
            rollout: the motion.
            model: the body.
            begin: not used: nothing but the end counts.
            drift: charge for landing sideways.
        """
        from softgym_envs.extensions.beams.rollout import Gain

        at = model.constraints["e"][0].embedding  # type: ignore[attr-defined]
        ids, weights = at.node_ids[0], at.weights[0]
        place, velocity = weights @ rollout.x[-1, ids], weights @ rollout.velocity[-1, ids]
        time, impact = flight(place, velocity, self.floor), _speed_of_impact(place, velocity, self.floor)
        landed = landing(place, velocity, self.floor)
        by_landing = np.array([1.0, -drift * np.sign(landed[1])])
        by_time = float(by_landing @ velocity[:2])
        by_place, by_velocity = np.zeros(3), np.zeros(3)
        by_place[:2], by_velocity[:2] = by_landing, time * by_landing
        if place[2] > self.floor:
            by_place[2] = by_time / impact
        by_velocity[2] = by_time * (1.0 + velocity[2] / impact) / GRAVITY
        by_x, by_rate = np.zeros_like(rollout.x), np.zeros_like(rollout.x)
        by_x[-1, ids], by_rate[-1, ids] = np.outer(weights, by_place), np.outer(weights, by_velocity)
        return Gain(float(landed[0]), float(by_landing @ landed[:2]), by_x, by_rate)

    # -- pictures -----------------------------------------------------------------------------------------------------

    def drawn_goals(self, state: State, path: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the flight of the payload if it was let go now, shape (p, 3), and the goal (3,) [m]."""
        place = state.effector[0]
        velocity = np.zeros(3) if state.velocity is None else state.velocity[0]
        times = np.linspace(0.0, flight(place, velocity, self.floor), 40)[:, None]
        return place + times * velocity - 0.5 * GRAVITY * times**2 * [0.0, 0.0, 1.0], goal
