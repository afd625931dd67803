"""Prediction of the equilibrium at the end of a load increment from what happened in the last one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LARGEST_BEND = 0.05
"""Largest part of a first step that corrections may add; larger ones point to an event, such as a new contact."""
SHORT_STEP = 0.05
"""Steps of less than this part of Newton's count as short."""


@dataclass(frozen=True)
class Bend:
    """How the path of the equilibria bends: what Newton's method added to the first step of an increment.

    The first step follows the tangent of the path. What is left to correct grows with the square of the increment, so
    the corrections of one increment predict those of the next, with an error of third order.

    Attributes:
        change: of the commands in the increment, shape (size,).
        corrections: sum of all steps of the equations but the first, shape (N,).
    """

    change: np.ndarray
    corrections: np.ndarray

    def expected(self, change: np.ndarray) -> np.ndarray | None:
        """Return the corrections (N,) to expect in an increment that changes commands (size,) in the same direction.

        None in other directions, and where the increment is much smaller or larger.
        """
        square = float(self.change @ self.change)
        factor = float(change @ self.change) / square if square > 0.0 else 0.0
        aside = float(np.linalg.norm(change - factor * self.change))
        alike = 0.1 <= factor <= 2.0 and aside <= 1e-6 * float(np.linalg.norm(change))
        return factor**2 * self.corrections if alike else None


@dataclass
class Steps:
    """The Newton steps of a load increment so far.

    Attributes:
        corrections: sum of all steps of the equations but the first, shape (N,).
        straight: largest displacement of the first step [m], zero if the line search shortened it.
        norm: that of the last Newton step [m].
        length: part of it that was taken.
        short: number of short steps in a row.
    """

    corrections: np.ndarray
    straight: float = 0.0
    norm: float = np.inf
    length: float = 0.0
    short: int = 0

    def add(self, step: np.ndarray, norm: float, length: float, predicted: np.ndarray | None = None) -> None:
        """Add the part ``length`` of a Newton step (N,) of size ``norm`` [m], and the corrections it predicted (N,)."""
        if self.norm < np.inf:
            self.corrections += length * step
        elif length == 1.0:
            self.straight = norm
        if predicted is not None:
            self.corrections += predicted
        self.norm, self.length = norm, length
        self.short = self.short + 1 if length < SHORT_STEP else 0

    def bend(self, change: np.ndarray, size: float) -> Bend | None:
        """Return the bend of an increment that changed commands (size,), or None if an event has made it.

        ``size`` is the largest displacement of the corrections [m].
        """
        return Bend(change, self.corrections) if size <= LARGEST_BEND * self.straight else None
