"""What an agent sees and does: spaces, scaling and bookkeeping shared by the single and the batched environment."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from softgym_envs.robots.base import Robot

__all__ = ["Interface"]


class Interface:
    """Observation and action layout of a robot and a task. All methods work on batches (B, ...).

    Args:
        robot: the robot.
        action_mode: ``"increment"``: an action of 1 moves a command by its largest rate; ``"absolute"``: -1 and 1 are
            the ends of the actuator's range, approached at no more than the rate.
        design_names: design variables shown in the observation, none for an empty tuple.
        axes: which coordinates of the effector count in the error, shape (3,); default all.
        moving: show velocities, as an agent needs in dynamics.

    Attributes:
        reach: what positions are divided by [m].
        error_scale: distance to the goal that is shown as one half [m].
        slices: where the parts of an observation are: command, displacement, effort, effector, goal, error, velocity,
            design.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        action_mode: str,
        design_names: tuple[str, ...],
        axes: np.ndarray | None = None,
        moving: bool = False,
    ) -> None:
        if action_mode not in ("increment", "absolute"):
            raise ValueError(f"action_mode = {action_mode!r} is unknown; allowed: 'increment', 'absolute'")
        self.robot = robot
        self.action_mode = action_mode
        self.design_names = design_names
        self.axes = np.ones(3) if axes is None else axes
        self.moving = moving
        self.lower, self.upper, self.rates = robot.lower, robot.upper, robot.rates
        self._middle = 0.5 * (self.lower + self.upper)
        self._half = 0.5 * (self.upper - self.lower)
        self.reach = 1.25 * robot.size
        self.error_scale = robot.workspace_scale / 2.5
        n = len(robot.actuators)
        self.action_space = spaces.Box(-1.0, 1.0, (n,), np.float32)
        self.slices: dict[str, slice] = {}
        start = 0
        for name, size in (
            ("command", n),
            ("displacement", n),
            ("effort", n),
            ("effector", 3),
            ("goal", 3),
            ("error", 3),
            ("velocity", 3 * moving),
            ("design", len(design_names)),
        ):
            self.slices[name] = slice(start, start + size)
            start += size
        self.observation_space = spaces.Box(-1.0, 1.0, (start,), np.float32)

    def check_action(self, action: np.ndarray) -> np.ndarray:
        """Return the action as float64, clipped to [-1, 1].

        Raises:
            ValueError: for a wrong shape or a value that is not finite.
        """
        action = np.asarray(action, dtype=float)
        shape = action.shape[:-1] + self.action_space.shape
        if action.ndim == 0 or action.shape != shape:
            raise ValueError(f"action must have shape {self.action_space.shape}, got {action.shape}")
        if not np.isfinite(action).all():
            raise ValueError(f"action = {action.tolist()} must be finite; allowed: -1 to 1")
        return np.minimum(np.maximum(action, -1.0), 1.0)

    def command(self, action: np.ndarray, previous: np.ndarray) -> np.ndarray:
        """Commanded displacements that follow an action, shape (..., n_a)."""
        if self.action_mode == "increment":
            target = previous + action * self.rates
        else:
            target = self._middle + action * self._half
            target = previous + np.minimum(np.maximum(target - previous, -self.rates), self.rates)
        return np.minimum(np.maximum(target, self.lower), self.upper)

    def action(self, command: np.ndarray, previous: np.ndarray) -> np.ndarray:
        """The action that leads to a command, for controllers that think in displacements; shape (..., n_a)."""
        if self.action_mode == "increment":
            action = (command - previous) / self.rates
        else:
            action = (command - self._middle) / self._half
        return np.minimum(np.maximum(action, -1.0), 1.0).astype(np.float32)

    def observe(
        self,
        command: np.ndarray,
        displacement: np.ndarray,
        effort: np.ndarray,
        effector: np.ndarray,
        goal: np.ndarray,
        unit_design: np.ndarray,
        velocity: np.ndarray | None = None,
    ) -> np.ndarray:
        """Scaled observation (..., d): command, displacement, effort, effector, goal, error, velocity, design.

        Efforts and errors have no bound of their own and are squashed by x / (1 + |x|), which loses nothing.
        """
        relative = effort / self.robot.effort_scale
        speed = velocity / self.robot.size if self.moving and velocity is not None else None
        parts = (
            (command - self._middle) / self._half,
            (displacement - self._middle) / self._half,
            relative / (1.0 + np.abs(relative)),
            effector / self.reach,
            *self._show_goal(effector, goal),
            *(() if speed is None else (speed / (1.0 + np.abs(speed)),)),
            unit_design,
        )
        observation = np.concatenate(parts, axis=-1)
        return np.minimum(np.maximum(observation, -1.0), 1.0).astype(np.float32)

    def _show_goal(self, effector: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        error = self.axes * (goal - effector) / self.error_scale
        return goal / self.reach, error / (1.0 + np.abs(error))

    def effector(self, observation: np.ndarray) -> np.ndarray:
        """The first effector [m] (..., 3) that observations (..., d) show, with their seven digits."""
        return observation[..., self.slices["effector"]].astype(float) * self.reach

    def effort_share(self, observation: np.ndarray) -> np.ndarray:
        """The mean effort over its scale (...) that observations (..., d) show."""
        squashed = np.abs(observation[..., self.slices["effort"]].astype(float))
        return (squashed / (1.0 - np.minimum(squashed, 1.0 - 1e-7))).mean(axis=-1)

    def with_goal(self, observation: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Observations (..., d) as they would be with other goals [m] (..., 3)."""
        changed = observation.copy()
        shown = np.concatenate(self._show_goal(self.effector(observation), goal), axis=-1)
        changed[..., self.slices["goal"].start : self.slices["error"].stop] = np.clip(shown, -1.0, 1.0)
        return changed
