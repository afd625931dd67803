"""What a model predicts for FEM equilibria under given commands, and how well, by stratum."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from softgym_envs.extensions.fitting.data.strata import SLACK, StratifiedStates
from softgym_envs.surrogate.model import SurrogateModel

TOUCHING = "touching"
"""Name of all states in which surfaces are in contact, wherever they were drawn. They count in their strata as well: a
model does not know which states touch."""


@dataclass(frozen=True)
class Predictions:
    """Predictions of a model for N judged states.

    Attributes:
        error: largest distance of an effector from that of FEM [m], shape (N,).
        spread: of the ensemble [m], shape (N,).
        uncertainty: [m], shape (N,).
        trusted: shape (N,).
        growth: predicted growth (see `Domain`), shape (N,); 1 for robots that do not buckle.
        found: the model and FEM both have an equilibrium, shape (N,).
        slack: the same actuators are slack as on FEM, shape (N,); None where nobody asked.
    """

    error: np.ndarray
    spread: np.ndarray
    uncertainty: np.ndarray
    trusted: np.ndarray
    growth: np.ndarray
    found: np.ndarray
    slack: np.ndarray | None = None


@dataclass(frozen=True)
class StratumReport:
    """How a model does in one stratum.

    Attributes:
        states: number of states in which FEM and the model have an equilibrium.
        mean: mean error of the effector [m].
        worst: largest error [m].
        coverage: share of the errors below their uncertainty.
        trusted: share of the states that are trusted.
        worst_trusted: largest error of a trusted state [m].
        lost: commands without an equilibrium on FEM; they do not count in any of the above.
        unsolved: those of them that are trusted.
        missed: commands with an equilibrium on FEM that the model does not find; they do not count either.
        slack: share of the states in which the same actuators are slack as on FEM; None where nobody asked.
    """

    states: int
    mean: float
    worst: float
    coverage: float
    trusted: float
    worst_trusted: float
    lost: int
    unsolved: int
    missed: int
    slack: float | None = None


def reached(model: SurrogateModel, context: Any, command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the displacements (B, n_a) that a model predicts under commands, and whether it found them (B,)."""
    if not model.robot.learning.convex:  # its cables can push
        return command, np.ones(len(command), dtype=bool)
    displacement, _, found = model.search(context, command, command, model.robot.unilateral, 5e-5, 25)
    return displacement, found


def predict(model: SurrogateModel, states: StratifiedStates) -> Predictions:
    """Return a model's predictions under the commands of judged states."""
    context = model.context(states.design)
    displacement, found = reached(model, context, states.command)
    effector, spread = model.effector(context, displacement)
    uncertainty, trusted = model.trust(context, displacement, spread, states.command)
    off = (effector - states.effector).reshape(len(states), -1, 3)
    growth = model.softening_ratio(context, displacement) if model.domain.limits_growth else np.ones(len(states))
    error = np.linalg.norm(off, axis=2).max(axis=1)
    beyond = displacement > states.command + SLACK * (model.robot.upper - model.robot.lower)
    slack = ((model.robot.unilateral & beyond) == states.slack).all(axis=1)
    return Predictions(error, spread, uncertainty, trusted & found, growth, found & states.found, slack)


def report(model: SurrogateModel, states: StratifiedStates) -> dict[str, StratumReport]:
    """Return how a model does in each stratum of judged states, and in all that touch, under `TOUCHING`."""
    return by_stratum(predict(model, states), states)


def by_stratum(every: Predictions, states: StratifiedStates) -> dict[str, StratumReport]:
    """Return what predictions for judged states amount to in each stratum."""
    groups = {str(stratum): states.stratum == stratum for stratum in dict.fromkeys(states.stratum.tolist())}
    if states.touching.any():
        groups[TOUCHING] = states.touching
    return {name: _report(every, states, which) for name, which in groups.items() if (which & every.found).any()}


def _report(every: Predictions, states: StratifiedStates, which: np.ndarray) -> StratumReport:
    """Return how a model does in some of the judged states."""
    rows = which & every.found
    return StratumReport(
        states=int(rows.sum()),
        mean=float(every.error[rows].mean()),
        worst=float(every.error[rows].max()),
        coverage=float((every.error <= every.uncertainty)[rows].mean()),
        trusted=float(every.trusted[rows].mean()),
        worst_trusted=float(every.error[rows & every.trusted].max(initial=0.0)),
        lost=int((which & ~states.found).sum()),
        unsolved=int((every.trusted & ~states.found & which).sum()),
        slack=None if every.slack is None else float(every.slack[rows].mean()),
        missed=int((which & states.found & ~every.found).sum()),
    )
