"""Tables of the pages on surrogates: what calibrated weights say about their errors, and what they were trained on."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from scipy.stats import binomtest

from benchmarks.recorded import records, results
from benchmarks.tables import WEIGHTS, markdown, short
from softgym_envs.robots.registry import make_robot
from softgym_envs.surrogate.pretrained import pretrained_folder, shipped_robots


def trust() -> str:
    """Errors, coverage and trust of calibrated weights on states that the calibration has not seen, by stratum.

    Intervals of the coverage are those of a share of independent states (Clopper and Pearson, 95 %).
    """
    rows = []
    for name, title in CALIBRATED.items():
        if f"trust_{name}" in records():
            found = results(f"trust_{name}")
            strata = {k: v for k, v in found.items() if isinstance(v, dict)}
            rows += _trust_rows(title, strata, found["goal tolerance [mm]"])
    return markdown(TRUST_HEAD, rows, "llrrrrrrrr")


def calibrated() -> str:
    """The same on the states by which the weights were calibrated, from their cards."""
    rows = []
    for name, (robot, options) in shipped_robots().items():
        body = make_robot(robot, **options)
        card = json.loads((pretrained_folder(body) / "model.json").read_text())
        if found := card.get("calibration"):
            strata = {k: {n: v * FACTORS.get(n, 1.0) for n, v in row.items()} for k, row in found["strata"].items()}
            rows += _trust_rows(CALIBRATED[name], strata, 1e3 * body.goal_tolerance)
    return markdown(TRUST_HEAD, rows, "llrrrrrrrr")


def fidelities() -> str:
    """How many FEM states each of the shipped weights was trained on, by mesh, and how long the training took.

    A card counts the images of states under the symmetries of a robot, if its training used them: those of more than
    one fidelity do.
    """
    rows = []
    for name, (robot, options) in shipped_robots().items():
        if name not in FIDELITIES:
            continue
        body = make_robot(robot, **options)
        card = json.loads((pretrained_folder(body) / "model.json").read_text())
        cheap = card["states"].get("pretraining/train", 0)
        images = 1 + len(body.symmetries) if cheap else 1
        mesh = body.mechanics_key.get("mesh", "published")
        first = f"{cheap // images:,}" if cheap else ""
        own = f"{card['states']['train'] // images:,}"
        minutes = f"{card['training_seconds'] / 60:.1f}"
        rows.append([FIDELITIES[name], mesh, first, own, str(images), minutes])
    head = ["weights", "mesh", "states of the published mesh", "states of its own", "images of each", "training [min]"]
    return markdown(head, rows, "llrrrr")


def surrogates() -> str:
    """Errors of all shipped weights: at equal displacements, and for calibrated ones under commands inside the box."""
    rows = []
    for name, (robot, options) in shipped_robots().items():
        body = make_robot(robot, **options)
        card = json.loads((pretrained_folder(body) / "model.json").read_text())
        strata = card.get("calibration", {}).get("strata", {})
        inside, corners = strata.get("inside"), strata.get("corners")
        cells = [_pair(card["test"]["effector_mean"], card["test"]["effector_worst"])]
        cells += [_pair(inside["mean"], inside["worst"]) if inside else ""]
        cells += [f"{100 * inside['trusted']:.0f}, {100 * corners['trusted']:.0f}" if inside and corners else ""]
        rows.append([SHIPPED[name], *cells, f"{1e3 * body.goal_tolerance:.3g}"])
    head = ["weights", "same displacements: mean, worst", "same commands: mean, worst"]
    return markdown([*head, "trusted inside, at corners [%]", "goal tolerance"], rows, "lrrrr")


def _pair(mean: float, worst: float) -> str:
    return f"{short(1e3 * mean)}, {short(1e3 * worst)}"


CALIBRATED = WEIGHTS | {f"{name}_accurate": f"{title}, accurate mesh" for name, title in WEIGHTS.items()}
FIDELITIES = CALIBRATED | {"cable_trunk_coarse": "cable trunk, quadratic elements"}
SHIPPED = FIDELITIES | {
    "sensorized_finger_2cavities_touched": "sensorized finger, 2 cavities",
    "sensorized_finger_4cavities_touched": "sensorized finger, 4 cavities",
}
FACTORS = {"mean": 1e3, "worst": 1e3, "worst_trusted": 1e3, "coverage": 100.0, "trusted": 100.0}
"""From metres and shares to millimetres and percent."""
TRUST_HEAD = [
    *("weights", "stratum", "states", "error, mean [mm]", "worst [mm]", "covered (95 %) [%]", "trusted [%]"),
    *("worst trusted [mm]", "goal tolerance [mm]", "no equilibrium: all / trusted"),
]


def _trust_rows(title: str, strata: Mapping[str, Mapping[str, Any]], tolerance: float) -> list[list[str]]:
    rows = []
    for stratum, row in strata.items():
        states = int(row["states"])
        interval = binomtest(round(row["coverage"] / 100 * states), states).proportion_ci()
        covered = f"{row['coverage']:.1f} ({100 * interval.low:.0f} to {100 * interval.high:.0f})"
        cells = [str(states), *(short(row[k]) for k in ("mean", "worst")), covered, f"{row['trusted']:.0f}"]
        cells += [short(row["worst_trusted"]) if row["trusted"] else "", f"{tolerance:.3g}"]
        # Older records count only the trusted ones.
        cells.append(f"{row['lost']:.0f} / {row['unsolved']:.0f}" if "lost" in row else f"? / {row['unsolved']:.0f}")
        rows.append(["" if rows else title, stratum, *cells])
    return rows


TABLES: dict[str, Callable[[], str]] = {
    function.__name__: function for function in (trust, calibrated, fidelities, surrogates)
}
"""Tables by name."""
