"""Compare the sensorized finger with the published study of its design (thesis, sec. 3.3).

``softgym bench sensor_finger`` computes the published tables and times. The 400 designs that the authors of the study
recorded are not part of this project: pass the file that holds them, a CSV with the columns ``trial``, the seven
variables [mm, rad], ``obj0`` (volume change [mm3]) and ``obj1`` (bending angle [rad]); infeasible ones are infinite.

    python -m benchmarks.sensor_finger TRIALS.csv

evaluates them (and resumes), writes ``results/sensor_finger.csv`` and
``results/sensor_finger.json``, and prints how well both agree. Its results are kept in ``benchmarks/data``.
"""

from __future__ import annotations

import csv
import math
import statistics
import time
from collections.abc import Mapping
from pathlib import Path

import click
import numpy as np

from softgym_envs.config import provenance
from softgym_envs.errors import ConvergenceError, DataError, InfeasibleDesign
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.geometry.meshing import BodyMesh
from softgym_envs.robots.sensorized_finger import SensorizedFinger
from softgym_envs.storage import atomic_write, write_json

MM = 1e-3
DESIGNS: dict[str, dict[str, float]] = {
    "baseline": {},
    "slim": {
        "slope": 0.878,
        "outer_radius": 9.10 * MM,
        "joint_height": 5.10 * MM,
        "cork_thickness": 2.14 * MM,
        "bellow_height": 9.60 * MM,
        "wall_thickness": 2.45 * MM,
        "plateau_height": 3.84 * MM,
    },
    "large": {
        "slope": 0.592,
        "outer_radius": 17.52 * MM,
        "joint_height": 6.45 * MM,
        "cork_thickness": 2.05 * MM,
        "bellow_height": 13.0 * MM,
        "wall_thickness": 3.0 * MM,
        "plateau_height": 3.86 * MM,
    },
}
"""The initial design and the two that were built (thesis, fig. 3.3)."""

TABLE = {"baseline": (41.5, 21.1), "slim": (29.7, 28.13), "large": (153.1, 19.1)}
"""Simulated values of the thesis (table 3.1): volume change [mm3] and bending angle [deg]."""

MEASURED = {"slim": (45.7, 26.1), "large": (300.7, 16.9)}
"""Measured on prototypes (thesis, tables 3.2 and 3.4): volume change [mm3] and bending angle [deg]."""

NAMES = {
    "JointSlopeAngle": "slope",
    "OuterRadius": "outer_radius",
    "JointHeight": "joint_height",
    "CavityCorkThickness": "cork_thickness",
    "BellowHeight": "bellow_height",
    "WallThickness": "wall_thickness",
    "PlateauHeight": "plateau_height",
}
"""Names of the variables in the recorded trials."""

FIELDS = (
    "trial",
    "status",  # ok, no shape (closed formula), no mesh, no equilibrium
    "nodes",
    "meshing_s",
    "solving_s",
    "initial_volume_mm3",
    "volume_change_mm3",
    "angle_rad",  # of the tip point (0, 0, -3L)
    "middle_angle_rad",  # of (0, H/2, -3L)
    "weighted_volume_change_mm3",  # with the weight of the source's scene
    "weighted_middle_angle_rad",
)


class SourceFinger(SensorizedFinger):
    """The finger as in the scenes of the study.

    Args:
        mass: total mass under gravity along -z [kg]; the scenes have 0.1 kg for every volume.
        **options: as for `SensorizedFinger`.
    """

    def __init__(self, *, mass: float = 0.1, **options) -> None:
        super().__init__(**options)
        self.mass = mass

    def equip(self, mesh: BodyMesh, design: Mapping[str, float]) -> MechanicalModel:
        model = super().equip(mesh, design)
        model.set_gravity((0.0, 0.0, -9.81 * self.mass / model.mass))
        return model


# -- published tables --------------------------------------------------------------------------------------------------


