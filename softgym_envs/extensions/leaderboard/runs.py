"""Runs of baselines on problems: resumable, one small JSON file each."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.codesign.records import Record
from softgym_envs.extensions.leaderboard.frozen import FrozenProblem, load_problem, problem_names
from softgym_envs.extensions.leaderboard.problem import Judge, JudgedScore
from softgym_envs.extensions.leaderboard.scoring import DATA, front
from softgym_envs.extensions.leaderboard.search import Search, make_optimiser, solve
from softgym_envs.extensions.leaderboard.table import Table, TableSearch
from softgym_envs.runs import provenance
from softgym_envs.storage import atomic_write, read_json, write_json


@dataclass(eq=False)
class Run(Record):
    """One search by a baseline.

    Attributes:
        problem: ID with its version.
        hash: of the frozen problem.
        method: key of `softgym_envs.extensions.leaderboard.search.METHODS`.
        judge: who controlled the bodies in the search.
        level: name of the budget.
        seed: of the optimiser and of trainings.
        designs: the winner; with several objectives, bodies of the front.
        search_scores: their scores in the search.
        curve: for each body that became the best: environment steps and CPU seconds until then, and its score in the
            search. Empty with several objectives.
        unseen: scores of the baseline and of the winner under the inverse QP on the validation goals, which no search
            sees: one yardstick for all judges. Empty with several objectives, on a table, and for a problem with a
            single path.
        bodies: number of bodies scored.
        infeasible: number of these that could not be scored.
        diversity: mean distance between bodies in the unit box, divided by its diagonal.
        spent: environment steps, CPU seconds and solves on finite elements.
        optimiser_seconds: CPU time of the optimiser itself [s].
        commit: of the code.
        optimum: best score of a listed body, for a search on a table.
        baseline: scores of the baseline body in the search.
        limit: largest number of bodies, if the search had a limit besides its budget.
    """

    problem: str
    hash: str
    method: str
    judge: str
    level: str
    seed: int
    designs: list[dict[str, float]]
    search_scores: list[list[float]]
    curve: list[list[float]] = field(default_factory=list)
    unseen: list[float] = field(default_factory=list)
    bodies: int = 0
    infeasible: int = 0
    diversity: float = 0.0
    spent: dict[str, float] = field(default_factory=dict)
    optimiser_seconds: float = 0.0
    commit: str | None = None
    optimum: float | None = None
    baseline: list[float] = field(default_factory=list)
    limit: int | None = None


def run(
    folder: Path,
    name: str,
    method: str,
    judge: Judge | None,
    level: str,
    seed: int,
    table: Table | None = None,
    limit: int | None = None,
) -> Run:
    """Run a baseline, on a table if one is given, or return its result if the folder has it.

    With a limit, the search also ends after so many bodies.
    """
    problem = load_problem(name) if table is None else table.problem
    search = Search(problem, level, judge, seed, limit)
    if table is not None:
        search = TableSearch.on(table, level, judge or problem.definition.judge)
        search.limit = limit
    kind = "table-" if table is not None else ""
    cap = "" if limit is None else f"-{limit}"
    path = folder / "runs" / name / f"{kind}{method}-{search.judge}-{level}{cap}-{seed}.json"
    if path.is_file():
        stored = Run.read(path)
        if stored.hash == problem.hash:
            return stored
    own = solve(search, make_optimiser(method, problem, seed))
    single = problem.definition.score_count == 1
    winners = front(search.ledger) if not single else [search.best] if search.best else []
    found = Run(
        problem=name,
        hash=problem.hash,
        method=method,
        judge=str(search.judge),
        level=level,
        seed=seed,
        designs=[row.design for row in winners],
        search_scores=[row.scores for row in winners],
        curve=_curve(search) if single else [],
        unseen=_unseen(problem, winners, folder) if single and table is None and not problem.single_path else [],
        bodies=len(search.ledger),
        infeasible=sum(not row.feasible for row in search.ledger),
        diversity=_diversity(problem, search.ledger),
        spent={key: round(value, 3) for key, value in search.spent.items()},
        optimiser_seconds=round(own, 3),
        commit=provenance()["commit"],
        optimum=None if table is None else table.best(str(search.judge)),
        baseline=search.ledger[0].scores,
        limit=limit,
    )
    found.write(path)
    return found


def _curve(search: Search) -> list[list[float]]:
    rows = []
    for index, row in search.incumbents:
        spent = search.ledger[: index + 1]
        steps, seconds = sum(r.environment_steps for r in spent), sum(r.cpu_seconds for r in spent)
        rows.append([steps, round(seconds, 3), row.score])
    return rows


def _unseen(problem: FrozenProblem, winners: Sequence[JudgedScore], folder: Path) -> list[float]:
    designs = [problem.definition.baseline_values, *(row.design for row in winners)]
    return [tested(problem, design, "qp", "validation", None, folder).score for design in designs]


def _diversity(problem: FrozenProblem, rows: Sequence[JudgedScore]) -> float:
    variables = problem.definition.optimised
    points = np.array([[float(variables[n].to_unit(value)) for n, value in row.design.items()] for row in rows])
    if len(points) < 2:
        return 0.0
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    mean = distance.sum() / (len(points) * (len(points) - 1))
    return round(float(mean / (2.0 * np.sqrt(points.shape[1]))), 4)


def tested(
    problem: FrozenProblem,
    design: dict[str, float],
    judge: Judge,
    goals: str,
    backend: str | None,
    folder: Path,
    seed: int = 0,
) -> JudgedScore:
    """Return the score of a body on a set of goals; computed once and kept in a folder."""
    point = [round(float(problem.definition.optimised[name].to_unit(value)), 6) for name, value in design.items()]
    key = json.dumps([problem.hash, point, judge, goals, backend, seed if judge == "trained" else 0])
    path = folder / "scores" / problem.name / f"{sha256(key.encode()).hexdigest()[:24]}.json"
    if path.is_file():
        return JudgedScore.read(path)
    found = problem.evaluator(goals, backend)(design, judge, seed=seed)
    found.write(path)
    return found


# -- stored results ---------------------------------------------------------------------------------------------------


def collect(folder: Path, data: Path = DATA) -> Path:
    """Add all runs of a folder, with the tests of their winners, to one small file; runs of older versions are dropped.

    A run replaces the stored one with the same problem, method, judge, budget and seed.
    """
    names = problem_names()  # a version that is no longer offered is not among them
    rows = {_key(each): (each, test) for each, test in stored_runs(data) if each.problem in names}
    problems: dict[str, FrozenProblem] = {}
    for path in sorted(folder.glob("runs/*/*.json")):
        each = Run.read(path)
        if each.problem not in names:
            continue
        problem = problems.setdefault(each.problem, load_problem(each.problem))
        if each.hash == problem.hash:
            rows[_key(each)] = each, _stored_test(problem, each, folder)
    current = [
        {**each.to_json(), "test": test}
        for _, (each, test) in sorted(rows.items(), key=lambda item: str(item[0]))
        if each.hash == problems.setdefault(each.problem, load_problem(each.problem)).hash
    ]
    target = data / "runs.json"
    with atomic_write(target, "w") as stream:
        stream.write("[\n" + ",\n".join(json.dumps(row) for row in current) + "\n]\n")
    return target


def _key(each: Run) -> tuple:
    return each.problem, each.optimum is not None, each.judge, each.level, each.limit, each.method, each.seed


def _stored_test(problem: FrozenProblem, each: Run, folder: Path) -> list[list[float]] | None:
    judge, found = problem.definition.judge, []
    for design in each.designs:
        point = [round(float(problem.definition.optimised[name].to_unit(value)), 6) for name, value in design.items()]
        key = json.dumps([problem.hash, point, judge, "test", "fem", each.seed if judge == "trained" else 0])
        path = folder / "scores" / problem.name / f"{sha256(key.encode()).hexdigest()[:24]}.json"
        if not path.is_file():
            return None
        found.append(JudgedScore.read(path).scores)
    return found


def stored_runs(data: Path = DATA) -> list[tuple[Run, list[list[float]] | None]]:
    """Return the stored runs, each with the scores of its winners on finite elements, or None if not tested."""
    path = data / "runs.json"
    if not path.is_file():
        return []
    rows = []
    for row in read_json(path):
        test = row.pop("test")
        rows.append((Run.from_json(row), test))
    return rows


# -- judges ---------------------------------------------------------------------------------------------------------


def judges(folder: Path, name: str, bodies: int, seed: int = 0) -> dict[str, Any]:
    """Compare the judges with specialists on finite elements, on bodies of a Sobol sequence and the search goals.

    Returns:
        The scores of each judge, and Kendall's tau and the mean difference to the specialists; also written to the
        folder.
    """
    from scipy.stats import kendalltau, qmc

    problem = load_problem(name)
    points = 2.0 * qmc.Sobol(len(problem.variables), rng=np.random.default_rng(seed)).random(bodies) - 1.0
    designs = [problem.design(point) for point in points]
    specialist: Judge = "trained" if "trained" in problem.definition.judges else "qp"
    exact = [tested(problem, d, specialist, "search", "fem", folder).score for d in designs]
    found: dict[str, Any] = {
        "problem": name,
        "hash": problem.hash,
        "designs": designs,
        "specialist": specialist,
        "exact": exact,
        "judges": {},
    }
    for judge in problem.definition.judges:
        scores = [tested(problem, d, judge, "search", None, folder).score for d in designs]
        pairs = [(a, b) for a, b in zip(scores, exact, strict=True) if np.isfinite([a, b]).all()]
        first, second = np.array(pairs).T
        found["judges"][judge] = {
            "scores": scores,
            "kendall_tau": float(kendalltau(first, second).statistic),
            "exploitation": float(np.mean(first - second)),
        }
    write_json(folder / "judges" / f"{name}.json", found)
    return found
