"""Which learner judges decides which whip wins? The bodies of a study under common throws and under their own.

    softgym codesign --config whip_throw --folder results/whip_throw
    python studies/whip_throw/judges.py results/whip_throw results/whip_judges

Judges of the bodies of the study: the common throw; the throw of the baseline; a throw of its own along gradients, as in
the study; for some of them, a throw by CMA-ES of six numbers (swings, their phase and growth, strokes of both segments, a
shift) with 80 motions. Then the best body under the common throw gets three throws of its own, and the throws of the
study of baseline and winner are repeated with time steps of 1 ms. Ranges are means of six episodes with payloads of 15 to
25 g. Everything is kept in the folder; a second call resumes.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from cmaes import CMA
from scipy.stats import kendalltau

from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.agents.evaluation import evaluate
from softgym_envs.agents.training import train
from softgym_envs.codesign import load_study
from softgym_envs.runs import provenance
from softgym_envs.storage import read_json, write_json

ID = "SoftGym/WhipThrow-v0"
GOALS = np.tile([0.5, 0.0, -0.6], (6, 1))
EVOLVED, STEPS, ROLLOUTS, THROW = 5, 1800, 80, 30
GAIT = {"period": THROW, "periods": 1, "learning_rate": 0.2, "excess": 5.0}
SHORTER: dict[str, Any] = {"backend_options": {"time_step": 0.001}}


def environment(design: dict[str, float], **options: Any) -> EnvironmentConfig:
    return EnvironmentConfig(id=ID, design=design, **options)


def reach(agent: str | Path, design: dict[str, float], **options: Any) -> float:
    """Mean range of six throws [m]."""
    return float(evaluate(agent, environment(design, **options), GOALS).tallies["range"].mean())


def gait(folder: Path, design: dict[str, float], seed: int = 0, **options: Any) -> tuple[Path, float]:
    """Policy of a throw along gradients, and its CPU time [s]."""
    config = TrainConfig(
        environment=environment(design, **options), learner="gait", steps=STEPS, report_every=STEPS,
        evaluation_episodes=1, num_envs=1, seed=seed, gait=GAIT,
    )  # fmt: skip
    path = train(config, folder, progress=False)
    return path, float(read_json(path.with_suffix(".json"))["cpu_seconds"])


def swings(numbers: np.ndarray) -> np.ndarray:
    """Commands (30, 4) of a throw of six numbers, each about 1 in size."""
    rhythm, phase, growth, first, second, shift = numbers
    time_left = np.arange(THROW, dtype=float)[::-1] / THROW
    angle = 2.0 * np.pi * 2.0 * np.exp(0.3 * rhythm) * time_left + phase
    size = 3e-8 * np.exp(growth * (0.5 - time_left)) * (1.0 - time_left**8)
    strokes = [np.exp(0.7 * first) * np.sin(angle), np.exp(0.7 * second) * np.sin(angle + shift)]
    return np.concatenate([np.stack([-size * stroke, size * stroke], axis=1) for stroke in strokes], axis=1)


def thrown(env: Any, numbers: np.ndarray, seed: int) -> float:
    """Range of a throw of six numbers [m]; the seed draws the payload."""
    env.reset(seed=seed)
    for command in swings(numbers):
        *_, info = env.step(env.spaces.action(command, env.command))
    return float(info["range"])


def mean_range(numbers: np.ndarray, design: dict[str, float], first: int = 100, **options: Any) -> float:
    """Mean range of six throws of six numbers [m], with payloads of the seeds from ``first`` on."""
    env: Any = environment(design, **options).make().unwrapped
    found = float(np.mean([thrown(env, numbers, first + seed) for seed in range(len(GOALS))]))
    env.close()
    return found


def evolve(design: dict[str, float], seed: int = 0) -> tuple[np.ndarray, float]:
    """Six numbers of the best throw that CMA-ES finds, and its CPU time [s]."""
    env: Any = environment(design).make().unwrapped
    search = CMA(mean=np.zeros(6), sigma=0.5, population_size=8, seed=seed)
    best, cpu = -np.inf, time.process_time()
    for generation in range(ROLLOUTS // search.population_size):
        scored = []
        for _ in range(search.population_size):
            numbers = search.ask()
            scored.append((numbers, -thrown(env, numbers, generation)))
        search.tell(scored)
        numbers, value = min(scored, key=lambda pair: pair[1])
        if -value > best:
            best, kept = -value, numbers
    env.close()
    return kept, time.process_time() - cpu


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("study", type=Path)
    parser.add_argument("folder", type=Path)
    arguments = parser.parse_args()
    folder: Path = arguments.folder
    folder.mkdir(parents=True, exist_ok=True)
    place = folder / "judges.json"
    data: dict[str, Any] = read_json(place) if place.exists() else {"provenance": provenance()}
    trials = [trial for trial in load_study(arguments.study).trials if trial.state == "complete"]
    (baseline,) = (trial for trial in trials if trial.origin == "baseline")
    of_baseline = arguments.study / baseline.controller
    if "bodies" not in data:
        data["bodies"] = [
            {
                "number": trial.number,
                "design": trial.design,
                "common": trial.qp_value,
                "gradients": trial.score,
                "cpu": trial.cpu_seconds,
                "baseline_throw": reach(of_baseline, trial.design),
            }
            for trial in trials
        ]
        write_json(place, data)
    rows = data["bodies"]
    own = [row["gradients"] for row in rows]
    winners = {name: int(np.argmax([row[name] for row in rows])) for name in ("common", "baseline_throw", "gradients")}
    data["tau"] = {name: float(kendalltau([row[name] for row in rows], own)[0]) for name in winners}
    data["winners"] = {name: rows[k]["number"] for name, k in winners.items()}
    first = next(k for k, row in enumerate(rows) if row["number"] == baseline.number)
    best = rows[winners["common"]]
    if "body_first" not in data:
        paths = [gait(folder / f"body_first_{seed}", best["design"], seed)[0] for seed in range(3)]
        data["body_first"] = {"number": best["number"], "gradients": [reach(path, best["design"]) for path in paths]}
        write_json(place, data)
    if "shorter" not in data:
        data["shorter"] = {}
        for k in (first, winners["gradients"]):
            path = arguments.study / trials[k].controller
            data["shorter"][rows[k]["number"]] = {
                "2 ms": reach(path, rows[k]["design"]), "1 ms": reach(path, rows[k]["design"], **SHORTER)
            }  # fmt: skip
        write_json(place, data)
    chosen = list(dict.fromkeys([first, *winners.values(), *range(len(rows))]))[:EVOLVED]
    for k in chosen:
        if "evolution" not in rows[k]:
            numbers, rows[k]["evolution_cpu"] = evolve(rows[k]["design"])
            rows[k]["evolution"] = mean_range(numbers, rows[k]["design"])
            write_json(place, data)
            print("CMA-ES", rows[k]["number"], rows[k]["evolution"], rows[k]["evolution_cpu"], flush=True)
    data["tau"]["evolution"] = float(
        kendalltau([rows[k]["evolution"] for k in chosen], [rows[k]["gradients"] for k in chosen])[0]
    )
    write_json(place, data)


if __name__ == "__main__":
    main()
