"""Track: follow a path of goals, the published closing motion by default."""

from __future__ import annotations

import numpy as np

from softgym_envs.envs.task import Kinematics, Task, check_goals
from softgym_envs.robots.robot import Robot

__all__ = ["Track", "bending_arc"]


def bending_arc(robot: Robot, count: int = 25, angle: float = 0.5 * np.pi) -> np.ndarray:
    """Goals [m] (count, 3) of a tip swinging on a circle about the base: the thesis' quarter circle (Fig. 4.3).

    The radius shrinks linearly to 0.8 of the rest length, as a bending body's does; its end is outside the workspace
    of the baseline finger, as in the thesis.
    """
    theta = np.linspace(0.0, angle, count)
    radius = robot.size * np.linspace(1.0, 0.8, count)
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
