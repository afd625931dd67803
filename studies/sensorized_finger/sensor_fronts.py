"""Pareto fronts of the sensorized finger (thesis, fig. 3.6 and 3.7), found on FEM; searches resume."""

from __future__ import annotations

import csv
import time
from pathlib import Path

import numpy as np

from benchmarks.sensor_finger import DESIGNS
from softgym_envs.storage import atomic_write

ROOT = Path(__file__).resolve().parent

ENDS = {
    "volume_change": "sensing",
    "angular_displacement": "bending",
    "relative_volume_change": "pressure",
    "cavity_volume": "volume",
    "pressure_sensitivity": "pressure sensitivity",
    "information": "information",
}
"""What the end of a front is called at which a metric is best."""


def front(stem: str) -> dict[str, object]:
    """Search a front and return its ends, the fingers that were built, and what the search took.

    Values are in mm3 and degrees. The designs are kept in ``results/<stem>`` and ``benchmarks/data/<stem>.csv``.

    Args:
        stem: name of the configuration in ``configs/design``.
    """
    from softgym_envs.codesign.metrics.metric import METRICS
    from softgym_envs.codesign.tools.config import OptimiseConfig
    from softgym_envs.codesign.tools.plots import draw_front
    from softgym_envs.codesign.tools.search import search
    from softgym_envs.config import load_config

    folder = Path("results") / stem
    config = load_config(ROOT.parent / "configs" / "design" / f"{stem}.yaml", OptimiseConfig)
    began = time.perf_counter()
    found = search(config, folder)
    metrics = tuple(objective.metric for objective in config.objectives)
    units = ", ".join(METRICS[name].display.unit for name in metrics)

    def shown(values: dict[str, float]) -> list[float]:
        return [float(f"{METRICS[name].scale * values[name]:.4g}") for name in metrics]

    evaluator, space = config.bodies.evaluator(metrics), config.bodies.make_robot().design_space
    built = {name: evaluator(space.complete(design)) for name, design in DESIGNS.items()}
    with open(folder / "trials.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    free = config.bodies.box().names
    names = ["trial", *free, *metrics]
    with atomic_write(ROOT / "data" / f"{stem}.csv", "w") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([*names, "status"])
        for row in rows:
            numbers = [f"{float(row[name]):.7g}" if row[name] else "" for name in names]
            writer.writerow([*numbers, row["infeasible"].split(":")[0] or "ok"])
    feasible = [row for row in rows if not row["infeasible"]]
    values = np.array([[float(row[metric]) for metric in metrics] for row in feasible])
    on_front = {row.trial for row in found.front}
    chosen = np.array([k for k, row in enumerate(feasible) if int(row["trial"]) in on_front])
    references = {name: [row[metric] for metric in metrics] for name, row in built.items()}
    draw_front(folder / "front_with_built_fingers.png", [METRICS[name] for name in metrics], values, chosen, references)
    result: dict[str, object] = {
        "designs: feasible, infeasible, repeated": [found.feasible, found.infeasible, found.repeated],
        "evaluation, over all processes [s]": round(found.busy_seconds, 1),
        "wall time of this run [s]": round(time.perf_counter() - began, 1),
        "designs on the front": len(found.front),
    }
    for metric in metrics:
        row = max(found.front, key=lambda each: each.metrics[metric])
        design = {n: round(v if n == "slope" else 1e3 * v, 3) for n, v in row.design.items() if n in free}
        result[f"end for {ENDS[metric]} [{units}]"] = shown(row.metrics)
        result[f"end for {ENDS[metric]} [mm, rad]"] = design
    for name, row in built.items():
        result[f"{name} [{units}]"] = shown(row)
    return result


def sensor_front() -> dict[str, object]:
    """Bending against sensing (thesis, fig. 3.6), bellows up to 13 mm high: 1500 designs with NSGA-II."""
    return front("sensorized_finger_front")


def sensor_front_published() -> dict[str, object]:
    """Bending against sensing (thesis, fig. 3.6), bellows up to 10 mm high as published: 1500 designs."""
    return front("sensorized_finger_front_published")


def sensor_pressure_front() -> dict[str, object]:
    """Bending, relative change and initial volume of the cavity (thesis, fig. 3.7): NSGA-II in the published box."""
    return front("sensorized_finger_pressure_front")


def sensor_four_cavities_front() -> dict[str, object]:
    """Bending, pressure sensitivity and initial volume with four cavities (thesis, fig. 3.15): 185 designs."""
    return front("sensorized_finger_four_cavities_front")


def sensor_information_front() -> dict[str, object]:
    """Bending against what the volumes tell about touches: 300 designs."""
    return front("sensorized_finger_information_front")
