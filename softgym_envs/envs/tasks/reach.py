"""Reach: bring the effector to a random goal and hold it there."""

from __future__ import annotations

import numpy as np

from softgym_envs.envs.tasks.base import Kinematics, Task, check_goals
from softgym_envs.errors import ConvergenceError
from softgym_envs.robots.base import Robot

__all__ = ["Reach"]


class Reach(Task):
    """A random goal per episode.

    Args:
        robot: the robot.
        goals: ``"reachable"`` draws goals the present body can reach; or an array of goals [m], shape (k, 3), to draw
            from whatever the body is, which makes bodies comparable.
        command_low: smallest command of a reachable goal, as a fraction of the actuator range; 0.5 asks for goals
            deep in the workspace.
        spread: largest random shift of a reachable goal along each axis [m]; some goals then lie off the workspace,
            and the best an agent can do is to come near.
    """

    name = "reach"
    horizon = 1

    def __init__(
        self, robot: Robot, *, goals: str | np.ndarray = "reachable", command_low: float = 0.0, spread: float = 0.0
    ) -> None:
        super().__init__(robot)
        if isinstance(goals, str):
            if goals != "reachable":
                raise ValueError(f"goals = {goals!r} is unknown; allowed: 'reachable' or an array of shape (k, 3)")
            self.fixed_goals = None
        else:
            self.fixed_goals = check_goals(goals, "goals")
        if not 0.0 <= command_low < 1.0:
            raise ValueError(f"command_low = {command_low} is out of bounds; allowed: [0, 1)")
        if not (np.isfinite(spread) and spread >= 0.0):
            raise ValueError(f"spread = {spread} m must be non-negative and finite")
        self.command_low = command_low
        self.spread = spread

    def sample(self, rng: np.random.Generator, count: int, kinematics: Kinematics) -> np.ndarray:
        if self.fixed_goals is not None:
            return self.fixed_goals[rng.integers(len(self.fixed_goals), size=count)][:, None]
        low = self.robot.lower + self.command_low * (self.robot.upper - self.robot.lower)
        goals = kinematics(rng.uniform(low, self.robot.upper, (count, len(low))))
        for _ in range(50):
            lost = np.isnan(goals[:, 0])  # commands without an equilibrium are drawn again
            if not lost.any():
                break
            goals[lost] = kinematics(rng.uniform(low, self.robot.upper, (count, len(low))))[lost]
        else:
            raise ConvergenceError(
                "50 random commands in a row have no equilibrium: no goal can be drawn", fraction=0.0
            )
        return (goals + rng.uniform(-self.spread, self.spread, goals.shape))[:, None]
