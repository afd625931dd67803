"""Design along the surrogate's gradients, in a box, from several starts (thesis 4.5.3)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign.tools.bodies import Box
from codesign.tools.config import GradientConfig, ObjectiveConfig, OptimiseConfig
from codesign.tools.folder import run_folder
from softgym_envs.config import provenance
from softgym_envs.storage import write_json

__all__ = ["Descent", "WeightedCost", "descend", "optimise"]


class WeightedCost:
    """The cost that is minimised: ``sum gamma_i (O_i - min O_i) / (max O_i - min O_i)`` (eq. 4.18).

    Args:
        objectives: what is wanted of each metric.
        metrics: values of the metrics (B, m) of complete designs (B, len(space)).
        box: the designs under consideration.
        grid: number of designs, on a regular grid, that the extremes are taken over.

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
            single = self._single(values)
            self._low, self._range = single.amin(dim=0), single.amax(dim=0) - single.amin(dim=0)
            self._range = self._range.clamp(min=1e-300)
            self.costs = self._add(single).numpy()
        self.values = values.numpy()

    def _single(self, values: Tensor) -> Tensor:
        return torch.stack([o.cost(values[:, k]) for k, o in enumerate(self.objectives)], dim=1)

    def _add(self, single: Tensor) -> Tensor:
        gamma = torch.tensor([objective.weight for objective in self.objectives], dtype=torch.float64)
        return ((single - self._low) / self._range) @ gamma

    def __call__(self, unit: Tensor) -> Tensor:
        """Return the cost of points (B, d) in unit coordinates, shape (B,)."""
        return self._add(self._single(self.metrics(self.box.values(unit))))

    def with_gradient(self, unit: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the cost of one point (d,) and its gradient (d,)."""
        point = torch.tensor(unit[None], dtype=torch.float64, requires_grad=True)
        cost = self(point)
        (gradient,) = torch.autograd.grad(cost.sum(), point)
        return float(cost[0].detach()), gradient[0].numpy()


@dataclass(frozen=True)
class Descent:
    """One descent.

    Attributes:
        start: unit coordinates of the start, (d,).
        end: and of the end, (d,).
        cost: at the end.
        history: cost after each iteration, the start first.
        projected_gradient: largest component of the gradient at the end that the box does not stop.
        evaluations: of cost and gradient.
    """

    start: list[float]
    end: list[float]
    cost: float
    history: list[float]
    projected_gradient: float
    evaluations: int


def descend(cost: WeightedCost, start: np.ndarray, *, iterations: int = 100, tolerance: float = 1e-6) -> Descent:
    """Minimise a cost within the box from one start (L-BFGS-B).

    Args:
        cost: what is minimised.
        start: unit coordinates, shape (d,).
        iterations: bound on them.
        tolerance: of the projected gradient.
    """
    from scipy.optimize import minimize

    first = float(cost(torch.as_tensor(start[None]))[0])
    history = [first]
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
        start.tolist(), end.tolist(), float(found.fun), history, float(np.abs(projected).max()), int(found.nfev)
    )


def starts_of(solver: GradientConfig, cost: WeightedCost) -> np.ndarray:
    """Return the starts that a configuration asks for, in unit coordinates (n, d)."""
    if solver.starts == "corners":
        return cost.box.corners()
    if solver.starts == "reference":
        return cost.box.unit(cost.box.reference)[None]
    return cost.points[np.argsort(cost.costs, kind="stable")[: solver.count]]


def optimise(config: OptimiseConfig, folder: str | Path | None = None) -> dict[str, Any]:
    """Descend from every start, and evaluate the best design on the surrogate and on FEM.

    Args:
        config: with solver ``"gradient"``.
        folder: where ``result.json``, the resolved configuration and a picture go, or None.

    Returns:
        ``best`` (design, cost and metrics by backend), ``descents`` and ``seconds``; lengths and all else are SI.

    Raises:
        ConfigError: if the weights have no exact gradients, the folder holds something else or another process is at
            it, see `codesign.tools.folder.run_folder`.
        WeightsError: if there are none.
        InfeasibleDesign: if the best design cannot be built for the check on FEM.
        ConvergenceError: if it has no equilibrium there.
    """
    if folder is None:
        return _optimise(config)[0]
    from codesign.tools.plots import draw_descents

    folder = Path(folder)
    with run_folder(folder, config, "an optimisation", may_change=("name", "workers")):
        result, cost, descents = _optimise(config)
        write_json(folder / "result.json", {**provenance(), **result})
        draw_descents(folder / "descents.png", cost, descents)
    return result


def _optimise(config: OptimiseConfig) -> tuple[dict[str, Any], WeightedCost, list[Descent]]:
    """Return what `optimise` does, the cost and the descents."""
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
    design = box.design(np.array(best.end))
    # The backend, unlike the gradients, lets cables hang slack: it has the last word.
    values = {name: bodies.evaluator(config.metrics, name)(design) for name in ("surrogate", "fem")[: 1 + solver.check]}
    result: dict[str, Any] = {
        "best": {"design": design, "cost": best.cost, **values},
        "descents": [
            asdict(d) | {"start": box.design(np.array(d.start)), "end": box.design(np.array(d.end))} for d in descents
        ],
        "grid": len(cost.points),
        "seconds": seconds,
    }
    return result, cost, descents
