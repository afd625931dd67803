"""The region in which a trained model may be trusted, and the calibration of its uncertainty, read from its card."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from softgym_envs.mechanics.compilation import njit
from softgym_envs.robots.base import Robot

#: Why a state is not trusted. States hold the sum of these numbers, 0 for a trusted state.
OUTSIDE, SPREAD, SOFT, LOADED, FOLDED, UNEXPLAINED, SELF_CONTACT = 1, 2, 4, 8, 16, 32, 64

DISTRUST_REASONS = {
    OUTSIDE: "outside box",
    SPREAD: "spread",
    SOFT: "softening",
    LOADED: "loads",
    FOLDED: "folded beam",
    UNEXPLAINED: "unexplained readings",
    SELF_CONTACT: "self-contact",
}
"""The reasons in words: body or displacements lie outside the box of the training states; the uncertainty is above the
limit; the actuators are so soft that the body may be about to buckle, or a body of superelements has; a learned
superelement carries larger loads than those that it was learned under; a beam element
passed its stability limit, and the mesh should be refined; an estimate explains the readings of the sensors badly; a
finger on learned chains would touch itself."""

SLACK = 1e-3
"""Actuators that end farther beyond their commands than this are slack [half their range]."""

EDGE = 0.1
"""A variable counts as being at its bound within this part of half its range, linearly from 0 to 1."""


def distrust_text(code: int) -> str:
    """Return the reasons of a state's distrust in words, empty for a trusted state."""
    return ", ".join(text for number, text in DISTRUST_REASONS.items() if code & number) if code else ""


