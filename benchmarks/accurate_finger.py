"""The two-cable finger on its accurate mesh: what its weights get right, and its study judged on finer meshes."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.recorded import results
from benchmarks.tables import markdown
from softgym_envs.codesign.snapshot import load_study
from softgym_envs.control.inverse_qp import InverseQP
from softgym_envs.control.settling import settle
from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.registry import make_robot
from softgym_envs.storage import write_json
from softgym_envs.surrogate.model import SurrogateModel
from softgym_envs.surrogate.pretrained import pretrained_model

WEIGHTS = {"accurate": {"mesh": "accurate", "design_box": "wide"}, "published": {}}
"""Options of the finger for two sets of weights."""

STEPS = 60
"""Steps of the inverse QP on the weights."""

MESHES = {"accurate": (10e-3, 20), "refined": (7.5e-3, 6)}
"""Sizes of the meshes on which the study's bodies are judged [m], and the number of unseen goals."""


def accurate_weights() -> dict[str, object]:
    """Tip and tension of weights against values extrapolated from three meshes, on bodies of no training set.

    Bodies, command and converged values are those of the recorded benchmark ``convergence_finger``.
    """
    found = results("convergence_finger")
    rows: list[dict[str, Any]] = []
    for weights, options in WEIGHTS.items():
        model = pretrained_model(make_robot("finger", **options))
        for body, converged in found["errors"].items():
            tip, tension = _predicted(model, found["designs"][body], np.array(found["command"]))
            truth = np.array(converged["tip [mm]"])
            rows.append(
                {
                    "weights": weights,
                    "body": body,
                    "tip": float(np.linalg.norm(tip - truth) / np.linalg.norm(truth)),
                    "tension": tension / converged["effort"] - 1.0,
                }
            )
    worst = {
        f"{weights}: worst {name} [%]": 100 * max(abs(row[name]) for row in rows if row["weights"] == weights)
        for weights in WEIGHTS
        for name in ("tip", "tension")
    }
    return {"rows": rows, **worst}


