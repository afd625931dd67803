"""Robots on their accurate meshes: what weights learned there get right, and what finer meshes say of studies."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from benchmarks.recorded import results
from benchmarks.studies import JUDGES
from benchmarks.tables import markdown
from softgym_envs.robots.registry import make_robot
from softgym_envs.surrogate.model import SurrogateModel
from softgym_envs.surrogate.pretrained import pretrained_model
from softgym_envs.wording import decimal


@dataclass(frozen=True)
class AccurateRobot:
    """A robot whose weights were learned from its accurate mesh.

    Attributes:
        robot: registered name.
        convergence: recorded benchmark with its converged tips and efforts.
        weights: options of the robot for two sets of weights, by name.
        study: recorded study that uses the first of these weights; empty for none.
    """

    robot: str
    convergence: str
    weights: Mapping[str, Mapping[str, Any]]
    study: str


ROBOTS = {
    "finger": AccurateRobot(
        "finger",
        "convergence_finger",
        {"accurate": {"mesh": "accurate", "design_box": "wide"}, "published": {}},
        "finger_reach",
    ),
    "diamond": AccurateRobot(
        "diamond",
        "convergence_diamond",
        {"accurate": {"mesh": "accurate"}, "published": {}},
        "diamond_reach",
    ),
    "cable_trunk": AccurateRobot(
        "cable_trunk", "convergence_cable_trunk", {"accurate": {"mesh": "coarse"}, "published": {}}, ""
    ),
}
"""Robots by the last part of the benchmarks' names."""

BODIES = ("baseline", "winner")
PHYSICS = ("fem", "refined")


def accurate_weights(name: str) -> dict[str, object]:
    """Tip and tension of weights against values extrapolated from three meshes, on bodies of no training set.

    Bodies, command and converged values are those of the robot's recorded benchmark of convergence.
    """
    robot = ROBOTS[name]
    found = results(robot.convergence)
    rows: list[dict[str, Any]] = []
    for weights, options in robot.weights.items():
        model = pretrained_model(make_robot(robot.robot, **options))
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
        for weights in robot.weights
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


def weights_table(name: str) -> str:
    """Errors of tip and tension of both sets of weights, body by body."""
    found, kinds = results(f"accurate_weights_{name}")["rows"], ROBOTS[name].weights
    of = {(row["weights"], row["body"]): row for row in found}
    rows = []
    for body in dict.fromkeys(row["body"] for row in found):
        title = body if body == "baseline" else f"random body {body}"
        cells = [f"{100 * of[weights, body][what]:.1f}" for weights in kinds for what in ("tip", "tension")]
        rows.append([title, *cells])
    head = ["body", "accurate: tip [%]", "tension [%]", "published: tip [%]", "tension [%]"]
    return markdown(head, rows, "lrrrr")


def study_table(name: str) -> str:
    """Mean distance from the test goals of a study's baseline and winner, with each physics that judged them."""
    rows = []
    for row in results("codesign")[ROBOTS[name].study]["meshes"]:
        change = decimal(row["change [mm]"], 2)
        if "change before [mm]" in row:
            change += f" (mesh above: {decimal(row['change before [mm]'], 2)})"
        for key, form in (("interval [mm]", "({} to {})"), ("with the mesh [mm]", "; with the mesh {} to {}")):
            ends = row.get(key)
            change += (" " if form[0] == "(" else "") + form.format(*(decimal(end, 2) for end in ends)) if ends else ""
        unknowns = f"{row['unknowns']:,}" if row.get("unknowns") else ""
        known = [row.get(f"{body}, mean effort [N]") for body in BODIES]
        efforts = ["" if effort is None else f"{effort:.2f}" for effort in known]
        cells = [decimal(row[f"{body} [mm]"], 2) for body in BODIES]
        rows.append([row["judge"], unknowns, str(row["goals"]), *cells, change, *efforts])
    head = [
        "judge",
        "unknowns",
        "goals",
        "baseline [mm]",
        "winner [mm]",
        "change (95%) [mm]",
        "mean effort, baseline [N]",
        "winner [N]",
    ]
    return markdown(head, rows, "lrrrrrrr")


def studies_table() -> str:
    """All studies with a finer mesh: the change from baseline to winner on both meshes, at the same goals."""
    rows = []
    for study in results("codesign").values():
        own, finer = (next((r for r in study.get("meshes", ()) if r["judge"] == JUDGES[k]), {}) for k in PHYSICS)
        if not finer:
            continue
        # Two digits beyond the goal tolerances, which are 0.5 mm and more; small changes as they are.
        changes = [f"{1e3 * finer[key]:.0f} µm" for key in ("change before [mm]", "change [mm]")]
        ends = [f"{finer[f'{body} [mm]']:.3g}" for body in BODIES]
        unknowns = " → ".join(f"{row['unknowns']:,}" for row in (own, finer))
        interval = "{:.1f} to {:.1f} mm".format(*own["with the mesh [mm]"]) if "with the mesh [mm]" in own else ""
        rows.append([study["title"], unknowns, str(finer["goals"]), *changes, " → ".join(ends), interval])
    head = ["robot", "unknowns of both meshes", "goals", "change", "on the finer mesh", "baseline → winner there [mm]"]
    return markdown([*head, "95% of the change, mesh included"], rows, "lrrrrrr")


def _named(kind: Callable[..., Any], name: str) -> Callable[[], Any]:
    run = partial(kind, name)
    run.__doc__ = f"{(kind.__doc__ or '').splitlines()[0][:-1]}: {name}."
    return run


TABLES: dict[str, Callable[[], str]] = {
    f"{prefix}_{name}": _named(table, name)
    for name, robot in ROBOTS.items()
    for prefix, table in (("accurate_weights", weights_table), ("study_meshes", study_table))
    if table is weights_table or robot.study
} | {"study_meshes": studies_table}
"""Tables of pages by name."""

BENCHMARKS: dict[str, Callable[[], dict[str, object]]] = {
    f"accurate_weights_{name}": _named(accurate_weights, name) for name in ROBOTS
}
"""Benchmarks by name."""
