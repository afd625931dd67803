"""The strongest finger of the search over several objects, on its mesh and on a finer one.

    softgym optimise --config configs/design/contact_aided_finger_robust.yaml --folder FOLDER
    python -m benchmarks.zigzag_robust FOLDER

prints, as one JSON object, mean force [N], energy [N m] and resistance [m] over the objects of the search for the
fingers it started from and for its strongest one, on quadratic meshes of 20 and of 12 mm.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from pathlib import Path

import numpy as np

from softgym_envs.codesign.tools.config import OptimiseConfig
from softgym_envs.config import load_config

CONFIG = Path(__file__).parent.parent / "configs" / "design" / "contact_aided_finger_robust.yaml"
OBJECTIVES = ("grip_force", "grip_energy", "grip_resistance")
STARTS = ("A", "B", "203", "step", "best force")
FINER = ("B", "step", "robust")
"""Fingers that are evaluated on the finer mesh."""


def compare(folder: Path) -> dict[str, list[float]]:
    """Return the means of each finger, by its name and the mesh."""
    rows = [row for row in csv.DictReader((folder / "trials.csv").open()) if row["grip_force"]]
    fingers = dict(zip(STARTS, rows, strict=False)) | {"robust": max(rows, key=lambda row: float(row["grip_force"]))}
    means = {name: [float(row[key]) for key in OBJECTIVES] for name, row in fingers.items()}
    finer = load_config(CONFIG, OptimiseConfig, ("bodies.robot_options.mesh_size=0.012",)).bodies
    space = finer.make_robot().design_space
    evaluate = finer.evaluator(OBJECTIVES)
    for name in FINER:
        design = {variable: float(fingers[name][variable]) for variable in finer.box().names}
        found = evaluate(space.complete(design))
        means[f"{name}, finer mesh"] = [found[key] for key in OBJECTIVES]
        print(name, design, means[f"{name}, finer mesh"], file=sys.stderr)
    return {f"{name}: force [N], energy [N m], resistance [m]": np.round(v, 5).tolist() for name, v in means.items()}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of the finished search")
    json.dump(compare(parser.parse_args().folder), sys.stdout, indent=2)