def _predicted(model: SurrogateModel, design: Mapping[str, float], command: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the motion of the tip [mm] and the tension of the first cable [N] under a command."""
    context = model.context(model.robot.design_space.complete(design).array[None])
    ends = np.stack([np.zeros_like(command), command])
    reached = [model.search(context, end[None], end[None], model.robot.unilateral, 1e-6, 50) for end in ends]
    rest, tip = (model.effector(context, displacement)[0][0, :3] for displacement, _, _ in reached)
    return 1e3 * (tip - rest), float(reached[1][1][0, 0])


def accurate_study(folder: str | Path = "results/finger_reach_accurate") -> dict[str, object]:
    """Baseline and winner of the study ``finger_reach_accurate``: where the inverse QP ends, on two meshes of FEM.

    Distances from the first of the study's unseen goals [mm], fewer on the refined mesh, in which all elements are
    smaller by a quarter.

    Args:
        folder: the finished study; finished bodies are kept in it.
    """
    study = load_study(folder)
    assert study.best is not None
    goals = study.folder.goals["unseen"][: max(count for _, count in MESHES.values()), 0]
    bodies = {"baseline": study.config.baseline, "winner": study.best.design}
    result: dict[str, Any] = {"designs": {name: dict(design) for name, design in bodies.items()}}
    result["goals [mm]"] = (1e3 * goals).tolist()
    for name, design in bodies.items():
        commands, distances = _on_weights(design, goals)
        result[f"{name}: surrogate: distance [mm]"] = (1e3 * distances).tolist()
        for mesh, (size, count) in MESHES.items():
            path = Path(folder) / f"judged_{name}_{mesh}_{count}.json"
            if not path.exists():
                write_json(path, _on_mesh(size, design, goals[:count], commands))
            result |= {f"{name}: {mesh}: {key}": value for key, value in json.loads(path.read_text()).items()}
    return result


def _on_weights(design: Mapping[str, float], goals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the commands (k, 2) at which the inverse QP ends on the weights, and the distances from goals [m] (k,)."""
    model = pretrained_model(make_robot("finger", mesh="accurate"))
    context = model.context(model.robot.design_space.complete(design).array[None])
    commands, distances = [], []
    for goal in goals:
        controller, command = InverseQP.for_robot(model.robot), np.zeros(2)
        for _ in range(STEPS):
            reached, _, _ = model.search(context, command[None], command[None], model.robot.unilateral, 1e-6, 50)
            both = model.condensed(context, reached)
            state = replace(both, compliance=both.compliance[0], free=both.free[0], effort=both.effort[0])
            command = controller.solve(state, goal, command, reached[0] > command + 1e-6)
        commands.append(command)
        distances.append(float(np.linalg.norm(model.effector(context, reached)[0][0, :3] - goal)))
    return np.array(commands), np.array(distances)


def _on_mesh(size: float, design: Mapping[str, float], goals: np.ndarray, starts: np.ndarray) -> dict[str, Any]:
    """Return distances from goals [mm] and tensions [N] where the inverse QP ends on one mesh, NaN where it fails."""
    robot, start = make_robot("finger", mesh="accurate", mesh_size=size), time.process_time()
    statics, distances, tensions, count = Statics(robot.build(design)), [], [], 0
    for goal, command in zip(goals, starts, strict=False):
        try:
            found = settle(statics, robot, goal, command)
            count += found.equilibria
            distances.append(1e3 * found.distance)
            tensions.append(float(found.effort.max()))
        except ConvergenceError:
            distances.append(float("nan"))
            tensions.append(float("nan"))
    seconds = time.process_time() - start
    return {"distance [mm]": distances, "tension [N]": tensions, "equilibria": count, "CPU [s]": seconds}


def weights_table() -> str:
    """Errors of tip and tension of both sets of weights, body by body."""
    found = results("accurate_weights")["rows"]
    of = {(row["weights"], row["body"]): row for row in found}
    rows = []
    for body in dict.fromkeys(row["body"] for row in found):
        title = body if body == "baseline" else f"random body {body}"
        cells = [f"{100 * of[weights, body][name]:.1f}" for weights in WEIGHTS for name in ("tip", "tension")]
        rows.append([title, *cells])
    head = ["body", "accurate: tip [%]", "tension [%]", "published: tip [%]", "tension [%]"]
    return markdown(head, rows, "lrrrr")


def study_table() -> str:
    """Mean distance from the goals of the study's baseline and winner on the weights and on two meshes."""
    found = results("accurate_study")

    def change(judge: str, count: int | None) -> np.ndarray:
        before, after = (np.array(found[f"{body}: {judge}: distance [mm]"][:count]) for body in ("baseline", "winner"))
        return after - before

    rows, intervals = [], {}
    for judge in ("surrogate", *MESHES):
        values = change(judge, None)
        draws = np.random.default_rng(0).integers(len(values), size=(10_000, len(values)))
        low, high = intervals[judge] = np.quantile(values[draws].mean(axis=1), (0.025, 0.975))
        cells = [f"{np.mean(found[f'{body}: {judge}: distance [mm]']):.2f}" for body in ("baseline", "winner")]
        tensions = [
            f"{np.mean(found[f'{body}: {judge}: tension [N]']):.2f}" if judge in MESHES else ""
            for body in ("baseline", "winner")
        ]
        shown = f"{values.mean():.2f} ({low:.2f} to {high:.2f})"
        rows.append([judge, str(len(values)), *cells, shown, *tensions])
    (coarse, _), (fine, count) = MESHES["accurate"], MESHES["refined"]
    left = (change("refined", count) - change("accurate", count)).mean() / (1.0 - fine / coarse)
    low, high = intervals["accurate"]
    whole = f"{low + min(left, 0.0):.2f} to {high + max(left, 0.0):.2f}"
    rows.append(["accurate, with its error", "", "", "", f"{whole}", "", ""])
    head = [
        "judge",
        "goals",
        "baseline [mm]",
        "winner [mm]",
        "change (95 %) [mm]",
        "tension, baseline [N]",
        "winner [N]",
    ]
    return markdown(head, rows, "lrrrrrr")


TABLES = {"accurate_weights": weights_table, "accurate_study": study_table}
"""Tables of pages by name."""

BENCHMARKS = {"accurate_weights": accurate_weights, "accurate_study": accurate_study}
