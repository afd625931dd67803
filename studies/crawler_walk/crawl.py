"""Which judge decides which crawler wins? The bodies of two finished searches under one gait and under their own.

    softgym codesign --config crawler_walk --folder NESTED
    softgym codesign --config studies/crawler_walk/common_gait.yaml --folder COMMON
    python studies/crawler_walk/crawl.py FOLDER NESTED COMMON

Judges of the bodies of NESTED: the common gait, the gait of the baseline, and gaits of their own. The winner of COMMON
gets three gaits of its own. Everything is kept in the folder; a second call resumes.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import kendalltau

from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.agents.evaluation import evaluate
from softgym_envs.agents.training import train
from softgym_envs.codesign import load_study
from softgym_envs.runs import provenance
from softgym_envs.storage import read_json, write_json

ID = "SoftGym/CrawlerWalk-v0"
GOAL = np.array([[0.0108, 0.0, 0.0]])
GRADIENTS, PERIOD = 20, 25
OTHERS = ({"elements": 4}, {"friction": 0.4}, {"friction": 1.2})
"""A finer mesh, and other grounds."""


def environment(design: dict[str, float], **robot_options: Any) -> EnvironmentConfig:
    return EnvironmentConfig(id=ID, design=design, robot_options=robot_options)


def speed(agent: str | Path, design: dict[str, float], **robot_options: Any) -> dict[str, float]:
    """Tallies of an episode [mm/s, mW], and the largest pressure [kPa]."""
    found = evaluate(agent, environment(design, **robot_options), GOAL)
    tallies = {name: 1e3 * float(values[0]) for name, values in found.tallies.items()}
    return tallies | {"pressure": 1e-3 * float(found.largest_efforts[0])}


def own(folder: Path, design: dict[str, float], seed: int = 0, period: int = PERIOD) -> dict[str, float]:
    """Speed with a gait along gradients, and its CPU time [s]."""
    steps = 3 * period * GRADIENTS
    config = TrainConfig(
        environment=environment(design), learner="gait", steps=steps, report_every=steps,
        evaluation_episodes=1, num_envs=1, seed=seed, gait={"period": period},
    )  # fmt: skip
    path = train(config, folder, progress=False)
    return {"cpu": float(read_json(path.with_suffix(".json"))["cpu_seconds"]), **speed(path, design)}


def main() -> None:
    parser = argparse.ArgumentParser()
    for name in ("folder", "nested", "common"):
        parser.add_argument(name, type=Path)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    place = given.folder / "results.json"
    data: dict[str, Any] = read_json(place) if place.exists() else {"provenance": provenance(), "rows": {}}

    def once(name: str, compute: Any) -> Any:
        if name not in data["rows"]:
            data["rows"][name] = compute()
            write_json(place, data)
            print(name, data["rows"][name], flush=True)
        return data["rows"][name]

    trials = load_study(given.nested).trials
    designs = [{name: float(value) for name, value in trial.design.items()} for trial in trials]
    allowed = [trial.number for trial in trials if trial.feasible]
    best = max(allowed, key=lambda number: trials[number].score)
    found = max((trial for trial in load_study(given.common).trials if trial.feasible), key=lambda trial: trial.score)
    design = {name: float(value) for name, value in found.design.items()}
    data |= {"designs": designs, "winner": best, "allowed": allowed, "common_design": design}
    gaits = [given.nested / trial.controller for trial in trials]
    for number in (0, best):
        for options in OTHERS:
            label = "_".join(f"{name}_{value}" for name, value in options.items())
            once(f"{number}_{label}", lambda n=number, o=options: speed(gaits[n], designs[n], **o))
    once("common_gait_of_winner", lambda: speed("gait", designs[best]))
    once("common_gait_of_common", lambda: speed("gait", design))
    for number, body in enumerate(designs):
        once(f"{number}_baseline_gait", lambda body=body: speed(gaits[0], body))
    judges = {
        "own": [1e3 * trial.score for trial in trials],
        "common": [1e3 * trial.qp_value for trial in trials],
        "baseline": [data["rows"][f"{number}_baseline_gait"]["speed"] for number in range(len(trials))],
    }
    data["judges"] = judges
    data["tau"] = {judge: list(kendalltau(judges[judge], judges["own"])) for judge in ("common", "baseline")}
    write_json(place, data)
    for seed in range(3):
        once(f"common_seed_{seed}", lambda seed=seed: own(given.folder / f"common_{seed}", design, seed))
    once("baseline_period_50", lambda: own(given.folder / "period_50", designs[0], period=50))


if __name__ == "__main__":
    main()
