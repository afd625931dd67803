"""A linear drive: how far a point has moved along a direction."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from softgym_envs.mechanics.constraints.constraint import Constraint
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints


class Slide(Constraint):
    """How far an embedded point has moved along a fixed direction; delta [m] is zero at rest, effort [N] a force on it.

    The point is free across the direction, so a stage that holds it there needs clamps besides.

    Args:
        name: identifier.
        embedding: the point, of a solid, rod or frame.
        direction: in space, shape (3,), of any length.

    Raises:
        ValueError: for several points, or a direction without length.
    """

    size = 1

    def __init__(self, name: str, embedding: EmbeddedPoints, direction: ArrayLike) -> None:
        if len(embedding.node_ids) != 1:
            raise ValueError(f"slide '{name}' needs exactly one embedded point, got {len(embedding.node_ids)}")
        along = np.asarray(direction, dtype=float)
        length = float(np.linalg.norm(along)) if along.shape == (3,) else 0.0
        if not 0.0 < length < np.inf:
            raise ValueError(
                f"the direction of slide '{name}' must be three numbers of some length, got {along.tolist()}"
            )
        self.name = name
        ids, weights = embedding.node_ids[0], embedding.weights[0]
        self.dofs = (3 * ids[:, None] + np.arange(3)).ravel()
        self._rows = ids
        self._jacobian = np.kron(weights, along / length)[None, :]
        self._rest = float(embedding.points[0] @ along) / length

    def value(self, x: np.ndarray) -> np.ndarray:
        return self._jacobian @ x[self._rows].ravel() - self._rest

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        return self._jacobian
