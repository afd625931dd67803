"""Track: follow a path of goals, the published closing motion by default."""

from __future__ import annotations

import numpy as np

from softgym_envs.envs.task import Kinematics, Task, check_goals
from softgym_envs.robots.robot import Robot

__all__ = ["Track", "bending_arc"]


def bending_arc(robot: Robot, count: int = 25, angle: float = np.pi / 3) -> np.ndarray:
    """Goals [m] (count, 3) of a tip that bends about the base, after the closing motion of the thesis (Fig. 4.3).

    The radius shrinks as that of the bending finger does, ``1 - 0.7 (theta / 90 deg)^2`` of the rest length (within
    2 mm of the baseline's workspace up to 45 degrees); the end of the path is outside the workspace, as in the thesis.
    """
    theta = np.linspace(0.0, angle, count)
    radius = robot.size * (1.0 - 0.7 * (theta / (0.5 * np.pi)) ** 2)
    offset = robot.effector_rest[1]
    return np.column_stack(
        [
            np.zeros(count),
            offset * np.cos(theta) + radius * np.sin(theta),
            -radius * np.cos(theta) + offset * np.sin(theta),
        ]
    )


class Track(Task):
    """A path of goals, one after the other.

    Args:
        robot: the robot.
        path: goals [m], shape (p, 3); default the bending arc.
        jitter: largest random shift of the path along each axis per episode [m].
    """

    name = "track"
    success_distance = 0.002
    horizon = 100

    def __init__(self, robot: Robot, *, path: np.ndarray | None = None, jitter: float = 0.0) -> None:
        super().__init__(robot)
        self.path = bending_arc(robot) if path is None else check_goals(path, "path")
        if not (np.isfinite(jitter) and jitter >= 0.0):
            raise ValueError(f"jitter = {jitter} m must be non-negative and finite")
        self.jitter = jitter

    def sample(self, rng: np.random.Generator, count: int, kinematics: Kinematics) -> np.ndarray:
        return self.path + rng.uniform(-self.jitter, self.jitter, (count, 1, 3))
