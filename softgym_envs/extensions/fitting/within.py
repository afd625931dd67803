"""Calibration of a learned part by the bodies that consist of it, on finite elements of whole bodies."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from softgym_envs.backends.registry import make_backend
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.fitting.calibration import conformal_quantile
from softgym_envs.extensions.fitting.data.strata import StratifiedStates, draw_commands, solve_commands, strata_of
from softgym_envs.extensions.fitting.predictions import Predictions, StratumReport, by_stratum
from softgym_envs.robots.base import Robot
from softgym_envs.storage import write_json
from softgym_envs.surrogate.domain import SPREAD


def judged_within(
    whole: Robot, bodies: int, states: int, seed: int, folder: str | Path | None = None, workers: int = 1
) -> StratifiedStates:
    """Return finite-element states of whole bodies in all strata.

    Args:
        whole: the robot of the bodies.
        bodies: of each stratum.
        states: commands of each body.
        seed: of bodies and commands.
        folder: where the states of each body are kept, so that an interrupted run continues.
        workers: number of processes that solve bodies.
    """
    drawn = (draw_commands(whole, stratum, bodies, states, seed) for stratum in strata_of(whole, buckles=False))
    return StratifiedStates.join(
        [solve_commands(whole, commands, folder=folder, workers=workers) for commands in drawn]
    )


def predict_within(
    folder: str | Path, whole: Robot, states: StratifiedStates, *, tolerance: float | None = None
) -> Predictions:
    """Return what bodies of a learned part predict under the commands of judged states, each from rest.

    Args:
        folder: weights of the part.
        whole: the robot of the bodies, whose backend ``surrogate`` composes them.
        states: the same commands on finite elements.
        tolerance: uncertainty up to which states are trusted [m]; default the goal tolerance.
    """
    limit = whole.goal_tolerance if tolerance is None else tolerance
    error, uncertainty = np.full((2, len(states)), np.nan)
    trusted, slack = np.zeros((2, len(states)), dtype=bool)
    backend = make_backend("surrogate", whole, weights=folder)
    for body in np.unique(states.body):
        rows = np.flatnonzero(states.body == body)
        design = dict(zip(whole.design_space.names, map(float, states.design[rows[0]]), strict=True))
        for row in rows:
            backend.reset(design)
            try:
                found = backend.step(states.command[row], "displacement")
            except ConvergenceError:
                continue
            error[row] = np.linalg.norm(found.effector.ravel()[:3] - states.effector[row, :3])
            uncertainty[row] = found.uncertainty
            slack[row] = (found.slack == states.slack[row]).all()
            trusted[row] = not found.distrust & ~SPREAD and found.uncertainty <= limit
    kept = np.isfinite(uncertainty) & states.found
    return Predictions(error, uncertainty, uncertainty, trusted, np.ones(len(states)), kept, slack)


def calibrate_within(
    folder: str | Path,
    whole: Robot,
    *,
    bodies: int = 64,
    states: int = 5,
    seed: int = 11,
    state_folder: str | Path | None = None,
    workers: int = 1,
) -> dict[str, StratumReport]:
    """Calibrate the weights of a part by the effector of whole bodies, and write the result to their card.

    What the members say about the part's efforts moves the effector by the compliance of the body. One factor scales
    this such that it covers 95 % of the errors, and another one those of slack corners, by the share of a body's
    commands that are at their bounds. States of one body err alike: many bodies of one command say more than few of
    many.

    Args:
        folder: the weights of the part.
        whole: the robot that consists of such parts.
        bodies: of each stratum.
        states: commands of each body.
        seed: of bodies and commands.
        state_folder: where the states of finite elements are kept, so that an interrupted run continues.
        workers: number of processes that solve bodies.

    Returns:
        How bodies of the calibrated part do on these states, by stratum.
    """
    known, path = judged_within(whole, bodies, states, seed, state_folder, workers), Path(folder) / "model.json"
    card = json.loads(path.read_text())
    card["calibration"] = {"within": whole.name, "bodies": bodies, "states": states, "seed": seed, "inflation": 1.0}
    write_json(path, card)
    plain = predict_within(folder, whole, known)
    ratio, slack = plain.error / plain.uncertainty, known.stratum == "slack corners"
    inflation = conformal_quantile(ratio[plain.found & ~slack])
    card["calibration"]["inflation"] = inflation
    if (plain.found & slack).any():
        card["calibration"]["slack_corners"] = max(1.0, conformal_quantile(ratio[plain.found & slack]) / inflation)
    write_json(path, card)
    found = by_stratum(predict_within(folder, whole, known), known)
    card["calibration"]["strata"] = {name: asdict(row) for name, row in found.items()}
    write_json(path, card)
    return found


def tested_within(
    folder: str | Path,
    whole: Robot,
    *,
    bodies: int = 64,
    states: int = 5,
    seed: int = 12,
    state_folder: str | Path | None = None,
    workers: int = 1,
    tolerance: float | None = None,
) -> dict[str, StratumReport]:
    """Return how bodies of a calibrated part do on states that its calibration has not seen; its card stays as it is.

    Args: as for `calibrate_within`, and ``tolerance`` as for `predict_within`.

    Returns:
        By stratum, then for each choice of the design, such as a number of fingers, in each stratum.

    Raises:
        ValueError: for the seed of the calibration.
    """
    card = json.loads((Path(folder) / "model.json").read_text())
    if card.get("calibration", {}).get("seed") == seed:
        raise ValueError(f"seed = {seed} is that of the calibration of '{folder}': choose another one")
    known = judged_within(whole, bodies, states, seed, state_folder, workers)
    every = predict_within(folder, whole, known, tolerance=tolerance)
    found = by_stratum(every, known)
    for column, name in enumerate(whole.design_space.names):
        if (variable := whole.design_space[name]).choices:
            labels = [
                f"{stratum}, {name} {variable.choice(value)}"
                for stratum, value in zip(known.stratum, known.design[:, column], strict=True)
            ]
            found |= by_stratum(every, replace(known, stratum=np.array(labels)))
    return found
