"""Scores that are comparable between problems, and what is known about each problem on finite elements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.codesign.records import Record
from softgym_envs.errors import DataError
from softgym_envs.extensions.leaderboard.frozen import FrozenProblem
from softgym_envs.extensions.leaderboard.problem import JudgedScore
from softgym_envs.extensions.sweeps.statistics import Estimate, bootstrap
from softgym_envs.storage import read_json, write_json

DATA = Path(__file__).parent / "data"
"""Shipped data: references, results of the baselines, submissions, tables of bodies."""

WORST = 2.0
"""Reference point of hypervolumes: twice the baseline's value of each objective."""


@dataclass(eq=False)
class Reference(Record):
    """What is known about a problem on finite elements, on its test goals.

    ``baseline`` holds the scores of the baseline body under the inverse QP, ``best`` those of the best body known (of
    several objectives: of each body of the best front). ``found`` says how the best was found. ``accurate``, if not
    empty, holds the scores of the baseline and of the best body where the inverse QP comes to rest on the accurate
    mesh.
    """

    problem: str
    hash: str
    baseline: list[float]
    best: list[list[float]] = field(default_factory=list)
    designs: list[dict[str, float]] = field(default_factory=list)
    controller: str = "qp"
    found: dict[str, Any] = field(default_factory=dict)
    accurate: list[float] = field(default_factory=list)


def reference(problem: FrozenProblem, folder: Path = DATA) -> Reference | None:
    """Return what is known about a problem as it is now frozen, or None."""
    path = folder / "references" / f"{problem.name}.json"
    if not path.is_file():
        return None
    known = Reference.from_json(read_json(path))
    return known if known.hash == problem.hash else None


def make_reference(problem: FrozenProblem, folder: Path = DATA) -> Reference:
    """Return what is known about a problem; if nothing is, test its baseline on finite elements and store that."""
    known = reference(problem, folder)
    if known is None:
        found = problem.evaluator("test", "fem")(problem.definition.baseline_values, "qp")
        if not found.feasible:
            raise DataError(f"problem '{problem.name}': its baseline cannot be tested: {found.reason}")
        known = Reference(problem.name, problem.hash, found.scores)
        write_reference(known, folder)
    return known


def write_reference(known: Reference, folder: Path = DATA) -> None:
    """Store what is known about a problem."""
    write_json(folder / "references" / f"{known.problem}.json", known.to_json())


def normalised(known: Reference, scores: Sequence[Sequence[float]]) -> float | None:
    """Return the normalised score of bodies on finite elements: 0 for the baseline, 1 for the best known.

    With one objective, it is the share of the way from the baseline to the best. With several, it is that of the
    hypervolume over `WORST` times the baseline's values. None if no body better than the baseline is known.

    Args:
        known: the reference of the problem.
        scores: scores of each body, shape (bodies, objectives).
    """
    if not known.best:
        return None
    low, high, value = (merit(known, each) for each in ([known.baseline], known.best, scores))
    return None if high <= low else (value - low) / (high - low)


def merit(known: Reference, scores: Sequence[Sequence[float]]) -> float:
    """Return the number that bodies are compared by: the score, or the hypervolume of several objectives."""
    if len(known.baseline) == 1:
        return max(each[0] for each in scores)
    costs = -np.asarray(scores, dtype=float) / np.abs(known.baseline)
    return hypervolume(costs, np.full(len(known.baseline), WORST))


def hypervolume(costs: np.ndarray, worst: np.ndarray) -> float:
    """Return the volume that points dominate up to a reference point, by slicing along the last objective.

    Args:
        costs: smaller is better, shape (n, m).
        worst: reference point, shape (m,); points beyond it do not count.
    """
    costs = costs[(costs < worst).all(axis=1)]
    if len(costs) == 0:
        return 0.0
    if costs.shape[1] == 1:
        return float(worst[0] - costs.min())
    costs = costs[np.argsort(costs[:, -1])]
    ends = np.append(costs[1:, -1], worst[-1])
    return sum(
        float(end - point[-1]) * hypervolume(costs[: i + 1, :-1], worst[:-1])
        for i, (point, end) in enumerate(zip(costs, ends, strict=True))
        if end > point[-1]
    )


def improvement(first: np.ndarray, second: np.ndarray, *, resamples: int = 2000) -> Estimate:
    """Return the probability that a run of the first method beats one of the second, averaged over problems.

    Ties count half. The interval is a 95 % percentile bootstrap that resamples the runs of each problem and method
    (Agarwal et al. 2021).

    Args:
        first: scores, shape (runs, problems), with two runs or more.
        second: scores, shape (other runs, problems), likewise.
        resamples: number of resamples.
    """
    problems = first.shape[1]

    def statistic(*columns: np.ndarray, axis: int = -1) -> np.ndarray:
        better = []
        for a, b in zip(columns[:problems], columns[problems:], strict=True):
            difference = a[..., :, None] - b[..., None, :]
            better.append(((difference > 0.0) + 0.5 * (difference == 0.0)).mean(axis=(-2, -1)))
        return np.mean(better, axis=0)

    return bootstrap((*first.T, *second.T), statistic, resamples)


def bounds_share(problem: FrozenProblem, design: dict[str, float]) -> float:
    """Return the share of variables that lie within 1 % of a limit."""
    variables = problem.definition.optimised
    return float(np.mean([abs(float(variables[name].to_unit(value))) > 0.98 for name, value in design.items()]))


def front(rows: Sequence[JudgedScore], limit: int = 8) -> list[JudgedScore]:
    """Return bodies that no other one dominates, spread over the front if there are more than a limit.

    Of bodies with equal scores, which optimisers ask for again and again, the first is kept.
    """
    feasible = list({tuple(row.scores): row for row in reversed(rows) if row.feasible and row.share == 1.0}.values())
    kept = [
        row
        for row in feasible
        if not any(
            all(a >= b for a, b in zip(other.scores, row.scores, strict=True)) and other.scores != row.scores
            for other in feasible
        )
    ]
    kept.sort(key=lambda row: -row.scores[0])
    if len(kept) <= limit:
        return kept
    return [kept[round(i * (len(kept) - 1) / (limit - 1))] for i in range(limit)]
