"""Agents of bodies that move: a gait without feedback, and one that is steered by hand."""

from __future__ import annotations

from typing import Any

import numpy as np

from softgym_envs.agents.policy import Policy
from softgym_envs.errors import WeightsError
from softgym_envs.extensions.walkers.robots.mobile import mobile, rhythmic

STEERING = 1.5
"""Steering of a gait, over the angle from where the robot faces to its heading [1/rad]."""


class GaitAgent:
    """A gait, which does not follow what happens.

    Args:
        seed: not used.
        policy: whose gait it is, without what it makes of observations: a file, the folder of a training or a name;
            default the reference gait of the robot, which is the same for all bodies.

    Raises:
        WeightsError: for a policy without a gait, or whose gait drives another number of actuators.
    """

    title = "common gait"
    takes_policy = True

    def __init__(self, seed: int = 0, policy: str | None = None) -> None:
        self._policy, self._clock = policy, None if policy is None else Policy(policy).clock
        if policy is not None and self._clock is None:
            raise WeightsError(f"policy '{policy}' has no gait; allowed: those of the learners gait and horizon")

    def __call__(self, observation: Any, env: Any) -> np.ndarray:
        """Return the action that leads towards the next command of the gait, shape (n_a,)."""
        robot, spaces = env.robot, env.spaces
        if self._clock is None:
            gait = self.led(rhythmic(robot).reference_gait(), env)
            action: np.ndarray = spaces.action(gait[(env.steps + 1) % len(gait)], env.command)
            return action
        if self._clock.shape[1] != len(robot.actuators):
            raise WeightsError(
                f"the gait of policy '{self._policy}' drives {self._clock.shape[1]} actuators; "
                f"'{robot.name}' has {len(robot.actuators)}"
            )
        # Where the policy would be after each step, and how it goes there.
        gait = self.led(spaces.middle + robot.rates * self._clock, env)
        return np.tanh((gait[env.steps % len(gait)] - env.command) / robot.rates)

    def led(self, gait: np.ndarray, env: Any) -> np.ndarray:
        """Return a gait (p, n_a) as it is to go on now."""
        return gait


class SteerAgent(GaitAgent):
    """A rule by hand: a gait, steered in proportion to the angle to the heading; arguments as for `GaitAgent`."""

    title = "steered gait"

    def led(self, gait: np.ndarray, env: Any) -> np.ndarray:
        robot = mobile(env.robot)
        row = robot.body_frame
        forwards, left, _ = env.state.nodes[row + 1 : row + 4] @ env.observed_goal
        turn = float(np.clip(STEERING * np.arctan2(left, forwards), -1.0, 1.0))
        return robot.steered_gait(turn, gait)
