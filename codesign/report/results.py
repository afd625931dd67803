"""What a study found, as plain data: ``results.json``, ``trials.csv``, ``finalists.csv``."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codesign.folder import StudyFolder
from codesign.objectives import OBJECTIVES, Objective
from codesign.phases.finalists import (
    BACKENDS,
    Finalist,
    choose_winner,
    evaluations,
    finalists,
    pareto_trials,
    trainings,
)
from codesign.phases.screen import screen_records
from codesign.scheduling.queue import open_study
from softgym_envs.config import provenance
from softgym_envs.envs.tasks.registry import make_task
from softgym_envs.storage import atomic_write, read_json, write_json

__all__ = ["collect", "mean_interval", "rank_correlation", "rate_interval", "write_results"]

CONFIDENCE = 0.95


Interval = tuple[float, float] | None
"""Ends of a 95 % interval; None where there is nothing to judge the chance by: one goal, one training."""


def mean_interval(table: np.ndarray, minus: np.ndarray | None = None) -> Interval:
    """Interval of a mean, or of the difference of two, over goals and, where there are several, training seeds.

    Goals are the same for both, the seeds of each its own. It is Student's, with the variance over goals and, where
    there are several seeds, the variances over these added, and Satterthwaite's degrees of freedom (1946). Of a normal
    distribution it covers 95 %, with two to five seeds 93 to 99 %; where most goals do not change and a few change much
    it covers less, 75 % over 12 goals, 89 % over 40, and a bootstrap no more.

    Args:
        table: values, shape (seeds, goals).
        minus: what is subtracted, shape (other seeds, goals).
    """
    from scipy.stats import t

    tables = [table] if minus is None else [table, minus]
    goals = table.mean(axis=0) - (0.0 if minus is None else minus.mean(axis=0))
    samples = [goals] + [each.mean(axis=1) for each in tables]
    # variances of a mean, and their degrees of freedom
    parts = [(x.var(ddof=1) / len(x), len(x) - 1) for x in samples if len(x) > 1]
    if len(goals) < 2:
        return None
    variance = sum(v for v, _ in parts)
    mean = float(goals.mean())
    if variance == 0.0:
        return mean, mean
    freedom = variance**2 / sum(v * v / f for v, f in parts)
    half = float(t.ppf(0.5 + 0.5 * CONFIDENCE, freedom) * np.sqrt(variance))
    return mean - half, mean + half


def rate_interval(successes: np.ndarray) -> Interval:
    """Interval of a success rate, successes (seeds, goals): Wilson's over goals, widened to `mean_interval` over seeds.

    With several seeds Wilson's is as if each goal had been tried once: several policies that reach all goals tell
    little more about other goals than one does.
    """
    from scipy.stats import binomtest

    goals, reached = successes.shape[1], float(successes.mean(axis=0).sum())
    # Half reached counts against the end of the interval that it moves.
    ends = (int(np.floor(reached + 1e-9)), int(np.ceil(reached - 1e-9)))
    low, high = (binomtest(k, goals).proportion_ci(CONFIDENCE, method="wilson") for k in ends)
    found = float(low.low), float(high.high)
    wide = mean_interval(successes) if len(successes) > 1 else None
    return found if wide is None else (max(min(found[0], wide[0]), 0.0), min(max(found[1], wide[1]), 1.0))


def rank_correlation(first: Sequence[float], second: Sequence[float]) -> float | None:
    """Spearman's rank correlation, or None with fewer than three pairs or without any variation."""
    from scipy.stats import spearmanr

    if len(first) < 3 or np.ptp(first) == 0.0 or np.ptp(second) == 0.0:
        return None
    return float(spearmanr(first, second).statistic)


def success_distance(folder: StudyFolder) -> float:
    """Distance below which a goal counts as reached [m]."""
    config = folder.config
    row = config.environment.row
    return make_task(row.task, config.robot, **{**row.task_options, **config.environment.task_options}).success_distance


def _table(record: Mapping[str, Any], key: str) -> np.ndarray:
    """Values by seed and goal, shape (seeds, goals)."""
    return np.atleast_2d(np.array(record.get("of_seeds", record)[key], dtype=float))


