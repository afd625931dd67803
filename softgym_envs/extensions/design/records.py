"""Results of the design tools."""

from __future__ import annotations

from dataclasses import dataclass, field

from softgym_envs.codesign.records import Record


@dataclass(frozen=True)
class FrontDesign(Record):
    """A design that no other design of a search beats in every objective."""

    trial: int
    design: dict[str, float]  # complete [SI]
    metrics: dict[str, float]  # by name [SI]


@dataclass(frozen=True)
class SearchResult(Record):
    """Result of a search: its Pareto front, or the one best design for a single objective."""

    front: list[FrontDesign]  # sorted by the first objective
    feasible: int  # number of designs with metrics
    infeasible: int
    repeated: int  # number of proposals of a design that was known already
    busy_seconds: float  # evaluation time, summed over all processes


@dataclass(frozen=True)
class Descent(Record):
    """One descent along gradients."""

    start: dict[str, float]  # complete design [SI]
    end: dict[str, float]  # complete design [SI]
    cost: float  # normalised, at the end
    history: list[float]  # normalised cost after each iteration, the start first
    projected_gradient: float  # largest component of the gradient at the end that the bounds do not stop
    evaluations: int  # of cost and gradient


@dataclass(frozen=True)
class BestDesign(Record):
    """The end of the best descent, with its metrics [SI] on both backends."""

    design: dict[str, float]  # complete [SI]
    cost: float  # normalised
    surrogate: dict[str, float]  # on the surrogate backend, in which cables can hang slack
    fem: dict[str, float] | None  # None without the check


@dataclass(frozen=True)
class GradientResult(Record):
    """Result of descents from several starts."""

    best: BestDesign
    descents: list[Descent]
    grid: int  # number of designs over which the objectives are normalised
    seconds: float  # of the grid and all descents


@dataclass(frozen=True)
class SensitivityResult(Record):
    """Result of a sensitivity study."""

    method: str  # "oat", "morris" or "sobol"
    indices: dict[str, dict[str, dict[str, float]]]  # {metric: {variable: {index: value}}}
    designs: int
    infeasible: int
    groups_kept: float  # share of the trajectories or blocks without an infeasible design; the others are left out
    seconds: float  # evaluation time, summed over all processes


@dataclass(frozen=True)
class Fit(Record):
    """One fit to measurements."""

    start: dict[str, float]  # fitted parameters [SI]
    found: dict[str, float]  # fitted parameters at the end [SI]
    cost: float  # sum of the squared relative residuals at the end
    evaluations: int  # of the residuals
    seconds: float
    history: list[dict[str, float]] = field(repr=False, default_factory=list)  # best so far: cost and parameters


@dataclass(frozen=True)
class CalibrationResult(Record):
    """Result of a calibration: the best fit.

    Profile intervals are those of the fitted variables, over all values of the other variables and the nuisance
    parameters; linear ones are those of all parameters.
    """

    design: dict[str, float]  # complete, with fitted robot options [SI]
    nuisances: dict[str, float]  # [SI]
    intervals: dict[str, tuple[float, float]] | None  # (low, high) by variable [SI]; None without a level
    level: float | None  # confidence level of the intervals
    at_bound: list[str]  # parameters that lie at one of their bounds
    errors: dict[str, float]  # root mean square of "effector" [m] and "effort" [N, ...], if they were measured
    fits: list[Fit]  # one for each start
    refined: Fit | None  # on FEM
    measured_states: int
    seconds: float
    correlations: dict[str, dict[str, float]] | None = None  # of the errors of all parameters; None if some do not act
    held_out_states: int = 0
    held_out_errors: dict[str, float] = field(default_factory=dict)  # as `errors`, of trials that were not fitted
    plant: dict[str, dict[str, float] | float] = field(default_factory=dict)  # option of environments: what drives do
    notes: list[str] = field(default_factory=list)  # what these data do not determine
