"""Track: follow a path of goals, the robot's published one by default."""

from __future__ import annotations

import numpy as np

from softgym_envs.envs.arrays import Array
from softgym_envs.envs.tasks.base import Kinematics, Random, Task, check_goals, check_length
from softgym_envs.robots.base import Robot


class Track(Task):
    """A path of goals, one after the other.

    Args:
        robot: the robot.
        path: goals [m], shape (p, 3); default the robot's `reference_path`.
        jitter: largest random shift of the path along each axis per episode [m].
        lookahead: control steps by which the observed goal is ahead of the rated one. With 1, the default, the
            observation shows the goal that the next action is rated by; with 0 the goal moves after the action.

    Raises:
        ValueError: for a malformed path, a negative jitter or lookahead, or a robot without a reference path.
    """

    name = "track"
    horizon = 100

    def __init__(
        self, robot: Robot, *, path: np.ndarray | None = None, jitter: float = 0.0, lookahead: int = 1
    ) -> None:
        super().__init__(robot)
        name = "path" if path is not None else f"reference_path of robot '{robot.name}'"
        self.path: Array = check_goals(robot.reference_path() if path is None else path, name, robot)
        self.jitter = check_length(jitter, "jitter", robot)
        if lookahead < 0:
            raise ValueError(f"lookahead = {lookahead} control steps must be 0 or more")
        self.lookahead = lookahead

    def sample(self, rng: Random, count: int, kinematics: Kinematics) -> Array:
        return self.path + rng.uniform(-self.jitter, self.jitter, (count, 1, 3))
