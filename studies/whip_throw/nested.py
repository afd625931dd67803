"""Body and throw by CMA-ES: does the search find a better whip when the stronger learner judges?

    python studies/whip_throw/nested.py results/whip_nested

Each search (TPE, 16 bodies, the baseline first) gives every body a throw of six numbers: the best of four by CMA-ES from
other seeds, as one alone is a matter of luck. Then baseline and winners get three such throws each, of other seeds, on
payloads that no search has seen, also on a finer mesh and with half the time step. Everything is kept in the folder; a
second call resumes.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from judges import SHORTER, evolve, mean_range

from softgym_envs import make_robot
from softgym_envs.runs import provenance
from softgym_envs.storage import read_json, write_json

BODIES, SEARCHES, THROWS, RESTARTS = 16, 2, 3, 4
FINER: dict[str, Any] = {"robot_options": {"elements": 4}}


def best_throw(design: dict[str, float], group: int) -> tuple[np.ndarray, list[float], float]:
    """Numbers of the best of some throws by CMA-ES, ranges of all [m], and the CPU time [s]."""
    throws = [evolve(design, seed=RESTARTS * group + k) for k in range(RESTARTS)]
    ranges = [mean_range(numbers, design) for numbers, _ in throws]
    return throws[int(np.argmax(ranges))][0], ranges, sum(cpu for _, cpu in throws)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    folder: Path = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    place = folder / "nested.json"
    data: dict[str, Any] = {"provenance": provenance(), "searches": {}, "throws": {}}
    if place.exists():
        data = read_json(place)
    space = make_robot("whip").design_space
    variables = [space[name] for name in ("length", "radius", "taper", "tail", "young_modulus")]
    boxes: dict[str, Any] = {v.name: optuna.distributions.FloatDistribution(v.low, v.high, log=v.log) for v in variables}
    baseline = {v.name: v.baseline for v in variables}
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    for seed in range(SEARCHES):
        rows = data["searches"].setdefault(str(seed), [])
        study = optuna.create_study(
            direction="maximize", sampler=optuna.samplers.TPESampler(seed=seed, n_startup_trials=8)
        )
        if not rows:
            study.enqueue_trial(baseline)
        for row in rows:
            study.add_trial(
                optuna.trial.create_trial(params=row["design"], distributions=boxes, value=row["range"])
            )
        while len(rows) < BODIES:
            trial = study.ask(boxes)
            _, ranges, cpu = best_throw(trial.params, 0)
            found = max(ranges)
            study.tell(trial, found)
            rows.append({"design": trial.params, "range": found, "ranges": ranges, "cpu": cpu})
            write_json(place, data)
            print(seed, len(rows), f"{found:.3f} m, {cpu:.1f} CPU s", flush=True)
    bodies = {"baseline": baseline}
    for seed, rows in data["searches"].items():
        bodies[f"winner {seed}"] = max(rows, key=lambda row: row["range"])["design"]
    for name, design in bodies.items():
        throws = data["throws"].setdefault(name, [])
        while len(throws) < THROWS:
            numbers, ranges, _ = best_throw(design, 1 + len(throws))
            throws.append(
                {
                    "searched": ranges,
                    "range": mean_range(numbers, design, 300),
                    "finer mesh": mean_range(numbers, design, 300, **FINER),
                    "1 ms": mean_range(numbers, design, 300, **SHORTER),
                }
            )
            write_json(place, data)
            print(name, throws[-1], flush=True)


if __name__ == "__main__":
    main()
