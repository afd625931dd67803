"""Which judge decides which crawler wins? Bodies of the crawler under one gait and under gaits of their own.

    python studies/crawler_walk/crawl.py FOLDER NESTED COMMON

NESTED and COMMON are the folders of the finished studies `crawler_walk` and `common_gait.yaml`. Bodies: seven that spread
over the design box, and the baseline, the winner of NESTED and that of COMMON. Judges: the common gait; the gait of the
baseline; a gait along gradients from the common one. Everything is kept in the folder; a second call resumes.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import kendalltau, qmc

from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.agents.evaluation import evaluate
from softgym_envs.agents.training import train
from softgym_envs.codesign import load_study
from softgym_envs.robots.registry import make_robot
from softgym_envs.runs import provenance
from softgym_envs.storage import read_json, write_json

ID = "SoftGym/CrawlerWalk-v0"
GOAL = np.array([[0.0108, 0.0, 0.0]])
BODIES, GRADIENTS, PERIOD = 7, 20, 25
OTHERS = ({"elements": 4}, {"friction": 0.4}, {"friction": 1.2})
"""A finer mesh, and other grounds."""
PERIODS = (15, 50)
"""Control steps of slower and faster gaits of the baseline."""


def environment(design: dict[str, float], **robot_options: Any) -> EnvironmentConfig:
    return EnvironmentConfig(id=ID, design=design, robot_options=robot_options)


def speed(agent: str | Path, design: dict[str, float], **robot_options: Any) -> dict[str, float]:
    """Tallies of an episode [mm/s, mW], and the largest pressure [kPa]."""
    found = evaluate(agent, environment(design, **robot_options), GOAL)
    tallies = {name: 1e3 * float(values[0]) for name, values in found.tallies.items()}
    return tallies | {"pressure": 1e-3 * float(found.largest_efforts[0])}


def gait(
    folder: Path, design: dict[str, float], seed: int = 0, period: int = PERIOD, **robot_options: Any
) -> tuple[Path, float]:
    """Policy of a gait along gradients, and its CPU time [s]."""
    steps = 3 * period * GRADIENTS
    config = TrainConfig(
        environment=environment(design, **robot_options), learner="gait", steps=steps, report_every=steps,
        evaluation_episodes=1, num_envs=1, seed=seed, gait={"period": period},
    )  # fmt: skip
    path = train(config, folder, progress=False)
    return path, float(read_json(path.with_suffix(".json"))["cpu_seconds"])


def winner(folder: Path) -> dict[str, float]:
    """Design of the fastest body of a study that keeps to the limit of pressure."""
    allowed = [trial for trial in load_study(folder).trials if trial.score is not None and trial.feasible]
    best = max(allowed, key=lambda trial: trial.score)
    return {name: float(value) for name, value in best.design.items()}


def main() -> None:
    parser = argparse.ArgumentParser()
    for name in ("folder", "nested", "common"):
        parser.add_argument(name, type=Path)
    given = parser.parse_args()
    folder = given.folder
    folder.mkdir(parents=True, exist_ok=True)
    place = folder / "results.json"
    data: dict[str, Any] = read_json(place) if place.exists() else {"provenance": provenance(), "rows": {}}

    def once(name: str, compute: Any) -> Any:
        if name not in data["rows"]:
            data["rows"][name] = compute()
            write_json(place, data)
            print(name, data["rows"][name], flush=True)
        return data["rows"][name]

    def own(name: str, design: dict[str, float], seed: int = 0, period: int = PERIOD, **options: Any) -> Any:
        def compute() -> dict[str, float]:
            path, cpu = gait(folder / name, design, seed, period, **options)
            return {"cpu": cpu, **speed(path, design, **options)}

        return once(name, compute)

    space = make_robot("crawler").design_space
    units = 2.0 * qmc.Sobol(len(space), seed=0).random(8)[:BODIES] - 1.0
    found = {"baseline": dict(space.baseline), "nested": winner(given.nested), "common": winner(given.common)}
    designs = found | {f"body_{k}": dict(space.from_unit(unit)) for k, unit in enumerate(units)}
    data["designs"] = designs
    for name, design in designs.items():
        once(f"{name}_common_gait", lambda design=design: speed("gait", design))
        own(f"{name}_seed_0", design)
    baseline = folder / "baseline_seed_0" / "policy.safetensors"
    for name, design in designs.items():
        once(f"{name}_baseline_gait", lambda design=design: speed(baseline, design))
    judges = {
        judge: [data["rows"][f"{name}_{judge}"]["speed"] for name in designs]
        for judge in ("common_gait", "baseline_gait", "seed_0")
    }
    data["tau"] = {
        judge: list(kendalltau(judges[judge], judges["seed_0"])) for judge in ("common_gait", "baseline_gait")
    }
    for name in found:
        own(f"{name}_seed_1", designs[name], 1)
        own(f"{name}_seed_2", designs[name], 2)
    for name in ("baseline", "nested"):
        # The same gait on a finer mesh; new ones there and on other grounds.
        path = folder / f"{name}_seed_0" / "policy.safetensors"
        once(f"{name}_gait_on_4", lambda name=name, path=path: speed(path, designs[name], elements=4))
        for options in OTHERS:
            own("_".join([name, *(f"{k}_{v}" for k, v in options.items())]), designs[name], **options)
    for period in PERIODS:
        own(f"baseline_period_{period}", designs["baseline"], period=period)
    write_json(place, data)


if __name__ == "__main__":
    main()
