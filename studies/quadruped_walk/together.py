"""What does it gain to search body and gait together? Three searches over walkers, and what their winners are worth.

    python studies/quadruped_walk/together.py results/together

* nested: the winner of `softgym codesign --config quadruped_walk` (codesign.json beside this file), whose trials each
  searched a gait of their own;
* fixed: as many bodies by the same sampler, all driven by the best gait of the baseline;
* joint: body and gait together down one gradient, from the baseline and the common gait.

Each winner and the baseline then get three gaits of their own. Speeds are those of the second half of 5 s. Everything
is kept in the folder; a second call resumes.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from walk import gait, speed

from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.agents.learners.gait import GaitLearner
from softgym_envs.robots.neighbours import neighbours_of
from softgym_envs.robots.registry import make_robot
from softgym_envs.runs import provenance
from softgym_envs.storage import read_json, write_json

TRIALS, STARTUP, SEEDS, GRADIENTS = 24, 10, 3, 60
OTHERS = ({"friction": 0.4}, {"friction": 1.2}, {"elements": 8})
"""Other grounds, and a finer mesh."""
Body = dict[str, float]


def search_under(policy: Path, number: int) -> tuple[Body, list[float], float]:
    """Return the fastest of TPE's bodies under one gait, the speeds of all [mm/s], and the CPU time [s]."""
    space, cpu = make_robot("quadruped").design_space, time.process_time()
    study = optuna.create_study(
        direction="maximize", sampler=optuna.samplers.TPESampler(seed=0, n_startup_trials=STARTUP)
    )

    def score(trial: optuna.Trial) -> float:
        unit = [trial.suggest_float(name, -1.0, 1.0) for name in space.names]
        return speed(policy, dict(space.from_unit(np.array(unit))))["speed"]

    study.optimize(score, n_trials=number)
    best = np.array([study.best_params[name] for name in space.names])
    return dict(space.from_unit(best)), [float(trial.value) for trial in study.trials], time.process_time() - cpu


def descend(steps: int) -> tuple[Body, list[float], float]:
    """Return the body at the end of one gradient for body and gait, the ways of its motions [mm], and the CPU time [s].

    Adam, as in the search for gaits, on half ranges of commands and of design variables alike.
    """
    robot, cpu = make_robot("quadruped"), time.process_time()
    learner = GaitLearner(
        TrainConfig(
            environment=EnvironmentConfig(id="SoftGym/QuadrupedWalk-v0"), learner="gait", num_envs=1, steps=steps
        )
    )
    space, unit, ways = robot.design_space, robot.design_space.to_unit(robot.design_space.baseline), []
    mean, square = (np.zeros(learner.gait.size + len(unit)) for _ in range(2))
    for k in range(steps):
        design = dict(space.from_unit(unit))
        learner.backend.reset(design)
        found = learner.climb(neighbours_of(robot, design))
        ways.append(1e3 * found.way)
        ends = [
            np.array([space[n].from_unit(u + e) for n, u in zip(space.names, unit, strict=True)]) for e in (1e-6, -1e-6)
        ]
        inside = np.abs(unit) < 1.0 - 1e-6
        by_unit = np.where(inside, found.by_design * (ends[0] - ends[1]) / 2e-6, 0.0)
        # At a limit of the box only derivatives that lead inside count.
        edge = found.by_design * (ends[0] - ends[1]) / 1e-6
        by_unit = np.where(~inside & (edge * unit < 0.0), edge, by_unit)
        gradient = np.concatenate([found.by_gait.ravel(), by_unit])
        mean, square = 0.8 * mean + 0.2 * gradient, 0.95 * square + 0.05 * gradient**2
        rate = 0.1 + (0.02 - 0.1) * k / steps
        step = rate * mean / (1.0 - 0.8 ** (k + 1)) / (np.sqrt(square / (1.0 - 0.95 ** (k + 1))) + 1e-15)
        size = learner.gait.size
        learner.gait = np.clip(learner.gait + step[:size].reshape(learner.gait.shape), -1.0, 1.0)
        unit = np.clip(unit + step[size:], -1.0, 1.0)
        print("joint", k, ways[-1], np.round(unit, 2).tolist(), flush=True)
    learner.close()
    return dict(space.from_unit(unit)), ways, time.process_time() - cpu


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    place = folder / "together.json"
    nested = read_json(Path(__file__).parent / "codesign.json")
    data: dict[str, Any] = {"provenance": provenance(), "bodies": {}, "gaits": [], "searches": {}}
    data = read_json(place) if place.exists() else data
    data["bodies"] |= {"baseline": nested["baseline"]["design"], "nested": nested["winner"]["design"]}

    def own(name: str) -> Path:
        """Search the gaits of a body; return the fastest."""
        for seed in range(SEEDS):
            if not any(g["body"] == name and g["seed"] == seed for g in data["gaits"]):
                policy, cpu = gait(folder / f"{name}_{seed}", data["bodies"][name], seed)
                found = speed(policy, data["bodies"][name])
                data["gaits"].append({"body": name, "seed": seed, "cpu": cpu, **found})
                write_json(place, data)
                print(data["gaits"][-1], flush=True)
        best = max((g for g in data["gaits"] if g["body"] == name), key=lambda g: g["speed"])
        return folder / f"{name}_{best['seed']}" / "policy.safetensors"

    own("baseline")
    for name, search in (
        ("fixed", lambda: search_under(own("baseline"), TRIALS)),
        ("joint", lambda: descend(GRADIENTS)),
    ):
        if name not in data["searches"]:
            data["bodies"][name], course, cpu = search()
            data["searches"][name] = {"course": course, "cpu": cpu}
            write_json(place, data)
    policies = {name: own(name) for name in data["bodies"]}
    if "table" not in data:
        data["table"] = {
            whose: {name: speed(policy, body)["speed"] for name, body in data["bodies"].items()}
            for whose, policy in policies.items()
        }
        write_json(place, data)
    data.setdefault("others", [])
    for options in OTHERS:
        for name, body in data["bodies"].items():
            if not any(o["body"] == name and o["options"] == options for o in data["others"]):
                data["others"].append({"body": name, "options": options, **speed(policies[name], body, **options)})
                write_json(place, data)
    print(data["table"], data["others"])


if __name__ == "__main__":
    main()
