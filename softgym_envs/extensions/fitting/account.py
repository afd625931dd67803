"""What a fit of a robot says besides its errors: states kept and lost, and where its model can be trusted."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.extensions.fitting.data.sampling import Lost
from softgym_envs.extensions.fitting.kinds import FitKind
from softgym_envs.extensions.fitting.training import FitConfig, describe_datasets, fit
from softgym_envs.mechanics.condensation import effort_unit
from softgym_envs.robots.base import Robot
from softgym_envs.robots.registry import make_robot
from softgym_envs.storage import read_json
from softgym_envs.wording import counted


def account(robot: Robot, card: Mapping[str, Any]) -> list[str]:
    """Return what a fit did, in sentences: states kept and lost, and where its model can be trusted.

    Args:
        robot: the robot.
        card: of the weights.
    """
    lines = []
    for split, states in card["states"].items():
        left = Lost(*card.get("lost", {}).get(split, ()))
        kinds = (
            (left.bodies, "body", "that cannot be built or held"),
            (left.commands, "command", "without an equilibrium"),
            (left.states, "state", "outside the ranges of the actuators"),
            (card["unstable_states_left_out"][split], "state", "too unstable to learn"),
        )
        parts = [f"{counted(n, name)} {why}" for n, name, why in kinds if n]
        lines.append(f"{split}: {counted(states, 'state')}; lost: {', '.join(parts) or 'nothing'}")
    found = card.get("trusted")
    if found is None:
        return lines
    shares = np.array(found["effort"]) / robot.effort_scale
    if (most := float(shares.max())) > 10.0:
        actuator, largest = robot.actuators[int(shares.argmax())], found["effort"][int(shares.argmax())]
        lines.append(
            f"'{actuator.name}' needs up to {largest:.3g} {effort_unit(actuator.unit)}, {most:.0f} times its "
            "effort_scale: do actuators fight each other? (`Robot.antagonists`, `softgym check`)"
        )
    tested = counted(int(card["test"]["states"]), "test state")
    text = f"It can be trusted on {found['share']:.0%} of {tested} of new bodies"
    if found["effector_p95"] is not None:
        text += f", where 95 % of the errors of the effector are below {1e3 * found['effector_p95']:.2g} mm"
    if found["elsewhere_p95"] is not None:
        text += f"; elsewhere below {1e3 * found['elsewhere_p95']:.2g} mm"
    lines.append(text + ".")
    if reasons := ", ".join(f"{reason} {share:.0%}" for reason, share in found["reasons"].items()):
        lines.append(f"Not trusted because of: {reasons}.")
    if found["share"] < 0.5:
        lines.append("Take more bodies (data.train.groups), narrower ranges, or fewer variables (data.vary).")
    return lines


def _account(config: FitConfig, folder: Path) -> list[str]:
    units = "errors of the effector are in metres, all others are shares (1 is 100%)"
    robot = make_robot(config.robot, **config.robot_options)
    return [units, *account(robot, read_json(folder / "model.json"))]


KIND = FitKind(FitConfig, describe_datasets, fit, _account)
