"""How wrong bodies of learned parts are, and the calibration of what they say about it, on finite elements."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.extensions.beams.parts.trust import Judged, judge
from softgym_envs.extensions.beams.parts.weights import LearnedLeg
from softgym_envs.extensions.fitting.calibration import conformal_quantile
from softgym_envs.extensions.fitting.data.strata import draw_commands
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.mechanics.solvers.equilibrium import Equilibrium
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.base import Robot
from softgym_envs.storage import read_json, write_json
from softgym_envs.surrogate.domain import SOFT

INCREMENTS = 20
"""Increments in which a command is approached from rest: of several equilibria both models are to find the same."""
STRATA = ("inside", "faces", "corners")


@dataclass(frozen=True)
class Comparison:
    """States of bodies of learned parts beside those of finite elements, N states.

    Attributes:
        stratum: as `strata.DRAWN`, shape (N,).
        design: shape (N, number of design variables).
        command: shape (N, n_a).
        error: distance of the first effector from that of finite elements [m], shape (N,).
        effort: largest error of an effort over the largest effort, shape (N,).
        held: relative error of the compliance of the effector while the actuators are held, shape (N,).
        jacobian: relative error of the effector's derivative by the displacements, shape (N,).
        uncertainty: [m], shape (N,).
        stiffness: as `Judged`, shape (N,).
        known: likewise.
        soft: whether the body was too soft, there or on its way, shape (N,).
        trusted: shape (N,).
        lost: commands for which finite elements found no equilibrium.
        failed: commands for which the parts found none, though there is one; they count as not trusted.
    """

    stratum: np.ndarray
    design: np.ndarray
    command: np.ndarray
    error: np.ndarray
    effort: np.ndarray
    held: np.ndarray
    jacobian: np.ndarray
    uncertainty: np.ndarray
    stiffness: np.ndarray
    known: np.ndarray
    soft: np.ndarray
    trusted: np.ndarray
    lost: int
    failed: int

    def summary(self, rows: np.ndarray) -> dict[str, float]:
        """Return what is known of some of the states: means, and largest errors of trusted ones [mm, shares]."""
        trusted = rows & self.trusted
        best = trusted if trusted.any() else rows
        return {
            "states": int(rows.sum()),
            "mean [mm]": 1e3 * float(self.error[rows].mean()),
            "median [mm]": 1e3 * float(np.median(self.error[rows])),
            "trusted": float(self.trusted[rows].mean()),
            "trusted: mean [mm]": 1e3 * float(self.error[best].mean()),
            "trusted: 95 % [mm]": 1e3 * float(np.quantile(self.error[best], 0.95)),
            "trusted: worst [mm]": 1e3 * float(self.error[best].max()),
            "trusted: effort, 90 %": float(np.quantile(self.effort[best], 0.9)),
            "trusted: held W, 90 %": float(np.quantile(self.held[best], 0.9)),
            "trusted: derivative by commands, 90 %": float(np.quantile(self.jacobian[best], 0.9)),
            "coverage": float((self.error <= self.uncertainty)[rows].mean()),
        }


def approach(statics: Statics, command: np.ndarray) -> Iterator[Equilibrium]:
    """Yield the equilibria on the way to a command that is approached slowly from rest.

    Raises:
        ConvergenceError: if one is not found.
    """
    for share in np.linspace(0.0, 1.0, INCREMENTS + 1):
        yield statics.solve(share * command)


def compare(robot: Robot, part: LearnedLeg, *, bodies: int, seed: int, strata: tuple[str, ...] = STRATA) -> Comparison:
    """Return how bodies of parts compare with finite elements, one command for each body.

    Args:
        robot: on its mesh of finite elements.
        part: the learned part.
        bodies: of each stratum.
        seed: of bodies and commands.
        strata: see `strata.DRAWN`.
    """
    learned, rows, lost, failed = robot.of_parts({"leg": part}), [], 0, 0
    held = np.ones(len(robot.actuators), dtype=bool)
    for stratum in strata:
        drawn = draw_commands(robot, stratum, bodies, 1, seed)
        for values, commands in zip(drawn.design.tolist(), drawn.command, strict=True):
            design = dict(zip(robot.design_space.names, values, strict=True))
            command = commands[0]
            try:
                *_, end = approach(Statics(robot.build(design)), command)
                true = end.condensed
            except (ConvergenceError, InfeasibleDesign):
                lost += 1
                continue
            statics, distrust = Statics(learned.build(design)), 0
            try:
                for found in approach(statics, command):
                    judged = judge(statics, robot, found.x, found.effort, held, limit=part.limit, before=distrust)
                    distrust = judged.distrust
            except ConvergenceError:
                failed += 1
                continue
            rows.append((stratum, np.array(values), command, *_errors(found.condensed, true), *_verdict(judged)))
    columns: list[Any] = [*(np.array(column) for column in zip(*rows, strict=True)), lost, failed]
    return Comparison(*columns)


def _verdict(judged: Judged) -> tuple[float, float, bool, bool, bool]:
    soft = bool(judged.distrust & SOFT)
    return judged.uncertainty, judged.stiffness, judged.known, soft, judged.distrust == 0


def _errors(found: CondensedModel, true: CondensedModel) -> tuple[float, float, float, float]:
    def parts(model: CondensedModel) -> tuple[np.ndarray, np.ndarray]:
        W = model.W
        jacobian = np.linalg.solve(W.aa, W.ae).T
        return W.ee - jacobian @ W.ae, jacobian

    held, jacobian = (
        float(np.linalg.norm(a - b) / np.linalg.norm(b)) for a, b in zip(parts(found), parts(true), strict=True)
    )
    effort = np.abs(found.lambda_.a - true.lambda_.a).max() / np.abs(true.lambda_.a).max()
    return float(np.linalg.norm(found.delta.e[:3] - true.delta.e[:3])), float(effort), held, jacobian


def calibrate_parts(folder: str | Path, robot: Robot, *, bodies: int, seed: int) -> Mapping[str, Mapping[str, float]]:
    """Calibrate how far bodies of parts may be off, and write the result to the card of the weights.

    The errors of the parts are scaled so that the uncertainty covers 95 % of the errors of the effector, inside the
    design box and at its corners, of known states that were never soft; bodies at its faces are reported. The limit of
    the uncertainty is then lowered until no trusted state of any body is off by more than the goal tolerance.

    Args:
        folder: of the weights.
        robot: on its mesh of finite elements.
        bodies: of each stratum.
        seed: of bodies and commands.

    Returns:
        What `Comparison.summary` says of each stratum.
    """
    folder, part = Path(folder), LearnedLeg(folder)
    found = compare(robot, part, bodies=bodies, seed=seed)
    path = folder / "model.json"
    trust: dict[str, float] = {"bodies": bodies, "seed": seed}
    card = read_json(path)
    for name, now in zip(("inside", "corners"), part.inflation, strict=True):
        rows = found.known & ~found.soft & (found.stratum == name)
        trust[name] = now * conformal_quantile(found.error[rows] / found.uncertainty[rows])
    write_json(path, {**card, "trust": trust})
    calibrated = LearnedLeg(folder)
    designs = [dict(zip(robot.design_space.names, row, strict=True)) for row in found.design.tolist()]
    ratio = [calibrated.inflation_of(design) / part.inflation_of(design) for design in designs]
    uncertainty = found.uncertainty * np.array(ratio)
    trusted = found.known & ~found.soft & (uncertainty <= robot.goal_tolerance)
    again = replace(found, uncertainty=uncertainty, trusted=trusted)
    wrong = again.uncertainty[again.trusted & (again.error > robot.goal_tolerance)]
    if len(wrong):
        trust["limit"] = float(np.nextafter(wrong.min(), 0.0))
        write_json(path, {**card, "trust": trust})
        again = replace(again, trusted=again.trusted & (again.uncertainty <= trust["limit"]))
    return {stratum: again.summary(again.stratum == stratum) for stratum in STRATA}
