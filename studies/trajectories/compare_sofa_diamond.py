"""Compare the rest compliance of the Diamond with the one that SOFA computed on the same mesh.

The mesh comes from the SoftRobots plugin of SOFA (LGPL) and is not part of this project: pass the folder that holds
``diamond_mesh.npz`` and ``diamond_W.json``.

    python -m benchmarks.compare_sofa_diamond FOLDER

At rest, without tension, SOFA's tangent is complete, so both compliances should agree. One row differs: the anchor of
the north cable lies outside the mesh and is extrapolated from one element. This project takes the nearest element,
SOFA another one; with SOFA's element that row agrees as well.
"""

from __future__ import annotations

import json
from pathlib import Path

import click
import numpy as np

from softgym_envs.errors import DataError
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.storage import read_npz

CABLES = ("north", "west", "south", "east")


def build_diamond(mesh: dict[str, np.ndarray], *, same_elements: bool) -> MechanicalModel:
    """Return the Diamond: E 180 kPa, nu 0.45, no mass, four cables that may push, the effector at the top.

    Args:
        mesh: arrays of ``diamond_mesh.npz``, in mm.
        same_elements: extrapolate cable anchors outside the mesh from the elements that SOFA chose instead of the
            nearest ones.
    """
    model = MechanicalModel.from_mesh(
        mesh["nodes"] * 1e-3,
        mesh["tets"],
        fixed=mesh["fixed"],
        material="corotational",
        young_modulus=180e3,
        poisson_ratio=0.45,
    )
    corners = np.sort(mesh["tets"], axis=1)
    for name in CABLES:
        pull_point, anchor = mesh[f"cable_{name}"] * 1e-3
        hint = None
        if same_elements:
            hint = np.flatnonzero((corners == np.sort(mesh[f"map_nodes_{name}"][0])).all(axis=1))
        model.add_cable(name, anchor[None], pull_point, unilateral=False, hint=hint)
    model.add_effector("tip", mesh["tip_point"] * 1e-3)
    return model


def compare(folder: str | Path) -> dict[str, dict[str, float]]:
    """Return the largest difference in each row of W at rest, relative to its largest entry, by choice of elements.

    Raises:
        DataError: if a file is missing or damaged.
    """
    folder = Path(folder)
    names = ["nodes", "tets", "fixed", "tip_point"]
    names += [f"{kind}_{name}" for kind in ("cable", "map_nodes", "map_w") for name in CABLES]
    mesh = read_npz(folder / "diamond_mesh.npz", tuple(names))
    try:
        reference = json.loads((folder / "diamond_W.json").read_text())
        rows = reference["rows"]
        rest = next(s for s in reference["states"] if not any(s["gravity"]) and not any(s["displacement"]))
    except (OSError, ValueError, KeyError, StopIteration) as error:
        raise DataError(f"'{folder / 'diamond_W.json'}' cannot be read: {error}") from error
    # Rows there: tip, then cables; here actuators come first. mm/mN and m/N are the same number.
    expected = np.array(rest["W"])
    order = [rows.index(name) for name in (*CABLES, "tip_x", "tip_y", "tip_z")]
    expected = expected[np.ix_(order, order)]
    result = {}
    for label, same in (("nearest elements", False), ("SOFA's elements", True)):
        model = build_diamond(mesh, same_elements=same)
        W = Statics(model).solve(np.zeros(len(CABLES)), "effort").condensed.compliance
        difference = np.abs(W - expected).max(axis=1) / np.abs(expected).max(axis=1)
        result[label] = {rows[k]: float(d) for k, d in zip(order, difference, strict=True)}
        for cable in model.constraints["a"]:
            weights = cable.embedding.weights[0]  # type: ignore[attr-defined]
            click.echo(
                f"{label:16s}  {cable.name:5s}  anchor in element {cable.embedding.elements[0]:4d}, "  # type: ignore[attr-defined]
                f"weights {np.round(weights, 3)}, the mesh file's {np.round(mesh[f'map_w_{cable.name}'][0], 3)}"
            )
    return result


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
def main(folder: Path) -> None:
    """Print the largest relative difference of each row of W at rest."""
    result = compare(folder)
    click.echo("\nlargest difference of a row of W at rest, relative to the row's largest entry")
    click.echo(f"{'row':8s}" + "".join(f"{label:>20s}" for label in result))
    for row in next(iter(result.values())):
        click.echo(f"{row:8s}" + "".join(f"{result[label][row]:20.1e}" for label in result))
    click.echo(
        "\nThe anchor of the north cable lies outside the mesh. Here it is extrapolated from the nearest element, the "
        "one\nwhere its smallest barycentric coordinate is largest; SOFA took another one. That choice, not the "
        "mechanics,\nis the difference of the north row, and of the entries of other rows in the north column."
    )


if __name__ == "__main__":
    main()
