"""One step from design B of the contact-aided finger towards more force, from the sensitivities.

    softgym sensitivity --config configs/design/contact_aided_finger_sensitivity.yaml --folder FOLDER
    python -m benchmarks.zigzag_step FOLDER

Each variable that alone raises the contact force by at least 4 % goes to its better end, all together. The design is
evaluated beside B on the published and on the accurate mesh, and one JSON object is printed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from benchmarks.zigzag_designs import DESIGNS
from benchmarks.zigzag_study import MESHES, evaluate_all
from softgym_envs.codesign.tools.config import SensitivityConfig
from softgym_envs.config import load_config, provenance
from softgym_envs.storage import JsonLines

LEAST_GAIN = 0.04
"""Relative gain of force from which on a variable is changed; smaller ones are of the size of remeshing noise."""


def step(
    design: Mapping[str, float], bounds: Mapping[str, Sequence[float]], forces: Sequence[float]
) -> dict[str, float]:
    """Return the design with the variables at their better ends that raise the force alone by `LEAST_GAIN`.

    Args:
        design: the middle.
        bounds: both ends of each variable, in the order of the evaluations.
        forces: contact forces of the middle, and of the lower and the upper end of each variable [N], shape (1 + 2 n,).
    """
    middle, *ends = forces
    chosen = {}
    for name, limits, pair in zip(bounds, bounds.values(), zip(ends[::2], ends[1::2], strict=True), strict=True):
        if max(pair) >= (1.0 + LEAST_GAIN) * middle:
            chosen[name] = limits[int(pair[1] > pair[0])]
    return {**design, **chosen}


@click.command(help=__doc__)
@click.argument("folder", type=click.Path(path_type=Path, exists=True, file_okay=False))
def main(folder: Path) -> None:
    """Take the step and evaluate it."""
    config = load_config(folder / "config.yaml", SensitivityConfig)
    rows: list[dict[str, Any]] = JsonLines(folder / "evaluations.jsonl").read()
    forces = [row["metrics"]["grip_force"] for row in rows]
    bodies = config.bodies
    bounds = {name: bodies.bounds[name] for name in bodies.variables}
    design = step(bodies.design, bounds, forces)
    values = evaluate_all({"B": DESIGNS["B"], "step": design}, folder / "step.jsonl")
    output: dict[str, Any] = {"changed [m]": {k: v for k, v in design.items() if v != bodies.design[k]}}
    for mesh in MESHES:
        for value in values:
            if value.mesh == mesh:
                output[f"{value.design}, {mesh}: force, resistance, energy"] = [
                    value.force,
                    value.resistance,
                    value.energy,
                ]
    click.echo(json.dumps({**provenance(), "results": output}))


if __name__ == "__main__":
    main()
