"""Closings of fingers on objects by finite elements: they calibrate the trust of a chain, and test it in contact."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from softgym_envs.errors import ConvergenceError, DataError, InfeasibleDesign
from softgym_envs.extensions.grasping.chain.contact import ChainBatch, rows_for
from softgym_envs.extensions.grasping.chain.model import ChainModel
from softgym_envs.extensions.grasping.robots.grasping_hands import GraspingFinger
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.storage import atomic_write, read_npz

STEP = np.radians(2.0)
"""Increment of the servo's angle, that of the environments [rad]."""

PRESSED = 0.02
"""Smallest contact force whose relative error counts [N]."""


class Closings(NamedTuple):
    """States of c closings, one for each of a angles; rows beyond the last equilibrium are NaN.

    Attributes:
        design: of the finger and its object, shape (c, len(space)).
        force: of the object on the finger, in the plane [N], shape (c, a, 2).
        tip: [m], shape (c, a, 2).
        torque: [N m], shape (c, a).
        self_force: sum of the normal forces between parts of the finger [N], shape (c, a).
    """

    design: np.ndarray
    force: np.ndarray
    tip: np.ndarray
    torque: np.ndarray
    self_force: np.ndarray


def close_bodies(robot: GraspingFinger, bodies: np.ndarray, seed: int) -> Closings:
    """Close bodies (c, 17 or more) on objects that are drawn from the whole scene of a robot, by finite elements."""
    space, count = robot.design_space, round(robot.actuators[0].high / STEP)
    own = [name for name in space.names if name not in robot.scene]
    designs, results = [], []
    for number, body in enumerate(bodies):
        rng = np.random.default_rng([seed, number])
        values = dict(zip(own, map(float, body), strict=True))
        while True:
            drawn = space.sample(rng, robot.scene)
            design = space.complete({**values, **{name: drawn[name] for name in robot.scene}})
            try:
                statics = Statics(robot.build(design))
                break
            except InfeasibleDesign:  # the body at rest is inside the object
                continue
        rows = np.full((count, 6), np.nan)
        try:
            for k in range(count):
                state = statics.solve([STEP * (k + 1)])
                contacts = state.contacts
                assert contacts is not None
                tip = state.condensed.delta.e[:2]
                rows[k] = [*contacts.total[0, :2], *tip, state.effort[0], contacts.self_force]
        except ConvergenceError:
            pass
        designs.append(design.array)
        results.append(rows)
    found = np.array(results)
    return Closings(np.array(designs), found[..., :2], found[..., 2:4], found[..., 4], found[..., 5])


def kept_closings(path: Path, robot: GraspingFinger, bodies: np.ndarray, seed: int) -> Closings:
    """Return the closings in a file, which is written if it does not hold those of these bodies and this seed."""
    try:
        kept = read_npz(path, ("seed", *Closings._fields))
    except DataError:  # missing, damaged, or written before the seed was kept
        kept = {}
    if kept and kept["seed"] == seed and np.array_equal(kept["design"][:, : bodies.shape[1]], bodies):
        return Closings(*(kept[name] for name in Closings._fields))
    found = close_bodies(robot, bodies, seed)
    with atomic_write(path) as stream:
        np.savez_compressed(stream, allow_pickle=False, seed=seed, **found._asdict())
    return found


class ClosingErrors(NamedTuple):
    """Errors of a chain in the states of closings; NaN where finite elements or the chain have no state.

    Attributes:
        force: of the contact force, relative; NaN where it is smaller than `PRESSED`; shape (c, a).
        tip: [m], shape (c, a).
        torque: relative to the largest of the closing, shape (c, a).
        folded: whether the chain touches itself, shape (c, a).
        spread: of the members, shape (c,).
        known: whether the chain knows the body, shape (c,).
    """

    force: np.ndarray
    tip: np.ndarray
    torque: np.ndarray
    folded: np.ndarray
    spread: np.ndarray
    known: np.ndarray


def closing_errors(model: ChainModel, robot: GraspingFinger, closings: Closings) -> ClosingErrors:
    """Close the chain on the same objects."""
    space = robot.design_space
    scenes = [
        robot.surroundings(space.complete(dict(zip(space.names, map(float, row), strict=True))))
        for row in closings.design
    ]
    bodies = closings.design[:, : len(model.robot.design_space)]
    prepared = model.prepare(bodies, rows_for(scenes, robot.thickness))
    batch = ChainBatch(prepared, scenes)
    states = [batch.close(np.full(len(bodies), STEP * (k + 1))) for k in range(closings.force.shape[1])]
    found = np.stack([state.found for state in states], axis=1)
    force = np.stack([state.force[:, 0] for state in states], axis=1)
    size = np.linalg.norm(closings.force, axis=2)
    force_error = np.linalg.norm(force - closings.force, axis=2) / np.where(size > PRESSED, size, np.nan)
    tip_error = np.linalg.norm(np.stack([state.tip for state in states], axis=1) - closings.tip, axis=2)
    torque = np.stack([state.torque for state in states], axis=1)
    torque_error = np.abs(torque - closings.torque) / np.nanmax(np.abs(closings.torque), axis=1, keepdims=True)
    return ClosingErrors(
        force=np.where(found, force_error, np.nan),
        tip=np.where(found, tip_error, np.nan),
        torque=np.where(found, torque_error, np.nan),
        folded=np.stack([state.folded for state in states], axis=1),
        spread=model.spread(bodies),
        known=prepared.known,
    )


def summary(errors: ClosingErrors, closings: Closings) -> dict[str, float]:
    """Return what a card says about closings.

    Errors are those of trusted states: of bodies that the chain knows and that do not touch themselves.
    ``folds_missed`` is the part of the trusted states in which the finger of finite elements touches itself with more
    than `PRESSED`, and ``folds_flagged`` the part of the states without such contact that are not trusted because of a
    fold.
    """
    solved = np.isfinite(closings.torque) & np.isfinite(errors.tip)
    trusted = solved & ~errors.folded & errors.known[:, None]
    touches = closings.self_force > PRESSED
    found: dict[str, float] = {
        "states": int(solved.sum()),
        "trusted": float(trusted.sum() / solved.sum()),
        "folds_missed": float((trusted & touches).sum() / max(trusted.sum(), 1)),
        "folds_flagged": float((solved & errors.folded & ~touches).sum() / max((solved & ~touches).sum(), 1)),
    }
    for name, values in (("force", errors.force), ("tip", errors.tip), ("torque", errors.torque)):
        good = values[trusted & np.isfinite(values)]
        if len(good):
            found |= {
                f"{name}_median": float(np.median(good)),
                f"{name}_p95": float(np.quantile(good, 0.95)),
                f"{name}_worst": float(good.max()),
            }
    return found
