"""Which robot weights were trained for: its class, and a few numbers of bodies that it builds."""

from __future__ import annotations

from typing import Any

import numpy as np

from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.registry import class_path
from softgym_envs.robots.base import Robot
from softgym_envs.robots.registry import ROBOTS

TOLERANCE = 1e-3
"""Largest difference between numbers of the same body, relative to the largest of their kind."""


def class_of(robot: Robot) -> str:
    """Return the registered name of a robot's class, or the place ``"module:class"`` of one that is not registered.

    A subclass of a registered class is another robot, also if it keeps the name.
    """
    cls = type(robot)
    if robot.name in ROBOTS and ROBOTS[robot.name] is cls:
        return robot.name
    try:
        return class_path(cls)
    except ValueError:  # one that other processes cannot import
        return f"{cls.__module__}:{cls.__qualname__}"


def is_shipped(robot: Robot) -> bool:
    """Return whether a robot's class is part of the suite, whose weights and classes are tested together."""
    return type(robot).__module__.startswith("softgym_envs.")


def fingerprint(robot: Robot) -> dict[str, Any]:
    """Return numbers of two bodies of a robot by which a change of its code or files is noticed.

    For the baseline and one other body: kinds of parts, mass, volume, where actuators and effectors are, and the
    compliance at rest.
    """
    space = robot.design_space
    other = space.from_unit(np.resize([0.3, -0.4, 0.5], len(space)))
    return {name: _numbers(robot, body) for name, body in (("baseline", space.baseline), ("other", other))}


def _numbers(robot: Robot, design: Any) -> dict[str, Any]:
    try:
        model = robot.build(design)
    except InfeasibleDesign:
        return {}
    parts = [type(block).__name__ for block in model.blocks] + [type(solid.material).__name__ for solid in model.solids]
    constraints = [*model.constraints["a"], *model.constraints["e"]]
    found: dict[str, Any] = {
        "parts": parts + [type(constraint).__name__ for constraint in constraints],
        "mass": [model.mass],
        "volume": [model.volume],
        "positions": [float(v) for constraint in constraints for v in constraint.value(model.nodes)],
    }
    from softgym_envs.mechanics.solvers.statics import Statics  # a surrogate that is used solves none

    statics, zero = Statics(model), np.zeros(len(robot.actuators))
    try:
        rest = statics.solve(zero)
        found["compliance"] = np.ravel(rest.condensed.compliance).tolist()
    except ConvergenceError:
        pass
    return found


def difference(trained: Any, now: Any) -> str:
    """Return what differs between two fingerprints, for a message; empty for the same robot."""
    if not isinstance(trained, dict):
        return "the card has no fingerprint of the body"
    for body, numbers in now.items():
        known = trained.get(body)
        if not isinstance(known, dict) or known.keys() != numbers.keys():
            return f"the {body} body has {', '.join(numbers) or 'no shape'}, the trained one {known and list(known)}"
        for name, values in numbers.items():
            if name == "parts" and values != known[name]:
                return f"parts of the {body} body were {known[name]}, now {values}"
            if name == "parts":
                continue
            a, b = np.asarray(known[name], dtype=float), np.asarray(values, dtype=float)
            if a.shape != b.shape or np.abs(a - b).max(initial=0.0) > TOLERANCE * np.abs(a).max(initial=0.0):
                worst = int(np.argmax(np.abs(a - b))) if a.shape == b.shape else 0
                return f"{name} of the {body} body was {a[worst]:.6g}, now {b[worst]:.6g}"
    return ""
