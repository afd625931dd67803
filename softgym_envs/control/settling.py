"""Where the inverse QP ends on finite elements, without the path that leads there.

In statics without friction the equilibrium under a command does not depend on how the command was reached, except where
there are several equilibria. The end of an episode then takes a few equilibria instead of one per control step, so fine
meshes can judge a body.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from softgym_envs.control.inverse_qp import InverseQP
from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.solvers.equilibrium import Equilibrium
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.base import Robot


@dataclass(frozen=True)
class Settled:
    """Where the inverse QP stays.

    Attributes:
        command: shape (n_a,).
        effector: first effector [m], shape (3,).
        effort: shape (n_a,).
        displacement: of the actuators, shape (n_a,).
        self_force: with which surfaces of the body press on each other [N]; NaN without contact.
        distance: from the goal [m], along the robot's goal axes.
        change: largest change of the last command, relative to its range; small if the QP has settled.
        equilibria: number of equilibria that were solved.
    """

    command: np.ndarray
    effector: np.ndarray
    effort: np.ndarray
    displacement: np.ndarray
    self_force: float
    distance: float
    change: float
    equilibria: int


def settle(
    statics: Statics,
    robot: Robot,
    goal: np.ndarray,
    start: np.ndarray,
    *,
    longest: float = 0.15,
    tolerance: float = 1e-3,
    equilibria: int = 8,
    limit_efforts: bool = False,
) -> Settled:
    """Return where the inverse QP of a robot with one effector stays: it steps from equilibrium to equilibrium.

    The nearest equilibrium to the goal is returned, so a step that leads away is not taken, and the next one is half as
    long. The solver does not keep to the largest efforts of the actuators: compare ``effort`` with them.

    Args:
        statics: solver of the body.
        robot: the robot.
        goal: of the effector [m], shape (3,).
        start: first command, for example that of a surrogate, shape (n_a,).
        longest: largest step, relative to the ranges of the commands.
        tolerance: smallest step, likewise.
        equilibria: largest number of equilibria.
        limit_efforts: whether the controller keeps to the largest efforts.

    Raises:
        ConvergenceError: if there is no equilibrium under the first command.
    """
    span = robot.upper - robot.lower
    unlimited = {} if limit_efforts else {"min_effort": None, "max_effort": None}
    command = np.clip(start, robot.lower, robot.upper)
    best: tuple[Settled, Equilibrium] | None = None
    for count in range(1, equilibria + 1):
        try:
            state = statics.solve(command)
        except ConvergenceError:
            if best is None:
                raise
            longest *= 0.5
        else:
            effector = state.condensed.delta.e[:3]
            distance = float(np.linalg.norm((effector - goal) * robot.goal_axes))
            if best is None or distance < best[0].distance:
                effort, displacement = state.effort[: len(span)], state.delta[: len(span)]
                pressing = np.nan if state.contacts is None else state.contacts.self_force
                best = Settled(command, effector, effort, displacement, pressing, distance, np.inf, count), state
            else:
                longest *= 0.5
        found, state = best
        controller = InverseQP.for_robot(robot, rates=longest * span, **unlimited)
        command = controller.solve(state.condensed, goal, found.command, state.slack)
        change = float((np.abs(command - found.command) / span).max())
        if change <= tolerance:
            break
    return replace(found, change=change, equilibria=count)


def nearest_next(points: np.ndarray) -> list[int]:
    """Return an order of points (k, n) with short ways: from the origin to the nearest one, and so on."""
    left, order, here = list(range(len(points))), [], np.zeros(points.shape[1])
    while left:
        order.append(min(left, key=lambda k: float(np.linalg.norm(points[k] - here))))
        left.remove(order[-1])
        here = points[order[-1]]
    return order
