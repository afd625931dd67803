"""Optimisation along the surrogate's gradients, in a box, from several starts (thesis, sec. 4.5.3)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from softgym_envs.extensions.design.box import Box
from softgym_envs.extensions.design.config import GradientConfig, ObjectiveConfig, OptimiseConfig
from softgym_envs.extensions.design.plots import draw_descents
from softgym_envs.extensions.design.records import BestDesign, Descent, GradientResult
from softgym_envs.runs import RunFolder, provenance
from softgym_envs.storage import write_signed


class Cost(Protocol):
    """A cost of the designs of a box, with gradients."""

    @property
    def box(self) -> Box:
        """The designs."""

    def __call__(self, unit: Tensor) -> Tensor:
        """Return the cost of points (B, d) in unit coordinates, shape (B,)."""

    def with_gradient(self, unit: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the cost of one point (d,) and its gradient (d,)."""


class WeightedCost:
    """The cost to minimise: ``sum gamma_i (O_i - min O_i) / (max O_i - min O_i)`` (thesis, eq. 4.18).

    Args:
        objectives: the objectives O_i with their weights gamma_i.
        metrics: returns the metrics (B, m) of complete designs (B, len(space)).
        box: the designs under consideration.
        grid: number of designs, on a regular grid, over which the extremes are taken.

    Attributes:
        points: the grid in unit coordinates, shape (n, d).
        values: metrics on it [SI], shape (n, m).
        costs: cost on it, shape (n,).
    """

    def __init__(
        self,
        objectives: Sequence[ObjectiveConfig],
        metrics: Callable[[Tensor], Tensor],
        box: Box,
        grid: int = 600,
    ) -> None:
        self.objectives, self.metrics, self.box = tuple(objectives), metrics, box
        self.points = box.grid(grid)
        with torch.no_grad():
            values = metrics(box.values(torch.as_tensor(self.points)))
            single = self._each(values)
            self._low, self._range = single.amin(dim=0), single.amax(dim=0) - single.amin(dim=0)
            self._range = self._range.clamp(min=1e-300)
            self.costs = self._sum(single).numpy()
        self.values = values.numpy()

    def _each(self, values: Tensor) -> Tensor:
        return torch.stack([o.cost(values[:, k]) for k, o in enumerate(self.objectives)], dim=1)

    def _sum(self, single: Tensor) -> Tensor:
        gamma = torch.tensor([objective.weight for objective in self.objectives], dtype=torch.float64)
        return ((single - self._low) / self._range) @ gamma

    def __call__(self, unit: Tensor) -> Tensor:
        """Return the cost of points (B, d) in unit coordinates, shape (B,)."""
        return self._sum(self._each(self.metrics(self.box.values(unit))))

    def with_gradient(self, unit: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the cost of one point (d,) and its gradient (d,)."""
        point = torch.tensor(unit[None], dtype=torch.float64, requires_grad=True)
        cost = self(point)
        (gradient,) = torch.autograd.grad(cost.sum(), point)
        return float(cost[0].detach()), gradient[0].numpy()


def descend(cost: Cost, start: np.ndarray, *, iterations: int = 100, tolerance: float = 1e-6) -> Descent:
    """Minimise a cost within the box from one start (d,) in unit coordinates (L-BFGS-B).

    It ends when no component of the projected gradient exceeds the tolerance.
    """
    from scipy.optimize import minimize

    history = [float(cost(torch.as_tensor(start[None]))[0])]
    found = minimize(
        cost.with_gradient,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=[(-1.0, 1.0)] * len(start),
        callback=lambda intermediate_result: history.append(float(intermediate_result.fun)),
        options={"maxiter": iterations, "gtol": tolerance, "ftol": 1e-15},
    )
    end, gradient = np.asarray(found.x), np.asarray(found.jac)
    projected = end - np.clip(end - gradient, -1.0, 1.0)
    return Descent(
        start=cost.box.design(start),
        end=cost.box.design(end),
        cost=float(found.fun),
        history=history,
        projected_gradient=float(np.abs(projected).max()),
        evaluations=int(found.nfev),
    )


def starts_of(solver: GradientConfig, cost: WeightedCost) -> np.ndarray:
    """Return the starts of a configuration in unit coordinates (n, d)."""
    if solver.starts == "corners":
        return cost.box.corners()
    if solver.starts == "reference":
        return cost.box.unit(cost.box.reference)[None]
    return cost.points[np.argsort(cost.costs, kind="stable")[: solver.count]]


def optimise(config: OptimiseConfig, folder: str | Path | None = None) -> GradientResult:
    """Descend from every start, and evaluate the best design on the surrogate and on FEM.

    Args:
        config: a configuration with solver ``"gradient"``.
        folder: where ``result.json``, the resolved configuration and a picture go; None to write nothing.

    Raises:
        ConfigError: if the weights have no exact gradients, the folder holds results of another
            configuration or tool, or another process uses it.
        WeightsError: if there are no weights.
        InfeasibleDesign: if the best design cannot be built for the check on FEM.
        ConvergenceError: if the best design has no equilibrium on FEM.
    """
    if folder is None:
        return _optimise(config)[0]
    with RunFolder(folder, OptimiseConfig, "an optimisation").reserve(config, ("name", "workers")) as place:
        result, cost = _optimise(config)
        write_signed(place / "result.json", {**provenance(), **result.to_json()})
        ends = [cost.box.unit(descent.end) for descent in result.descents]
        with torch.no_grad():
            reached = cost.metrics(cost.box.values(torch.tensor(np.array(ends)))).numpy()
        metrics = [objective.find() for objective in config.objectives]
        histories = [descent.history for descent in result.descents]
        draw_descents(place / "descents.png", metrics, histories, cost.values, reached)
    return result


def _optimise(config: OptimiseConfig) -> tuple[GradientResult, WeightedCost]:
    solver = config.solver
    assert isinstance(solver, GradientConfig)
    bodies, box = config.bodies, config.bodies.box()
    began = time.perf_counter()
    cost = WeightedCost(config.objectives, bodies.learned(config.metrics), box, solver.grid)
    descents = [
        descend(cost, start, iterations=solver.iterations, tolerance=solver.tolerance)
        for start in starts_of(solver, cost)
    ]
    seconds = time.perf_counter() - began
    best = min(descents, key=lambda descent: descent.cost)
    # Unlike the gradients, the backend lets cables hang slack: its values count.
    surrogate = bodies.evaluator(config.metrics, "surrogate").measure(best.end)
    fem = bodies.evaluator(config.metrics, "fem").measure(best.end) if solver.check else None
    return GradientResult(BestDesign(best.end, best.cost, surrogate, fem), descents, len(cost.points), seconds), cost
