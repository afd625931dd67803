"""How long contact-aided fingers take to close, and whether random ones do.

    python -m benchmarks.zigzag_closing
    python -m benchmarks.zigzag_closing --designs 200 FOLDER

The first prints the CPU seconds of a grasp of 40 angles of the fingers A and B, with and without friction. The second
closes random bodies of the whole design space by 40 degrees on the plane, with friction, and prints their outcomes.
Both print one JSON object. Bodies that are done are kept in the folder.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks.zigzag_designs import DESIGNS
from softgym_envs.robots.contact_aided_finger import ContactAidedFinger
from softgym_envs.robots.grasping import Grasp, GraspObject, evaluate_grasp
from softgym_envs.storage import JsonLines

MESHES: dict[str, dict[str, Any]] = {"linear, 3 mm": {"mesh": "published"}, "quadratic, 8 mm": {"mesh": "accurate"}}
FRICTIONS = {"frictionless": 0.0, "friction 0.85": 0.85}
RANDOM: dict[str, Any] = {"mesh": "accurate", "mesh_size": 0.020}
"""Mesh of random bodies."""
WALLS_AND_FOLDS = ("e1", "e2", "e3", *(f"d{k}" for k in range(12)))


def speed(fingers: Sequence[str] = ("A", "B"), meshes: Sequence[str] = tuple(MESHES)) -> dict[str, Any]:
    """Return nodes, CPU seconds and Newton iterations of grasps of 40 angles, without those of meshing."""
    found: dict[str, Any] = {}
    coarse = ContactAidedFinger(mesh="published", mesh_size=0.010)
    evaluate_grasp(coarse, DESIGNS["A"], angle=0.3, angles=4)  # loads the compiled kernels
    for mesh in meshes:
        robot = ContactAidedFinger(**MESHES[mesh])
        for finger in fingers:
            robot.build(DESIGNS[finger])  # its mesh is kept
            for title, friction in FRICTIONS.items():
                start = time.process_time()
                grasp = evaluate_grasp(robot, DESIGNS[finger], GraspObject(friction=friction), self_friction=friction)
                seconds = time.process_time() - start
                iterations = int(grasp.iterations.sum())
                found[f"{finger}, {mesh}, {title}: nodes, CPU [s], iterations"] = [grasp.nodes, seconds, iterations]
    return found


def random_design(number: int) -> dict[str, float]:
    """Return a random body of the whole design space [m]."""
    drawn = ContactAidedFinger().design_space.sample(np.random.default_rng([number, 7]), WALLS_AND_FOLDS)
    return {name: drawn[name] for name in WALLS_AND_FOLDS}


def close_random(count: int, folder: Path, angles: int, options: dict[str, Any] | None = None) -> list[dict[str, Any]]:
    """Close random bodies by 40 degrees on the plane; return a row for each, kept in the folder."""
    robot = ContactAidedFinger(**(RANDOM if options is None else options))
    kept = JsonLines(folder / f"closing_{angles}.jsonl")
    rows: list[dict[str, Any]] = kept.read()
    for number in range(len(rows), count):
        start = time.process_time()
        grasp = evaluate_grasp(robot, random_design(number), angle=math.radians(40.0), angles=angles)
        rows.append({"number": number, **_row(grasp), "cpu_seconds": time.process_time() - start})
        kept.append(rows[-1])
    return rows[:count]


def _row(grasp: Grasp) -> dict[str, Any]:
    return {
        "status": grasp.status,
        "reason": grasp.reason,
        "angle": float(grasp.angle.max(initial=0.0)),
        "gap": float(grasp.gap.min(initial=math.inf)),
        "limited": grasp.torque_limited,
        "nodes": grasp.nodes,
        "iterations": int(grasp.iterations.sum()),
    }


def outcomes(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Numbers of random bodies by what became of them, their smallest gap, and their times."""
    closed = [row for row in rows if row["status"] == "ok"]
    gaps = [row["gap"] for row in rows if row["gap"] < math.inf]
    return {
        "designs": len(rows),
        "closed": sum(not row["limited"] for row in closed),
        "closed until the largest torque": sum(row["limited"] for row in closed),
        "infeasible": sum(row["status"] == "infeasible" for row in rows),
        "no equilibrium": sum(row["status"] == "no equilibrium" for row in rows),
        "smallest gap [mm]": 1e3 * min(gaps, default=math.inf),
        "CPU, median and largest [s]": [float(f([row["cpu_seconds"] for row in closed])) for f in (np.median, np.max)],
        "iterations, largest": max(row["iterations"] for row in rows),
    }


@click.command(help=__doc__)
@click.argument("folder", type=click.Path(path_type=Path), required=False)
@click.option("--designs", default=0, show_default=True, help="Random bodies to close, instead of the times.")
@click.option("--angles", default=40, show_default=True, help="Steps to 40 degrees of random bodies.")
def main(folder: Path | None, designs: int, angles: int) -> None:
    """Measure times, or close random bodies."""
    if designs and folder is None:
        raise click.UsageError("--designs needs a FOLDER for what is done")
    found = outcomes(close_random(designs, folder, angles)) if designs and folder is not None else speed()
    click.echo(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