def published() -> dict[str, object]:
    """Sensorized finger: table 3.1 and table 3.5 of the thesis, and the time of a design."""
    kinds = {
        "7 mm": SensorizedFinger(),
        # Settings of the scene of the built fingers.
        "as built": SourceFinger(mesh="local", cable_clearance=1.0 * MM),
        "3 mm": SensorizedFinger(mesh_size=3.0 * MM),
    }
    result: dict[str, object] = {}
    for name, design in DESIGNS.items():
        result[f"{name}: thesis [uL, deg]"] = list(TABLE[name])
        for kind, robot in kinds.items():
            elasticity = {"poisson_ratio": 0.495} if kind == "as built" else {}
            readings = robot.readings(design | elasticity)
            angle = math.degrees(readings.bending_angle)
            result[f"{name}: {kind} [uL, deg]"] = [round(1e9 * readings.volume_change, 1), round(angle, 2)]
    # The study keeps the cable of the initial finger at 17.75 mm, 3 mm above the bellows.
    readings = SensorizedFinger(cable_clearance=3.0 * MM).readings()
    angle = math.degrees(readings.bending_angle)
    result["baseline: 7 mm, cable at 17.75 mm [uL, deg]"] = [round(1e9 * readings.volume_change, 1), round(angle, 2)]

    result["large, wall 3 -> 2.6 mm: thesis, 3209 nodes [uL]"] = [175.2, 217.0]
    for size in (2.8, 2.5, 2.2):
        robot = SensorizedFinger(mesh_size=size * MM)
        changes = [
            round(1e9 * robot.readings(DESIGNS["large"] | {"wall_thickness": wall * MM}).volume_change, 1)
            for wall in (3.0, 2.6)
        ]
        nodes = len(robot.body(DESIGNS["large"]).nodes)
        result[f"large, wall 3 -> 2.6 mm: {nodes} nodes [uL]"] = changes

    for size in (7.0, 3.0):
        robot = SensorizedFinger(mesh_size=size * MM)
        times = []
        for design in DESIGNS.values():
            nodes = len(robot.body(design).nodes)  # meshing is not counted
            for _ in range(3):
                start = time.perf_counter()
                robot.readings(design)
                times.append(time.perf_counter() - start)
        result[f"build and pull by 10 mm, about {nodes} nodes [s]"] = statistics.median(times)
    return result


# -- recorded trials ---------------------------------------------------------------------------------------------------


def read_trials(path: str | Path) -> list[dict[str, float]]:
    """Read recorded trials: the design in SI, ``trial``, ``obj0`` and ``obj1``.

    Raises:
        DataError: if the file is missing or lacks a column.
    """
    trials = []
    try:
        with open(path, newline="") as stream:
            for row in csv.DictReader(stream):
                trial = {ours: float(row[theirs]) * MM for theirs, ours in NAMES.items()}
                trial["slope"] /= MM
                trials.append(trial | {name: float(row[name]) for name in ("trial", "obj0", "obj1")})
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise DataError(f"trials '{path}' cannot be read: {error!r}") from None
    return trials


def evaluate(design: Mapping[str, float]) -> dict[str, object]:
    """Evaluate one design; see `FIELDS`."""
    low, middle = SensorizedFinger(), SensorizedFinger(tip_height=0.010)
    weighted = SourceFinger(tip_height=0.010)
    complete = low.design_space.complete(design)
    try:
        low.drawing(complete)
    except InfeasibleDesign:
        return {"status": "no shape"}
    start = time.perf_counter()
    try:
        nodes = len(low.body(complete).nodes)
    except InfeasibleDesign:
        return {"status": "no mesh"}
    meshed = time.perf_counter()
    row: dict[str, object] = {"nodes": nodes, "meshing_s": f"{meshed - start:.3f}"}
    try:
        readings = low.readings(complete)
        row["solving_s"] = f"{time.perf_counter() - meshed:.3f}"
        heavy = weighted.readings(complete)
        high = middle.readings(complete)
    except ConvergenceError:
        return row | {"status": "no equilibrium"}
    return row | {
        "status": "ok",
        "initial_volume_mm3": f"{1e9 * readings.initial_volume:.2f}",
        "volume_change_mm3": f"{1e9 * readings.volume_change:.3f}",
        "angle_rad": f"{readings.bending_angle:.5f}",
        "middle_angle_rad": f"{high.bending_angle:.5f}",
        "weighted_volume_change_mm3": f"{1e9 * heavy.volume_change:.3f}",
        "weighted_middle_angle_rad": f"{heavy.bending_angle:.5f}",
    }


