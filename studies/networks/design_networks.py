"""The thesis' network and ours over the lengths of the Soft Finger (thesis, sec. 4.5.2, table 4.2 and 4.3).

    python -m benchmarks.design_networks results/design_networks

solves the states on FEM, trains the network of the thesis (5 x 800 ReLU, dropout, learning rate reduced on plateaus)
and one member of ours on them, and writes ``benchmarks/data/design_networks.json``; ``softgym bench design_networks``
shows that file. Finished parts are not computed again.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from benchmarks.accuracy import CONFIGS, GEOMETRIES, closing_error
from benchmarks.networks import standardised_loss
from softgym_envs.config import load_config, provenance
from softgym_envs.storage import write_json

KEPT = Path(__file__).parent / "data" / "design_networks.json"

NETWORKS = {
    "thesis, 5 x 800": "finger_1cable_dimensions_thesis.yaml",
    "potential, one member": "finger_1cable_dimensions.yaml",
}
"""Name of each network and its configuration."""


def main(folder: Path) -> None:
    """Train and test both networks."""
    from softgym_envs.robots.registry import make_robot
    from softgym_envs.surrogate.training import FitConfig, fit, generate_datasets
    from softgym_envs.surrogate.weight_files import load_model

    rows = []
    for name, file in NETWORKS.items():
        config = load_config(CONFIGS / file, FitConfig)
        data = generate_datasets(config, folder / "data")
        weights = folder / file.removesuffix(".yaml")
        start = time.process_time()
        errors = fit(config, weights, folder / "data")
        robot = make_robot(config.robot, **config.robot_options)
        model = load_model(weights, robot)
        row = {
            "network": name,
            **errors,
            "training states": model.card["states"]["train"],
            "training, CPU [s]": round(time.process_time() - start, 1),
            "loss as in the thesis": standardised_loss(model, data["train"], data["test"]),
            "best validation loss": model.card["best_validation"],
        }
        for *lengths, published in GEOMETRIES:
            design = dict(zip(("length", "height", "joint_height"), (1e-3 * x for x in lengths), strict=True))
            row[f"trajectory {lengths} (thesis {published}) [%]"] = closing_error(robot, design, str(weights))[0]
        rows.append(row)
    write_json(KEPT, {**provenance(), "runs": rows})


def design_networks() -> dict[str, object]:
    """Networks over the lengths of the finger: errors on unseen bodies, and of the closing trajectory."""
    return {
        f"{row['network']}: {key}": value for row in json.loads(KEPT.read_text())["runs"] for key, value in row.items()
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("results/design_networks"))
    main(parser.parse_args().folder)
