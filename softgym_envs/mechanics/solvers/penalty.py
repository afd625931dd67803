"""The exact penalty function by which the lengths of Newton steps with contact are chosen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np


@dataclass
class Penalty:
    """What is added to the energy: weights times the violations of driven rows, less the work of given efforts [J].

    Attributes:
        target: commanded values of driven rows and efforts of all others, shape (size,).
        driven: rows whose values are commanded, shape (d,).
        loose: which of them may lie beyond their commands, because they cannot push, shape (d,).
        weight: of their violations [N, Pa, ...], shape (d,).
    """

    target: np.ndarray
    driven: np.ndarray
    loose: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, target: np.ndarray, driven: np.ndarray, unilateral: np.ndarray) -> Self:
        """Return the penalty without weights; ``unilateral`` (n_a,) are actuators that cannot push."""
        loose = np.zeros(len(target), dtype=bool)
        loose[: len(unilateral)] = unilateral
        return cls(target, driven, loose[driven], np.zeros(len(driven)))

    def raise_weights(self, effort: np.ndarray) -> None:
        """Raise the weights above efforts (size,): then steps towards the equilibrium reduce energy plus penalty."""
        self.weight = np.maximum(self.weight, 1.5 * np.abs(effort[self.driven]) + 1e-9)

    @property
    def forced(self) -> np.ndarray:
        """Given efforts, zero in driven rows, shape (size,)."""
        forced = self.target.copy()
        forced[self.driven] = 0.0
        return forced

    def violation(self, delta: np.ndarray) -> np.ndarray:
        """Return by how much driven rows miss their commands, shape (d,), for values of all rows (size,)."""
        gap = (delta - self.target)[self.driven]
        return np.abs(np.where(self.loose, np.minimum(gap, 0.0), gap))

    def value(self, delta: np.ndarray) -> float:
        """Return the penalty [J] for values of all rows (size,)."""
        return float(self.weight @ self.violation(delta) - self.forced @ delta)
