"""What a study found, as typed records."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from softgym_envs.codesign.records import Finalist, FinalistTraining, Record, TestGroup
from softgym_envs.codesign.statistics import Interval, MeshPart

LIMIT_MARGIN = 0.02
"""A variable this close to an end of its range, as a fraction of the range, is at its limit."""


@dataclass(frozen=True, eq=False)
class VariableResult(Record):
    """A variable of the body, with its values in baseline and winner [unit]."""

    name: str
    unit: str  # SI
    low: float
    high: float
    log: bool  # whether the range is logarithmic
    description: str
    optimised: bool
    baseline: float
    winner: float | None

    def place(self, value: float) -> float:
        """Return the place of a value in the range, in [0, 1], on the scale of the variable."""
        if self.log:
            return float(np.log(value / self.low) / np.log(self.high / self.low))
        return (value - self.low) / (self.high - self.low)

    @property
    def at_limit(self) -> str:
        """``"lower"`` or ``"upper"`` if the optimised value of the winner is at an end of the range, else empty."""
        if self.winner is None or not self.optimised:
            return ""
        place = self.place(self.winner)
        return "lower" if place <= LIMIT_MARGIN else "upper" if place >= 1.0 - LIMIT_MARGIN else ""

    def to_json(self) -> dict[str, Any]:
        """Return everything as plain data."""
        return {**super().to_json(), "at_limit": self.at_limit}


@dataclass(frozen=True, eq=False)
class BodyStatistics(Record):
    """Test of one body with one controller on one backend [SI]; intervals of 95 %."""

    success_rate: float
    success_interval: Interval
    mean_distance: float
    distance_interval: Interval
    worst_distance: float
    mean_return: float | None  # unknown if only the ends of episodes were tested
    mean_effort: float
    objective: float
    objective_interval: Interval
    largest_effort: float | None = None  # unknown in tests of earlier versions, as are the next two
    largest_strain: float | None = None  # of a drive, over its length or volume at rest
    self_force: float | None = None  # with which surfaces of the body press on each other


@dataclass(frozen=True, eq=False)
class Comparison(Record):
    """Winner against baseline on the same test goals, with one controller on one backend [SI]; intervals of 95 %.

    The backend ``"refined"`` is FEM with a finer mesh, on some of the test goals.
    """

    backend: str
    agent: str
    goals: int
    baseline: BodyStatistics
    winner: BodyStatistics
    success_change: float
    success_change_interval: Interval
    distance_change: float
    distance_change_interval: Interval
    objective_change: float
    objective_change_interval: Interval
    goals_closer: int
    goals_farther: int
    distance_mesh: MeshPart | None = None  # of the change, if a finer mesh was tested
    objective_mesh: MeshPart | None = None


@dataclass(frozen=True, eq=False)
class Transfer(Record):
    """An objective of all finalists on the surrogate and on FEM [SI]."""

    agent: str
    objective: str
    trials: list[int]
    surrogate: list[float]
    fem: list[float]
    mean_gap: float
    worst_gap: float
    spearman: float | None


@dataclass(frozen=True, eq=False)
class Cost(Record):
    """Environment steps of each part of a study, and its time by phase [s]."""

    retraining_steps: int
    retraining_report_steps: int
    training_steps: int
    report_steps: int
    selection_steps: int
    screen_steps: int
    test_steps_surrogate: int
    test_steps_fem: int
    cpu_seconds: dict[str, float]
    wall_seconds: dict[str, float]


@dataclass(frozen=True, eq=False)
class StudyResults(Record):
    """Results of a study; quantities are in SI units.

    Attributes:
        name: name of the study.
        title: title of the report.
        environment: ID of the environment.
        objective: name of the objective.
        objectives: names of the objective and the secondary objectives.
        constraints: limit of each constraint.
        strategy: how bodies were scored.
        command: command that ran the study.
        trials: numbers of trials: ``requested``, ``complete``, ``pruned``, ``infeasible``, and ``feasible``: those that
            satisfy the constraints.
        variables: all variables of the body.
        baseline: the baseline, if it could be simulated and tested.
        winner: the body that wins, or None.
        no_winner: why there is no winner, with the nearest miss; else empty.
        few_goals: warning if there are few test goals, else empty.
        comparison: winner against baseline, for each controller and backend.
        pareto: trials on the Pareto front, with several objectives.
        transfer: surrogate against FEM over the finalists.
        finalists: all bodies in the final test.
        trainings: policies trained anew for them.
        tests: their tests.
        importance: how much each variable decides between good and bad bodies.
        cost: environment steps and time.
        success_distance: distance within which a goal counts as reached.
        provenance: versions, commit, time and machine; ``code_changes``: other code that continued the study.
    """

    name: str
    title: str
    environment: str
    objective: str
    objectives: list[str]
    constraints: dict[str, float]
    strategy: str
    command: str
    trials: dict[str, int]
    variables: list[VariableResult]
    baseline: Finalist | None
    winner: Finalist | None
    no_winner: str
    few_goals: str
    comparison: list[Comparison]
    pareto: list[int]
    transfer: list[Transfer]
    finalists: list[Finalist]
    trainings: list[FinalistTraining]
    tests: list[TestGroup]
    importance: dict[str, float]
    cost: Cost
    success_distance: float
    provenance: dict[str, Any]

    @property
    def bodies(self) -> int:
        """Number of finished trials."""
        return sum(self.trials[state] for state in ("complete", "pruned", "infeasible"))

    @property
    def roles(self) -> dict[int, str]:
        """Trial numbers of baseline and winner."""
        bodies = {"baseline": self.baseline, "winner": self.winner}
        return {body.trial: role for role, body in bodies.items() if body is not None}
