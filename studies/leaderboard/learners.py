"""How strong must a learner be to judge bodies that move? The plain gait, and gaits of more and more gradients.

    python studies/leaderboard/learners.py swimmer-swim-v1 results/learners

Bodies of a Sobol sequence are judged by the plain gait, by gaits of a tenth, a quarter and a half of the problem's
gradients, and by all of them, from three starts. The best of these three stands for what a body can do. Everything is
kept in the folder; a second call resumes.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import kendalltau, qmc

from softgym_envs.extensions.leaderboard import load_problem
from softgym_envs.runs import provenance
from softgym_envs.storage import read_json, write_json

JUDGES: dict[str, dict[str, Any]] = {
    "plain": {"judge": "qp"},
    **{f"share {share:g}": {"judge": "trained", "budget": share} for share in (0.1, 0.25, 0.5)},
    **{f"seed {seed}": {"judge": "trained", "seed": seed} for seed in range(3)},
}


def main() -> None:
    """Judge the bodies and print how well each judge ranks them."""
    parser = argparse.ArgumentParser()
    parser.add_argument("problem")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--bodies", type=int, default=16)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    place = given.folder / f"learners_{given.problem}.json"
    data: dict[str, Any] = read_json(place) if place.exists() else {"provenance": provenance(), "bodies": []}
    problem = load_problem(given.problem)
    points = 2.0 * qmc.Sobol(len(problem.variables), rng=np.random.default_rng(0)).random(given.bodies) - 1.0
    for point in points[len(data["bodies"]) :]:
        design = problem.design(point)
        row: dict[str, Any] = {"design": design, "cpu": {}, "speed": {}}
        for name, options in JUDGES.items():
            found = problem.evaluate(design, **options)
            row["speed"][name] = 1e3 * found.values.get(problem.definition.objective, 0.0)  # also beyond limits
            row["cpu"][name] = found.cpu_seconds
        data["bodies"].append(row)
        write_json(place, data)
    speeds = {name: np.array([row["speed"][name] for row in data["bodies"]]) for name in JUDGES}
    able = np.max([speeds[f"seed {seed}"] for seed in range(3)], axis=0)
    data["judges"] = {
        name: {
            "tau": float(kendalltau(values, able).statistic),
            "choice": float(able[np.argmax(values)]),
            "cpu": float(np.mean([row["cpu"][name] for row in data["bodies"]])),
        }
        for name, values in speeds.items()
    }
    data["best"] = float(able.max())
    write_json(place, data)
    print(data["best"], data["judges"])


if __name__ == "__main__":
    main()
