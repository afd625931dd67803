"""Search for a gait along gradients through time (model-based): commands that repeat, without feedback.

The commands of a period follow the gradient of the way that the robot goes, through contact and friction
(`softgym_envs.extensions.beams.rollout`), or of what else the task's method ``gain`` makes of a motion, such as the
range of a throw. A gradient costs little more than the motion itself, and the motion is short: over a second or two a
gradient tells how a gait should change, while those of many periods of a fast gait that slips are noise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import Field

from softgym_envs.agents.config import TrainConfig
from softgym_envs.agents.learners.base import Learner, Tensors, check_weights
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.config import Config
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.beams.rollout import Rollout, roll_out_backend
from softgym_envs.extensions.walkers.robots.mobile import RhythmicRobot, rhythmic

if TYPE_CHECKING:
    from softgym_envs.extensions.beams.solver.design import Neighbours

TIGHTNESS = 1.0
"""How fast commands follow those of the gait, in their rates over a distance to them of one rate."""
SHORTER, LONGER = 0.4, 1.5
"""What a step that leads to a worse gait, or to a better one, does to the length of the next."""
FORGET, FORGET_SQUARES = 0.8, 0.95
"""Memory of the mean and of the mean square of gradients (Kingma and Ba 2015), short for a search of a few steps."""


class GaitConfig(Config):
    """Hyperparameters of the search for a gait (`softgym_envs.extensions.walkers.learners.gait`)."""

    period: int = Field(default=10, gt=1, description="control steps of a period")
    periods: int = Field(default=3, gt=0, description="periods of a motion; the way ahead counts after the first one")
    learning_rate: float = Field(
        default=0.1, gt=0, description="first step of a command, in half ranges of the actuator"
    )
    final_learning_rate: float = Field(default=0.02, gt=0, description="reached linearly at the last step")
    drift: float = Field(default=1.0, ge=0, description="charge for the way sideways, over the way ahead")
    spread: float = Field(
        default=0.05, ge=0, description="by which the seed moves the start away from the reference gait, in half ranges"
    )
    largest_effort: float | None = Field(
        default=None,
        gt=0,
        description="of an actuator [SI], if less than that of the robot; the search charges for what is beyond",
    )
    excess: float = Field(
        default=100.0,
        ge=0,
        description="charge for squares of efforts beyond their limit, over it, in sizes of the robot; by default far "
        "more than they gain",
    )


class Move(NamedTuple):
    """A motion, and what its derivatives are made of.

    Attributes:
        way: ahead after the first period [m].
        value: way ahead less the charges for the way sideways and for efforts beyond their limit [m].
        rollout: the motion.
        by_x: derivative of the value by the places, for `Rollout.gradient`.
        by_velocity: likewise by the velocities.
        by_effort: likewise by the efforts; None without a limit.
        follow, pull: derivatives of `GaitLearner.commands`.
    """

    way: float
    value: float
    rollout: Rollout
    by_x: np.ndarray
    by_velocity: np.ndarray
    by_effort: np.ndarray | None
    follow: np.ndarray
    pull: np.ndarray


class Climb(NamedTuple):
    """A motion, and derivatives of its way ahead less the charge for the way sideways.

    Attributes:
        way: ahead after the first period [m].
        by_gait: derivative by the gait, shape (p, n_a).
        by_design: by the design variables, shape (d,); none where no neighbours of the body were given.
        value: way ahead less the charges for the way sideways and for efforts beyond their limit [m].
    """

    way: float
    by_gait: np.ndarray
    by_design: np.ndarray
    value: float


class Ascent:
    """Steps of Adam towards larger values (Kingma and Ba 2015), in a box of -1 to 1.

    A step that led to a smaller value is made again from the best point so far, shorter.

    Args:
        start: first point.

    Attributes:
        point: that is tried next.
        best: best point so far.
        value: of the best point.
    """

    ARRAYS = ("point", "best", "slope", "mean", "square")

    def __init__(self, start: np.ndarray) -> None:
        self.point = self.best = start
        self.value, self.stride, self.count = -np.inf, 1.0, 0
        self.slope, self.mean, self.square = (np.zeros_like(start) for _ in range(3))

    def step(self, value: float | None, slope: np.ndarray | None, rate: float) -> None:
        """Make the next point from the value of the present one and its slope; none if it cannot be computed.

        Args:
            value: of the present point.
            slope: derivative of the value by the point.
            rate: first step of a coordinate.
        """
        if value is not None and slope is not None and value > self.value:
            self.value, self.stride = value, min(LONGER * self.stride, 1.0)
            self.best, self.slope = self.point, slope
            self.count += 1
            self.mean = FORGET * self.mean + (1.0 - FORGET) * self.slope
            self.square = FORGET_SQUARES * self.square + (1.0 - FORGET_SQUARES) * self.slope**2
        elif not self.count:  # the first one cannot be computed
            self.point = self.best = 0.8 * self.point
            return
        else:
            self.stride *= SHORTER
            self.count, self.mean = 1, (1.0 - FORGET) * self.slope
            self.square = (1.0 - FORGET_SQUARES) * self.slope**2
        size = np.sqrt(self.square / (1.0 - FORGET_SQUARES**self.count)) + 1e-15
        ahead = self.mean / (1.0 - FORGET**self.count) / size
        self.point = np.clip(self.best + self.stride * rate * ahead, -1.0, 1.0)


def check_compiled(config: TrainConfig, backend: object) -> None:
    """Check that a learner can follow derivatives through the motions of an environment.

    Raises:
        ValueError: for an environment with drawn bodies, other actions than changes of commands, commanded efforts, or
            without motion on finite elements in compiled code.
    """
    learner, environment = config.learner, config.environment
    if environment.sample_design or environment.action_mode != "increment" or environment.residual_scale:
        raise ValueError(
            f"learner '{learner}' needs one body, action_mode = increment and no residual_scale, got sample_design = "
            f"{environment.sample_design}, {environment.action_mode} and {environment.residual_scale:g}"
        )
    if not isinstance(backend, FEMBackend) or not backend.moving or backend.not_compiled is not None:
        why = (backend.not_compiled if isinstance(backend, FEMBackend) else None) or "no motion"
        raise ValueError(f"learner '{learner}' needs a motion on finite elements in compiled code: {why}")
    backend.robot.needs_displacements(f"learner '{learner}'")


def resampled_gait(robot: RhythmicRobot, period: int) -> np.ndarray:
    """Return where a policy of another period should be after each step of the reference gait, shape (period, n_a).

    -1 and 1 are the ends of the ranges of the actuators.
    """
    gait = robot.reference_gait()
    places = np.arange(period) * len(gait) / period
    after = (np.floor(places).astype(int) + 1) % len(gait)
    share = (places % 1.0)[:, None]
    resampled = (1.0 - share) * gait[np.floor(places).astype(int)] + share * gait[after]
    middle, half = 0.5 * (robot.lower + robot.upper), 0.5 * (robot.upper - robot.lower)
    return np.roll((resampled - middle) / half, -1, axis=0)


def shift_of_sides(robot: RhythmicRobot, gait: np.ndarray) -> int | None:
    """Return by how many control steps one side does later what the other one does in a gait (p, n_a), or None."""
    if robot.mirrored_actuators is None:
        return None
    other, shifts = gait[:, list(robot.mirrored_actuators)], {0, len(gait) // 2}
    return next((k for k in sorted(shifts) if np.allclose(np.roll(other, k, axis=0), gait, atol=1e-9)), None)


def command_gradient(by_part: np.ndarray, parts: int) -> np.ndarray:
    """Return derivatives by the commands of control steps (k, n_a) from those by their time steps (k parts, n_a).

    Time steps lie on a ramp from the last command to the next.
    """
    by_part = by_part.reshape(-1, parts, by_part.shape[1])
    share = (np.arange(1, parts + 1) / parts)[:, None]
    by_command = (share * by_part).sum(axis=1)
    by_command[:-1] += ((1.0 - share) * by_part[1:]).sum(axis=1)
    return by_command


class GaitLearner(Learner):
    """Commands that repeat, improved along the gradient of the way ahead (+x).

    It begins near the reference gait of the robot. Where the robot has two equal sides that do the same in that gait,
    at once or in turns, half a period apart, they go on to do so: what repeats like that goes straight. A policy adds
    up a bias that depends on the time in the period and a fixed pull towards it, so it acts as any other policy does
    and is limited as these are.

    Args:
        config: configuration of the training; the environment has one body, and ``num_envs`` has no effect.

    Attributes:
        ascent: the search.
        ways: way ahead of each motion so far after its first period [m].

    Raises:
        ValueError: for an environment with drawn bodies, or without motion on finite elements in compiled code.
    """

    Config = GaitConfig
    title = "gait by gradients"
    model_based = True

    def __init__(self, config: TrainConfig) -> None:
        super().__init__(config)
        env: Any = config.environment.make().unwrapped
        self.env, backend = env, env.backend
        check_compiled(config, backend)
        if not hasattr(env.task, "gain"):
            raise ValueError(f"learner 'gait' needs a task that rates whole motions by `gain`, got '{env.task.name}'")
        self.backend = backend
        robot = rhythmic(env.robot)
        self._middle, self._half = 0.5 * (robot.lower + robot.upper), 0.5 * (robot.upper - robot.lower)
        self._gain = TIGHTNESS * self._half / robot.rates
        start = resampled_gait(robot, config.settings.period)
        noise = np.random.default_rng(config.seed).normal(size=start.shape)
        self._shift = shift_of_sides(robot, start)
        self.ascent = Ascent(np.clip(start + config.settings.spread * self.straight(noise), -1.0, 1.0))
        self.step = 0
        self.ways: list[float] = []

    @property
    def gait(self) -> np.ndarray:
        """Commands of a period that are tried next, -1 and 1 at the ends of the ranges, shape (p, n_a)."""
        return self.ascent.point

    @gait.setter
    def gait(self, value: np.ndarray) -> None:
        self.ascent.point = value

    @property
    def best(self) -> np.ndarray:
        """Commands of the best gait so far, which a policy has, shape (p, n_a)."""
        return self.ascent.best

    def learn(self, target: int, progress: Callable[[int], object]) -> None:
        settings = self.config.settings
        steps = settings.period * settings.periods
        while self.step < target:
            try:
                found = self.climb()
            except ConvergenceError:  # a gait that cannot be computed
                self.ascent.step(None, None, self.rate())
            else:
                self.ways.append(found.way)
                self.ascent.step(found.value, found.by_gait, self.rate())
            self.step += steps
            progress(steps)

    def rate(self) -> float:
        """Return the first step of a command, in half ranges, at the present step of the search."""
        settings, share = self.config.settings, min(self.step / self.config.steps, 1.0)
        return (1.0 - share) * settings.learning_rate + share * settings.final_learning_rate

    def move(self) -> Move:
        """Move the body from rest.

        Raises:
            ConvergenceError: if a time step cannot be computed.
        """
        settings, backend = self.config.settings, self.backend
        commands, follow, pull = self.commands(settings.period * settings.periods)
        backend.reset()
        parts = backend.steps.count
        rollout = roll_out_backend(backend, commands)
        begin = settings.period * parts - 1 if settings.periods > 1 else -1
        gain = self.env.task.gain(rollout, backend.model, begin, settings.drift)
        charge, by_effort = self._excess(rollout.effort)
        return Move(gain.way, gain.value - charge, rollout, gain.by_x, gain.by_velocity, by_effort, follow, pull)

    def climb(self, neighbours: Neighbours | None = None) -> Climb:
        """Move the body from rest, and return how the gait should change.

        Args:
            neighbours: of the present body, if that is to change too (`softgym_envs.extensions.beams.neighbours`).

        Raises:
            ConvergenceError: if a time step cannot be computed.
        """
        moved, parts, period = self.move(), self.backend.steps.count, self.config.settings.period
        found = moved.rollout.gradient(
            by_x=moved.by_x, by_velocity=moved.by_velocity, by_effort=moved.by_effort, neighbours=neighbours
        )
        by_command = command_gradient(found.commands, parts)
        gradient, carried = np.zeros_like(self.gait), np.zeros(by_command.shape[1])
        for k in reversed(range(len(by_command))):
            carried = carried + by_command[k]
            gradient[k % period] += carried * moved.pull[k]
            carried = carried * moved.follow[k]
        return Climb(moved.way, self.straight(gradient), found.design, moved.value)

    def _excess(self, effort: np.ndarray) -> tuple[float, np.ndarray | None]:
        """Return the charge for efforts (k, size) beyond their limit [m], and the derivatives of the value by them.

        Recorded motions follow their commands whatever that takes; those of the environment do not.
        """
        settings, limit = self.config.settings, self.backend.largest_efforts
        if settings.largest_effort is not None:
            limit = np.minimum(limit, settings.largest_effort)
        if np.isinf(limit).all():
            return 0.0, None
        count = len(limit)
        excess = np.maximum(np.abs(effort[:, :count]) / limit - 1.0, 0.0)
        by_effort, scale = np.zeros_like(effort), settings.excess * self.env.robot.size / len(effort)
        by_effort[:, :count] = -2.0 * scale * excess * np.sign(effort[:, :count]) / limit
        return scale * float((excess**2).sum()), by_effort

    def _mirrored(self, gait: np.ndarray, shift: int) -> np.ndarray:
        return np.roll(gait, shift, axis=0)[:, list(self.env.robot.mirrored_actuators)]

    def straight(self, change: np.ndarray) -> np.ndarray:
        """Return the part of a change of the gait (p, n_a) after which both sides still do the same."""
        return change if self._shift is None else 0.5 * (change + self._mirrored(change, self._shift))

    def commands(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the commands of the first control steps from rest, as the policy gives them.

        Returns:
            Commands, their derivatives by the command before, and those by the gait in this step (in half ranges), each
            of shape (count, n_a).
        """
        robot = self.env.robot
        command, rows = np.zeros(len(self._half)), []
        for k in range(count):
            ahead = self.gait[k % len(self.gait)] - (command - self._middle) / self._half
            action = np.tanh(self._gain * ahead)
            slope = self._gain * robot.rates * (1.0 - action**2)  # of the command, by what it is ahead
            wish = command + robot.rates * action
            free = (wish > robot.lower) & (wish < robot.upper)
            command = np.clip(wish, robot.lower, robot.upper)
            rows.append((command, np.where(free, 1.0 - slope / self._half, 0.0), np.where(free, slope, 0.0)))
        found = np.array(rows)
        return found[:, 0], found[:, 1], found[:, 2]

    # -- files --------------------------------------------------------------------------------------------------------

    def weights(self) -> Tensors:
        size, n = self.env.observation_space.shape[0], len(self._half)
        pull = np.zeros((n, size), dtype=np.float32)
        place = self.env.spaces.slices["command"].start + np.arange(n)
        pull[np.arange(n), place] = -self._gain
        return {
            "actor.mu.weight": pull,
            "actor.mu.bias": np.zeros(n, dtype=np.float32),
            "actor.clock": (self._gain * self.best).astype(np.float32),
        }

    def load_weights(self, tensors: Mapping[str, np.ndarray], path: Path) -> None:
        check_weights({"actor.clock": self.gait.shape}, tensors, path)
        self.ascent = Ascent(tensors["actor.clock"].astype(float) / self._gain)

    def state(self) -> tuple[Tensors, dict[str, Any]]:
        ascent = self.ascent
        kept = {name: getattr(ascent, name).copy() for name in Ascent.ARRAYS}
        value = ascent.value if ascent.count else None
        meta = {"step": self.step, "ways": self.ways, "value": value, "stride": ascent.stride, "count": ascent.count}
        return kept, meta

    def restore(self, tensors: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
        ascent = self.ascent
        for name in Ascent.ARRAYS:
            setattr(ascent, name, tensors[name].copy())
        self.step, self.ways, ascent.count = int(meta["step"]), list(meta["ways"]), int(meta["count"])
        ascent.value, ascent.stride = meta["value"] if ascent.count else -np.inf, float(meta["stride"])

    def close(self) -> None:
        self.env.close()
