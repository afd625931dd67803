"""Weights shipped with the package, each made by ``softgym fit --config configs/surrogate/<weights name>.yaml``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from softgym_envs.errors import WeightsError
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.model import SurrogateModel
from softgym_envs.surrogate.weight_files import load_model

_ROOT = Path(__file__).parent / "weights"


def pretrained_folder(robot: Robot) -> Path:
    """Return the folder of a robot's shipped weights; its name ends in that of the mesh unless it is the published."""
    mesh = robot.mechanics_key.get("mesh")
    return _ROOT / (robot.weights_name if mesh is None else f"{robot.weights_name}_{mesh}")


def pretrained_model(robot: Robot, weights: str | Path | None = None, members: int | None = None) -> SurrogateModel:
    """Return the learned model of a robot, from a folder or from the shipped weights.

    Args:
        robot: the robot.
        weights: folder of weights; default the shipped ones.
        members: how many members of the ensemble to use, fewer for speed; default all.

    Raises:
        WeightsError: if there are no weights, or they are damaged or for another robot.
    """
    if weights is None and robot.touches:
        raise WeightsError(
            f"the shipped weights of '{robot.weights_name}' know no contact: use backend='fem' for a robot with "
            "obstacles or self_contact"
        )
    folder = Path(weights) if weights is not None else pretrained_folder(robot)
    if weights is None and not folder.is_dir():
        shipped = sorted(p.name for p in _ROOT.iterdir()) if _ROOT.is_dir() else []
        raise WeightsError(f"no weights ship for '{folder.name}'; shipped: {', '.join(shipped) or 'none'}")
    return load_model(folder, robot, members)


def shipped_robots() -> dict[str, tuple[str, dict[str, Any]]]:
    """Return the names of all shipped weights, with the robot and the options they were trained for."""
    found = {}
    for card in sorted(_ROOT.glob("*/model.json")):
        config = json.loads(card.read_text())["config"]
        found[card.parent.name] = (config["robot"], config["robot_options"])
    return found
