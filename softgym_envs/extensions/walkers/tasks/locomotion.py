"""Locomotion: go where one is told to, as fast as possible; what tasks of robots that walk and swim have in common."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from softgym_envs.backends.backend import State
from softgym_envs.envs.arrays import Array
from softgym_envs.envs.tasks.base import DistanceScale, Kinematics, Random, Sensors, Task
from softgym_envs.extensions.walkers.robots.mobile import MobileRobot
from softgym_envs.units import effort_unit, present

if TYPE_CHECKING:
    from softgym_envs.extensions.beams.rollout import Gain, Rollout
    from softgym_envs.mechanics.model import MechanicalModel

SHORTEST = 1.0
"""Shortest time over which speeds are averaged [s]: at the start of an episode there is no second half yet."""


@dataclass(frozen=True)
class _Moment:
    """What the task remembers of a moment: sums are since the start of the episode."""

    time: float  # [s]
    place: np.ndarray  # of the robot [m], shape (3,)
    slip: float  # way on which the robot slipped [m]
    work: float  # that actuators did, without what they took back [J]
    displacement: np.ndarray  # of the actuators, shape (n_a,)
    effort: np.ndarray  # shape (n_a,)


@dataclass(frozen=True)
class Pace:
    """How a robot goes on, as means over a part of an episode."""

    velocity: np.ndarray  # of the robot [m/s], shape (3,)
    slip: float  # speed of slipping [m/s]
    power: float  # of the actuators [W]
    span: float  # [s]


class Pose(Sensors):
    """How the body stands and moves, and the efforts of the actuators.

    Args:
        robot: what moves about.

    Attributes:
        signs: of the readings of the body, as its mirror image across the plane of x and z has them.
    """

    signs: tuple[int, ...] = (1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1)

    def __init__(self, robot: MobileRobot) -> None:
        self.frame, self.size = robot.body_frame, robot.size
        self.effort_scale = np.asarray(robot.effort_scale, dtype=float)
        unit = robot.actuators[0].unit
        efforts = ", ".join(present(value, effort_unit(unit)) for value in sorted(set(self.effort_scale.tolist())))
        self.parts = tuple(
            (size, what, f"x / (1 + abs(x)) of it{over}", si)
            for size, what, over, si in (
                *self.of_body(present(0.1 * robot.size, "m"), present(robot.size, "m/s")),
                (len(robot.actuators), "effort of each actuator", f" over {efforts}", effort_unit(unit)),
            )
        )
        self.count = sum(size for size, *_ in self.parts)
        self._start: np.ndarray | None = None

    def of_body(self, short: str, speed: str) -> tuple[tuple[int, str, str, str], ...]:
        """Return the parts that show the body: for each its size, what it is, its scale and its SI unit.

        Args:
            short: scale of lengths, as text.
            speed: scale of speeds.
        """
        return (
            (1, "height of the body, against that at the start", f" over {short}", "m"),
            (1, "place of the body sideways, against that at the start", f" over {short}", "m"),
            (3, "vertical along the directors of the body", "", ""),
            (1, "first director sideways", "", ""),
            (3, "velocity of the body", f" over {speed}", "m/s"),
            (3, "angular velocity of the body", " over 1 rad/s", "rad/s"),
        )

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
        body = self.body((place - self._start) / (0.1 * self.size), axes, speed[0] / self.size, spin)
        return np.concatenate([*body, state.effort / self.effort_scale])

    def body(self, moved: np.ndarray, axes: np.ndarray, speed: np.ndarray, spin: np.ndarray) -> list[np.ndarray]:
        """Return the readings of `of_body`.

        Args:
            moved: way of the body since the start, over its scale, shape (3,).
            axes: its directors as rows, shape (3, 3).
            speed: its velocity over its scale, shape (3,).
            spin: its angular velocity [rad/s], shape (3,).
        """
        return [moved[[2, 1]], axes[:, 2], axes[:1, 1], speed, spin]

    def further(self, readings: np.ndarray, new: bool) -> np.ndarray:
        return np.zeros(0)


class Locomotion(Task):
    """Go along a heading, as fast as possible: along x, unless a task draws others.

    Goals are horizontal velocities (vx, vy, 0) [m/s]; what is compared with them is the mean velocity of the robot over
    the second half of the time since it was given the goal. The distance is by how much that falls short of the goal
    ahead, and by how much it drifts sideways. Going faster than the goal is no error.

    The reward of a step is the speed ahead in sizes of the robot per second, less charges in the same unit for the
    speed sideways, for the work of the actuators, and for what else a task charges. No charge is negative, so rewards
    never add up to more than the way ahead: whoever rocks or turns on the spot gains nothing.

    Args:
        robot: what moves about.
        pace: speed of the goal [sizes of the robot per second].
        charges: what each term of the reward besides the speed costs, by its name.

    Raises:
        ValueError: for a number out of bounds.
    """

    max_episode_steps = 100
    agents: tuple[str, ...] = ("gait", "random")
    qp_agent = "gait"
    distance_scale = DistanceScale("shortfall", "mm/s", 1e3, goal_unit="m/s")
    tallies: tuple[str, ...] = ("speed", "drift", "power")

    robot: MobileRobot

    def __init__(self, robot: MobileRobot, *, pace: float, **charges: float) -> None:
        super().__init__(robot)
        if not 0.0 < pace < np.inf:
            raise ValueError(f"pace = {pace} sizes per second must be positive and finite")
        for name, value in charges.items():
            if not 0.0 <= value < np.inf:
                raise ValueError(f"{name} = {value} must be finite and not negative")
        self.pace, self.charges = pace, charges
        self.sensors = Pose(robot)
        self.axes = np.array([1.0, 1.0, 0.0])
        self.success_distance = 0.1 * pace * robot.size
        self.goal_scale = self.measured_scale = robot.size
        self._moments: list[_Moment] = []

    @abstractmethod
    def power_scale(self, span: float) -> float:
        """Return the power that is charged like one size of the robot per second [W].

        Args:
            span: duration of a control step [s].
        """

    def slipped(self, state: State) -> float:
        """Return the way on which the robot slipped since the last state of the episode [m]; 0 by default."""
        return 0.0

    def sample(self, rng: Random, count: int, kinematics: Kinematics) -> Array:
        return np.tile([self.pace * self.robot.size, 0.0, 0.0], (count, 1, 1))

    def check_paths(self, goals: object, leading: tuple[int, ...] = ()) -> np.ndarray:
        """Return the wanted velocities of episodes [m/s] as an array (*leading, p, 3), p = 1 for a single goal.

        Raises:
            ValueError: for another shape, or a velocity that is not finite, horizontal and more than zero; for a task
                with a single goal, it must be (v, 0, 0) with a positive v.
        """
        array, single = np.asarray(goals, dtype=float), self.horizon == 1
        array = array[..., None, :] if array.shape == (*leading, 3) else array
        known = array.ndim == len(leading) + 2 and array.shape[: len(leading)] == leading and array.shape[-1] == 3
        if known and np.isfinite(array).all() and array.shape[-2] and not array[..., 2].any():
            ahead = array.shape[-2] == 1 and not array[..., 1].any() and (array[..., 0] > 0.0).all()
            if ahead if single else array[..., :2].any(axis=-1).all():
                return array
        kind = "velocities (vx, vy, 0) [m/s], finite and not zero"
        if single:
            kind = "a velocity (v, 0, 0) [m/s] with v > 0 and finite"
        raise ValueError(f"goal must be {kind}, got {np.asarray(goals).tolist()}")

    def turn_to(self, ahead: int = 0) -> tuple[np.ndarray, int]:
        """Return the direction of the present goal, shape (3,), and the control steps since the robot was given it.

        Args:
            ahead: control steps from now for which to return it.
        """
        step, count = len(self._moments) - 1 + ahead, len(self.wanted)
        goal = self.goals(self.wanted[None], np.array([count]), np.array([step]))[0]
        number = min(step * count // self.horizon, count - 1)
        begun = max(-(-number * self.horizon // count) - 1, 0) if number else 0
        return goal / np.linalg.norm(goal), step - begun

    # -- what happens in an episode -----------------------------------------------------------------------------------

    def begin(self, rng: np.random.Generator) -> None:
        self._moments = []

    def record(self, state: State) -> None:
        time = 0.0 if state.motion is None else state.motion.time
        work = slip = 0.0
        if self._moments:
            last = self._moments[-1]
            if time <= last.time:  # the step has found no state
                return
            mean = 0.5 * (state.effort + last.effort)
            work = last.work + float((mean * (state.displacement - last.displacement)).clip(min=0.0).sum())
            slip = last.slip
        slip += self.slipped(state)
        assert state.nodes is not None
        place = self.robot.place(state.nodes).copy()
        self._moments.append(_Moment(time, place, slip, work, state.displacement, state.effort))

    # -- what follows from it -----------------------------------------------------------------------------------------

    def paced(self, shortest: float | None = None) -> Pace:
        """Return how the robot goes on in the last part of the time since it was given its goal.

        Args:
            shortest: the last part is the second half, but not shorter than this [s]; None: the last step.
        """
        now = self._moments[-1]
        if len(self._moments) == 1:
            return Pace(np.zeros(3), 0.0, 0.0, 1.0)
        first, span = self._moments[-2], now.time - self._moments[-2].time
        if shortest is not None:
            begun = self._moments[-1 - self.turn_to()[1]].time
            span = max(0.5 * (now.time - begun), shortest)
            first = min(self._moments, key=lambda each: abs(each.time - (now.time - span)))
            span = max(now.time - first.time, shortest)
        return Pace(
            (now.place - first.place) / span, (now.slip - first.slip) / span, (now.work - first.work) / span, span
        )

    def measure(self, state: State) -> np.ndarray:
        """Return the mean velocity [m/s] over the second half of the time since the goal was given, shape (3,)."""
        return self.paced(SHORTEST).velocity

    def tally(self) -> dict[str, float]:
        """Return speeds [m/s], ahead, sideways and of slipping, and the power [W], over the same time."""
        pace = self.paced(SHORTEST)
        ahead, across = _along(pace.velocity, self.turn_to()[0])
        found = {"speed": float(ahead), "drift": float(abs(across)), "slip": pace.slip, "power": pace.power}
        return {name: found[name] for name in self.tallies}

    def gain(self, rollout: Rollout, model: MechanicalModel, begin: int, drift: float) -> Gain:
        """Return the way along x of the body's frame in a motion, less a charge for that sideways, with derivatives.

        Args:
            rollout: the motion.
            model: the body.
            begin: time step after which the way counts.
            drift: charge for the way sideways, over the way ahead.

        Raises:
            ValueError: for a motion of which all counts: its beginning from rest is no gait.
        """
        from softgym_envs.extensions.beams.rollout import Gain

        if begin < 0:
            raise ValueError("the way of a gait counts after its first period: periods must be at least 2")
        row = self.robot.body_frame
        way = rollout.x[-1, row] - rollout.x[begin, row]
        by_way = np.array([1.0, -drift * np.sign(way[1]), 0.0])
        by_x = np.zeros_like(rollout.x)
        by_x[-1, row], by_x[begin, row] = by_way, -by_way
        return Gain(float(way[0]), float(by_way @ way), by_x, np.zeros_like(rollout.x))

    def distance(self, effector: Array, goal: Array) -> Array:
        speed = np.linalg.norm(goal, axis=-1)
        ahead, across = _along(effector, goal / speed[..., None])
        return np.hypot((speed - ahead).clip(min=0.0), across)

    def rate(self, effector: Array, goal: Array, effort_share: Array) -> tuple[Array, dict[str, Array], Array]:
        distance = self.distance(effector, goal)
        return distance, {}, np.zeros_like(distance)

    def state_terms(self, state: State) -> dict[str, float]:
        """Return the terms of the reward: speed ahead and charges [sizes of the robot per second]."""
        pace, size = self.paced(), self.robot.size
        ahead, across = _along(pace.velocity, self.turn_to()[0])
        speed, drift = float(ahead) / size, float(abs(across)) / size
        found = {"slip": pace.slip / size, "drift": drift, "work": pace.power / self.power_scale(pace.span)}
        return {"speed": speed} | {name: -share * found[name] for name, share in self.charges.items()}

    def reward(self, terms: Mapping[str, Array]) -> Array:
        """Return the sum of the terms."""
        return np.sum(list(terms.values()), axis=0)


def _along(velocity: np.ndarray, direction: np.ndarray) -> tuple[Array, Array]:
    """Return the components of velocities (..., 3) along horizontal directions (..., 3), and to the left of these."""
    ahead = velocity[..., 0] * direction[..., 0] + velocity[..., 1] * direction[..., 1]
    return ahead, velocity[..., 1] * direction[..., 0] - velocity[..., 0] * direction[..., 1]
