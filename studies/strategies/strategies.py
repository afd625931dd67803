"""Co-design strategies compared on one question: regret by environment steps and CPU time, three repeats each.

    python -m benchmarks.strategies results/strategies 2
    python -m benchmarks.strategies results/strategies 2 "inverse QP" critic    # only these

First the ground truth: 64 bodies of the Soft Finger (4 x 4 x 4 over length, height, joint height), each with a policy
trained until it stops improving, in the work zone of ``configs/codesign/finger_reach.yaml``. Then every strategy,
three times with other seeds. Everything is kept in the folder, and a second call resumes the first. The numbers that
this repository keeps are in ``benchmarks/data/strategies.json``; ``softgym bench strategies`` shows them.

The score of a body between those of the grid is that of the inverse QP, which is cheap, plus the interpolated gap
between it and the trained policies (thin plate spline). Regret is the remaining part of the way from the baseline body
to the best one: 100 % at the baseline, 0 % at the best.
"""

from __future__ import annotations

import argparse
import itertools
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.config import load_config, provenance
from softgym_envs.errors import DataError
from softgym_envs.storage import write_json

KEPT = Path(__file__).parent / "data" / "strategies.json"
QUESTION = Path(__file__).parent.parent / "configs" / "codesign" / "finger_reach.yaml"
VARIABLES = ("length", "height", "joint_height")
LEVELS = (-0.9, -0.3, 0.3, 0.9)
"""Grid of each variable, in unit coordinates."""
TRUTH_STEPS = 8_000
GOALS = 40
"""Number of goals of the true score of a body; strategies may use fewer."""
REPEATS = 3
PRETRAINING = 80_000 + 10 * 200 * 50
"""Environment steps behind the policy ``finger_reach_designs``: training, and the points of its learning curve."""

SAC = {
    "learner": "sac",
    "steps": 2_560,
    "report_every": 640,
    "evaluation_episodes": 32,
    "num_envs": 16,
    "sac": {"learning_starts": 0},
}
"""Training in a trial unless a strategy says otherwise, and of the ground truth."""
ANALYTIC = {"learner": "analytic", "num_envs": 128, "steps": 51_200, "report_every": 25_600}

PLAIN = {
    "policy": None,
    "screen": {"enabled": False},
    "pruner": {"name": "none"},
    "finalists": {"count": 0},
    "workers": 1,
}
STRATEGIES: dict[str, dict[str, Any]] = {
    "plain nesting": {
        "strategy": "scratch",
        "trials": 12,
        "training": {"steps": 12_000, "report_every": 12_000, "num_envs": 16},
    },
    "plain nesting, Hyperband": {
        "strategy": "scratch",
        "trials": 12,
        "training": {"steps": 12_000, "report_every": 1_500, "num_envs": 16},
        "pruner": {"name": "hyperband"},
    },
    "plain nesting, Gaussian process": {
        "strategy": "scratch",
        "trials": 12,
        "training": {"steps": 12_000, "report_every": 12_000, "num_envs": 16},
        "sampler": {"name": "gp"},
    },
    "plain nesting, analytic gradient, Gaussian process, 12 goals": {
        "strategy": "scratch",
        "trials": 24,
        "training": ANALYTIC,
        "sampler": {"name": "gp"},
        "goals": {"count": 12},
    },
    "warm start, analytic gradient, Gaussian process, 12 goals (default)": {
        "strategy": "warm_start",
        "policy": "finger_reach_designs",
        "trials": 24,
        "training": {**ANALYTIC, "steps": 25_600, "report_every": 12_800, "analytic": {"learning_rate": 1e-3}},
        "sampler": {"name": "gp"},
        "goals": {"count": 12},
    },
    "warm start": {"strategy": "warm_start", "policy": "finger_reach_designs", "trials": 12},
    "warm start, screen": {
        "strategy": "warm_start",
        "policy": "finger_reach_designs",
        "trials": 12,
        "screen": {"enabled": True, "candidates": 40, "keep": 0.1, "goals": 10},
        "pruner": {"name": "percentile", "options": {"percentile": 60.0, "n_startup_trials": 5}},
    },
    "inverse QP": {"strategy": "qp", "trials": 30},
    "inverse QP, Wilcoxon": {"strategy": "qp", "trials": 30, "pruner": {"name": "wilcoxon"}},
    "inverse QP, Gaussian process": {"strategy": "qp", "trials": 30, "sampler": {"name": "gp"}},
    "inverse QP, Gaussian process, 12 goals": {
        "strategy": "qp",
        "trials": 30,
        "sampler": {"name": "gp"},
        "goals": {"count": 12},
    },
    "shared policy": {"strategy": "policy", "policy": "finger_reach_designs", "trials": 30},
    "shared policy, Gaussian process": {
        "strategy": "policy",
        "policy": "finger_reach_designs",
        "trials": 30,
        "sampler": {"name": "gp"},
    },
    "shared policy, Gaussian process, 12 goals": {
        "strategy": "policy",
        "policy": "finger_reach_designs",
        "trials": 30,
        "sampler": {"name": "gp"},
        "goals": {"count": 12},
    },
    "shared policy, Wilcoxon": {
        "strategy": "policy",
        "policy": "finger_reach_designs",
        "trials": 30,
        "pruner": {"name": "wilcoxon"},
    },
    "critic": {"strategy": "critic", "trials": 12, "joint": {"steps": 60_000, "report_every": 6_000}},
    "distribution": {"strategy": "distribution", "trials": 12, "joint": {"steps": 60_000, "report_every": 6_000}},
}


