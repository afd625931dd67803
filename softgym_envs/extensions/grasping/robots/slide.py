"""A linear drive: how far a frame has moved along a direction."""

from __future__ import annotations

import numpy as np

from softgym_envs.mechanics.constraints.constraint import Constraint


class Slide(Constraint):
    """Displacement of a frame's origin along a fixed direction; delta [m] is zero at rest, effort [N] is a force on it.

    Args:
        name: identifier.
        row: first row of the frame.
        direction: shape (3,), of any length.
        nodes: rest rows [m], shape (n, 3).
    """

    size = 1

    def __init__(self, name: str, row: int, direction: np.ndarray, nodes: np.ndarray) -> None:
        self.name = name
        direction = np.asarray(direction, dtype=float)
        length = float(np.linalg.norm(direction))
        if not length > 0.0:
            raise ValueError(f"slide '{name}': direction {direction.tolist()} has no length")
        self.row = row
        self.dofs = 3 * row + np.arange(3)
        self._jacobian = (direction / length)[None, :]
        self._rest = float(self._jacobian[0] @ nodes[row])

    def value(self, x: np.ndarray) -> np.ndarray:
        return self._jacobian @ x[self.row] - self._rest

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        return self._jacobian
