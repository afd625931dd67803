"""Descents along the gradient of the inverse QP's score on the learned model, as an optimiser that asks and tells.

A descent does not run whole episodes: it goes to the states where the inverse QP comes to rest: fewer steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, cast

import numpy as np
import torch
from scipy.stats import qmc
from torch import Tensor

from softgym_envs.extensions.design.bodies import learned_model
from softgym_envs.extensions.design.box import Box
from softgym_envs.extensions.design.gradient import descend
from softgym_envs.extensions.leaderboard.clock import working_seconds
from softgym_envs.extensions.leaderboard.frozen import FrozenProblem
from softgym_envs.extensions.leaderboard.problem import JudgedScore
from softgym_envs.extensions.leaderboard.rest import settle

if TYPE_CHECKING:
    from softgym_envs.envs.vector_env import SoftRobotVectorEnv

AT_LIMIT = 1e-4
"""Distance of a command to a limit, relative to its range, below which it counts as at the limit."""

RANK = 1e-3
"""Singular values, relative to the largest, below which actuators do not move the effector."""

ITERATIONS = 20
"""Largest number of iterations of a descent."""

TIGHT = 1e-3
"""Effort, relative to the largest in a state, below which a cable counts as slack."""


class StepsSpent(Exception):
    """A descent has used all environment steps that are left."""


class SettledCost:
    """Mean distance to the search goals at rest under the inverse QP, divided by that of the baseline, with gradient.

    At rest no small change of the commands brings the effector closer, so the derivative of the distance in the design
    is that at constant displacements, minus the displacement of slack actuators, whose efforts stay zero (envelope
    theorem).
    A goal that is reached has a derivative of zero.

    Args:
        problem: a problem with one objective, the mean distance to points.

    Attributes:
        box: the designs.
        steps: environment steps spent: one per goal for each step of the inverse QP towards rest, and one per goal for
            the derivatives.
        steps_left: environment steps after which no evaluation begins.
        best: point with the least cost since it was last set to None, and this cost.

    Raises:
        ValueError: for a problem with another objective, or variables that are not design variables.
        ConfigError: if the weights have no exact gradients.
    """

    def __init__(self, problem: FrozenProblem) -> None:
        definition = problem.definition
        if definition.objective != "mean_distance" or definition.score_count > 1 or problem.single_path:
            raise ValueError(f"problem '{problem.name}': method 'gradient' minimises the mean distance to points only")
        if other := [name for name in definition.variables if name not in definition.space.names]:
            raise ValueError(f"problem '{problem.name}': the learned model has no variable '{other[0]}'")
        self.goals = np.asarray(problem.goals["search"]).reshape(-1, 3)
        env = definition.environment.make_vec(len(self.goals), sample_design=False)
        self._env = cast("SoftRobotVectorEnv", env.unwrapped)
        self.box = Box(definition.space, definition.variables, design=definition.baseline)
        self._net = learned_model(definition.robot)
        self._axes = torch.as_tensor(self._env.task.axes)
        self.steps, self.steps_left = 0, np.inf
        self.best: tuple[np.ndarray, float] | None = None
        self._last: tuple[bytes, float, np.ndarray] | None = None
        self._scale = 1.0
        self._scale = self.with_gradient(self.box.unit(self.box.reference))[0]
        self._last = None

    def __call__(self, unit: Tensor) -> Tensor:
        """Return the cost of points (B, d) in unit coordinates, shape (B,)."""
        return torch.tensor([self.with_gradient(point)[0] for point in unit.detach().numpy()], dtype=torch.float64)

    def with_gradient(self, unit: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the cost of one point (d,) and its gradient (d,).

        Raises:
            StepsSpent: if no steps are left for it.
        """
        if self._last is None or self._last[0] != unit.tobytes():
            if self.steps >= self.steps_left:
                raise StepsSpent
            self._last = unit.tobytes(), *self._evaluate(unit)
        _, cost, gradient = self._last
        if self.best is None or cost < self.best[1]:
            self.best = unit.copy(), cost
        return cost, gradient.copy()

    def _evaluate(self, unit: np.ndarray) -> tuple[float, np.ndarray]:
        displacement, slack, free = self._settle(self.box.design(unit))
        point = torch.tensor(unit[None], dtype=torch.float64, requires_grad=True)
        held = torch.as_tensor(displacement)
        effort, effector, W = self._net(self.box.values(point).expand(len(held), -1), held)
        offset = (effector[:, :3] - torch.as_tensor(self.goals)) * self._axes
        distance = offset.norm(dim=1)
        count = held.shape[1]
        by_effector, by_effort = np.zeros((len(held), 3)), np.zeros((len(held), count))
        matrices = W.detach().numpy()
        for row, direction in enumerate((offset / distance.clamp(min=1e-12)[:, None]).detach().numpy()):
            stiffness = np.linalg.inv(matrices[row, :count, :count])
            jacobian = self._axes.numpy()[:, None] * (matrices[row, count : count + 3, :count] @ stiffness)
            loose, moved = slack[row], free[row]
            # A change of free actuators moves slack ones so that their efforts stay zero.
            given = np.linalg.solve(stiffness[np.ix_(loose, loose)], np.eye(int(loose.sum())))
            reduced = jacobian[:, moved] - jacobian[:, loose] @ given @ stiffness[np.ix_(loose, moved)]
            # Free actuators make good what they can; at rest nothing but rounding is left of that.
            direction = direction - reduced @ (np.linalg.pinv(reduced, rcond=RANK) @ direction)
            by_effector[row], by_effort[row, loose] = direction, given.T @ (jacobian[:, loose].T @ direction)
        change = (torch.as_tensor(by_effector) * offset).sum() - (torch.as_tensor(by_effort) * effort).sum()
        (gradient,) = torch.autograd.grad(change, point)
        self.steps += len(self.goals)
        scale = len(held) * self._scale
        return float(distance.detach().sum()) / scale, gradient[0].numpy() / scale

    def _settle(self, design: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return displacements of the actuators at rest, which of them carry no effort, and which can move both ways.

        All have the shape (goals, n_a).
        """
        env, robot = self._env, self._env.robot
        complete = {name: design[name] for name in self.box.space.names}
        env.reset(seed=0, options={"design": complete, "goal": self.goals[:, None]})
        span = robot.upper - robot.lower
        command, steps = settle(env, self.goals)
        self.steps += steps * len(self.goals)
        state = env.backend.state
        loose = np.abs(state.effort) < TIGHT * np.abs(state.effort).max(axis=1, keepdims=True)
        slack = (state.slack | loose) & robot.unilateral
        inside = (command > robot.lower + AT_LIMIT * span) & (command < robot.upper - AT_LIMIT * span)
        return state.displacement.copy(), slack, inside & ~slack


class GradientOptimiser:
    """L-BFGS-B on `SettledCost` from the points of a Sobol sequence; the end of each descent is a body to score.

    Args:
        problem: the problem.
        seed: of the sequence.

    Attributes:
        steps_left: environment steps that the next descent may spend; one that needs more ends early.
    """

    def __init__(self, problem: FrozenProblem, seed: int) -> None:
        self._cost = SettledCost(problem)
        self._names = problem.variables
        self._starts = qmc.Sobol(len(self._names), rng=np.random.default_rng(seed))
        self._charged, self._seconds = 0, 0.0
        self.steps_left = np.inf

    def ask(self) -> Mapping[str, float]:
        """Return the best body of a new descent."""
        began, cost = working_seconds(), self._cost
        start = 2.0 * self._starts.random(1)[0] - 1.0
        cost.best, cost.steps_left = None, self._charged + self.steps_left
        try:
            descend(cost, start, iterations=ITERATIONS, tolerance=1e-4)
        except StepsSpent:
            pass
        point = start if cost.best is None else cost.best[0]
        self._seconds += working_seconds() - began
        design = cost.box.design(point)
        return {name: design[name] for name in self._names}

    def tell(self, score: JudgedScore) -> None:
        """Learn nothing: descents do not depend on scores."""

    def take_charge(self) -> tuple[int, float]:
        """Return the environment steps and CPU seconds [s] spent since the last call, for the ledger."""
        steps, seconds = self._cost.steps - self._charged, self._seconds
        self._charged, self._seconds = self._cost.steps, 0.0
        return steps, seconds