def _question(**changes: Any) -> Any:
    """Return the study of the question with some values replaced."""
    from softgym_envs.codesign.config import StudyConfig

    base = load_config(QUESTION, StudyConfig).model_dump(mode="json")
    base["goals"]["count"], base["training"] = GOALS, SAC
    # The ground truth is that of the published mesh, whose finite elements are not asked.
    base["environment"]["robot_options"], base["finalists"] = {}, {"count": 0}
    return StudyConfig.model_validate({**base, **changes})


def _study(name: str, repeat: int) -> Any:
    given = {**PLAIN, **STRATEGIES[name]}
    base = _question().model_dump(mode="json")
    for part in ("training", "joint"):
        given[part] = {**base[part], "seed": repeat, **given.get(part, {})}
    given["goals"] = {**base["goals"], **given.get("goals", {})}
    if given["strategy"] == "scratch":
        given["training"] = {**given["training"], "sac": {**given["training"]["sac"], "learning_starts": 1_000}}
    given["sampler"] = {"name": "tpe", "seed": repeat, "options": {"n_startup_trials": 6}, **given.get("sampler", {})}
    if not given["screen"]["enabled"]:
        given["screen"] = {"enabled": False}
    return _question(name=f"repeat{repeat}", **given)


def _truth(path: Path, values: tuple[float, ...], folder: Path) -> Path:
    """Score of one body of the grid: train from the shared policy, and evaluate."""
    import torch

    from softgym_envs.agents.evaluation import evaluate
    from softgym_envs.agents.training import train
    from softgym_envs.codesign.folder import StudyFolder
    from softgym_envs.codesign.phases.trial import training_config

    torch.set_num_threads(1)
    study = StudyFolder.create(folder / "question", _question(**PLAIN, strategy="qp", trials=1))
    config, space = study.config, study.config.space
    design = config.baseline | {n: float(space[n].from_unit(v)) for n, v in zip(VARIABLES, values, strict=True)}
    training = training_config(study, design, {}).model_copy(
        update={"steps": TRUTH_STEPS, "report_every": 1_000, "evaluation_episodes": 40}
    )
    run = path.with_suffix("")
    policy = train(training, run, initial="finger_reach_designs", progress=False)
    goals = study.goals["selection"]
    curve = json.loads(policy.with_suffix(".json").read_text())["curve"]
    write_json(
        path,
        {
            "unit": list(values),
            "design": design,
            "sac": evaluate(policy, config.environment, goals, design=design).to_json(),
            "qp": evaluate("qp", config.environment, goals, design=design).to_json(),
            "curve": [[row["step"], row["mean_distance"]] for row in curve],
        },
    )
    return path


def _run_study(path: Path, name: str, repeat: int) -> Path:
    from softgym_envs.codesign.folder import StudyFolder
    from softgym_envs.codesign.study import run_study

    cost = run_study(_study(name, repeat), path.parent, progress=False).cost
    folder = StudyFolder(path.parent)
    before = cost.joint_steps + cost.joint_report_steps + cost.screen_steps
    cpu = cost.cpu_seconds["shared_policy"] + cost.cpu_seconds["screen"]
    rows = []
    for trial in sorted(folder.results(), key=lambda trial: trial.finished_at):
        scored = trial.evaluation.steps if trial.evaluation is not None else 0
        others = [trial.qp, trial.judge] if trial.controller != "qp" else []
        unneeded = sum(evaluation.cpu_seconds for evaluation in others if evaluation is not None)
        reports = len(trial.curve) * folder.config.training.evaluation_episodes * 50
        rows.append(
            {
                "design": trial.design,
                "score": trial.score,
                # Trials are also scored by the inverse QP and by the policy that trainings start from; strategies do
                # not need these scores, so their steps do not count.
                "steps": trial.training_steps + reports + scored,
                "cpu_seconds": trial.cpu_seconds - unneeded,
            }
        )
    pretraining = PRETRAINING if folder.config.policy else 0
    found = {"name": name, "repeat": repeat, "pretraining": pretraining, "steps": before, "cpu_seconds": cpu}
    write_json(path, {**found, "trials": rows})
    return path


