"""The Tetrapod of four learned legs against finite elements: errors, trust, motion and speed."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.beams.parts.backends import PartsBackend
from softgym_envs.extensions.beams.parts.weights import LearnedLeg
from softgym_envs.extensions.fitting.parts.calibration import compare

BODIES, CORNERS, MOVING, SEED = 300, 60, 60, 2026
"""New bodies inside the design box and at its corners, bodies in motion, and the seed of all."""
STEPS, RAMP = 20, 10
"""Control steps of a motion, one second, and those in which the servos reach their commands."""


def learned_tetrapod() -> dict[str, object]:
    """Statics to 90 degrees, a second of motion, and speed, on the accurate mesh."""
    robot = make_robot("tetrapod", mesh="accurate")
    result: dict[str, object] = {}
    found = compare(robot, LearnedLeg(), bodies=BODIES, seed=SEED, strata=("inside",))
    corners = compare(robot, LearnedLeg(), bodies=CORNERS, seed=SEED, strata=("corners",))
    inside = np.ones(len(found.error), dtype=bool)
    groups = {
        "inside": (found, inside),
        "inside, within 45 degrees": (found, np.abs(found.command).max(axis=1) < 0.25 * np.pi),
        "corners": (corners, np.ones(len(corners.error), dtype=bool)),
    }
    for name, (states, rows) in groups.items():
        result |= {f"{name}: {key}": value for key, value in states.summary(rows).items()}
    result["commands without equilibrium on finite elements"] = found.lost + corners.lost
    result["commands without equilibrium of parts"] = found.failed + corners.failed
    return result | motion(robot) | speed(robot)


def motion(robot: Any) -> dict[str, object]:
    """Return errors of the centre in open loop [mm], means over the second, of bodies by trust."""
    rng = np.random.default_rng(SEED)
    true, learned = FEMBackend(robot, dynamics=True), PartsBackend(robot, dynamics=True)
    errors, trusted, failed = [], [], 0
    for _ in range(MOVING):
        design, command = robot.design_space.sample(rng), rng.uniform(robot.lower, robot.upper)
        paths, sure = [], True
        try:
            for backend in (true, learned):
                backend.reset(design)
                path = [backend.step(command * min(1.0, (k + 1) / RAMP)).effector[0].copy() for k in range(STEPS)]
                paths.append(np.array(path))
            sure = learned.state.trusted
        except ConvergenceError:
            failed += 1
            continue
        errors.append(1e3 * np.linalg.norm(paths[1] - paths[0], axis=1).mean())
        trusted.append(sure)
    off, sure_of = np.array(errors), np.array(trusted)
    return {
        "motion: bodies": len(off),
        "motion: not solved": failed,
        "motion: mean over a second [mm], median": float(np.median(off)),
        "motion: mean over a second [mm], mean": float(off.mean()),
        "motion: trusted at the end": float(sure_of.mean()),
        "motion: trusted, mean [mm]": float(off[sure_of].mean()),
        "motion: trusted, worst [mm]": float(off[sure_of].max()),
    }


def speed(robot: Any) -> dict[str, object]:
    """Return static steps and control steps per CPU second of both, W and trust included."""
    result: dict[str, object] = {}
    command = np.array([0.6, -0.4, 0.3, -0.2])
    for name, kind in (("finite elements", FEMBackend), ("parts", PartsBackend)):
        for what, moving in (("statics", False), ("control steps", True)):
            backend = kind(robot, dynamics=moving)
            backend.step(0.1 * command)
            start, count = time.process_time(), 40
            for k in range(count):
                backend.step(command * (0.2 + 0.8 * k / count))
            result[f"{what} per CPU second: {name}"] = count / (time.process_time() - start)
    return result
