"""Swim: go straight ahead in a fluid, as fast as possible."""

from __future__ import annotations

import numpy as np

from softgym_envs.extensions.walkers.robots.mobile import MobileRobot
from softgym_envs.extensions.walkers.tasks.locomotion import Locomotion
from softgym_envs.robots.base import Robot


class Swim(Locomotion):
    """Go along x in a fluid, as fast as possible; see `Locomotion`.

    A power is charged in proportion to that of all actuators at their typical efforts and full rates.

    Args:
        robot: a `MobileRobot` that touches nothing.
        pace: speed of the goal [sizes of the robot per second].
        drift: charge for the speed sideways.
        work: charge for work.

    Raises:
        ValueError: for a robot that does not swim, or a number out of bounds.
    """

    name = "swim"

    def __init__(self, robot: Robot, *, pace: float = 0.1, drift: float = 0.5, work: float = 0.02) -> None:
        if not isinstance(robot, MobileRobot) or robot.may_touch:
            raise ValueError(f"task 'swim' needs a robot that moves about and touches nothing; '{robot.name}' does not")
        super().__init__(robot, pace=pace, drift=drift, work=work)

    def power_scale(self, span: float) -> float:
        return float(np.asarray(self.robot.effort_scale) @ self.robot.rates) / span