def _call(function: Callable[..., Path], arguments: tuple) -> Path:
    return function(*arguments)


def main(folder: Path, workers: int = 1, names: Sequence[str] = ()) -> None:
    """Compute what is missing, and merge everything into ``benchmarks/data/strategies.json``, even if interrupted.

    Args:
        folder: folder of the studies.
        workers: number of processes.
        names: of strategies; default all of them and the ground truth.
    """
    from softgym_envs.executors import parallel_map

    folder = folder.resolve()
    jobs: list[tuple[Any, tuple]] = []
    for values in itertools.product(LEVELS, repeat=len(VARIABLES)) if not names else ():
        name = "_".join(f"{value:+.1f}" for value in values)
        jobs.append((_truth, (folder / "truth" / f"{name}.json", values, folder)))
    for repeat in range(REPEATS):
        for name in names or STRATEGIES:
            place = folder / re.sub(r"\W+", "_", name) / str(repeat)
            jobs.append((_run_study, (place / "regret.json", name, repeat)))
    missing = [job for job in jobs if not job[1][0].exists()]
    try:
        for done, path in enumerate(parallel_map(_call, missing, workers), 1):
            print(f"[{done}/{len(missing)}] {path.relative_to(folder)}", flush=True)
    finally:
        collect(folder)


def collect(folder: Path) -> None:
    """Merge the finished runs into ``benchmarks/data/strategies.json``."""
    kept = _kept()
    points = [_short(json.loads(path.read_text())) for path in sorted((folder / "truth").glob("*.json"))]
    truth = {tuple(point["unit"]): point for point in (*kept["truth"], *_rounded(points))}
    found = [json.loads(path.read_text()) for path in sorted(folder.glob("*/*/regret.json"))]
    runs = {(run["name"], run["repeat"]): run for run in (*kept["runs"], *found)}
    merged = {**provenance(), "truth": list(truth.values()), "runs": [runs[key] for key in sorted(runs)]}
    if len(truth) == len(LEVELS) ** len(VARIABLES):
        merged |= _judge(merged["truth"], merged["runs"], kept)
    write_json(KEPT, _rounded(merged))


def _kept() -> dict[str, Any]:
    return json.loads(KEPT.read_text()) if KEPT.exists() else {"truth": [], "runs": []}


def _rounded(value: Any) -> Any:
    """Return plain data rounded to seven digits, to keep the file small."""
    if isinstance(value, float):
        return float(f"{value:.7g}")
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return {key: _rounded(item) for key, item in value.items()} if isinstance(value, dict) else value


def _short(point: dict[str, Any]) -> dict[str, Any]:
    return {
        "unit": point["unit"],
        "sac": point["sac"]["mean_distance"],
        "qp": point["qp"]["mean_distance"],
        "curve": point["curve"],
    }


