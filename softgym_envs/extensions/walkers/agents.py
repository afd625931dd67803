"""Agents of bodies that move: a gait without feedback, and one that is steered by hand."""

from __future__ import annotations

from typing import Any

import numpy as np

STEERING = 1.5
"""Steering of a gait, over the angle from where the robot faces to its heading [1/rad]."""


class GaitAgent:
    """The reference gait of the robot, which is the same for all bodies.

    Args:
        seed: not used.
    """

    title = "common gait"

    def __init__(self, seed: int = 0) -> None:
        pass

    def __call__(self, observation: Any, env: Any) -> np.ndarray:
        """Return the action that leads towards the next command of the gait, shape (n_a,)."""
        gait = env.robot.reference_gait()
        action: np.ndarray = env.spaces.action(gait[(env.steps + 1) % len(gait)], env.command)
        return action


class SteerAgent:
    """A rule by hand: the reference gait of the robot, steered in proportion to the angle to its heading.

    Args:
        seed: not used.
    """

    title = "steered gait"

    def __init__(self, seed: int = 0) -> None:
        pass

    def __call__(self, observation: Any, env: Any) -> np.ndarray:
        """Return the action that leads towards the next command of the gait, shape (n_a,)."""
        forwards, left, _ = env.state.nodes[env.robot.body_frame + 1 : env.robot.body_frame + 4] @ env.observed_goal
        gait = env.robot.steered_gait(np.clip(STEERING * np.arctan2(left, forwards), -1.0, 1.0))
        action: np.ndarray = env.spaces.action(gait[(env.steps + 1) % len(gait)], env.command)
        return action