@dataclass(frozen=True)
class Calibration:
    """How the spread of the ensemble becomes a bound on 95 % of the effector errors under given commands.

    ``uncertainty = factor * floor^(1 - power) * (spread^2 + floor^2)^(power / 2)``. The factor depends on where the
    body lies in the design box: the logarithm is interpolated between those of bodies inside, on a face and at a vertex
    of the box. The default bounds the error by the spread itself.

    Members may disagree about where the effector is, and about the forces of the actuators: those move the effector by
    its compliance (`SurrogateModel.force_spread`). The spread is the root of the sum of both squares. An estimate from
    few members is uncertain; one from twice as many quantities is less so.

    Attributes:
        forces: weight of the disagreement about forces; 0 for weights that were calibrated without it.
        floor: noise floor of the ensemble standard deviation: members share some errors [m].
        power: how the error grows with the spread.
        inside: factor of bodies far from the bounds of all design variables.
        faces: of bodies with one variable at its bound.
        corners: of bodies with all variables at their bounds.
        slack_corners: of these under commands at a vertex of their box that leave an actuator slack.
        buckling: additional factor of states softer than `soft`.
        soft: growth (see `Domain`) from which states count as near buckling.
    """

    forces: float = 0.0
    floor: float = 0.0
    power: float = 1.0
    inside: float = 1.0
    faces: float = 1.0
    corners: float = 1.0
    slack_corners: float = 1.0
    buckling: float = 1.0
    soft: float = np.inf

    @classmethod
    def of_card(cls, values: Mapping[str, Any]) -> Calibration:
        """Read the calibration from a card.

        Raises:
            ValueError: for unknown names, or values that are not positive.
        """
        names = {f.name for f in fields(cls)}
        if unknown := sorted(values.keys() - names):
            raise ValueError(f"the calibration of the card has unknown entries: {', '.join(unknown)}")
        found = cls(**{name: float(value) for name, value in values.items()})
        for name in names:
            value = getattr(found, name)
            may_vanish = name == "forces" or (name == "floor" and found.power == 1.0)
            if not (value > 0.0 or (value == 0.0 and may_vanish)):
                raise ValueError(f"the calibration of the card has {name} = {value}; it must be positive")
        return found

    def body_factors(self, share: np.ndarray, variables: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the factor of bodies (B,), and by how much it is multiplied at slack corners of the commands (B,).

        Args:
            share: part of the design variables that lie at their bounds, shape (B,).
            variables: number of these variables.
        """
        nodes = {0.0: self.inside, 1.0 / max(variables, 1): self.faces, 1.0: self.corners}
        factor = np.exp(np.interp(share, list(nodes), np.log(list(nodes.values()))))
        return factor, (self.slack_corners / self.corners) ** share


@njit(cache=True, error_model="numpy")
def assess_trust(
    displacement, command, spread, slot, low, high, command_low, command_high, pulls,
    factor, corner, known, scale, floor, power, limit, uncertainty, distrust,
):  # fmt: skip
    """Fill ``uncertainty`` and ``distrust`` (B,) of states by displacements, commands (B, n) and spread (B,).

    ``scale`` multiplies the uncertainty, of all rows (1,) or of each (B,).
    """
    n = displacement.shape[1]
    edge = 1.0 / EDGE
    for row in range(len(displacement)):
        body = slot[row]
        code = 0 if known[body] else OUTSIDE
        slack, ends = False, 0.0
        for i in range(n):
            d, c = displacement[row, i], command[row, i]
            if not low[i] <= d <= high[i]:
                code = OUTSIDE
            half = 0.5 * (command_high[i] - command_low[i])
            slack = slack or pulls[i] and d > c + SLACK * half
            away = abs(c - 0.5 * (command_high[i] + command_low[i])) / half
            ends += min(max((away - 1.0) * edge + 1.0, 0.0), 1.0)
        sigma = spread[row]
        if floor > 0.0:
            sigma = np.hypot(sigma, floor)
        value = scale[min(row, len(scale) - 1)] * factor[body] * sigma**power
        if slack and corner[body] != 1.0:
            value *= corner[body] ** (ends / n)
        uncertainty[row] = value
        if not value <= limit and not np.isinf(sigma):
            code |= SPREAD
        distrust[row] = code


def share_at_bounds(values: np.ndarray, middle: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Return the part of values (..., k) that lie at their bounds ``middle -+ half`` (k,), shape (...)."""
    away = np.abs(values - middle) / half
    return np.clip((away - 1.0) / EDGE + 1.0, 0.0, 1.0).mean(axis=-1)


@dataclass(frozen=True)
class Domain:
    """The box of states a model was trained on, and the limits below which its predictions are trusted.

    Attributes:
        low: smallest displacements, shape (n_a,); a margin of 1 % of the range is included.
        high: largest displacements, shape (n_a,), likewise.
        design_low: smallest values of all design variables in the order of the space, shape (d,), likewise (see
            `_with_margin`); -inf for variables without bounds.
        design_high: largest values, shape (d,), likewise.
        inflation: factor of the uncertainty.
        limit: largest trusted uncertainty of the effector [m].
        growth: how many times softer than at zero displacement the actuators of a trusted state may be; infinite for
            robots that do not buckle.
        calibration: how the spread becomes an uncertainty.
        command_low: smallest commands, shape (n_a,).
        command_high: largest commands, shape (n_a,).
        unilateral: actuators that cannot push, shape (n_a,).
        columns: design variables with bounds, in the order of the space.
        middle: of the bounds of these, shape (k,).
        half: half of their ranges, shape (k,).
    """

    low: np.ndarray
    high: np.ndarray
    design_low: np.ndarray
    design_high: np.ndarray
    inflation: float
    limit: float
    growth: float
    calibration: Calibration
    command_low: np.ndarray
    command_high: np.ndarray
    unilateral: np.ndarray
    columns: list[int] = field(default_factory=list)
    middle: np.ndarray = field(default_factory=lambda: np.zeros(0))
    half: np.ndarray = field(default_factory=lambda: np.ones(0))

    @property
    def limits_growth(self) -> bool:
        """Whether states are also judged by how soft their actuators are."""
        return bool(np.isfinite(self.growth))

    def at_bounds(self, designs: np.ndarray) -> np.ndarray:
        """Return the part of the design variables of bodies (B, d) that lie at their bounds, shape (B,)."""
        if not self.columns:
            return np.zeros(len(designs))
        return share_at_bounds(designs[:, self.columns], self.middle, self.half)

    @classmethod
    def of_card(cls, card: Mapping[str, Any], robot: Robot) -> Domain:
        """Read the domain from a model's card; quantities that the card does not mention are unlimited.

        Raises:
            ValueError: if the domain is malformed or names design variables that the robot does not have.
        """
        domain = card.get("domain", {})
        if not isinstance(domain, dict):
            raise ValueError(f"the domain of the card is not a mapping: {domain!r}")
        count, names = len(robot.actuators), robot.design_space.names
        box = np.array(domain.get("displacement", np.column_stack([robot.lower, robot.upper])), dtype=float)
        if box.shape != (count, 2):
            raise ValueError(f"the card's domain has displacements of shape {box.shape}, not ({count}, 2)")
        margin = 0.01 * (box[:, 1] - box[:, 0])
        designs = domain.get("design", {})
        if unknown := sorted(designs.keys() - set(names)):
            raise ValueError(f"the card's domain has unknown design variables: {', '.join(unknown)}")
        design_low, design_high = np.full(len(names), -np.inf), np.full(len(names), np.inf)
        bounded = sorted(((names.index(name), *ends) for name, ends in designs.items() if ends[1] > ends[0]))
        for name, (low, high) in designs.items():
            k = names.index(name)
            design_low[k], design_high[k] = _with_margin(name, low, high)
        return cls(
            box[:, 0] - margin,
            box[:, 1] + margin,
            design_low,
            design_high,
            float(domain.get("inflation", 1.0)),
            float(domain.get("limit", np.inf)),
            float(domain.get("growth", np.inf)),
            Calibration.of_card(domain.get("calibration", {})),
            robot.lower,
            robot.upper,
            robot.unilateral,
            [column for column, _, _ in bounded],
            np.array([0.5 * (low + high) for _, low, high in bounded]),
            np.array([0.5 * (high - low) for _, low, high in bounded]),
        )


def _with_margin(name: str, low: float, high: float) -> tuple[float, float]:
    """Return the bounds of a design variable's trusted values: those of the training bodies, and 1 % of their range.

    Near 0.5 everything depends on ``1 - 2 nu``, over orders of magnitude, so for Poisson's ratio the 1 % hold for the
    logarithm of that as well, which networks are given: from 0.498 to 0.499 it halves, and the bulk modulus doubles.
    """
    margin = 0.01 * (high - low)
    lowest, highest = low - margin, high + margin
    if name == "poisson_ratio" and high < 0.5:
        factor = ((1.0 - 2.0 * low) / (1.0 - 2.0 * high)) ** 0.01
        lowest = max(lowest, 0.5 - (0.5 - low) * factor)
        highest = min(highest, 0.5 - (0.5 - high) / factor)
    rounding = 1e-9 * abs(high)
    return lowest - rounding, highest + rounding
