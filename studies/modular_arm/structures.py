"""Structures of the modular arm: searches over structures and dimensions against dimensions of one fixed structure.

``python -m benchmarks.structures FOLDER`` runs all searches with three seeds each, judges the best body of each, and
writes ``benchmarks/data/structures.json``. What is finished is in the folder, so that it may be stopped and go on.

Goals, sampler and budget were decided before the runs; the search over three kinds, which repeats an older one with new
energies, was added when that over seven kinds had lost. All searches use the same sampler, `TRIALS` bodies, and `GOALS`
goals of the zone of ``configs/codesign/modular_reach.yaml``; all begin with the baseline, whose leaves take turns. A
body's score is the mean distance at which the inverse QP settles. A state in which a module is loaded or strained more
than it was learned, or which is unstable, does not count: then the arm stays at rest. Winners are judged at `UNSEEN`
other goals, and quadratic finite elements of the whole body judge the best one of each search at the first of these.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import qmc, ttest_ind

from benchmarks.tables import markdown
from softgym_envs.config import provenance
from softgym_envs.designs import DesignVariable
from softgym_envs.errors import ConvergenceError, DataError, InfeasibleDesign
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.base import Robot
from softgym_envs.storage import write_json

KEPT = Path(__file__).parent / "data" / "structures.json"
SEEDS = (0, 1, 2)
TRIALS, FIRST, GOALS, UNSEEN = 200, 40, 16, 150
"""Bodies of each search, those of them that are drawn at random, and goals of the search and of the judgement."""
SOLID = 2
"""Unseen goals at which finite elements judge the best body of each search."""
ZONE = np.array([0.0, 0.0, 0.135]), np.array([0.020, 0.060, 0.010])
"""Middle and half of the size of the zone [m]."""
CELLS = 6
FEW = ("leaf_x", "leaf_y", "block")
BASELINE, DIMENSIONS = "baseline", "dimensions"
SEARCHES = {
    "structure of three kinds": FEW,
    "structure of seven kinds": (*FEW, "notch_x", "notch_y", "tube", "accordion"),
    DIMENSIONS: FEW,
}
"""What the cells may be, in each search; the last one leaves the structure of the baseline as it is."""
WORST = 0.1
"""Distance that counts for a body that cannot exist [m]."""


def goals(number: int, seed: int) -> np.ndarray:
    """Return goals (n, 3) [m] that are spread over the zone."""
    return ZONE[0] + (2.0 * qmc.Halton(3, rng=np.random.default_rng(seed)).random(number) - 1.0) * ZONE[1]


def arm(kind: str, **options: Any) -> Robot:
    """Return the arm of a search, or of the baseline, with its structure as part of the design."""
    from softgym_envs.robots.registry import make_robot

    return make_robot("modular_arm", cells=CELLS, kinds=SEARCHES.get(kind, FEW), **options)


def reach(robot: Robot, design: Mapping[str, float], places: np.ndarray) -> dict[str, Any]:
    """Return where the inverse QP settles at goals (n, 3), on superelements.

    Returns:
        ``distances`` [mm], shape (n,), ``commands`` (n, 2), and in how many states the modules are not trusted.
    """
    from softgym_envs.control.settling import settle

    solver = Statics(robot.build(design))
    start = solver.solve(np.zeros(2)).condensed.delta.e[:3]
    found: dict[str, Any] = {"distances": [], "commands": [], "untrusted": 0}
    for goal in places:
        solver.reset()
        try:
            settled = settle(solver, robot, goal, np.zeros(2))
            state = solver.solve(settled.command)
            trusted = state.stable and all(block.knows(state.x) for block in solver.model.blocks)
        except ConvergenceError:
            trusted = False
        found["untrusted"] += not trusted
        found["distances"].append(1e3 * (settled.distance if trusted else float(np.linalg.norm(start - goal))))
        found["commands"].append(settled.command.tolist() if trusted else [0.0, 0.0])
    return found


def search(kind: str, seed: int) -> dict[str, Any]:
    """Return the best body of one search, its score [mm], and the best score after each body."""
    import optuna

    from softgym_envs.codesign.sampling import SamplerConfig, make_sampler

    robot = arm(kind)
    variables = [v for v in robot.design_space if kind != DIMENSIONS or not v.choices]
    sampler = SamplerConfig(name="tpe", seed=seed, options={"n_startup_trials": FIRST})
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=make_sampler(sampler, 0))
    study.enqueue_trial({v.name: v.choices[int(v.baseline)] if v.choices else v.baseline for v in variables})
    places = goals(GOALS, 0)

    def value(trial: optuna.Trial) -> float:
        design = {v.name: _drawn(trial, v) for v in variables}
        try:
            distance = float(np.mean(reach(robot, robot.design_space.complete(design), places)["distances"]))
        except (InfeasibleDesign, ConvergenceError):
            distance = 1e3 * WORST
        trial.set_user_attr("design", design)
        return distance

    study.optimize(value, n_trials=TRIALS)
    best = np.minimum.accumulate([trial.value for trial in study.trials]).tolist()
    design = robot.design_space.complete(study.best_trial.user_attrs["design"])
    return {
        "search": kind,
        "seed": seed,
        "design": dict(design),
        "score [mm]": study.best_value,
        "best so far [mm]": best,
    }


def _drawn(trial: Any, variable: DesignVariable) -> float:
    """Return the value of a variable that the sampler proposes; the kind of a cell is a category."""
    if not variable.choices:
        return float(trial.suggest_float(variable.name, variable.low, variable.high, log=variable.log))
    names = [*variable.choices, "none"]
    return names.index(trial.suggest_categorical(variable.name, names)) + 0.5


def judge(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a body's row with its cells, and with its distances [mm] and commands at unseen goals on superelements."""
    robot = arm(row["search"])
    found = reach(robot, row["design"], goals(UNSEEN, 20))
    cells = [cell for cell in robot.kinds(row["design"]) if cell != "none"]  # type: ignore[attr-defined]
    found["commands"] = found["commands"][:SOLID]
    return {**row, "cells": cells, "distances [mm]": found.pop("distances"), **found}


