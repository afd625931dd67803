"""Regret of stored runs: by problem, and over the problems of a track."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softgym_envs.extensions.leaderboard.frozen import FrozenProblem, load_problem
from softgym_envs.extensions.leaderboard.runs import Run
from softgym_envs.extensions.leaderboard.scoring import (
    DATA,
    Reference,
    bounds_share,
    improvement,
    merit,
    normalised,
    reference,
)
from softgym_envs.extensions.sweeps.statistics import Estimate, interquartile_mean, stratified_estimate

FINISHED = 0.01
"""Regret below which a search counts as finished."""

EQUAL = 0.001
"""Regrets are rounded to this before methods are compared, so that differences without a meaning are ties."""

FEWEST_SEEDS = 3
"""Seeds of random search below which a problem does not count for its track."""

Stored = tuple[Run, Any]
"""A run and the scores of its winners on finite elements, or None."""


@dataclass(frozen=True)
class Contest:
    """Runs on one problem that can be compared: with one judge, budget and limit of bodies.

    Attributes:
        problem: ID with its version.
        judge: who controlled the bodies in the search.
        listed: whether the searches were on a table.
        level: name of the budget.
        limit: largest number of bodies, or None.
        runs: by method, ordered by seed.
        worst: merit of the baseline body.
        best: merit of the best body that any run found under the same judge, or of the best listed one; with several
            objectives, of the winners of all runs of the contest together.
    """

    problem: str
    judge: str
    listed: bool
    level: str
    limit: int | None
    runs: dict[str, list[Stored]]
    worst: float
    best: float

    def regrets(self, method: str) -> np.ndarray:
        """Return the regret at the end of each run: 0 at ``best``, 1 at ``worst``; 0 if no run beat the baseline."""
        return np.array([self._regret(_end(run)) for run, _ in self.runs[method]])

    def unseen(self, method: str) -> np.ndarray:
        """Return the score of each winner on the validation goals divided by that of the baseline.

        Scores are negative distances: below 1 the winner is better than the baseline, above 1 worse. None with several
        objectives, on a table, and for problems with a single path.
        """
        pairs = np.array([run.unseen for run, _ in self.runs[method] if len(run.unseen) == 2]).reshape(-1, 2)
        return pairs[:, 1] / pairs[:, 0]

    def curve(self, run: Run) -> np.ndarray:
        """Return rows of environment steps, CPU seconds and regret; none with several objectives."""
        return np.array([[steps, seconds, self._regret(value)] for steps, seconds, value in run.curve]).reshape(-1, 3)

    def _regret(self, merit: float) -> float:
        return (self.best - merit) / (self.best - self.worst) if self.best > self.worst else 0.0

    @property
    def steps(self) -> float:
        """Most environment steps that a run spent."""
        return max(run.spent["environment_steps"] for rows in self.runs.values() for run, _ in rows)


def contests(runs: Sequence[Stored]) -> list[Contest]:
    """Return the stored runs by problem, judge, budget and limit."""
    groups: dict[tuple, dict[str, list[Stored]]] = defaultdict(lambda: defaultdict(list))
    best: dict[tuple, float] = defaultdict(lambda: -np.inf)
    for run, test in sorted(runs, key=lambda row: row[0].seed):
        listed = run.optimum is not None
        groups[run.problem, run.judge, listed, run.level, run.limit][run.method].append((run, test))
        if run.curve:
            kind = run.problem, run.judge, listed
            best[kind] = max(best[kind], run.curve[-1][2] if run.optimum is None else run.optimum)
    found = []
    for (name, judge, listed, level, limit), members in sorted(groups.items(), key=lambda item: str(item[0])):
        every = [run for rows in members.values() for run, _ in rows]
        if every[0].curve:
            worst, top = every[0].curve[0][2], best[name, judge, listed]
        else:
            worst = _merit(every[0], [every[0].baseline])
            top = _merit(every[0], [scores for run in every for scores in run.search_scores])
        ordered = dict(sorted(members.items()))
        found.append(Contest(name, judge, listed, level, limit, ordered, worst, top))
    return found


def _end(run: Run) -> float:
    """Return the merit that a run ended with: the score of its best body, or the hypervolume of its front."""
    return run.curve[-1][2] if run.curve else _merit(run, run.search_scores)


def _merit(run: Run, scores: Sequence[Sequence[float]]) -> float:
    return merit(Reference(run.problem, run.hash, run.baseline), scores)


# -- by problem ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MethodRow:
    """A method on one problem, over its seeds.

    ``regret`` is 0 for the best body that any run found and 1 for the baseline, by the scores of the search; on a table
    0 for its best body; with several objectives it is that of the hypervolume. ``unseen`` is that of `Contest` or None.
    ``area`` is the mean regret over the logarithm of the environment steps, ``steps`` and ``seconds`` the medians until
    it stays below 1 %, infinite if more than half of the runs never get there; these three are NaN with several
    objectives. ``score`` is the normalised score on finite elements.
    """

    problem: str
    judge: str
    table: bool
    method: str
    seeds: int
    regret: Estimate
    unseen: Estimate | None
    area: float
    steps: float
    seconds: float
    score: Estimate | None
    at_bounds: float
    diversity: float


def method_rows(runs: Sequence[Stored], data: Any = DATA) -> list[MethodRow]:
    """Return one row per problem, judge, budget and method."""
    rows = []
    for contest in contests(runs):
        problem = load_problem(contest.problem, check=False)
        known = reference(problem, data)
        for method, members in contest.runs.items():
            curves = [contest.curve(run) for run, _ in members if run.curve]
            scores = [normalised(known, test) for _, test in members if known is not None and test]
            known_scores = np.array([[s] for s in scores if s is not None])
            reached = np.array([_reached(curve) for curve in curves]) if curves else np.full((1, 2), np.nan)
            unseen = contest.unseen(method)
            steps, seconds = (float(value) for value in np.median(reached, axis=0))
            rows.append(
                MethodRow(
                    contest.problem,
                    contest.judge,
                    contest.listed,
                    method,
                    len(members),
                    stratified_estimate(contest.regrets(method)[:, None]),
                    stratified_estimate(unseen[:, None]) if len(unseen) else None,
                    float(np.mean([_area(curve, contest.steps) for curve in curves])) if curves else np.nan,
                    steps,
                    seconds,
                    stratified_estimate(known_scores) if len(known_scores) == len(members) else None,
                    float(np.mean([_at_bounds(problem, run) for run, _ in members])),
                    float(np.mean([run.diversity for run, _ in members])),
                )
            )
    return rows


def _at_bounds(problem: FrozenProblem, run: Run) -> float:
    return float(np.mean([bounds_share(problem, design) for design in run.designs])) if run.designs else 0.0


def _reached(curve: np.ndarray) -> tuple[float, float]:
    """Return environment steps and CPU seconds from which on the regret stays below `FINISHED`; infinite if never."""
    if curve[-1, 2] >= FINISHED:
        return np.inf, np.inf
    above = np.flatnonzero(curve[:, 2] >= FINISHED)
    index = 0 if len(above) == 0 else above[-1] + 1
    return curve[index, 0], curve[index, 1]


def _area(curve: np.ndarray, limit: float) -> float:
    """Return the mean regret over the logarithm of the environment steps, from the first body to the budget."""
    steps = np.append(curve[:, 0], max(limit, curve[-1, 0] + 1))
    widths = np.diff(np.log(steps))
    return float(np.dot(widths, curve[:, 2]) / widths.sum())


# -- by track -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TrackRow:
    """A method over the problems of a track, under one judge.

    ``regret`` is over all problems and seeds; ``improvement`` the probability that a run ends with less regret than one
    of random search; ``factor`` the regret of random search divided by that of the method; ``wins`` the number of
    problems on which the method has the smallest interquartile mean, ties included.
    """

    track: str
    judge: str
    listed: bool
    problems: tuple[str, ...]
    seeds: int
    method: str
    regret: Estimate
    improvement: Estimate
    factor: float
    wins: int


def track_rows(runs: Sequence[Stored]) -> list[TrackRow]:
    """Return one row per track, judge, number of seeds and method.

    Problems on which random search has equally many seeds are taken together, and the methods that have at least as
    many on each of them.
    """
    rows = []
    for (track, judge, listed, seeds), members in _tracks(runs):
        methods = [m for m in members[0].runs if all(len(contest.runs.get(m, ())) >= seeds for contest in members)]
        table = {m: np.stack([contest.regrets(m)[:seeds] for contest in members], axis=1) for m in methods}
        rounded = {m: np.round(values / EQUAL) for m, values in table.items()}
        means = {m: [interquartile_mean(column) for column in values.T] for m, values in rounded.items()}
        lowest = np.min(list(means.values()), axis=0)
        whole = interquartile_mean(table["random"])
        for method in methods:
            regret = stratified_estimate(table[method])
            rows.append(
                TrackRow(
                    track,
                    judge,
                    listed,
                    tuple(contest.problem for contest in members),
                    seeds,
                    method,
                    regret,
                    improvement(-rounded[method], -rounded["random"]),
                    whole / regret.value if regret.value > 0.0 else np.inf,
                    int(np.sum(np.array(means[method]) <= lowest)),
                )
            )
    return rows


def _tracks(runs: Sequence[Stored]) -> Iterator[tuple[tuple[str, str, bool, int], list[Contest]]]:
    groups: dict[tuple[str, str, bool, int], list[Contest]] = defaultdict(list)
    for contest in contests(runs):
        seeds = len(contest.runs.get("random", ()))
        if seeds < FEWEST_SEEDS:
            continue
        track = load_problem(contest.problem, check=False).definition.track
        groups[track, contest.judge, contest.listed, seeds].append(contest)
    yield from sorted(groups.items())