def compare(trials: str | Path, output: str | Path) -> dict[str, object]:
    """Evaluate all recorded designs that ``output`` does not hold yet, and compare.

    Args:
        trials: CSV of the recorded designs.
        output: CSV of our results, one row per design, written after each evaluation.

    Raises:
        DataError: if the trials cannot be read.
    """
    recorded = read_trials(trials)
    output = Path(output)
    rows: dict[int, dict[str, object]] = {}
    if output.exists():
        with open(output, newline="") as stream:
            rows = {int(row["trial"]): dict(row) for row in csv.DictReader(stream)}
    with click.progressbar([t for t in recorded if int(t["trial"]) not in rows], label="designs") as missing:
        for trial in missing:
            design = {name: trial[name] for name in NAMES.values()}
            rows[int(trial["trial"])] = {"trial": int(trial["trial"]), **evaluate(design)}
            with atomic_write(output, "w") as stream:
                writer = csv.DictWriter(stream, FIELDS, restval="", lineterminator="\n")
                writer.writeheader()
                writer.writerows(rows[number] for number in sorted(rows))
    return statistics_of(recorded, rows)


def statistics_of(recorded: list[dict[str, float]], rows: Mapping[int, Mapping[str, object]]) -> dict[str, object]:
    """Return how our evaluations agree with the recorded ones."""
    from scipy.stats import spearmanr

    result: dict[str, object] = {}
    theirs = {int(t["trial"]): t for t in recorded}
    infeasible = [n for n, t in theirs.items() if not math.isfinite(t["obj0"])]
    for status in ("ok", "no shape", "no mesh", "no equilibrium"):
        numbers = [n for n in theirs if rows[n]["status"] == status]
        both = len(set(numbers) & set(infeasible))
        result[f"{status}: designs, of these infeasible there"] = [len(numbers), both]
    both = [n for n in theirs if n not in infeasible and rows[n]["status"] == "ok"]
    result["compared designs"] = len(both)
    for objective, column in (
        ("obj0", "volume_change_mm3"),
        ("obj0", "weighted_volume_change_mm3"),
        ("obj1", "angle_rad"),
        ("obj1", "middle_angle_rad"),
        ("obj1", "weighted_middle_angle_rad"),
    ):
        a = np.array([theirs[n][objective] for n in both])
        b = np.array([float(str(rows[n][column])) for n in both])
        slope, offset = np.polyfit(b, a, 1)
        ratio = a / b
        result[column] = {
            "spearman": round(float(spearmanr(a, b)[0]), 4),
            "pearson": round(float(np.corrcoef(a, b)[0, 1]), 4),
            "theirs = slope * ours + offset": [round(float(slope), 4), round(float(offset), 4)],
            "theirs / ours: mean, standard deviation": [round(float(ratio.mean()), 4), round(float(ratio.std()), 4)],
            "theirs / ours: quantiles 5, 50, 95 %": np.quantile(ratio, [0.05, 0.5, 0.95]).round(4).tolist(),
        }
    for column in ("nodes", "meshing_s", "solving_s"):
        values = [float(str(rows[n][column])) for n in both]
        result[f"{column}: median, largest"] = [float(np.median(values)), max(values)]
    return result


@click.command()
@click.argument("trials", type=click.Path(path_type=Path))
@click.option("--output", type=click.Path(path_type=Path), default=Path("results/sensor_finger.csv"), show_default=True)
def main(trials: Path, output: Path) -> None:
    """Compare with the recorded TRIALS."""
    result = compare(trials, output)
    for key, value in result.items():
        click.echo(f"{key}: {value}")
    write_json(output.with_suffix(".json"), {**provenance(), "results": result})


if __name__ == "__main__":
    main()
