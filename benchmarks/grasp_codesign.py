"""Co-designed finger and its force control against design A, on objects and frictions that the study did not see.

    softgym codesign --config configs/codesign/finger_grasp.yaml --folder results/finger_grasp
    python -m benchmarks.grasp_codesign results/finger_grasp

Both bodies close on the same random objects under the same control of the force. One JSON object is printed: the
episodes, and for each score the mean over all scenes and meshes and the difference, with a 95 % interval that resamples
scenes and meshes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import click
import numpy as np

from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.agents.evaluation import evaluate
from softgym_envs.agents.statistics import crossed_estimate
from softgym_envs.codesign.snapshot import load_study
from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.robots.grasping import KINDS

SEED = 3_000_017
"""Seed of scenes, which no study uses."""

MESHES = (0.020, 0.012)
"""Target edge lengths of quadratic meshes [m]: that of the study and a finer one."""


@dataclass(frozen=True)
class Scene:
    """An object in front of the finger, and the wanted force along x [N]."""

    kind: str
    place: Mapping[str, float]
    force: float


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


def score(
    environment: EnvironmentConfig, design: Mapping[str, float], scene: Scene, mesh_size: float
) -> tuple[float, float]:
    """Return the return and the success of one episode; zeros if the body cannot be simulated there."""
    options = {**environment.robot_options, "object": scene.kind, "mesh_size": mesh_size}
    own = environment.model_copy(update={"robot_options": options, "design": None})
    try:
        found = evaluate("force", own, np.array([[scene.force, 0.0, 0.0]]), design={**design, **scene.place})
    except (InfeasibleDesign, ConvergenceError):
        return 0.0, 0.0
    return float(found.returns[0]), float(found.successes[0])


def compare(
    environment: EnvironmentConfig,
    bodies: Mapping[str, Mapping[str, float]],
    scenes: Sequence[Scene],
    meshes: Sequence[float] = MESHES,
) -> dict[str, Any]:
    """Return scores of bodies, ``{body: {score: [[value per scene] per mesh]}}``, and the differences of the last two.

    Args:
        environment: Finger Grasp.
        bodies: designs by name, without the variables of the scene.
        scenes: what they close on.
        meshes: target edge lengths [m].
    """
    scores = {
        name: np.array([[score(environment, design, scene, mesh) for scene in scenes] for mesh in meshes])
        for name, design in bodies.items()
    }
    first, second = (scores[name] for name in list(bodies)[-2:])
    estimates = {}
    for k, label in enumerate(("return", "success")):
        found = crossed_estimate((second - first)[..., k])
        estimates[label] = {"difference": found.value, "low": found.low, "high": found.high}
    return {
        "episodes": {name: {"return": s[..., 0].tolist(), "success": s[..., 1].tolist()} for name, s in scores.items()},
        "means": {name: {"return": s[..., 0].mean(), "success": s[..., 1].mean()} for name, s in scores.items()},
        "differences": estimates,
    }


@click.command()
@click.argument("folder", type=click.Path(exists=True))
@click.option("--scenes", default=8, show_default=True, help="Number of scenes.")
@click.option("--meshes", default=MESHES, multiple=True, type=float, show_default=True, help="Edge lengths [m].")
def main(folder: str, scenes: int, meshes: tuple[float, ...]) -> None:
    """Compare the best body of a study with its baseline."""
    study = load_study(folder)
    config = study.config
    best = study.best
    if best is None:
        raise click.ClickException(f"the study in '{folder}' has no feasible body yet")
    shape = config.variables
    bodies = {
        "A": {name: config.baseline[name] for name in shape},
        "co-designed": {name: best.design[name] for name in shape},
    }
    low, high = config.environment.task_options["forces"]
    found = compare(config.environment, bodies, draw_scenes(scenes, (low, high)), meshes)
    print(json.dumps({"trial": best.number, "bodies": bodies, **found}))


if __name__ == "__main__":
    main()
