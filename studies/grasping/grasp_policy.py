"""Co-designed finger and its closing policy against design A, on objects and frictions that the study did not see.

    softgym codesign --config configs/codesign/finger_grasp_policy.yaml --folder F
    python -m benchmarks.grasp_policy F

Both bodies close on the same random objects by finite elements, each with the policy that the study trained for it. For
A, control of the force is tried as well, and the better of the two counts, so that the comparison is fair to it.
Episodes are kept in the folder, so a second call resumes the first. Prints one JSON object.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from benchmarks.grasp_codesign import BASELINE, FOUND, Episode, compare, difference, draw_scenes, table_of

POLICY, FORCE = "own policy", "force control"
MESHES = (0.020, 0.012)


def fairest(episodes: Sequence[Episode]) -> tuple[str, list[Episode]]:
    """Return which controller of A has the larger mean return, and the episodes of both bodies with that one for A."""
    means = {name: float(table_of(episodes, f"{BASELINE}, {name}", "total").mean()) for name in (POLICY, FORCE)}
    best = max(means, key=lambda name: means[name])
    names = {f"{BASELINE}, {best}": BASELINE, f"{FOUND}, {POLICY}": FOUND}
    return best, [replace(each, body=names[each.body]) for each in episodes if each.body in names]


def summary(episodes: Sequence[Episode]) -> dict[str, Any]:
    """Return the mean return and the share of reached forces of every pair, and the change against the better A."""
    best, fair = fairest(episodes)
    found: dict[str, Any] = {"controller of A": best}
    for body in dict.fromkeys(each.body for each in episodes):
        for column in ("total", "success"):
            found[f"{body}: {column}"] = table_of(episodes, body, column).mean(axis=1).tolist()
    for column in ("total", "success"):
        change = difference(fair, column)
        found[f"change of {column}, low, high"] = [change.value, change.low, change.high]
    return found


@click.command(help=__doc__)
@click.argument("folder", type=click.Path(exists=True, path_type=Path))
@click.option("--scenes", default=8, show_default=True, help="Number of scenes.")
@click.option("--meshes", default=MESHES, multiple=True, type=float, show_default=True, help="Edge lengths [m].")
def main(folder: Path, scenes: int, meshes: tuple[float, ...]) -> None:
    """Compare the best body of a study and its policy with its baseline."""
    from softgym_envs.codesign.snapshot import load_study

    study = load_study(folder)
    config, best = study.config, study.best
    baseline = next((trial for trial in study.trials if trial.origin == "baseline"), None)
    if best is None or baseline is None:
        raise click.ClickException(f"the study in '{folder}' has no feasible body, or no baseline, yet")
    trials = {f"{BASELINE}, {POLICY}": baseline, f"{FOUND}, {POLICY}": best}
    bodies = {name: {each: trial.design[each] for each in config.variables} for name, trial in trials.items()}
    agents: dict[str, str | Path] = {name: folder / trial.controller for name, trial in trials.items()}
    bodies[f"{BASELINE}, {FORCE}"] = bodies[f"{BASELINE}, {POLICY}"]
    low, high = config.environment.task_options["forces"]
    drawn = draw_scenes(scenes, (low, high))
    episodes = compare(config.environment, bodies, drawn, meshes, folder / "judged", agents)
    click.echo(json.dumps(summary(episodes), indent=1))


if __name__ == "__main__":
    main()
