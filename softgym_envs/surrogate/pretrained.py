"""Weights that ship with the package, each made by ``softgym fit --config configs/surrogate/<variant>.yaml``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from softgym_envs.errors import WeightsError
from softgym_envs.robots.robot import Robot
from softgym_envs.surrogate.model import SurrogateModel, load_model

__all__ = ["family_goals", "pretrained_folder", "pretrained_model"]

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


def family_goals(robot: Robot, count: int, seed: int, command_low: float = 0.0) -> np.ndarray:
    """Effector positions [m] (count, 3) of random bodies of the family under random commands.

    They belong to no body, so they compare bodies fairly.

    Args:
        robot: the robot.
        count: number of goals.
        seed: random seed.
        command_low: smallest command, as a fraction of the actuator range.
    """
    from softgym_envs.backends.surrogate import settle

    rng = np.random.default_rng(seed)
    model = pretrained_model(robot)
    space = robot.design_space
    designs = np.array([list(space.sample(rng).values()) for _ in range(count)])
    low = robot.lower + command_low * (robot.upper - robot.lower)
    commands = rng.uniform(low, robot.upper, (count, len(robot.actuators)))
    context = model.context(designs)
    unilateral = np.array([actuator.unilateral for actuator in robot.actuators])
    return settle(model, context, commands, np.zeros_like(commands), unilateral).effector
