"""Follow: go along headings that change, as fast as possible."""

from __future__ import annotations

from typing import Any

import numpy as np

from softgym_envs.backends.backend import State
from softgym_envs.envs.arrays import Array
from softgym_envs.envs.tasks.base import Kinematics, Random
from softgym_envs.extensions.walkers.tasks.locomotion import Pose
from softgym_envs.extensions.walkers.tasks.walk import Walk
from softgym_envs.robots.base import Robot

HEADINGS = 2
"""Headings of an episode, each for the same time."""


class Bearing(Pose):
    """How the body stands and moves, and where it is told to go, as it sees it; and the efforts of the actuators.

    Args:
        robot: what moves about.

    Attributes:
        direction: where it is told to go, shape (3,).
    """

    direction: np.ndarray
    signs = (1, 1, -1, 1, 1, -1, 1, -1, 1, -1, 1, -1)

    def of_body(self, short: str, speed: str) -> tuple[tuple[int, str, str, str], ...]:
        return (
            (1, "height of the body, against that at the start", f" over {short}", "m"),
            (3, "vertical along the directors of the body", "", ""),
            (2, "wanted direction along its first two directors", "", ""),
            (3, "velocity of the body along its directors", f" over {speed}", "m/s"),
            (3, "angular velocity of the body along its directors", " over 1 rad/s", "rad/s"),
        )

    def body(self, moved: np.ndarray, axes: np.ndarray, speed: np.ndarray, spin: np.ndarray) -> list[np.ndarray]:
        return [moved[2:], axes[:, 2], (axes @ self.direction)[:2], axes @ speed, axes @ spin]


class Follow(Walk):
    """Go on the ground along headings that are drawn, as fast as possible; see `Walk` and `Locomotion`.

    An episode has two headings, each for half of the time. The first one is up to ``turn`` to the left or to the right
    of where the robot looks, the second one as much from the first. Observations show the heading in the frame of the
    body, one control step before it is rated.

    Args:
        robot: a `MobileRobot` that touches the ground.
        turn: largest angle of a heading from the last one [rad].
        **options: those of `Walk`.

    Raises:
        ValueError: for a robot that cannot walk, or a number out of bounds.
    """

    name = "follow"
    horizon = 200
    max_episode_steps = 200
    lookahead = 1
    agents = ("steer", "gait", "random")
    qp_agent = "steer"

    def __init__(self, robot: Robot, *, turn: float = 0.5 * np.pi, **options: Any) -> None:
        super().__init__(robot, **options)
        if not 0.0 <= turn <= np.pi:
            raise ValueError(f"turn = {turn} rad is out of bounds; allowed: 0 to pi")
        self.turn = turn
        self.sensors = self._bearing = Bearing(self.robot)

    def sample(self, rng: Random, count: int, kinematics: Kinematics) -> Array:
        angle = np.cumsum(rng.uniform(-self.turn, self.turn, (count, HEADINGS)), axis=1)
        speed = self.pace * self.robot.size
        return np.stack([speed * np.cos(angle), speed * np.sin(angle), np.zeros_like(angle)], axis=-1)

    def record(self, state: State) -> None:
        super().record(state)
        self._bearing.direction = self.turn_to(self.lookahead)[0]

    def drawn_goals(self, state: State, path: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return a line from the robot towards where it is told to go, as long as the robot is large, and its end."""
        start = state.effector[0]
        end = start + self.robot.size * goal / np.linalg.norm(goal)
        return np.stack([start, end]), end
