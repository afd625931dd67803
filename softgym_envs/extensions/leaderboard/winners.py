"""Winners of stored searches on finite elements: how much searches profit from errors of the learned model."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from softgym_envs.codesign.records import Record
from softgym_envs.codesign.statistics import kendall_tau
from softgym_envs.extensions.leaderboard.frozen import FrozenProblem, load_problem, problem_names
from softgym_envs.extensions.leaderboard.runs import Run, stored_runs, tested
from softgym_envs.extensions.leaderboard.scoring import DATA
from softgym_envs.extensions.leaderboard.table import Tabulation, tabulated
from softgym_envs.storage import atomic_write, read_json

FILE = "winners.json"


@dataclass(eq=False)
class Winner(Record):
    """The winner of one search, scored on the search goals by the inverse QP on both models of its body.

    Attributes:
        problem: ID with its version.
        hash: of the frozen problem.
        method: that found it.
        seed: of the search.
        median: whether the search is the one of its method's median seed.
        design: values of the variables [SI].
        surrogate: score on the learned model [SI].
        fem: score on finite elements [SI]; None if the body has no equilibrium there.
        rest: whether both scores are those where the inverse QP comes to rest, in place of whole episodes.
    """

    problem: str
    hash: str
    method: str
    seed: int
    median: bool
    design: dict[str, float]
    surrogate: float
    fem: float | None
    rest: bool = False

    @property
    def exploitation(self) -> float:
        """Score on the learned model minus that on finite elements [SI]; NaN without an equilibrium."""
        return np.nan if self.fem is None else self.surrogate - self.fem


def check(
    folder: Path,
    name: str,
    every: Sequence[str] = (),
    level: str = "small",
    data: Path = DATA,
    rest: bool = False,
) -> list[Winner]:
    """Score the winner of each method's median seed on finite elements (seconds to minutes each).

    The median seed is the one whose search ended with the median score; of an even number, the better of both.

    Args:
        folder: where the scores are kept, so that a call that was interrupted continues.
        name: a problem with one objective.
        every: methods of which the winners of all seeds are scored.
        level: budget of the searches, which are the stored ones under the inverse QP.
        data: folder of the stored runs.
        rest: compare the states where the inverse QP comes to rest, in place of whole episodes: a tenth of the steps.

    Raises:
        ValueError: if no such searches are stored.
    """
    problem = load_problem(name)
    searches: dict[str, list[Run]] = defaultdict(list)
    for run, _ in stored_runs(data):
        if (run.problem, run.judge, run.level) == (name, "qp", level) and run.curve and run.optimum is None:
            searches[run.method].append(run)
    if not searches:
        raise ValueError(f"problem '{name}': no searches with one objective under the inverse QP are stored")
    found = []
    for method, runs in sorted(searches.items()):
        ranked = sorted(runs, key=lambda run: (-run.search_scores[0][0], run.seed))
        middle = ranked[(len(ranked) - 1) // 2]
        for run in sorted(runs, key=lambda run: run.seed) if method in every else [middle]:
            learned, fem = (_at_rest if rest else _episodes)(problem, run.designs[0], folder)
            row = Winner(name, problem.hash, method, run.seed, run is middle, run.designs[0], learned, fem, rest)
            found.append(row)
    return found


def _episodes(problem: FrozenProblem, design: dict[str, float], folder: Path) -> tuple[float, float | None]:
    learned, exact = (tested(problem, design, "qp", "search", backend, folder) for backend in (None, "fem"))
    return learned.score, exact.score if exact.feasible else None


def _at_rest(problem: FrozenProblem, design: dict[str, float], folder: Path) -> tuple[float, float | None]:
    optimised, tabulation = problem.definition.optimised, Tabulation(problem)
    point = np.array([[float(optimised[name].to_unit(value)) for name, value in design.items()]])
    learned, exact = (
        problem.definition.primary.score(float(tabulated(tabulation, judge, point, folder)[0, 0]))
        for judge in ("rest", "fem")
    )
    return learned, exact if np.isfinite(exact) else None


def rank_correlation(rows: Sequence[Winner]) -> float:
    """Return Kendall's tau between the scores on both models; NaN for fewer than three winners."""
    pairs = [(row.surrogate, row.fem) for row in rows if row.fem is not None]
    tau = kendall_tau([pair[0] for pair in pairs], [pair[1] for pair in pairs])
    return np.nan if tau is None else tau


def store(rows: Sequence[Winner], data: Path = DATA) -> Path:
    """Add winners to the stored ones, in place of those of the same method and seed; return the file."""
    kept = {(row.problem, row.method, row.seed): row for row in (*stored_winners(data), *rows)}
    with atomic_write(data / FILE, "w") as stream:
        lines = [json.dumps(row.to_json()) for _, row in sorted(kept.items())]
        stream.write("[\n" + ",\n".join(lines) + "\n]\n")
    return data / FILE


def stored_winners(data: Path = DATA) -> list[Winner]:
    """Return the stored winners of the problems as they are now frozen."""
    path = data / FILE
    if not path.is_file():
        return []
    rows = [Winner.from_json(row) for row in read_json(path)]
    hashes = {name: load_problem(name, check=False).hash for name in {row.problem for row in rows} & {*problem_names()}}
    return [row for row in rows if hashes.get(row.problem) == row.hash]
