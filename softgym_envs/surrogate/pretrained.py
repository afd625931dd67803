"""Weights that ship with a robot: in the folder ``weights`` beside the file of its class, or in that of the suite.

Those of the suite were made by ``softgym fit --config <weights name>``.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from softgym_envs.errors import WeightsError
from softgym_envs.robots.base import CONTACT_DEFAULTS, Robot
from softgym_envs.robots.registry import ROBOTS
from softgym_envs.surrogate.identity import class_of
from softgym_envs.surrogate.model import SurrogateModel
from softgym_envs.surrogate.weight_files import load_model

_SUITE = Path(__file__).parent / "weights"


def pretrained_folder(robot: Robot) -> Path:
    """Return the folder of a robot's shipped weights; its name ends in that of the mesh unless it is the published."""
    mesh = robot.mechanics_key.get("mesh")
    name = robot.learning.weights if mesh is None else f"{robot.learning.weights}_{mesh}"
    folders = [folder / name for folder in _folders(cls.__module__ for cls in type(robot).__mro__[:-1])]
    return next((folder for folder in folders if folder.is_dir()), folders[-1])


def _folders(modules: Iterable[str]) -> list[Path]:
    """Return the folders in which weights of robots may be: beside the files of modules, then those of the suite."""
    found: dict[Path, None] = {}
    for module in modules:
        spec = sys.modules[module].__spec__ if module in sys.modules else find_spec(module)
        if spec is not None and spec.origin is not None:  # a class of an interactive session has no file
            found[Path(spec.origin).parent / "weights"] = None
    return [*found, _SUITE]


def ships_weights(robot: Robot) -> bool:
    """Return whether weights ship for a robot, with the contact that it has.

    A robot may touch itself without friction if its weights were trained so. Obstacles are never part of them.
    """
    key = robot.mechanics_key
    return _ships_for_class(robot) and _contact_of(_card(pretrained_folder(robot))["mechanics_key"]) == _contact_of(key)


def _ships_for_class(robot: Robot) -> bool:
    """Return whether weights ship for the very class of a robot: a subclass may be another body under the same name."""
    folder = pretrained_folder(robot)
    if not folder.is_dir():
        return False
    card = _card(folder)
    return card["robot"] == robot.name and card.get("class", card["robot"]) == class_of(robot)


def _card(folder: Path) -> dict[str, Any]:
    card: dict[str, Any] = json.loads((folder / "model.json").read_text())
    return card


def _contact_of(key: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of contact in a key; none for a robot that touches nothing, whatever its other options."""
    found = {name: key[name] for name in CONTACT_DEFAULTS if name in key}
    return found if found.get("obstacles") or found.get("self_contact") else {}


def pretrained_model(robot: Robot, weights: str | Path | None = None, members: int | None = None) -> SurrogateModel:
    """Return the learned model of a robot, from a folder or from the shipped weights.

    Args:
        robot: the robot.
        weights: folder of weights; default the shipped ones.
        members: how many members of the ensemble to use, fewer for speed; default all.

    Raises:
        WeightsError: if there are no weights, or they are damaged or for another robot.
    """
    if weights is None and _ships_for_class(robot) and not ships_weights(robot):
        known = _contact_of(_card(pretrained_folder(robot))["mechanics_key"])
        raise WeightsError(
            f"the shipped weights of '{robot.learning.weights}' know {'self_contact' if known else 'no contact'}"
            f"{' without obstacles' if known else ''}: use backend='fem' for a robot with other contact"
        )
    folder = Path(weights) if weights is not None else pretrained_folder(robot)
    if weights is None and not folder.is_dir():
        shipped = list(shipped_robots())
        if robot.may_touch:
            raise WeightsError(f"no weights ship for '{folder.name}', which touches something: use backend='fem'")
        raise WeightsError(
            f"no weights ship for '{folder.name}': use backend='fem', or fit weights with 'softgym fit' and pass "
            f"backend_options={{'weights': folder}} (or --weights); shipped: {', '.join(shipped) or 'none'}"
        )
    return load_model(folder, robot, members)


def standalone_model(robot: Robot, weights: str | Path | None = None, members: int | None = None) -> SurrogateModel:
    """Return the learned model of a robot that runs on it alone, see `pretrained_model`.

    Raises:
        WeightsError: also for actuators with a largest effort, which learned models do not know.
    """
    if limited := robot.effort_limited:
        kept = weights is not None or ships_weights(robot)
        hybrid = "'hybrid'" if kept else "'hybrid' with weights of 'softgym fit'"
        raise WeightsError(
            f"robot '{robot.name}': a surrogate drives actuators beyond their max_effort ({', '.join(limited)}); use "
            f"backend='fem' or {hybrid}"
        )
    return pretrained_model(robot, weights, members)


def shipped_robots() -> dict[str, tuple[str, dict[str, Any]]]:
    """Return the names of all shipped weights, with the robot and the options they were trained for."""
    found = {}
    for folder in _folders(ROBOTS.place(name).partition(":")[0] for name in ROBOTS):
        for card in folder.glob("*/model.json"):
            config = json.loads(card.read_text()).get("config")  # none for weights that no configuration made
            if config is not None:
                found[card.parent.name] = (config["robot"], config["robot_options"])
    return dict(sorted(found.items()))
