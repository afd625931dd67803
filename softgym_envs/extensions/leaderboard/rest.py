"""States where the inverse QP comes to rest: what an episode ends at, in far fewer steps.

The steps of an episode are limited by the rates of the actuators. Where only the end counts they may be longer, as long
as they lead to the same end: robots that can reach a goal in several ways (the Stiff-Flop trunk) need short steps.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from softgym_envs.control import settling
from softgym_envs.control.inverse_qp import InverseQP
from softgym_envs.control.settling import nearest_next
from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.base import Robot

if TYPE_CHECKING:
    from softgym_envs.envs.vector_env import SoftRobotVectorEnv

LONGEST = 0.1
"""Largest step of a command, relative to its range, unless the caller knows that longer ones lead to the same end."""

SETTLED = 3e-3
"""Step of all commands, relative to their ranges, below which a body counts as at rest."""

MAX_STEPS = 25
"""Largest number of steps towards rest."""


def settle(env: SoftRobotVectorEnv, goals: np.ndarray, longest: float = LONGEST) -> tuple[np.ndarray, int]:
    """Bring all rows of a batched environment from their present states to rest.

    Args:
        env: the environment, after its reset.
        goals: goal of each row [m], shape (n, 3).
        longest: largest step, relative to the range of a command.

    Returns:
        The last commands, shape (n, n_a), and the number of steps, the same for all rows.
    """
    span = env.robot.upper - env.robot.lower
    controller = InverseQP.for_robot(env.robot, goal_weights=env.task.axes, rates=longest * span)
    for steps in range(1, MAX_STEPS + 1):  # noqa: B007 - returned
        command = controller.solve_batch(env.condensed, goals, env.command, env.slack)
        change = np.abs(command - env.command).max(axis=0) / span
        env.backend.step(command)
        if change.max() < SETTLED:
            break
    return command, steps


def outcome(env: SoftRobotVectorEnv, goals: np.ndarray) -> np.ndarray:
    """Return distance to the goal, mean effort and success of the present state of each row, shape (n, 3)."""
    state, task = env.backend.state, env.task
    distance = np.linalg.norm((state.effector[:, :3] - goals) * task.axes, axis=1)
    return np.stack([distance, np.abs(state.effort).mean(axis=1), distance < task.success_distance], axis=1)


def settle_on_fem(
    robot: Robot, design: dict[str, float], goals: np.ndarray, commands: np.ndarray, success: float, longest: float
) -> np.ndarray:
    """Return `outcome` of a body on finite elements, where the inverse QP comes to rest there.

    Each goal begins with the command that the learned model rests at, which saves most of the way. The body goes from
    goal to goal, each time to the one with the nearest command: a way back to its state without commands would take
    most of the solves. Statics remember nothing, so a body with one equilibrium per command ends where it would
    otherwise.

    Args:
        robot: the robot.
        design: complete design [SI].
        goals: goals [m], shape (n, 3).
        commands: command that each goal begins with, shape (n, n_a).
        success: distance within which a goal counts as reached [m].
        longest: see `settle`.

    Returns:
        Shape (n, 3); NaN where the body has no equilibrium.
    """
    rows = np.full((len(goals), 3), np.nan)
    try:
        statics = Statics(robot.build(design))
        for place in nearest_next(commands / (robot.upper - robot.lower)):
            found = settling.settle(
                statics,
                robot,
                goals[place],
                commands[place],
                longest=longest,
                tolerance=SETTLED,
                equilibria=MAX_STEPS,
                limit_efforts=True,
            )
            rows[place] = found.distance, np.abs(found.effort).mean(), found.distance < success
    except (ConvergenceError, InfeasibleDesign):
        return np.full_like(rows, np.nan)
    return rows