def on_solid(row: Mapping[str, Any]) -> list[float]:
    """Return the distances [mm] of finite elements at the first unseen goals, under the commands of superelements."""
    model, distances = arm(row["search"], body="solid").build(row["design"]), []
    for goal, command in zip(goals(UNSEEN, 20), row["commands"], strict=False):
        solver = Statics(model)
        # Finite elements of some bodies need twice the iterations in one step.
        state = [solver.solve(share * np.array(command)) for share in (0.5, 1.0)][-1]
        distances.append(1e3 * float(np.linalg.norm(state.condensed.delta.e[:3] - goal)))
    return distances


def judge_all(folder: Path) -> list[dict[str, Any]]:
    """Return the judged best bodies of all searches, and the baseline; all are kept in the folder."""
    from softgym_envs.robots import export_body

    places = {}
    for kind, seed in [(BASELINE, 0), *((kind, seed) for seed in SEEDS for kind in SEARCHES)]:
        place = places[kind, seed] = folder / f"{kind.replace(' ', '_')}_{seed}.json"
        if not place.exists():
            baseline = {"search": kind, "seed": seed, "design": dict(arm(kind).design_space.complete({}))}
            row = judge(baseline if kind == BASELINE else search(kind, seed))
            write_json(place, row)
            export_body(arm(kind), place.with_suffix(".stl"), row["design"])
            print(kind, seed, row["cells"], np.mean(row["distances [mm]"]), file=sys.stderr, flush=True)
    found = {key: json.loads(place.read_text()) for key, place in places.items()}
    for kind in SEARCHES:
        best = min(SEEDS, key=lambda seed: np.mean(found[kind, seed]["distances [mm]"]))  # noqa: B023
        if "solid [mm]" not in found[kind, best]:
            found[kind, best]["solid [mm]"] = on_solid(found[kind, best])
            write_json(places[kind, best], found[kind, best])
    return list(found.values())


def _rows() -> list[dict[str, Any]]:
    if not KEPT.is_file():
        raise DataError(f"'{KEPT}' does not exist; make it with 'python -m benchmarks.structures results/structures'")
    found: list[dict[str, Any]] = json.loads(KEPT.read_text())["rows"]
    return found


def structures_table() -> str:
    """Cells and distances of the best bodies, and what finite elements change."""
    rows = []
    for row in _rows():
        title = row["search"] if row["search"] == BASELINE else f"{row['search']}, seed {row['seed']}"
        score = f"{row['score [mm]']:.2f}" if "score [mm]" in row else ""
        solid = np.array(row.get("solid [mm]", []))
        apart = f"{np.abs(solid - row['distances [mm]'][: len(solid)]).max():.2f}" if len(solid) else ""
        found = [score, f"{np.mean(row['distances [mm]']):.2f}", apart, f"{row['untrusted']} of {UNSEEN}"]
        rows.append([title, ", ".join(row["cells"]), *found])
    head = ["search", "cells", "search [mm]", "unseen [mm]", "finite elements differ by [mm]", "not trusted"]
    return markdown(head, rows, "llrrrr")


def more_table() -> str:
    """Mean distances at unseen goals, and what each search over structures gains."""
    found = _rows()
    means = {kind: np.array([np.mean(r["distances [mm]"]) for r in found if r["search"] == kind]) for kind in SEARCHES}
    rows = []
    for kind, each in means.items():
        gain = ""
        if kind != DIMENSIONS:
            interval = ttest_ind(means[DIMENSIONS], each, equal_var=False).confidence_interval()
            gain = f"{means[DIMENSIONS].mean() - each.mean():.2f} ({interval.low:.2f} to {interval.high:.2f})"
        rows.append([kind, *(f"{mean:.2f}" for mean in each), f"{each.mean():.2f}", gain])
    head = ["search", *(f"seed {seed} [mm]" for seed in SEEDS), "mean [mm]", "gain (95 % interval over seeds) [mm]"]
    return markdown(head, rows, "lrrrrr")


TABLES = {"structures": structures_table, "structures_more": more_table}
"""Tables of pages by name."""

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of the searches")
    write_json(KEPT, {"rows": judge_all(parser.parse_args().folder), "provenance": provenance()})
