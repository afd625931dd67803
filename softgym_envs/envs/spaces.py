"""Observation and action of an agent: layout, scaling and bounds, shared by all environments."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from softgym_envs.arguments import choice
from softgym_envs.envs.arrays import Array, namespace
from softgym_envs.robots.base import Robot


class AgentSpaces:
    """Observation and action spaces of a robot with a task, and the scaling between them and SI units.

    Methods take single states or batches (B, ...). `command` and `observe` also take torch tensors, in a copy of this
    object whose arrays are tensors.

    Args:
        robot: the robot.
        action_mode: ``"increment"``: an action of 1 moves a command by its largest rate; ``"absolute"``: -1 and 1 are
            the ends of the actuator's range, which the command approaches no faster than its rate.
        design_names: design variables in the observation; an empty tuple for none.
        axes: coordinates of the effector that count in the error, 1 or 0, shape (3,); default all.
        moving: whether the observation contains the effector's velocity, which an agent needs in dynamics.
        goal_scale: that of the task; default 1.25 times the size of the robot.
        error_scale: that of the task; default 0.4 times the workspace scale of the robot.
        sensors: number of sensor values that observations show in place of displacements, efforts, effector, error and
            velocity; 0 for those.

    Attributes:
        action_space: of one environment, shape (n_a,).
        observation_space: of one environment, shape (d,).
        position_scale: unit of observed effectors and goals [m].
        error_scale: distance to the goal that is observed as one half [m].
        slices: where to find the parts of an observation: command, displacement, effort, effector, sensors, goal,
            error, velocity, design; those that it does not have are empty.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        action_mode: str,
        design_names: tuple[str, ...],
        axes: np.ndarray | None = None,
        moving: bool = False,
        goal_scale: float | None = None,
        error_scale: float | None = None,
        sensors: int = 0,
    ) -> None:
        choice("action_mode", action_mode, ("increment", "absolute"))
        self.robot = robot
        self.action_mode = action_mode
        self.design_names = design_names
        self.axes: Array = np.ones(3) if axes is None else axes
        self.moving = moving
        self.sensors = sensors
        self.lower: Array
        self.upper: Array
        self.lower, self.upper = robot.command_limits
        self.rates: Array = robot.command_rates
        self.effort_scale: Array = np.asarray(robot.effort_scale, dtype=float)
        self.middle: Array = 0.5 * (self.lower + self.upper)
        self.half_range: Array = 0.5 * (self.upper - self.lower)
        self.displacement_middle: Array = 0.5 * (robot.lower + robot.upper)
        self.displacement_half: Array = 0.5 * (robot.upper - robot.lower)
        self.position_scale = 1.25 * robot.size if goal_scale is None else goal_scale
        self.error_scale = robot.workspace_scale / 2.5 if error_scale is None else error_scale
        n = len(robot.actuators)
        seen = sensors == 0
        self.action_space = spaces.Box(-1.0, 1.0, (n,), np.float32)
        self.slices: dict[str, slice] = {}
        start = 0
        for name, size in (
            ("command", n),
            ("displacement", n * seen),
            ("effort", n * seen),
            ("effector", 3 * seen),
            ("sensors", sensors),
            ("goal", 3),
            ("error", 3 * seen),
            ("velocity", 3 * (moving and seen)),
            ("design", sum(robot.design_space[name].observed_size for name in design_names)),
        ):
            self.slices[name] = slice(start, start + size)
            start += size
        self.observation_space = spaces.Box(-1.0, 1.0, (start,), np.float32)

    def check_action(self, action: np.ndarray) -> np.ndarray:
        """Return the action as float64, clipped to [-1, 1].

        Raises:
            ValueError: for a wrong shape or a value that is not finite.
        """
        try:
            action = np.asarray(action, dtype=float)
        except (TypeError, ValueError):
            raise ValueError(f"action = {action!r} must be numbers; allowed: -1 to 1") from None
        shape = action.shape[:-1] + self.action_space.shape
        if action.ndim == 0 or action.shape != shape:
            raise ValueError(f"action must have shape {self.action_space.shape}, got {action.shape}")
        if not np.isfinite(action).all():
            rows = action.reshape(-1, action.shape[-1])
            first = rows[np.flatnonzero(~np.isfinite(rows).all(axis=1))[0]]
            raise ValueError(f"action = {first.tolist()} must be finite; allowed: -1 to 1")
        return np.minimum(np.maximum(action, -1.0), 1.0)

    def command(self, action: Array, previous: Array) -> Array:
        """Return the commands that an action in [-1, 1] leads to, shape (..., n_a)."""
        xp = namespace(action)
        if self.action_mode == "increment":
            target = previous + action * self.rates
        else:
            target = self.middle + action * self.half_range
            target = previous + xp.minimum(xp.maximum(target - previous, -self.rates), self.rates)
        return xp.minimum(xp.maximum(target, self.lower), self.upper)

    def command_slope(self, action: np.ndarray, previous: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how commands follow actions, each of shape (..., n_a).

        Returns:
            The derivative of a command in its action where no limit holds it; and which limit holds it: 1 for one above
            (range, or rate of an absolute action), -1 for one below, 0 for none.
        """
        if self.action_mode == "increment":
            wish, slope = previous + action * self.rates, self.rates
            high, low = self.upper, self.lower
        else:
            wish, slope = self.middle + action * self.half_range, self.half_range
            high, low = np.minimum(self.upper, previous + self.rates), np.maximum(self.lower, previous - self.rates)
        limited = (wish > high).astype(float) - (wish < low)
        return np.broadcast_to(slope, wish.shape), limited

    def action(self, command: np.ndarray, previous: np.ndarray) -> np.ndarray:
        """Return the action that leads to a command, shape (..., n_a), for controllers that compute commands."""
        if self.action_mode == "increment":
            action = (command - previous) / self.rates
        else:
            action = (command - self.middle) / self.half_range
        return np.minimum(np.maximum(action, -1.0), 1.0).astype(np.float32)

    def observe(
        self,
        command: Array,
        displacement: Array,
        effort: Array,
        effector: Array,
        goal: Array,
        unit_design: Array,
        velocity: Array | None = None,
        sensors: Array | None = None,
    ) -> Array:
        """Return the observation of a state, shape (..., d), float32 or the type of the tensors.

        The parts are command, displacement, effort, effector, goal, error, velocity and design; or command, sensors,
        goal and design. Efforts, errors and velocities are unbounded; x / (1 + abs(x)) maps them to (-1, 1) without
        loss.

        Args:
            command: commanded displacements or efforts, shape (..., n_a).
            displacement: displacements, shape (..., n_a).
            effort: efforts, shape (..., n_a).
            effector: first effector [m], shape (..., 3).
            goal: goal [m], shape (..., 3).
            unit_design: design variables as `DesignSpace.observe` shows them, shape (..., k).
            velocity: of the first effector [m/s], shape (..., 3); required if ``moving``.
            sensors: values in [-1, 1], shape (..., sensors); required if there are any.
        """
        xp = namespace(effector)
        parts = [(command - self.middle) / self.half_range]
        if self.sensors:
            assert sensors is not None
            parts += [sensors, goal / self.position_scale]
        else:
            parts += [
                (displacement - self.displacement_middle) / self.displacement_half,
                squash(effort / self.effort_scale),
                effector / self.position_scale,
                *self._goal_parts(effector, goal),
            ]
            if self.moving and velocity is not None:
                parts.append(squash(velocity / self.robot.size))
        observation = xp.concatenate((*parts, unit_design), axis=-1)
        if xp is np:
            return np.minimum(np.maximum(observation, -1.0), 1.0).astype(np.float32)
        return observation.clip(-1.0, 1.0)

    def _goal_parts(self, effector: Array, goal: Array) -> tuple[Array, Array]:
        return goal / self.position_scale, squash(self.axes * (goal - effector) / self.error_scale)

    def observed_effector(self, observation: np.ndarray) -> np.ndarray:
        """Return the first effector [m] (..., 3) in observations (..., d), in float32 precision.

        Raises:
            ValueError: if observations show sensors in its place.
        """
        if self.sensors:
            raise ValueError(f"observations of robot '{self.robot.name}' show sensors in place of its effector")
        return observation[..., self.slices["effector"]].astype(float) * self.position_scale

    def observed_goal(self, observation: np.ndarray) -> np.ndarray:
        """Return the goals [m] (..., 3) in observations (..., d), in float32 precision."""
        return observation[..., self.slices["goal"]].astype(float) * self.position_scale

    def effort_share(self, effort: Array) -> Array:
        """Return the mean over the actuators (...) of efforts (..., n_a) relative to their scale."""
        return abs(effort / self.effort_scale).sum(axis=-1) / len(self.effort_scale)

    def observed_effort_share(self, observation: np.ndarray) -> np.ndarray:
        """Return `effort_share` (...) of the efforts in observations (..., d)."""
        squashed = np.abs(observation[..., self.slices["effort"]].astype(float))
        return (squashed / (1.0 - np.minimum(squashed, 1.0 - 1e-7))).mean(axis=-1)

    def with_goal(self, observation: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Return observations (..., d) of the same states with other goals [m] (..., 3)."""
        changed = observation.copy()
        parts = np.concatenate(self._goal_parts(self.observed_effector(observation), goal), axis=-1)
        changed[..., self.slices["goal"].start : self.slices["error"].stop] = np.clip(parts, -1.0, 1.0)
        return changed


def squash(x: Array) -> Array:
    """Return ``x / (1 + abs(x))``, in (-1, 1)."""
    return x / (1.0 + abs(x))
