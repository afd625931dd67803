"""Results of the design tools."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any


class Record:
    """Base of all results: plain data for JSON files."""

    def to_json(self) -> dict[str, Any]:
        """Return plain data."""
        return asdict(self)  # type: ignore[call-overload]


@dataclass(frozen=True)
class FrontDesign(Record):
    """A design that no other design of a search beats in every objective.

    Attributes:
        trial: number of its trial.
        design: complete design [SI].
        metrics: its metrics by name [SI].
    """

    trial: int
    design: dict[str, float]
    metrics: dict[str, float]


@dataclass(frozen=True)
class SearchResult(Record):
    """Result of a search.

    Attributes:
        front: the non-dominated designs sorted by the first objective; the one best design for a single objective.
        feasible: number of designs with metrics.
        infeasible: number of designs without.
        repeated: number of proposals of a design that was known already.
        busy_seconds: evaluation time, summed over all processes.
    """

    front: list[FrontDesign]
    feasible: int
    infeasible: int
    repeated: int
    busy_seconds: float


@dataclass(frozen=True)
class Descent(Record):
    """One descent along gradients.

    Attributes:
        start: complete design at the start [SI].
        end: complete design at the end [SI].
        cost: normalised cost at the end.
        history: normalised cost after each iteration, the start first.
        projected_gradient: largest component of the gradient at the end that the bounds do not stop.
        evaluations: number of evaluations of cost and gradient.
    """

    start: dict[str, float]
    end: dict[str, float]
    cost: float
    history: list[float]
    projected_gradient: float
    evaluations: int


@dataclass(frozen=True)
class BestDesign(Record):
    """The end of the best descent.

    Attributes:
        design: complete design [SI].
        cost: normalised cost.
        surrogate: its metrics on the surrogate backend, in which cables can hang slack [SI].
        fem: its metrics on FEM [SI], or None without the check.
    """

    design: dict[str, float]
    cost: float
    surrogate: dict[str, float]
    fem: dict[str, float] | None


@dataclass(frozen=True)
class GradientResult(Record):
    """Result of descents from several starts.

    Attributes:
        best: the end of the best descent.
        descents: one for each start.
        grid: number of designs that the objectives are normalised on.
        seconds: time of the grid and all descents.
    """

    best: BestDesign
    descents: list[Descent]
    grid: int
    seconds: float


@dataclass(frozen=True)
class SensitivityResult(Record):
    """Result of a sensitivity study.

    Attributes:
        method: ``"oat"``, ``"morris"`` or ``"sobol"``.
        indices: ``{metric: {variable: {index: value}}}``, see `codesign.tools.sensitivity`.
        designs: number of designs.
        infeasible: number of designs without metrics.
        groups_kept: share of the trajectories or blocks without an infeasible design; the others are left out.
        seconds: evaluation time, summed over all processes.
    """

    method: str
    indices: dict[str, dict[str, dict[str, float]]]
    designs: int
    infeasible: int
    groups_kept: float
    seconds: float


@dataclass(frozen=True)
class Fit(Record):
    """One fit to measurements.

    Attributes:
        start: fitted parameters at the start [SI].
        found: fitted parameters at the end [SI].
        cost: sum of the squared relative residuals at the end.
        evaluations: number of computations of the residuals.
        seconds: time of the fit.
        history: ``cost`` and the fitted parameters of the best point after each evaluation.
    """

    start: dict[str, float]
    found: dict[str, float]
    cost: float
    evaluations: int
    seconds: float
    history: list[dict[str, float]] = field(repr=False, default_factory=list)


@dataclass(frozen=True)
class CalibrationResult(Record):
    """Result of a calibration.

    Attributes:
        design: complete design of the best fit, with fitted robot options [SI].
        nuisances: nuisance parameters of the best fit [SI].
        intervals: confidence interval [low, high] of each fitted variable [SI], over all values of the other variables
            and the nuisance parameters; None without a level.
        level: confidence level of the intervals.
        at_bound: names of parameters that lie at one of their bounds.
        errors: root mean square errors of ``effector`` [m] and ``effort`` [N, ...], if they were measured.
        fits: one fit for each start.
        refined: the fit on FEM, or None.
        measured_states: number of measured states.
        seconds: total time.
    """

    design: dict[str, float]
    nuisances: dict[str, float]
    intervals: dict[str, tuple[float, float]] | None
    level: float | None
    at_bound: list[str]
    errors: dict[str, float]
    fits: list[Fit]
    refined: Fit | None
    measured_states: int
    seconds: float
