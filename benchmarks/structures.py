"""Structures of the modular arm: what the search over structures finds against the search over dimensions alone.

    softgym codesign --config configs/codesign/modular_reach.yaml --folder F/modular_reach_0 sampler.seed=0
    softgym codesign --config configs/codesign/modular_reach_fixed.yaml --folder F/modular_reach_fixed_0 sampler.seed=0

and so for the seeds 1 and 2. Then ``python -m benchmarks.structures F`` judges the best body of each study, and the
baseline, on quadratic finite elements of the whole body: where the inverse QP stays at the goals of the search and at
unseen ones. It writes each best body as STL to its folder, and ``benchmarks/data/structures.json``.

``python -m benchmarks.structures more`` judges the bodies in that file on `MANY` further unseen goals of the same zone,
on superelements, and two of them on a finer mesh of the solid body; it writes ``benchmarks/data/structures_more.json``.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import qmc, ttest_ind

from benchmarks.tables import markdown
from softgym_envs.config import provenance
from softgym_envs.errors import ConvergenceError, DataError
from softgym_envs.storage import write_json

KEPT = Path(__file__).parent / "data" / "structures.json"
MORE = KEPT.with_name("structures_more.json")
SEEDS = (0, 1, 2)
MANY = 150
REFINE = 1.5
"""Edges of the finer mesh are shorter by this factor."""
ZONE = np.array([0.0, 0.0, 0.135]), np.array([0.020, 0.060, 0.010])
"""Middle and half of the size of the zone of both studies [m]."""
SEARCHES = {"structure and dimensions": "modular_reach", "dimensions": "modular_reach_fixed"}
BASELINE = "baseline"
PARTS, BODIES = ("search", "unseen"), ("superelements", "solid")


def judge(study_folder: Path, design: Mapping[str, float], picture: Path | None = None) -> dict[str, Any]:
    """Judge a body on its superelements and on solid finite elements.

    Returns:
        Its cells, and the final distances [mm] at the goals of the search and at unseen ones on both bodies, with the
        largest difference of the two places where the effector stays; NaN where there is no equilibrium.
    """
    from softgym_envs.codesign.snapshot import load_study
    from softgym_envs.control.settling import settle
    from softgym_envs.mechanics.solvers.statics import Statics
    from softgym_envs.robots import export_body
    from softgym_envs.robots.modular_arm import ModularArm

    study = load_study(study_folder)
    robot = study.config.robot
    assert isinstance(robot, ModularArm)
    if picture is not None:
        export_body(robot, picture, design)
    complete = robot.design_space.complete(design)
    found: dict[str, Any] = {"cells": list(robot.kinds(complete)), "design": dict(complete)}
    arms = {"superelements": robot, "solid": robot.printable()}
    for part, goals in (("search", study.folder.goals["selection"]), ("unseen", study.folder.goals["unseen"])):
        solvers = {body: Statics(arm.build(complete)) for body, arm in arms.items()}
        distances: dict[str, list[float]] = {body: [] for body in arms}
        apart = []
        for goal in goals[:, 0]:
            start, places = np.zeros(2), []
            for body, solver in solvers.items():
                try:
                    settled = settle(solver, arms[body], goal, start)
                except ConvergenceError:
                    distances[body].append(float("nan"))
                    break
                # The finite elements start from where the superelements end, which saves equilibria.
                start = settled.command
                places.append(settled.effector)
                distances[body].append(1e3 * settled.distance)
            if len(places) == 2:
                apart.append(1e3 * float(np.linalg.norm(places[0] - places[1])))
        found |= {f"{part}: {body} [mm]": values for body, values in distances.items()}
        found[f"{part}: apart [mm]"] = apart
    return found


def judge_all(folder: Path) -> list[dict[str, Any]]:
    """Return the judgements of the best bodies of all studies in a folder, and of the baseline; kept there."""
    from softgym_envs.codesign.snapshot import load_study

    rows = []
    for search, name in SEARCHES.items():
        for seed in SEEDS:
            place = folder / f"{name}_{seed}"
            study = load_study(place)
            if study.best is None:
                raise DataError(f"study '{place}' has no body that could be scored")
            bodies = {search: study.best.design}
            if search == "dimensions" and seed == SEEDS[0]:
                bodies[BASELINE] = study.config.baseline
            for body, design in bodies.items():
                kept = place / f"judged_{body.replace(' ', '_')}.json"
                if not kept.exists():
                    write_json(kept, judge(place, design, kept.with_suffix(".stl")))
                row = {"search": body, "seed": seed, "trials": len(study.trials), **json.loads(kept.read_text())}
                row["score of the study [mm]"] = -1e3 * study.best.score if body != BASELINE else None
                rows.append(row)
                print(row, file=sys.stderr)
    return rows


def many_goals() -> np.ndarray:
    """Return goals (n, 3) [m] that are spread over the zone, other ones than those of the studies."""
    return ZONE[0] + (2.0 * qmc.Halton(3, rng=np.random.default_rng(20)).random(MANY) - 1.0) * ZONE[1]


def judge_more() -> dict[str, Any]:
    """Return the final distances [mm] of the bodies in the file of results at many goals, and errors of the mesh.

    The mesh error is how far the tip of the best body of each search moves on a finer mesh, under the command where the
    inverse QP of the superelements stays, at the first goals.
    """
    from softgym_envs.control.settling import settle
    from softgym_envs.mechanics.solvers.statics import Statics
    from softgym_envs.robots.registry import make_robot

    robot, goals = make_robot("modular_arm", cells=6), many_goals()
    rows: list[dict[str, Any]] = []
    mesh: dict[str, list[float]] = {}
    for row in json.loads(KEPT.read_text())["rows"]:
        solver, distances, commands = Statics(robot.build(row["design"])), [], []
        for goal in goals:
            solver.reset()
            settled = settle(solver, robot, goal, np.zeros(2))
            distances.append(1e3 * settled.distance)
            commands.append(settled.command)
        rows.append({"search": row["search"], "seed": row["seed"], "distances [mm]": distances})
        print(row["search"], row["seed"], np.mean(distances), file=sys.stderr, flush=True)
        if row["seed"] == SEEDS[0] and row["search"] in SEARCHES:
            tips = []
            for refine in (1.0, REFINE):
                body = make_robot("modular_arm", cells=6, body="solid", refine=refine)
                solid = Statics(body.build(row["design"]))
                tips.append([solid.solve(command).condensed.delta.e for command in commands[:2]])
            mesh[row["search"]] = (1e3 * np.linalg.norm(np.subtract(*tips), axis=1)).tolist()
            print(mesh, file=sys.stderr, flush=True)
    return {"rows": rows, "tip on the finer mesh, moved [mm]": mesh, "finer by": REFINE, "goals": MANY}


def more_table() -> str:
    """Mean final distances of the best bodies at many unseen goals, and the difference of both searches."""
    if not MORE.is_file():
        raise DataError(f"'{MORE}' does not exist; make it with 'python -m benchmarks.structures more'")
    found = json.loads(MORE.read_text())
    means = {
        search: [float(np.mean(row["distances [mm]"])) for row in found["rows"] if row["search"] == search]
        for search in SEARCHES
    }
    rows = [[search, *(f"{mean:.2f}" for mean in each), f"{np.mean(each):.2f}"] for search, each in means.items()]
    free, fixed = (np.array(means[search]) for search in SEARCHES)
    interval = ttest_ind(fixed, free, equal_var=False).confidence_interval()
    gain = f"{fixed.mean() - free.mean():.2f} ({interval.low:.2f} to {interval.high:.2f})"
    rows.append(["difference (95 % interval over seeds)", *(f"{d:.2f}" for d in fixed - free), gain])
    return markdown(["search", *(f"seed {seed} [mm]" for seed in SEEDS), "mean [mm]"], rows, "lrrrr")


def structures_table() -> str:
    """Final distances of the best bodies on solid finite elements, and how far the superelements are off."""
    if not KEPT.is_file():
        raise DataError(f"'{KEPT}' does not exist; make it with 'python -m benchmarks.structures results/structures'")
    rows = []
    for row in sorted(json.loads(KEPT.read_text())["rows"], key=lambda row: row["search"] != BASELINE):
        goals = [*row["search: solid [mm]"], *row["unseen: solid [mm]"]]
        apart = [*row["search: apart [mm]"], *row["unseen: apart [mm]"]]
        cells = [cell for cell in row["cells"] if cell != "none"]
        means = [f"{np.nanmean(row[f'{part}: {body} [mm]']):.2f}" for part in PARTS for body in BODIES]
        lost = int(np.isnan(goals).sum())
        title = row["search"] if row["search"] == BASELINE else f"{row['search']}, seed {row['seed']}"
        rows.append([title, ", ".join(cells), *means, f"{np.max(apart):.2f}", f"{lost} of {len(goals)}"])
    head = ["search", "cells", *(f"{part}: {body} [mm]" for part in PARTS for body in BODIES), "apart", "lost"]
    return markdown(head, rows, "llrrrrrr")


TABLES = {"structures": structures_table, "structures_more": more_table}
"""Tables of pages by name."""

if __name__ == "__main__":
    if sys.argv[1] == "more":
        write_json(MORE, {**judge_more(), "provenance": provenance()})
    else:
        write_json(KEPT, {"rows": judge_all(Path(sys.argv[1])), "provenance": provenance()})
