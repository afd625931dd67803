"""A bond: two points that stay together."""

from __future__ import annotations

import numpy as np

from softgym_envs.mechanics.constraints.constraint import Constraint
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints


class Bond(Constraint):
    """Point ``first`` minus point ``second`` [m], held at ``gap`` by a force [N] on the first and its opposite.

    Bilateral, without friction or rotation: a ball joint. Under the role ``"b"`` of a model it is always active and is
    eliminated from the condensed model.

    Args:
        name: identifier.
        first: one embedded point.
        second: one embedded point, or a fixed position [m], shape (3,).
        gap: offset to maintain [m], shape (3,); zero ties the points together.
    """

    size = 3

    def __init__(
        self, name: str, first: EmbeddedPoints, second: EmbeddedPoints | np.ndarray, gap: np.ndarray | None = None
    ) -> None:
        self.name = name
        self.first = first
        ids, weights = [first.node_ids[0]], [first.weights[0]]
        self._anchor = np.zeros(3) if gap is None else np.asarray(gap, dtype=float)
        if self._anchor.shape != (3,):
            raise ValueError(f"gap of bond '{name}' must be three numbers [m], got {self._anchor.tolist()}")
        if isinstance(second, EmbeddedPoints):
            ids.append(second.node_ids[0])
            weights.append(-second.weights[0])
        else:
            self._anchor = self._anchor + np.asarray(second, dtype=float)
        if self._anchor.shape != (3,) or not np.isfinite(self._anchor).all():
            raise ValueError(
                f"gap and position of bond '{name}' must be three finite numbers, got {self._anchor.tolist()}"
            )
        if any(len(points.node_ids) != 1 for points in (first, second) if isinstance(points, EmbeddedPoints)):
            raise ValueError(f"bond '{name}' needs exactly one point on each side")
        self._ids, self._weights = np.concatenate(ids), np.concatenate(weights)
        nodes, slot = np.unique(self._ids, return_inverse=True)
        self.dofs = (3 * nodes[:, None] + np.arange(3)).ravel()
        self._jacobian = np.kron(np.bincount(slot, weights=self._weights), np.eye(3))

    def value(self, x: np.ndarray) -> np.ndarray:
        return self._weights @ x[self._ids] - self._anchor

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        return self._jacobian
