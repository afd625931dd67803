"""Tables of the benchmark, as Markdown: the leaderboard, and the baselines."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from softgym_envs.codesign.metrics.metric import Metric
from softgym_envs.errors import DataError
from softgym_envs.extensions.leaderboard.frozen import load_definition, load_problem, problem_names
from softgym_envs.extensions.leaderboard.problem import TRACKS
from softgym_envs.extensions.leaderboard.regret import MethodRow, Stored, contests, method_rows, track_rows
from softgym_envs.extensions.leaderboard.runs import stored_runs
from softgym_envs.extensions.leaderboard.scoring import DATA, normalised, reference
from softgym_envs.extensions.leaderboard.submission import Submission
from softgym_envs.extensions.leaderboard.table import (
    BEST_SHARE,
    FEWEST_RANKED,
    TABLE_JUDGES,
    Agreement,
    Table,
    shipped_tables,
)
from softgym_envs.extensions.leaderboard.winners import rank_correlation, stored_winners
from softgym_envs.extensions.sweeps.statistics import Estimate, stratified_estimate
from softgym_envs.wording import counted

SUBMISSIONS = DATA / "submissions"
"""Accepted submissions, one JSON file each."""


def problem_table() -> str:
    """Return the table of all problems."""
    rows = []
    for name in problem_names():
        problem = load_definition(name)
        budget = problem.budgets["small"]
        rows.append(
            [
                f"`{name}`",
                problem.track,
                problem.title,
                str(len(problem.variables)),
                problem.judge,
                f"{budget.environment_steps:,}",
            ]
        )
    return _table(["problem", "track", "about", "variables", "judge", "environment steps (small)"], rows)


def tracks() -> str:
    """Return the list of the tracks."""
    return "\n".join(f"* **{key}**: {text}" for key, text in TRACKS.items())


def method_table(runs: Sequence[Stored] | None = None, data: Path = DATA) -> str:
    """Return the table of the baselines, one row per problem, judge and method; default the stored runs."""
    rows = method_rows(stored_runs(data) if runs is None else runs, data)
    if not rows:
        return "No runs are stored."
    header = [
        "problem",
        "judge",
        "method",
        "seeds",
        "regret at the end [%]",
        "on unseen goals [% of the baseline]",
        "area [%]",
        "steps to 1 %",
        "CPU s to 1 %",
        "score on FEM",
        "at limits [%]",
        "diversity",
    ]
    return _table(header, [_method_cells(row) for row in rows])


def _method_cells(row: MethodRow) -> list[str]:
    return [
        f"`{row.problem}`",
        row.judge + (", table" if row.table else ""),
        row.method,
        str(row.seeds),
        _interval(row.regret, 100.0, 1),
        "-" if row.unseen is None else _interval(row.unseen, 100.0, 0),
        "-" if np.isnan(row.area) else f"{100 * row.area:.1f}",
        _reached(row.steps, ",.0f"),
        _reached(row.seconds, ".1f"),
        "not tested" if row.score is None else _interval(row.score, 1.0, 3),
        f"{100 * row.at_bounds:.0f}",
        f"{row.diversity:.2f}",
    ]


def _reached(value: float, form: str) -> str:
    if np.isnan(value):
        return "-"
    return f"{value:{form}}" if np.isfinite(value) else "not reached"


def track_table(runs: Sequence[Stored] | None = None) -> str:
    """Return the baselines over the problems of each track; default the stored runs."""
    rows = []
    for row in track_rows(stored_runs() if runs is None else runs):
        rows.append(
            [
                row.track,
                row.judge + (", table" if row.listed else ""),
                f"{len(row.problems)} x {row.seeds}",
                row.method,
                _interval(row.regret, 100.0, 1),
                f"{row.factor:.1f}" if np.isfinite(row.factor) else "-",
                _interval(row.improvement, 1.0, 2),
                f"{row.wins}",
            ]
        )
    if not rows:
        return "No runs are stored."
    header = ["track", "judge", "problems x seeds", "method", "regret at the end [%]", "random / method"]
    return _table([*header, "better than random with probability", "smallest regret on"], rows)


def regret_table(runs: Sequence[Stored] | None = None, unseen: bool = False) -> str:
    """Return the regret of each method on each problem, or `Contest.unseen`; default the stored runs."""
    found = contests(stored_runs() if runs is None else runs)
    if not found:
        return "No runs are stored."
    methods = sorted({method for contest in found for method in contest.runs})
    rows = []
    for contest in found:
        seeds = sorted({len(members) for members in contest.runs.values()})
        cells = [f"`{contest.problem}`", contest.judge + (", table" if contest.listed else "")]
        cells.append(str(seeds[0]) if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}")
        for method in methods:
            values = np.array([])
            if method in contest.runs:
                values = contest.unseen(method) if unseen else contest.regrets(method)
            cells.append(_interval(stratified_estimate(values[:, None]), 100.0, 1) if len(values) else "-")
        if set(cells[3:]) != {"-"}:
            rows.append(cells)
    return _table(["problem", "judge", "seeds", *(f"{method} [%]" for method in methods)], rows)


def unseen_table() -> str:
    """Return how far winners of the stored runs end from unseen goals, in percent of the baseline."""
    return regret_table(unseen=True)


def _interval(estimate: Estimate, scale: float, digits: int) -> str:
    value = f"{scale * estimate.value:.{digits}f}"
    if np.isnan(estimate.low):
        return value
    return f"{value} ({scale * estimate.low:.{digits}f} to {scale * estimate.high:.{digits}f})"


def leaderboard(folder: Path = SUBMISSIONS, data: Path = DATA, more: Sequence[Path] = ()) -> str:
    """Return the leaderboard: the accepted submissions by problem, the best first.

    Submissions to a former version of a problem are left out.

    Args:
        folder: of the accepted submissions.
        data: folder of the references.
        more: files of further submissions, which are shown by the scores that they claim.

    Raises:
        DataError: if a further submission claims no scores.
    """
    rows: list[tuple[str, float, list[str]]] = []
    for path in (*sorted(folder.glob("*.json")), *more):
        submission = Submission.read(path)
        if path in more and not submission.claimed:
            raise DataError(f"the submission '{path}' claims no scores; write it with submit(..., test=True)")
        if submission.problem not in problem_names():
            continue
        known = reference(load_problem(submission.problem, check=False), data)
        if known is None or submission.hash != known.hash or not submission.claimed:
            continue
        score = normalised(known, submission.claimed)
        spent = sum(row["environment_steps"] for row in submission.ledger)
        seconds = sum(row["cpu_seconds"] for row in submission.ledger)
        rows.append(
            (
                submission.problem,
                -(score or 0.0),
                [
                    f"`{submission.problem}`",
                    _escaped(submission.method),
                    _escaped(submission.author) or "-",
                    submission.level,
                    "-" if score is None else f"{score:.3f}",
                    ", ".join(f"{value:.4g}" for value in submission.claimed[0]),
                    f"{spent:,}",
                    f"{seconds:.1f}",
                    f"{submission.pretraining_steps:,}",
                ],
            )
        )
    if not rows:
        return "No submissions are stored."
    header = [
        "problem",
        "method",
        "author",
        "budget",
        "score",
        "on FEM [SI]",
        "environment steps",
        "CPU s",
        "pre-training steps",
    ]
    return _table(header, [cells for *_, cells in sorted(rows, key=lambda row: row[:2])])


def reference_table(data: Path = DATA) -> str:
    """Return what the 0 and the 1 of each problem are on finite elements, on its test goals."""
    rows = []
    for name in problem_names():
        known = reference(load_problem(name, check=False), data)
        if known is None:
            continue
        unit = load_definition(name).primary

        def shown(score: float, unit: Metric = unit) -> str:
            return f"{unit.sign * unit.scale * score:.4g} {unit.display.unit}"

        best, found = "none better is known", "-"
        if known.best:
            best = (
                shown(known.best[0][0])
                if len(known.baseline) == 1
                else f"a front of {counted(len(set(map(tuple, known.best))), 'body')}"
            )
            found = f"{known.found.get('method')}, judge {known.found.get('judge')}"
        accurate = " and ".join(shown(score) for score in known.accurate) or "-"
        rows.append([f"`{name}`", shown(known.baseline[0]), best, known.controller, found, accurate])
    if not rows:
        return "No references are stored."
    header = ["problem", "0: the baseline", "1: the best known", "controlled by", "found by"]
    return _table([*header, "both at rest on the accurate mesh"], rows)


def winners_table(data: Path = DATA) -> str:
    """Return the stored winners of the median seeds on both models, and what all stored winners say together."""
    rows = stored_winners(data)
    if not rows:
        return "No winners are stored."
    cells, notes = [], []
    for name in sorted({row.problem for row in rows}):
        problem = load_problem(name, check=False)
        unit, sign = problem.definition.primary, problem.definition.primary.sign
        shown = unit.display.unit
        members = [row for row in rows if row.problem == name]
        for row in sorted((row for row in members if row.median), key=lambda row: -row.surrogate):
            fem = "no equilibrium" if row.fem is None else f"{sign * unit.scale * row.fem:.4f}"
            values = [f"{sign * unit.scale * row.surrogate:.4f}", fem, f"{unit.scale * row.exploitation:.4f}"]
            cells.append([f"`{name}`", row.method, f"{row.seed}", *values])
        gaps = unit.scale * np.array([row.exploitation for row in members if row.fem is not None])
        notes.append(
            f"* `{name}`: {counted(len(members), 'winner')}; exploitation {gaps.min():.4f} to {gaps.max():.4f} "
            f"{shown}, mean {gaps.mean():.4f} {shown}; Kendall's tau {rank_correlation(members):.2f}."
        )
    header = ["problem", "method", "median seed", "learned model [mm]", "finite elements [mm]", "exploitation [mm]"]
    return _table(header, cells) + "\n\n" + "\n".join(notes)


def bodies_table() -> str:
    """Return the shipped tables of bodies: how many each judge has scored, and how it ranks those of `rest`."""
    rows = []
    for name in shipped_tables():
        table = Table.read(name)
        unit = table.problem.definition.primary
        for judge in (key for key in TABLE_JUDGES if key in table.values):
            scored = int(np.isfinite(table.values[judge][:, 0]).sum())
            cells = [f"`{name}`", f"`{judge}`", TABLE_JUDGES[judge].about, f"{scored:,}"]
            goals = "_few" if judge.endswith("_few") else ""
            own = [f"rest_accurate{goals}"] if judge.startswith("fem_accurate") else []
            others = [other for other in (f"rest{goals}", *own) if other != judge and other in table.values]
            for other in others:
                every, best = table.agreement(other, judge), table.agreement(other, judge, best=BEST_SHARE)
                among = _tau(best) if best.bodies >= FEWEST_RANKED else "-"
                rows.append([*cells, f"`{other}`", _tau(every), among, f"{unit.scale * every.bias:+.4f}"])
            if not others:
                rows.append([*cells, *"----"])
    if not rows:
        return "No tables are shipped."
    compared = ["compared with", "Kendall's tau", "among the best tenth", "mean difference [mm]"]
    return _table(["problem", "judge", "about", "bodies", *compared], rows)


def _tau(found: Agreement) -> str:
    """Return Kendall's tau with its interval, and the number of bodies where it is that of a sample."""
    if np.isnan(found.tau):
        return "-"  # fewer than three bodies
    if np.isnan(found.interval[0]):
        return f"{found.tau:.3f}"
    return f"{found.tau:.2f} ({found.interval[0]:.2f} to {found.interval[1]:.2f}; {found.bodies} bodies)"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(header) + " |", "| " + " | ".join("---" for _ in header) + " |"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def _escaped(text: str) -> str:
    """Return what a stranger wrote as one cell of a table, without markup of HTML or Markdown."""
    plain = html.escape(" ".join(text.split()), quote=True)
    return re.sub(r"([\\`*_\[\]()!|#~])", lambda found: f"&#{ord(found[1])};", plain)
