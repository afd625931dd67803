"""Base classes of robots with a rhythm, and of those that move about."""

from __future__ import annotations

import numpy as np

from softgym_envs.robots.base import Robot


class RhythmicRobot(Robot):
    """A robot with a plain gait, from which others are searched.

    Attributes:
        mirrored_actuators: for each actuator, that on the other side of the body; None if it has no equal sides.
    """

    mirrored_actuators: tuple[int, ...] | None = None

    def reference_gait(self) -> np.ndarray:
        """Return the commands of one period of a plain gait, one for each control step, shape (p, n_a).

        Raises:
            ValueError: if the robot has none.
        """
        raise ValueError(f"robot '{self.name}' has no reference gait: define reference_gait")


class MobileRobot(RhythmicRobot):
    """A robot that no clamp holds; the frame that carries its body is the one that its `View` follows."""

    @property
    def body_frame(self) -> int:
        """Row of the model with the origin of the frame that carries the body; its directors follow."""
        assert self.view.follows is not None
        return self.view.follows

    def place(self, nodes: np.ndarray) -> np.ndarray:
        """Return where the robot is [m], shape (3,), for positions of all rows of the model [m], shape (n, 3)."""
        return nodes[self.body_frame]

    def steered_gait(self, turn: float, gait: np.ndarray | None = None) -> np.ndarray:
        """Return a gait, changed so that the robot turns, shape (p, n_a).

        Args:
            turn: from -1, to the right as fast as this gait can, over 0, straight ahead, to 1, to the left.
            gait: commands of one period, shape (p, n_a); default the reference gait.

        Raises:
            ValueError: if the robot has none.
        """
        raise ValueError(f"robot '{self.name}' has no gait that turns: define steered_gait")


def rhythmic(robot: Robot) -> RhythmicRobot:
    """Return a robot with a gait.

    Raises:
        ValueError: for another robot.
    """
    if not isinstance(robot, RhythmicRobot):
        raise ValueError(f"robot '{robot.name}' has no gait")
    return robot


def mobile(robot: Robot) -> MobileRobot:
    """Return a robot that moves about.

    Raises:
        ValueError: for another robot.
    """
    if not isinstance(robot, MobileRobot):
        raise ValueError(f"robot '{robot.name}' has no heading: it does not move about")
    return robot
