"""Co-designed finger and its force control against design A, on objects and frictions that the study did not see.

    softgym codesign --config configs/codesign/finger_grasp.yaml --folder F
    python -m benchmarks.grasp_codesign F

Both bodies close on the same random objects under the same control of the force, by finite elements on several meshes.
Episodes are kept in the folder, so a second call resumes the first; ``benchmarks/data/grasp_codesign.json`` gets all of
them. The tables compare the bodies, with 95 % intervals that resample scenes and meshes.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks.tables import markdown
from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.agents.evaluation import evaluate
from softgym_envs.agents.statistics import Estimate, crossed_estimate
from softgym_envs.config import provenance
from softgym_envs.errors import ConvergenceError, DataError, InfeasibleDesign
from softgym_envs.robots.grasping import KINDS
from softgym_envs.storage import write_json

KEPT = Path(__file__).parent / "data" / "grasp_codesign.json"

SEED = 3_000_017
"""Seed of scenes, which no study uses."""

MESHES = (0.020, 0.012, 0.008)
"""Target edge lengths of quadratic meshes [m]."""

BASELINE, FOUND = "A", "co-designed"


@dataclass(frozen=True)
class Scene:
    """An object in front of the finger, and the wanted force along x [N]."""

    kind: str
    place: Mapping[str, float]
    force: float


@dataclass(frozen=True)
class Episode:
    """What happened when one body closed on one scene.

    Attributes:
        body: its name.
        mesh: target edge length [m].
        scene: its number.
        simulated: whether the body could be built and meshed there.
        total: return; 0 if it was not simulated.
        success: whether the force ended within 5 % of the wanted one.
        error: of the force at the end, relative to the wanted one; 1 if it was not simulated.
        cpu_seconds: of the episode.
    """

    body: str
    mesh: float
    scene: int
    simulated: bool
    total: float
    success: bool
    error: float
    cpu_seconds: float


def draw_scenes(count: int, forces: tuple[float, float], seed: int = SEED) -> list[Scene]:
    """Draw scenes: all kinds in turn, gaps of 20 to 32 mm, frictions of 0.2 to 0.8, objects of 40 to 70 mm."""
    rng = np.random.default_rng(seed)
    scenes = []
    for k in range(count):
        kind = KINDS[k % len(KINDS)]
        place = {"object_gap": rng.uniform(0.020, 0.032), "friction": rng.uniform(0.2, 0.8)}
        size, height = rng.uniform(0.04, 0.07), rng.uniform(0.045, 0.070)
        if kind != "plane":
            place |= {"object_size": size, "object_height": height}
        scenes.append(Scene(kind, place, float(rng.uniform(*forces))))
    return scenes


def close(
    environment: EnvironmentConfig,
    body: str,
    design: Mapping[str, float],
    scenes: Sequence[Scene],
    k: int,
    mesh: float,
    agent: str | Path = "force",
) -> Episode:
    """Close one body on the scene with number ``k``, on finite elements, under a baseline or the file of a policy."""
    scene = scenes[k]
    options = {**environment.robot_options, "object": scene.kind, "mesh_size": mesh}
    own = environment.on("fem").model_copy(update={"robot_options": options, "design": None})
    try:
        found = evaluate(agent, own, np.array([[scene.force, 0.0, 0.0]]), design={**design, **scene.place})
    except (InfeasibleDesign, ConvergenceError):
        return Episode(body, mesh, k, False, 0.0, False, 1.0, 0.0)
    values = float(found.returns[0]), bool(found.successes[0]), float(found.distances[0])
    return Episode(body, mesh, k, True, *values, round(found.cpu_seconds, 2))


def compare(
    environment: EnvironmentConfig,
    bodies: Mapping[str, Mapping[str, float]],
    scenes: Sequence[Scene],
    meshes: Sequence[float],
    folder: Path,
    agents: Mapping[str, str | Path] | None = None,
) -> list[Episode]:
    """Return the episodes of all bodies, those of a mesh together; each is kept in a folder.

    Args:
        environment: Finger Grasp.
        bodies: designs by name, without the variables of the scene.
        scenes: what they close on.
        meshes: target edge lengths [m].
        folder: where episodes are kept, and taken from if they are there.
        agents: what closes each body, by its name; control of the force where it is missing.
    """
    episodes = []
    for mesh in meshes:
        for k in range(len(scenes)):
            for body, design in bodies.items():
                path = folder / f"{body}_{1e3 * mesh:g}mm_scene{k}.json"
                if not path.exists():
                    write_json(
                        path,
                        asdict(close(environment, body, design, scenes, k, mesh, (agents or {}).get(body, "force"))),
                    )
                    print(path.read_text(), file=sys.stderr, flush=True)
                episodes.append(Episode(**json.loads(path.read_text())))
    return episodes


def table_of(episodes: Sequence[Episode], body: str, column: str) -> np.ndarray:
    """Return one column of a body's episodes, shape (meshes, scenes).

    Raises:
        DataError: if the meshes have different numbers of scenes.
    """
    found: dict[float, list[float]] = {}
    for episode in episodes:
        if episode.body == body:
            found.setdefault(episode.mesh, []).append(float(getattr(episode, column)))
    if len({len(row) for row in found.values()}) != 1:
        raise DataError(f"body '{body}' has {[len(row) for row in found.values()]} scenes on its meshes")
    return np.array(list(found.values()))


def difference(episodes: Sequence[Episode], column: str) -> Estimate:
    """Interquartile mean of found body less baseline, and its 95 % interval over meshes and scenes."""
    return crossed_estimate(table_of(episodes, FOUND, column) - table_of(episodes, BASELINE, column))


def recorded() -> dict[str, Any]:
    """Return the recorded comparison.

    Raises:
        DataError: if there is none.
    """
    if not KEPT.is_file():
        raise DataError(f"'{KEPT}' does not exist; make it with 'python -m benchmarks.grasp_codesign FOLDER'")
    return json.loads(KEPT.read_text())


def grasp_codesign() -> dict[str, Any]:
    """Numbers of the recorded comparison, by name."""
    kept = recorded()
    episodes = [Episode(**row) for row in kept["episodes"]]
    found: dict[str, Any] = {"bodies of the study": kept["trials"], "scenes": len(kept["scenes"])}
    for column, label in (("total", "return"), ("success", "success")):
        change = difference(episodes, column)
        found[f"{label}: change, low, high"] = [change.value, change.low, change.high]
    found["not simulated"] = sum(not episode.simulated for episode in episodes)
    return found | {f"{FOUND}: {name} [mm]": 1e3 * value for name, value in kept["bodies"][FOUND].items()}


def grasp_codesign_table() -> str:
    """Mean return, reached forces and median error of both bodies on each mesh, and the change of the return."""
    episodes = [Episode(**row) for row in recorded()["episodes"]]
    rows = []
    for mesh in dict.fromkeys(episode.mesh for episode in episodes):
        own = [episode for episode in episodes if episode.mesh == mesh]
        cells = [f"{1e3 * mesh:g} mm"]
        for body in (BASELINE, FOUND):
            cells.append(f"{table_of(own, body, 'total').mean():.1f}")
            reached = table_of(own, body, "success")
            cells.append(f"{int(reached.sum())} of {reached.size}")
            cells.append(f"{100.0 * np.median(table_of(own, body, 'error')):.1f}")
        rows.append([*cells, _text(difference(own, "total"))])
    rows.append(["all", *[""] * 6, _text(difference(episodes, "total"))])
    head = ["mesh"]
    for body in (BASELINE, FOUND):
        head += [f"{body}: return", "forces reached", "median error [%]"]
    return markdown([*head, "change of the return (95 %)"], rows, "lrrrrrrr")


def _text(change: Estimate) -> str:
    return f"{change.value:+.1f} ({change.low:.1f} to {change.high:.1f})"


def scenes_table() -> str:
    """The scenes, and on how many meshes each body reaches the wanted force."""
    kept = recorded()
    episodes = [Episode(**row) for row in kept["episodes"]]
    reached = [table_of(episodes, body, "success") for body in (BASELINE, FOUND)]
    rows = []
    for k, scene in enumerate(kept["scenes"]):
        place = scene["place"]
        cells = [f"{1e3 * place[name]:.0f}" if name in place else "" for name in ("object_size", "object_height")]
        counts = [f"{int(table[:, k].sum())} of {len(table)}" for table in reached]
        gap, friction = f"{1e3 * place['object_gap']:.1f}", f"{place['friction']:.2f}"
        rows.append([scene["kind"].replace("_", " "), gap, *cells, friction, f"{scene['force']:.2f}", *counts])
    head = ["object", "gap [mm]", "size [mm]", "height [mm]", "friction", "wanted force [N]"]
    return markdown([*head, f"{BASELINE}: meshes", f"{FOUND}: meshes"], rows, "lrrrrrrr")


TABLES = {"grasp_codesign": grasp_codesign_table, "grasp_codesign_scenes": scenes_table}
"""Tables of pages by name."""


@click.command()
@click.argument("folder", type=click.Path(exists=True, path_type=Path))
@click.option("--scenes", default=8, show_default=True, help="Number of scenes.")
@click.option("--meshes", default=MESHES, multiple=True, type=float, show_default=True, help="Edge lengths [m].")
def main(folder: Path, scenes: int, meshes: tuple[float, ...]) -> None:
    """Compare the best body of a study with its baseline."""
    from softgym_envs.codesign.snapshot import load_study

    origin = provenance()
    study = load_study(folder)
    config, best = study.config, study.best
    if best is None:
        raise click.ClickException(f"the study in '{folder}' has no feasible body yet")
    bodies = {
        BASELINE: {name: config.baseline[name] for name in config.variables},
        FOUND: {name: best.design[name] for name in config.variables},
    }
    low, high = config.environment.task_options["forces"]
    drawn = draw_scenes(scenes, (low, high))
    episodes = compare(config.environment, bodies, drawn, meshes, folder / "judged")
    write_json(
        KEPT,
        {
            "trials": len(study.trials),
            "trial": best.number,
            "bodies": bodies,
            "scenes": [asdict(scene) for scene in drawn],
            "episodes": [asdict(episode) for episode in episodes],
            "provenance": origin,
        },
    )


if __name__ == "__main__":
    main()
