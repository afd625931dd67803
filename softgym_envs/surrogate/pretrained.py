"""Weights that ship with the package, each made by ``softgym fit --config configs/surrogate/<variant>.yaml``."""

from __future__ import annotations

from pathlib import Path

from softgym_envs.errors import WeightsError
from softgym_envs.robots.robot import Robot
from softgym_envs.surrogate.model import SurrogateModel, load_model

__all__ = ["pretrained_folder", "pretrained_model"]

_ROOT = Path(__file__).parent / "weights"


def pretrained_folder(robot: Robot) -> Path:
    """Folder of the shipped weights of a robot."""
    return _ROOT / robot.variant


def pretrained_model(robot: Robot, weights: str | Path | None = None) -> SurrogateModel:
    """Return the model of a robot, from a folder or from the shipped weights.

    Raises:
        WeightsError: if there are none, or they are damaged or for another robot.
    """
    folder = Path(weights) if weights is not None else pretrained_folder(robot)
    if weights is None and not folder.is_dir():
        shipped = sorted(p.name for p in _ROOT.iterdir()) if _ROOT.is_dir() else []
        raise WeightsError(f"no weights ship for '{robot.variant}'; shipped: {', '.join(shipped) or 'none'}")
    return load_model(folder, robot)