def _judge(truth: list[dict[str, Any]], runs: list[dict[str, Any]], kept: dict[str, Any]) -> dict[str, Any]:
    """Add the true score and the regret to every trial of every run."""
    from scipy.interpolate import RBFInterpolator
    from scipy.optimize import minimize

    from softgym_envs.agents.evaluation import evaluate
    from softgym_envs.errors import ConvergenceError, InfeasibleDesign

    config = _question()
    space = config.space
    from softgym_envs.codesign.goals import draw_goals

    goals = np.array(draw_goals(config)["selection"])
    x = np.array([point["unit"] for point in truth])
    lack = np.array([point["sac"] - point["qp"] for point in truth])
    residual = RBFInterpolator(x, lack)
    left_out = [
        lack[i] - RBFInterpolator(np.delete(x, i, 0), np.delete(lack, i))(x[i : i + 1])[0] for i in range(len(x))
    ]

    def score(unit: np.ndarray) -> float:
        design = config.baseline | {n: float(space[n].from_unit(v)) for n, v in zip(VARIABLES, unit, strict=True)}
        try:
            qp = evaluate("qp", config.environment, goals, design=design)
        except (InfeasibleDesign, ConvergenceError):
            return float("inf")
        return qp.mean_distance + float(residual(unit[None])[0])

    def unit_of(design: dict[str, float]) -> np.ndarray:
        return np.array([float(space[name].to_unit(design[name])) for name in VARIABLES])

    same = kept["truth"] == truth
    if same and "best" in kept:
        best_body, candidates = kept["best_body"], [kept["best"]]
    else:
        start = x[int(np.argmin([point["sac"] for point in truth]))]
        simplex = start + 0.2 * np.vstack([np.zeros(3), -np.sign(start) * np.eye(3)])
        found = minimize(
            lambda unit: score(np.clip(unit, -1.0, 1.0)),
            start,
            method="Nelder-Mead",
            options={"maxfev": 120, "initial_simplex": simplex},
        )
        best_body, candidates = found.x.tolist(), [float(found.fun)]

    def key_of(design: dict[str, float]) -> tuple[float, ...]:
        return tuple(np.round(unit_of(design), 5).tolist())

    # While the ground truth does not change, kept scores are valid.
    known = (
        {key_of(t["design"]): t["true_score"] for run in kept["runs"] for t in run["trials"] if "true_score" in t}
        if same
        else {}
    )
    for run in runs:
        for trial in run["trials"]:
            key = key_of(trial["design"])
            if key not in known:
                known[key] = score(np.array(key))
            trial["true_score"] = known[key]
            candidates.append(known[key])
    best, baseline = min(candidates), score(unit_of(config.baseline))
    for run in runs:
        steps, cpu, incumbent = run["steps"], run["cpu_seconds"], None
        curve = []
        for trial in run["trials"]:
            steps, cpu = steps + trial["steps"], cpu + trial["cpu_seconds"]
            if trial["score"] is not None and (incumbent is None or trial["score"] > incumbent["score"]):
                incumbent = trial
            if incumbent is not None:
                regret = (incumbent["true_score"] - best) / (baseline - best)
                curve.append([steps, round(cpu, 1), regret])
        run["regret"] = curve
    return {
        "best": best,
        "baseline": baseline,
        "best_body": best_body,
        "interpolation_error": float(np.median(np.abs(left_out))),
        "converged_within": float(
            np.median([abs(p["curve"][-1][1] - min(v for _, v in p["curve"][:-1])) for p in truth])
        ),
    }


def _cost_to(curve: list[list[float]], limit: float, column: int = 0) -> float:
    """Return the environment steps (column 0) or CPU seconds (1) after which the regret stays below a limit.

    A noisy score may raise the regret again.
    """
    reached = float("inf")
    for point in reversed(curve):
        if point[2] > limit:
            break
        reached = point[column]
    return reached


def strategies() -> dict[str, object]:
    """Regret of the co-design strategies by environment steps: median of the repeats (smallest to largest)."""
    kept = _kept()
    if unknown := sorted({run["name"] for run in kept["runs"]} - STRATEGIES.keys()):
        raise DataError(f"'{KEPT.name}' has runs of unknown strategies: {', '.join(unknown)}")
    result: dict[str, object] = {
        "bodies of the ground truth": len(kept["truth"]),
        "baseline, true score [mm]": 1e3 * kept["baseline"],
        "best body, true score [mm]": 1e3 * kept["best"],
        "interpolation of the ground truth, median error left out [mm]": 1e3 * kept["interpolation_error"],
    }
    for name in STRATEGIES:
        runs = [run for run in kept["runs"] if run["name"] == name]
        if not runs:
            continue
        last = sorted(run["regret"][-1] for run in runs)

        def spread(values: list[float], form: str) -> str:
            values = sorted(values)
            if len(values) == 1:
                return f"{values[0]:{form}} (one repeat)"
            return f"{np.median(values):{form}} ({values[0]:{form}} to {values[-1]:{form}})"

        result[f"{name}: regret at the end [%]"] = spread([100 * row[2] for row in last], ".2f")
        result[f"{name}: environment steps"] = spread([row[0] for row in last], ",.0f")
        result[f"{name}: steps behind the policy it is given"] = runs[0]["pretraining"]
        result[f"{name}: CPU minutes"] = spread([row[1] / 60 for row in last], ".1f")
        for limit in (0.1, 0.01):
            result[f"{name}: environment steps to {limit:.0%} regret"] = spread(
                [_cost_to(run["regret"], limit) for run in runs], ",.0f"
            )
        result[f"{name}: CPU seconds to 1% regret"] = spread([_cost_to(run["regret"], 0.01, 1) for run in runs], ".0f")
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("results/strategies"))
    parser.add_argument("workers", type=int, nargs="?", default=1, help="number of processes")
    parser.add_argument("names", nargs="*", help="of strategies (default: all, and the ground truth)")
    main(**vars(parser.parse_args()))
