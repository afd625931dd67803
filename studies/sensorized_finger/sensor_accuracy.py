"""How the readings of the sensorized finger depend on its mesh and on Poisson's ratio (thesis, sec. 3.3.4 and 3.3.5).

``softgym bench sensor_accuracy`` computes the published fingers on three meshes. With a file of recorded trials (see
`benchmarks.sensor_finger`),

    python -m benchmarks.sensor_accuracy TRIALS.csv --limit 100

ranks some of them on the published and on the accurate mesh, and prints how well both agree with the recorded ranks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import click
import numpy as np

from benchmarks.sensor_finger import DESIGNS, MM, NAMES, SourceFinger, read_trials
from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.robots.sensorized_finger import SensorizedFinger

RATIOS = (0.30, 0.45, 0.495)
"""Poisson's ratios of the two fronts of figure 3.12, after that of all other figures."""

MESHES = ("published", "local", "accurate")

SIZES = {"local": (20.0, 14.0, 10.0, 7.5), "accurate": (20.0, 14.0, 10.0)}
"""Sizes of the convergence study (thesis, fig. 3.11): the edge length away from the cavities [mm]; a fifth of it at the
cavities of linear elements, a quarter at those of quadratic ones."""


def shown(robot: SensorizedFinger, design: Mapping[str, float]) -> list[float]:
    """Volume change [uL] and bending angle [degrees] of a design; NaN without an equilibrium."""
    try:
        readings = robot.readings(design)
    except ConvergenceError:
        return [math.nan, math.nan]
    return [round(1e9 * readings.volume_change, 1), round(math.degrees(readings.bending_angle), 2)]


def sensor_accuracy() -> dict[str, object]:
    """Sensorized finger: table 3.1 on three meshes and at three Poisson's ratios, convergence, and wall thickness."""
    result: dict[str, object] = {}
    for mesh in MESHES:
        robot = SensorizedFinger(mesh=mesh)
        for nu in RATIOS:
            for name, design in DESIGNS.items():
                result[f"{mesh}, nu {nu:g}: {name}"] = shown(robot, {**design, "poisson_ratio": nu})
    for mesh, sizes in SIZES.items():
        for size in sizes:
            robot = SensorizedFinger(mesh=mesh, mesh_size=size * MM)
            for name in ("slim", "large"):
                nodes = len(robot.build(DESIGNS[name]).nodes)
                change = shown(robot, {**DESIGNS[name], "poisson_ratio": 0.45})[0]
                result[f"convergence, {robot.element}, {size:g} mm: {name} [nodes, uL]"] = [nodes, change]
    thin = {**DESIGNS["large"], "poisson_ratio": 0.45, "wall_thickness": 2.6 * MM}
    result["accurate, nu 0.45: large, wall of 2.6 mm"] = shown(SensorizedFinger(mesh="accurate"), thin)
    return result


def compare(trials: Path, limit: int, mesh_size: float | None = None) -> dict[str, object]:
    """Rank correlation with recorded trials on two meshes, for designs that all three can solve.

    The finger has the weight and the tip of the recorded scene; ``mesh_size`` is that of the accurate mesh [mm].
    """
    from scipy.stats import spearmanr

    recorded = [trial for trial in read_trials(trials) if math.isfinite(trial["obj0"])]
    recorded = recorded[:: max(1, len(recorded) // limit)][:limit]
    size = None if mesh_size is None else mesh_size * MM
    robots = {
        "published": SourceFinger(tip_height=0.010),
        "accurate": SourceFinger(mesh="accurate", mesh_size=size, tip_height=0.010),
    }
    found: dict[str, list[list[float]]] = {mesh: [] for mesh in robots}
    with click.progressbar(recorded, label="designs") as bar:
        for trial in bar:
            for mesh, robot in robots.items():
                try:
                    found[mesh].append(shown(robot, {name: trial[name] for name in NAMES.values()}))
                except InfeasibleDesign:
                    found[mesh].append([math.nan, math.nan])
    values = {mesh: np.array(rows) for mesh, rows in found.items()}
    both = np.isfinite(np.hstack(list(values.values()))).all(axis=1)
    theirs = np.array([[trial["obj0"], math.degrees(trial["obj1"])] for trial in recorded])[both]
    result: dict[str, object] = {"trials": len(recorded), "solved on both meshes": int(both.sum())}
    for mesh, ours in values.items():
        result[f"{mesh}: solved"] = int(np.isfinite(ours).all(axis=1).sum())
        for k, name in enumerate(("volume change", "bending angle")):
            ratio = ours[both, k] / theirs[:, k]
            result[f"{mesh}: {name}, Spearman"] = round(float(spearmanr(ours[both, k], theirs[:, k])[0]), 4)
            result[f"{mesh}: {name}, ours / theirs, median"] = round(float(np.median(ratio)), 3)
    return result


@click.command()
@click.argument("trials", type=click.Path(path_type=Path))
@click.option("--limit", default=100, show_default=True, help="number of trials, spread evenly over the file")
@click.option("--mesh-size", type=float, help="size of the accurate mesh [mm]; default: its own")
@click.option(
    "--output", type=click.Path(path_type=Path), default=Path("results/sensor_trials.json"), show_default=True
)
def main(trials: Path, limit: int, mesh_size: float | None, output: Path) -> None:
    """Compare with recorded TRIALS on the published and the accurate mesh."""
    from softgym_envs.config import provenance
    from softgym_envs.storage import write_json

    result = compare(trials, limit, mesh_size)
    for key, value in result.items():
        click.echo(f"{key}: {value}")
    write_json(output, {**provenance(), "results": result})


if __name__ == "__main__":
    main()
