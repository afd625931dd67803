"""Look again at the front of a search for contact-aided fingers (thesis, fig. 3.18).

    softgym optimise --config configs/design/contact_aided_finger_front.yaml --folder FOLDER
    python -m benchmarks.zigzag_study FOLDER

chooses the ends of the front and a compromise, evaluates them and the fingers that were built on the published and on
the accurate mesh, writes them as STEP and STL files for printing, draws all of it, and prints one JSON object.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks.zigzag_designs import DESIGNS, SIMULATED
from softgym_envs.codesign.tools.config import OptimiseConfig
from softgym_envs.codesign.tools.records import FrontDesign
from softgym_envs.config import load_config, provenance
from softgym_envs.robots.contact_aided_finger import ContactAidedFinger
from softgym_envs.robots.geometry.export import export_body
from softgym_envs.robots.grasping import evaluate_grasp
from softgym_envs.storage import JsonLines, read_json, write_json

MESHES: dict[str, dict[str, Any]] = {
    "published": {"mesh": "published"},
    "accurate": {"mesh": "accurate", "mesh_size": 12e-3},
}
"""Options of the robot."""

OBJECTIVES = {"grip_force": "maximize", "grip_energy": "minimize", "grip_resistance": "minimize"}


@dataclass(frozen=True)
class Value:
    """One design on one mesh."""

    design: str
    mesh: str
    status: str
    nodes: int
    force: float  # [N]
    resistance: float  # [m]
    energy: float  # [N m rad]


def winners(front: Sequence[FrontDesign]) -> dict[str, FrontDesign]:
    """Return the designs of a front with the best value of each objective, and the one nearest to all best values.

    Distances are those of objectives scaled to the range of the front.
    """
    costs = np.array(
        [
            [(-1 if goal == "maximize" else 1) * each.metrics[name] for name, goal in OBJECTIVES.items()]
            for each in front
        ]
    )
    best = {f"best {name.removeprefix('grip_')}": front[k] for name, k in zip(OBJECTIVES, costs.argmin(0), strict=True)}
    spans = np.ptp(costs, axis=0)
    scaled = (costs - costs.min(0)) / np.where(spans > 0.0, spans, 1.0)
    return best | {"compromise": front[int(np.linalg.norm(scaled, axis=1).argmin())]}


def evaluate(name: str, design: Mapping[str, float], mesh: str) -> Value:
    """Evaluate one design on one of the `MESHES`, against the plane of the thesis."""
    found = evaluate_grasp(ContactAidedFinger(**MESHES[mesh]), design)
    return Value(
        design=name,
        mesh=mesh,
        status=found.reason or found.status,
        nodes=found.nodes,
        force=found.contact_force,
        resistance=found.grasp_resistance,
        energy=found.grasp_energy,
    )


def first_names(designs: Mapping[str, Mapping[str, float]]) -> dict[str, str]:
    """Return for each name of a design the first name of the same design."""
    space = ContactAidedFinger().design_space
    complete = {name: tuple(np.round(list(space.complete(design).values()), 9)) for name, design in designs.items()}
    return {name: next(other for other in designs if complete[other] == complete[name]) for name in designs}


def evaluate_all(designs: Mapping[str, Mapping[str, float]], path: Path) -> list[Value]:
    """Evaluate designs on all meshes, each once; values that a file of JSON lines holds are not computed again."""
    lines = JsonLines(path)
    known = {(value.design, value.mesh): value for value in (Value(**record) for record in lines.read())}
    first = first_names(designs)
    for name in dict.fromkeys(first.values()):
        for mesh in MESHES:
            if (name, mesh) not in known:
                known[name, mesh] = evaluate(name, designs[name], mesh)
                lines.append(asdict(known[name, mesh]))
    return [replace(known[first[name], mesh], design=name) for name in designs for mesh in MESHES]


def draw(path: Path, all_designs: np.ndarray, values: Sequence[Value], shapes: Mapping[str, np.ndarray]) -> None:
    """Draw the search with the chosen and the built designs, and the outlines of the chosen ones.

    Args:
        path: of the picture.
        all_designs: force, energy and resistance of all designs of the search, shape (n, 3).
        values: of the chosen and the built designs.
        shapes: outlines [m], shape (k, 2), by name.
    """
    from softgym_envs.codesign.report.plots import BASELINE, MUTED, WINNER
    from softgym_envs.codesign.tools.plots import figure

    with figure(path, 3, width=4.4, height=4.2) as axes:
        for axis, column, words in ((axes[0], 1, "energy [N m]"), (axes[1], 2, "resistance [m]")):
            axis.scatter(all_designs[:, 0], all_designs[:, column], s=7, color=MUTED, label="search")
            ends: dict[str, list[tuple[float, float]]] = {}
            for value in values:
                ends.setdefault(value.design, []).append((value.force, (value.energy, value.resistance)[column - 1]))
            # One line for each design, from the published mesh, where it has its name, to the accurate one.
            for name, points in ends.items():
                axis.plot(*zip(*points, strict=True), color=MUTED, lw=0.8, zorder=1)
                axis.annotate(name, points[0], xytext=(4, 3), textcoords="offset points", size=6)
            for k, (mesh, color) in enumerate(zip(MESHES, (BASELINE, WINNER), strict=True)):
                places = np.array([points[k] for points in ends.values()])
                axis.scatter(*places.T, s=26, color=color, label=f"{mesh} mesh")
            for name, (force, resistance, energy) in SIMULATED.items():
                height = energy if column == 1 else resistance
                axis.scatter(force, height, s=40, marker="x", color=BASELINE)
                axis.annotate(f"{name}, thesis", (force, height), xytext=(4, -8), textcoords="offset points", size=6)
            axis.set_xlabel("contact force [N]")
            axis.set_ylabel(words)
        axes[0].legend(fontsize=7)
        for k, (name, corners) in enumerate(shapes.items()):
            closed = 1e3 * np.vstack([corners, corners[:1]]) + [62.0 * k, 0.0]
            axes[2].fill(*closed.T, color=WINNER, lw=0)
            words = name.replace(" ", "\n")
            axes[2].annotate(
                words, (np.ptp(closed[:, 0]) / 2 + closed[:, 0].min(), -12.0), ha="center", va="top", size=7
            )
        axes[2].set_aspect("equal")
        axes[2].set_ylim(-40.0, 110.0)
        axes[2].set_xlabel("[mm]")


@click.command(help=__doc__)
@click.argument("folder", type=click.Path(path_type=Path, exists=True, file_okay=False))
def main(folder: Path) -> None:
    """Evaluate, write and draw the chosen designs of a search."""
    config = load_config(folder / "config.yaml", OptimiseConfig)
    result = read_json(folder / "result.json")
    chosen = winners([FrontDesign.from_json(row) for row in result["front"]])
    designs = {**DESIGNS, **{name: each.design for name, each in chosen.items()}}
    values = evaluate_all(designs, folder / "chosen.jsonl")
    robot = ContactAidedFinger()
    shapes = {}
    different = set(first_names(designs).values())
    for name, design in designs.items():
        complete = robot.design_space.complete(design)
        if name in different:
            shapes[name] = robot.outline(complete)
        for ending in ("step", "stl"):
            export_body(robot, folder / "print" / f"{name.replace(' ', '_')}.{ending}", complete)
    every = np.genfromtxt(folder / "trials.csv", delimiter=",", names=True, usecols=tuple(OBJECTIVES), dtype=float)
    draw(
        folder / "chosen.png",
        np.column_stack([every[name] for name in OBJECTIVES]),
        [v for v in values if v.design in shapes],
        shapes,
    )
    output = {
        "search": {
            "mesh": config.bodies.robot_options,
            **{name: result[name] for name in ("feasible", "infeasible", "repeated", "busy_seconds")},
            "front": len(result["front"]),
        },
        "designs": {name: each.design for name, each in chosen.items()},
        "values": [asdict(value) for value in values],
    }
    write_json(folder / "chosen.json", {**provenance(), **output})
    click.echo(json.dumps(output))


if __name__ == "__main__":
    main()
