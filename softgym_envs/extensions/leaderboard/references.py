"""What is known about problems on finite elements: the 0 and the 1 of normalised scores."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from softgym_envs.extensions.leaderboard.frozen import FrozenProblem, load_problem
from softgym_envs.extensions.leaderboard.runs import Run, stored_runs, tested
from softgym_envs.extensions.leaderboard.scoring import (
    DATA,
    Reference,
    make_reference,
    merit,
    write_reference,
)
from softgym_envs.extensions.leaderboard.submission import is_better
from softgym_envs.extensions.leaderboard.table import Tabulation


def promising(name: str, data: Path = DATA) -> Run:
    """Return the stored search with the winner that is most likely the best on the test goals.

    That is the one that is best on the validation goals, which no search sees; for problems with a single path the one
    with the best score of the search, and with several objectives the one with the largest hypervolume.

    Raises:
        ValueError: if no search is stored.
    """
    problem = load_problem(name)
    runs = [run for run, _ in stored_runs(data) if (run.problem, run.hash) == (name, problem.hash)]
    runs = [run for run in runs if run.optimum is None and run.designs]
    if not runs:
        raise ValueError(f"problem '{name}': no searches are stored")
    seen = [run for run in runs if len(run.unseen) == 2]
    if seen:
        return max(seen, key=lambda run: run.unseen[1])
    return max(runs, key=lambda run: merit(Reference(name, run.hash, run.baseline), run.search_scores))


def check_winners(folder: Path, runs: Iterable[Run], data: Path = DATA) -> None:
    """Test the winners of runs on finite elements, on test goals, and keep the best known body of each problem."""
    for each in runs:
        problem = load_problem(each.problem)
        known = make_reference(problem, data)
        judge = problem.definition.judge
        scores = [tested(problem, design, judge, "test", "fem", folder, each.seed) for design in each.designs]
        values = [score.scores for score in scores if score.feasible]
        if values and is_better(known, values):
            designs = [score.design for score in scores if score.feasible]
            where = {"method": each.method, "judge": each.judge, "seed": each.seed, "level": each.level}
            known = Reference(
                known.problem, known.hash, known.baseline, values, designs, judge, {**where, "commit": each.commit}
            )
            write_reference(known, data)


def check_accurate(name: str, data: Path = DATA, longest: float = 0.5) -> Reference:
    """Score the baseline and the best known body on the accurate mesh, and store that (minutes).

    Both are scored where the inverse QP comes to rest, on the test goals.

    Args:
        name: a problem that can be tabulated, see `softgym_envs.extensions.leaderboard.table.Tabulation`.
        data: folder of the references.
        longest: largest step towards rest, relative to the range of a command.

    Raises:
        ValueError: for another problem, or if no better body than the baseline is known.
    """
    problem = load_problem(name)
    known = make_reference(problem, data)
    if len(known.designs) != 1:
        raise ValueError(f"problem '{name}': no body is known that is better than the baseline")
    points = np.array([_unit(problem, values) for values in (problem.definition.baseline_values, known.designs[0])])
    rows = Tabulation(problem, longest, "test").fem("accurate", points)
    known.accurate = [problem.definition.primary.score(float(value)) for value in rows[:, 0]]
    write_reference(known, data)
    return known


def _unit(problem: FrozenProblem, design: dict[str, float]) -> list[float]:
    variables = problem.definition.optimised
    return [float(variables[name].to_unit(design[name])) for name in problem.variables]
