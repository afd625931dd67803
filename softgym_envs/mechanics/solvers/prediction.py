"""Prediction of the equilibrium at the end of a load increment from what happened in the last one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LARGEST_BEND = 0.05
"""Largest part of a first step that corrections may add; larger ones point to an event, such as a new contact."""


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


def bend_of(change: np.ndarray, corrections: np.ndarray, size: float, straight: float) -> Bend | None:
    """Return the bend of an increment, or None if an event has made it.

    Args:
        change: of the commands, shape (size,).
        corrections: sum of all steps but the first, shape (N,).
        size: largest displacement of the corrections [m].
        straight: largest displacement of the first step [m], zero if it was cut.
    """
    return Bend(change, corrections) if size <= LARGEST_BEND * straight else None