def _compare(baseline: Mapping[str, Any], winner: Mapping[str, Any], objective: Objective) -> dict[str, Any]:
    """Winner minus baseline, goal by goal."""
    distances = {"baseline": np.array(baseline["distances"]), "winner": np.array(winner["distances"])}
    change = distances["winner"] - distances["baseline"]
    gained = np.array(winner["successes"], dtype=float) - np.array(baseline["successes"], dtype=float)
    tables = {
        key: (_table(baseline, key), _table(winner, key)) for key in {"distances", "successes", objective.per_goal}
    }
    own = tables[objective.per_goal]
    return {
        "backend": winner["backend"],
        "agent": winner["agent"],
        "goals": len(change),
        **{
            role: {
                "success_rate": record["success_rate"],
                "success_interval": rate_interval(tables["successes"][which]),
                "mean_distance": record["mean_distance"],
                "distance_interval": mean_interval(tables["distances"][which]),
                "worst_distance": record["worst_distance"],
                "mean_return": record["mean_return"],
                "mean_effort": record["mean_effort"],
            }
            for which, (role, record) in enumerate((("baseline", baseline), ("winner", winner)))
        },
        "success_change": float(gained.mean()),
        "success_change_interval": mean_interval(*reversed(tables["successes"])),
        "distance_change": float(change.mean()),
        "distance_change_interval": mean_interval(*reversed(tables["distances"])),
        "objective": [float(table.mean()) for table in own],
        "objective_change": float(own[1].mean() - own[0].mean()),
        "objective_change_interval": mean_interval(*reversed(own)),
        "goals_closer": int((change < 0.0).sum()),
        "goals_farther": int((change > 0.0).sum()),
    }


def _transfer(records: list[dict[str, Any]], key: str) -> list[dict[str, Any]]:
    """Surrogate against FEM over the finalists, for each controller: values, gap and rank correlation."""
    objective = OBJECTIVES[key]
    rows = []
    for agent in ("sac", "qp"):
        values = {
            backend: {r["trial"]: objective.score(r) for r in records if (r["agent"], r["backend"]) == (agent, backend)}
            for backend in BACKENDS
        }
        trials = sorted(set(values["surrogate"]) & set(values["fem"]))
        if not trials:
            continue
        surrogate, fem = ([values[backend][t] * objective.sign for t in trials] for backend in BACKENDS)
        rows.append(
            {
                "agent": agent,
                "objective": key,
                "trials": trials,
                "surrogate": surrogate,
                "fem": fem,
                "mean_gap": float(np.mean(np.subtract(fem, surrogate))),
                "worst_gap": float(np.max(np.abs(np.subtract(fem, surrogate)))),
                "spearman": rank_correlation(surrogate, fem),
            }
        )
    return rows


def importance(folder: StudyFolder) -> dict[str, float]:
    """How much each variable decides between good and bad bodies (PED-ANOVA), or nothing with too few trials."""
    import optuna
    from optuna.trial import TrialState

    study = open_study(folder)
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if len(complete) < 8 or len(folder.config.variables) < 2 or len({trial.values[0] for trial in complete}) < 3:
        return {}
    evaluator = optuna.importance.PedAnovaImportanceEvaluator(target_quantile=0.25)
    first = (lambda trial: -trial.values[0]) if folder.config.also else None
    try:
        with warnings.catch_warnings():  # it says that it takes small values for good ones, which these are
            warnings.filterwarnings("ignore", "PedAnovaImportanceEvaluator computes", UserWarning)
            found = optuna.importance.get_param_importances(study, evaluator=evaluator, target=first)
    except (ValueError, RuntimeError):  # no quantile of the trials can be told apart
        return {}
    return {name: float(value) for name, value in found.items()}


def _cost(folder: StudyFolder, trials: list[dict[str, Any]]) -> dict[str, Any]:
    screened = [record["qp"] for record in screen_records(folder)]
    judged = [trial[key] for trial in trials for key in ("qp", "evaluation") if trial[key] and trial["agent"] != key]
    config = folder.config
    path = folder.path / "judge" / "judge.json"
    judge = {"training_steps": 0, "report_steps": 0, "cpu_seconds": 0.0}
    if path.exists():
        judge = read_json(path)
    # Of all bodies that ever were finalists, not of the present ones alone.
    tests = [read_json(path) for path in sorted(folder.path.glob("finalists/trial*.json"))]
    retrained = [read_json(path) for path in sorted(folder.path.glob("finalists/*/training.json"))]
    return {
        "joint_steps": judge["training_steps"],
        "joint_report_steps": judge["report_steps"],
        "retraining_steps": sum(row["steps"] for row in retrained),
        "retraining_report_steps": sum(row["report_steps"] for row in retrained),
        "training_steps": sum(trial["training_steps"] for trial in trials),
        "report_steps": sum(len(trial["curve"]) for trial in trials)
        * config.training.evaluation_episodes
        * config.episode_steps,
        "selection_steps": sum(record.get("steps", 0) for record in judged),
        "screen_steps": sum(record.get("steps", 0) for record in screened),
        **{
            f"test_steps_{backend}": sum(r.get("steps", 0) for r in tests if r["backend"] == backend)
            for backend in BACKENDS
        },
        "cpu_seconds": {
            "screen": sum(record.get("cpu_seconds", 0.0) for record in screened),
            "judge": judge["cpu_seconds"],
            "trials": sum(trial["cpu_seconds"] for trial in trials),
            "finalists": sum(record.get("cpu_seconds", 0.0) for record in tests)
            + sum(row["cpu_seconds"] for row in retrained),
        },
        "wall_seconds": folder.account()["wall_seconds"],
    }


