"""The region in which a trained model may be trusted, read from its card."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from softgym_envs.robots.base import Robot


@dataclass(frozen=True)
class Domain:
    """The box of states a model was trained on, and the limits below which its predictions are trusted.

    Attributes:
        low: smallest displacements, shape (n_a,); a margin of 1 % of the range is included.
        high: largest displacements, shape (n_a,), likewise.
        design_low: smallest values of all design variables in the order of the space, shape (d,), likewise; -inf for
            variables without bounds.
        design_high: largest values, shape (d,), likewise.
        inflation: factor that turns the spread of the ensemble into a bound on 95 % of the validation errors.
        limit: largest trusted uncertainty of the effector [m].
        growth: how many times softer than at zero displacement the actuators of a trusted state may be; infinite for
            robots that do not buckle.
    """

    low: np.ndarray
    high: np.ndarray
    design_low: np.ndarray
    design_high: np.ndarray
    inflation: float
    limit: float
    growth: float

    @property
    def limits_growth(self) -> bool:
        """Whether states are also judged by how soft their actuators are."""
        return bool(np.isfinite(self.growth))

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
        for name, (low, high) in designs.items():
            slack = 0.01 * (high - low) + 1e-9 * abs(high)
            design_low[names.index(name)], design_high[names.index(name)] = low - slack, high + slack
        return cls(
            box[:, 0] - margin,
            box[:, 1] + margin,
            design_low,
            design_high,
            float(domain.get("inflation", 1.0)),
            float(domain.get("limit", np.inf)),
            float(domain.get("growth", np.inf)),
        )
