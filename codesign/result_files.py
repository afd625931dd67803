"""Files of a study's results: ``results.json``, ``trials.csv``, ``finalists.csv``."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from softgym_envs.agents.evaluation import Evaluation, none_for_nan
from softgym_envs.codesign.collect import collect
from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.records import Finalist, TestGroup, TrialResult
from softgym_envs.codesign.results import StudyResults
from softgym_envs.codesign.snapshot import StudySnapshot
from softgym_envs.registry import Table
from softgym_envs.storage import atomic_write

REPORTS = Table("report of a study", {}, group="softgym_envs.reports")
"""Reports of installed packages by name: each takes the folder of a study and returns the path of what it wrote."""


def write_results(snapshot: StudySnapshot) -> StudyResults:
    """Write ``results.json``, ``trials.csv`` and ``finalists.csv``; return what is in the first."""
    results = collect(snapshot)
    folder = snapshot.folder.path
    results.write(folder / "results.json")
    units = {variable.name: variable.unit for variable in results.variables}
    _write_csv(folder / "trials.csv", (_trial_row(trial, snapshot.config, units) for trial in snapshot.trials))
    bodies = {body.trial: body for body in results.finalists}
    _write_csv(folder / "finalists.csv", (_test_row(group, bodies[group.trial], units) for group in results.tests))
    return results


def _write_csv(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    rows = list(rows)
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with atomic_write(path, "w") as stream:
        writer = csv.DictWriter(stream, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _field(evaluation: Evaluation | None, name: str) -> float | None:
    return None if evaluation is None else none_for_nan(getattr(evaluation, name))


def _trial_row(trial: TrialResult, config: StudyConfig, units: Mapping[str, str]) -> dict[str, Any]:
    evaluation, qp = trial.evaluation, trial.qp
    named = {
        name: trial.values.get(name) for name in config.objectives if name not in ("success_rate", "mean_distance")
    }
    return {
        "trial": trial.number,
        "state": trial.state,
        "feasible": trial.feasible,
        "origin": trial.origin,
        **{f"{name} [{units[name]}]": value for name, value in {**trial.design, **trial.options}.items()},
        "score": trial.score,
        "success_rate": _field(evaluation, "success_rate"),
        "mean_distance [m]": _field(evaluation, "mean_distance"),
        "mean_return": _field(evaluation, "mean_return"),
        **{f"{name} [SI]": value for name, value in named.items()},
        **{f"violation of {name} [SI]": trial.violations.get(name) for name in config.constraints},
        "qp_success_rate": _field(qp, "success_rate"),
        "qp_mean_distance [m]": _field(qp, "mean_distance"),
        "training_steps": trial.training_steps,
        "seconds": round(trial.seconds, 3),
        "cpu_seconds": round(trial.cpu_seconds, 3),
        "sampler_seed": trial.sampler_seed,
        "reason": trial.reason or config.violations_text(trial.values, config.constraints) or None,
    }


def _test_row(group: TestGroup, body: Finalist, units: Mapping[str, str]) -> dict[str, Any]:
    mean = group.mean if group.error is None else None
    return {
        "trial": group.trial,
        "role": body.role,
        **{f"{name} [{units[name]}]": value for name, value in {**body.design, **body.options}.items()},
        "agent": group.agent,
        "backend": group.backend,
        "goals": group.goals,
        "success_rate": _field(mean, "success_rate"),
        "mean_distance [m]": _field(mean, "mean_distance"),
        "worst_distance [m]": None if mean is None else group.worst_distance,
        "mean_return": _field(mean, "mean_return"),
        "mean_effort": _field(mean, "mean_effort"),
        "largest_effort": None if mean is None else none_for_nan(group.largest_effort),
        "steps": _field(mean, "steps"),
        "unknowns": group.unknowns,
        "last_motion [m]": group.last_motion,
        "error": group.error,
    }
