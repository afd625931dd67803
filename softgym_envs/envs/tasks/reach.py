"""Reach: bring the effector to a random goal and hold it there."""

from __future__ import annotations

import numpy as np

from softgym_envs.envs.arrays import Array
from softgym_envs.envs.tasks.base import Kinematics, Random, Task, check_goals, check_length
from softgym_envs.robots.base import Robot


class Reach(Task):
    """One random goal per episode.

    Args:
        robot: the robot.
        goals: ``"reachable"`` draws goals within reach of the present body. Goals of an array [m], shape (k, 3), are
            drawn whatever the body is, which makes bodies comparable.
        command_low: smallest command of a reachable goal, as a fraction of the actuator's range; 0.5 leads to goals
            deep in the workspace.
        spread: largest random shift of a reachable goal along each axis [m]; some goals then lie outside the workspace,
            where an agent can only approach them.
    """

    name = "reach"
    horizon = 1
    max_episode_steps = 50

    def __init__(
        self, robot: Robot, *, goals: str | np.ndarray = "reachable", command_low: float = 0.0, spread: float = 0.0
    ) -> None:
        super().__init__(robot)
        self.fixed_goals: Array | None = None
        if not isinstance(goals, str):
            self.fixed_goals = check_goals(goals, "goals", robot)
        elif goals != "reachable":
            raise ValueError(f"goals = {goals!r} is unknown; allowed: 'reachable' or an array of shape (k, 3)")
        if not 0.0 <= command_low < 1.0:
            raise ValueError(f"command_low = {command_low} is out of bounds; allowed: [0, 1)")
        self.command_low = command_low
        self.spread = check_length(spread, "spread", robot)

    def sample(self, rng: Random, count: int, kinematics: Kinematics) -> Array:
        if self.fixed_goals is not None:
            return self.fixed_goals[rng.integers(len(self.fixed_goals), size=count)][:, None]
        lower, high = self.robot.command_limits
        low = lower + self.command_low * (high - lower)
        goals = kinematics(self.robot.balanced(rng.uniform(low, high, (count, len(low)))))
        return (goals + rng.uniform(-self.spread, self.spread, goals.shape))[:, None]