def _body(finalist: Finalist | None) -> dict[str, Any] | None:
    if finalist is None:
        return None
    return {
        "trial": finalist.number,
        "design": finalist.design,
        "score": finalist.score,
        "policy": finalist.policy,
    }


def collect(folder: StudyFolder) -> dict[str, Any]:
    """Gather everything that is known of a study [SI]; it need not be finished."""
    config = folder.config
    trials, tests = folder.results(), evaluations(folder)
    good = [record for record in tests if "error" not in record]
    unseen = [record for record in good if record["goals"] == "unseen"]
    bodies = finalists(folder)
    winner = choose_winner(folder, good)
    baseline = next((body for body in bodies if body.role == "baseline"), None)
    comparison = []
    if winner is not None and baseline is not None:
        found = {(r["trial"], r["agent"], r["backend"]): r for r in unseen}
        for backend in reversed(BACKENDS):
            for agent in winner.agents:
                pair = [found.get((body.number, agent, backend)) for body in (baseline, winner)]
                if pair[0] and pair[1]:
                    comparison.append(_compare(pair[0], pair[1], OBJECTIVES[config.objective]))
    states = [trial["state"] for trial in trials]
    space = config.space
    return {
        "name": config.name,
        "title": config.title or config.name,
        "environment": config.environment.title,
        "objective": config.objective,
        "strategy": config.strategy,
        "command": folder.account()["command"],
        "trials": {"asked": config.trials, **{s: states.count(s) for s in ("complete", "pruned", "infeasible")}},
        "variables": [
            {
                "name": name,
                "unit": space[name].unit,
                "low": space[name].low,
                "high": space[name].high,
                "log": space[name].log,
                "baseline": config.baseline[name],
                "winner": None if winner is None else winner.design[name],
                "optimised": name in config.variables,
                "description": space[name].description,
            }
            for name in space.names
        ],
        "baseline": _body(baseline),
        "winner": _body(winner),
        "comparison": comparison,
        "objectives": [config.objective, *config.also],
        "limits": config.limits,
        "pareto": [r["number"] for r in pareto_trials(folder)] if config.also else [],
        "transfer": [row for key, o in OBJECTIVES.items() if o.per_goal for row in _transfer(unseen, key)],
        "finalists": [
            {"trial": body.number, "role": body.role, "design": body.design, "score": body.score} for body in bodies
        ],
        "trainings": trainings(folder),
        "evaluations": tests,
        "importance": importance(folder),
        "cost": _cost(folder, trials),
        "success_distance": success_distance(folder),
        "provenance": provenance(),
    }


def _write_csv(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    rows = list(rows)
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with atomic_write(path, "w") as stream:
        writer = csv.DictWriter(stream, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _trial_row(trial: Mapping[str, Any], space_units: Mapping[str, str]) -> dict[str, Any]:
    evaluation, qp = trial["evaluation"] or {}, trial["qp"]
    return {
        "trial": trial["number"],
        "state": trial["state"],
        "origin": trial["origin"],
        **{f"{name} [{space_units[name]}]": value for name, value in trial["design"].items()},
        "score": trial["score"],
        "success_rate": evaluation.get("success_rate"),
        "mean_distance [m]": evaluation.get("mean_distance"),
        "mean_return": evaluation.get("mean_return"),
        "qp_success_rate": qp.get("success_rate"),
        "qp_mean_distance [m]": qp.get("mean_distance"),
        "training_steps": trial["training_steps"],
        "seconds": round(trial["seconds"], 3),
        "cpu_seconds": round(trial["cpu_seconds"], 3),
        "sampler_seed": trial["sampler_seed"],
        "reason": trial["reason"],
    }


def write_results(folder: StudyFolder) -> dict[str, Any]:
    """Write ``results.json``, ``trials.csv`` and ``finalists.csv``; return what is in the first."""
    results = collect(folder)
    write_json(folder.path / "results.json", results)
    units = {variable["name"]: variable["unit"] for variable in results["variables"]}
    _write_csv(folder.path / "trials.csv", (_trial_row(trial, units) for trial in folder.results()))
    bodies = {body["trial"]: body for body in results["finalists"]}
    _write_csv(
        folder.path / "finalists.csv",
        (
            {
                "trial": record["trial"],
                "role": bodies[record["trial"]]["role"],
                **{f"{name} [{units[name]}]": value for name, value in bodies[record["trial"]]["design"].items()},
                "agent": record["agent"],
                "backend": record["backend"],
                "goals": record["goals"],
                "success_rate": record.get("success_rate"),
                "mean_distance [m]": record.get("mean_distance"),
                "worst_distance [m]": record.get("worst_distance"),
                "mean_return": record.get("mean_return"),
                "mean_effort": record.get("mean_effort"),
                "steps": record.get("steps"),
                "error": record.get("error"),
            }
            for record in results["evaluations"]
        ),
    )
    return results
