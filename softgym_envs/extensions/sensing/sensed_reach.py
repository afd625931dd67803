"""Sensed Reach: bring a tip that the agent cannot see to a goal, while something touches the body."""

from __future__ import annotations

import numpy as np

from softgym_envs.backends.backend import PointForce, State
from softgym_envs.envs.tasks.base import Load, Sensors, check_force
from softgym_envs.envs.tasks.reach import Reach
from softgym_envs.extensions.sensing.loads import Cell, TouchGrid, finger_grid
from softgym_envs.robots.base import Robot


class RandomTouch(Load):
    """A constant force at a random point of a grid, from a random step on.

    Args:
        grid: cells of the touch sensor.
        largest: largest force [N]; each is drawn uniformly.
        window: it begins at a random step among this many first control steps.

    Attributes:
        cell: the touched cell; None before the touch.
    """

    on_body = True

    def __init__(self, grid: TouchGrid, largest: float, window: int) -> None:
        self.grid, self.largest, self.window = grid, largest, window
        self.cell: Cell | None = None
        self._load, self._first = PointForce(np.zeros(3), np.zeros(3)), 0

    def begin(self, rng: np.random.Generator) -> None:
        grid, self.cell = self.grid, None
        along, across = grid.pitch * np.array(grid.cells) * rng.random(2)
        point = np.array(grid.corner) + along * np.array(grid.along) + across * np.array(grid.across)
        force = rng.uniform(0.0, self.largest) * np.array(grid.normal)
        self._load, self._first = PointForce(point, force), int(rng.integers(self.window))

    def at(self, step: int) -> PointForce | None:
        """Return the force during a control step, or None; ``cell`` becomes its cell."""
        self.cell = None if step < self._first else self.grid.cell(self._load.point)
        return None if self.cell is None else self._load


class FingerSensors(Sensors):
    """Cavities, then a grid of touch cells, then earlier readings of the cavities with their commands.

    The grid shows whether a cell is touched (1 or -1), and its place along both axes (-1 to 1, or 0).

    Args:
        scale: of the changes of the cavities' volumes, or of their pressures, shape (s,).
        actuators: number of commands.
        touch: what touches the grid.
        history: number of readings of the cavities, the present one included.
    """

    def __init__(self, scale: np.ndarray, actuators: int, touch: RandomTouch, history: int) -> None:
        self.scale, self.touch, self.history = scale, touch, history
        self.count = len(scale) + 3 + (history - 1) * (actuators + len(scale))
        self._readings: list[np.ndarray] = []

    def begin(self) -> None:
        self._readings = []

    def readings(self, state: State) -> np.ndarray:
        return state.condensed.delta.s / self.scale

    def further(self, readings: np.ndarray, new: bool) -> np.ndarray:
        if new:
            known = [readings, *self._readings]
            self._readings = (known + self.history * known[-1:])[: self.history]
        touched = np.array([-1.0, 0.0, 0.0])
        if self.touch.cell is not None:
            touched[:] = 1.0, *(2.0 * (np.array(self.touch.cell) + 0.5) / np.array(self.touch.grid.cells) - 1.0)
        return np.concatenate([touched, *self._readings[1:]])


class SensedReach(Reach):
    """Reach with a hidden effector: the agent sees its commands, sensor rows, a grid of touch cells and the goal.

    At a random step something touches the body with a constant force and stays. The force and its place in the touched
    cell are unknown: the grid tells the cell. Only the goal's coordinate along the normal of the grid counts.

    Args:
        robot: a robot with sensor rows and the back of the sensorized finger.
        force: largest force of a touch [N]; each is drawn uniformly. 0 for no touch.
        window: the touch begins at a random step among this many first control steps.
        pitch: size of a cell of the grid [m].
        history: number of readings that an observation shows, the present one included. Earlier ones come with their
            commands, the latest first; before the episode, the first reading stands for them.
        **options: options of `Reach`; ``command_low`` is 0.4 here, so that a goal stays reachable under a touch.
    """

    name = "sensed_reach"
    agents = ("qp_model", "qp_estimated", "random")

    def __init__(
        self,
        robot: Robot,
        *,
        force: float = 1.0,
        window: int = 20,
        pitch: float = 5e-3,
        history: int = 1,
        command_low: float = 0.4,
        **options: object,
    ) -> None:
        super().__init__(robot, command_low=command_low, **options)  # type: ignore[arg-type]
        if not robot.sensing:
            raise ValueError(f"task '{self.name}' needs a robot with sensors, but robot '{robot.name}' has none")
        if not (np.isfinite(force) and force >= 0.0):
            raise ValueError(f"force = {force} N must be non-negative and finite")
        check_force(force, "force", robot)
        if window < 1:
            raise ValueError(f"window = {window} must be at least 1")
        if history < 1:
            raise ValueError(f"history = {history} must be at least 1")
        self.touch = RandomTouch(finger_grid(pitch), force, window)
        self.load = self.touch if force > 0.0 else None
        self.sensors = FingerSensors(robot.sensing.scale, len(robot.actuators), self.touch, history)
        self.axes = np.abs(np.array(self.touch.grid.normal))
