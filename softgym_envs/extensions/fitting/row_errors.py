"""Errors of the rows of a learned model that nothing drives: effectors and sensors, by the command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

KNOTS = 4
"""Equidistant commands, from the lower end of the range to the upper one, between which errors are interpolated."""


@dataclass(frozen=True)
class RowErrors:
    """Mean and standard deviation of what the model says more than the truth, at `KNOTS` commands.

    Errors of a learned model grow with the displacement, and on one body they have a mean.

    Attributes:
        mean: shape (KNOTS, r), in the units of the rows.
        deviation: about the mean, shape (KNOTS, r).
    """

    mean: np.ndarray
    deviation: np.ndarray

    @classmethod
    def none(cls, rows: int) -> RowErrors:
        """Return those of a body that is the learned model itself."""
        return cls(np.zeros((KNOTS, rows)), np.zeros((KNOTS, rows)))

    @classmethod
    def fit(cls, share: np.ndarray, errors: np.ndarray) -> RowErrors:
        """Fit the mean by least squares, then the variance at each knot by its neighbours' squared residuals.

        Args:
            share: of the ranges that the actuators are commanded, shape (N,).
            errors: model minus truth, shape (N, r).

        Raises:
            ValueError: if a knot has no state within a knot's distance, or there are hardly more states than knots.
        """
        weights = _hats(share)
        if len(share) < 2 * KNOTS or (weights.sum(axis=0) <= 0.0).any():
            raise ValueError(f"{len(share)} states do not tell the errors at {KNOTS} commands; use more")
        mean = np.linalg.lstsq(weights, errors, rcond=None)[0]
        squares = (errors - weights @ mean) ** 2 * (len(share) / (len(share) - KNOTS))
        return cls(mean, np.sqrt(weights.T @ squares / weights.sum(axis=0)[:, None]))

    @classmethod
    def from_card(cls, entry: Mapping[str, Sequence[Sequence[float]]]) -> RowErrors:
        """Return what `to_card` has written."""
        return cls(np.array(entry["mean"], dtype=float), np.array(entry["deviation"], dtype=float))

    def to_card(self) -> dict[str, list[list[float]]]:
        """Return the errors for the card of weights."""
        return {"mean": self.mean.tolist(), "deviation": self.deviation.tolist()}

    def rows(self, index: np.ndarray) -> RowErrors:
        """Return those of some rows."""
        return RowErrors(self.mean[:, index], self.deviation[:, index])

    def at(self, share: float) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation (r,) where the actuators are commanded a share of their ranges."""
        (weights,) = _hats(np.array([share]))
        return weights @ self.mean, weights @ self.deviation


def _hats(share: np.ndarray) -> np.ndarray:
    """Return the weights of the knots in linear interpolation, shape (N, KNOTS)."""
    place = (KNOTS - 1) * np.clip(share, 0.0, 1.0)
    return np.maximum(1.0 - np.abs(place[:, None] - np.arange(KNOTS)), 0.0)
