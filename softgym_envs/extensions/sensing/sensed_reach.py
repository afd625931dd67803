"""Sensed Reach: bring a tip that the agent cannot see to a goal, while something touches the body."""

from __future__ import annotations

import numpy as np

from softgym_envs.backends.backend import PointForce, State
from softgym_envs.envs.tasks.base import check_force
from softgym_envs.envs.tasks.reach import Reach
from softgym_envs.extensions.sensing.loads import Cell, finger_grid
from softgym_envs.robots.base import Robot


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
    hides_effector = True
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
        if not len(robot.sensing.scale):
            raise ValueError(f"task '{self.name}' needs a robot with sensors, but robot '{robot.name}' has none")
        if not (np.isfinite(force) and force >= 0.0):
            raise ValueError(f"force = {force} N must be non-negative and finite")
        check_force(force, "force", robot)
        if window < 1:
            raise ValueError(f"window = {window} must be at least 1")
        if history < 1:
            raise ValueError(f"history = {history} must be at least 1")
        self.grid = finger_grid(pitch)
        self.axes = np.abs(np.array(self.grid.normal))
        self.largest_force, self.window = force, window
        self.touches = force > 0.0
        each = len(robot.actuators) + len(robot.sensing.scale)
        self.history, self.sensors = history, len(robot.sensing.scale) + 3 + (history - 1) * each
        self._readings: list[np.ndarray] = []
        self.touched: Cell | None = None
        self._load, self._first = PointForce(np.zeros(3), np.zeros(3)), 0

    def begin(self, rng: np.random.Generator) -> None:
        self.touched, self._readings = None, []
        if self.touches:
            along, across = self.grid.pitch * np.array(self.grid.cells) * rng.random(2)
            point = np.array(self.grid.corner) + along * np.array(self.grid.along) + across * np.array(self.grid.across)
            force = rng.uniform(0.0, self.largest_force) * np.array(self.grid.normal)
            self._load, self._first = PointForce(point, force), int(rng.integers(self.window))

    def touch(self, step: int) -> PointForce | None:
        """Return the force that touches the body during a control step, or None; `touched` becomes its cell."""
        if not self.touches or step < self._first:
            self.touched = None
            return None
        self.touched = self.grid.cell(self._load.point)
        return self._load

    def sensor_readings(self, state: State) -> np.ndarray:
        """Return the changes of the cavities' volumes, or their pressures, over their scale, shape (s,)."""
        return state.condensed.delta.s / self.robot.sensing.scale

    def touch_readings(self) -> np.ndarray:
        """Return whether a cell is touched (1 or -1), and its place along both axes of the grid (-1 to 1, or 0)."""
        if self.touched is None:
            return np.array([-1.0, 0.0, 0.0])
        return np.array([1.0, *(2.0 * (np.array(self.touched) + 0.5) / np.array(self.grid.cells) - 1.0)])

    def past_readings(self, reading: np.ndarray, new: bool) -> np.ndarray:
        """Return the commands and cavities of the readings before the present one, shape ((history - 1) (n_a + s),)."""
        if new:
            known = [reading, *self._readings]
            self._readings = (known + self.history * known[-1:])[: self.history]
        return np.concatenate([np.zeros(0), *self._readings[1:]])
