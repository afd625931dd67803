"""A cable routed through embedded points."""

from __future__ import annotations

import numpy as np
from numba import njit

from softgym_envs.mechanics.constraints.constraint import Constraint
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints

__all__ = ["Cable"]


@njit(cache=True)
def _cable_length(x, ids, weights, pull, slot, length_gradient, length_hessian, want_hessian):
    """Length of the polyline pull -> p0 -> p1 ..., its gradient and hessian over the stencil."""
    count = ids.shape[0]
    points = np.zeros((count + 1, 3))
    points[0] = pull
    for p in range(count):
        for a in range(ids.shape[1]):
            for d in range(3):
                points[p + 1, d] += weights[p, a] * x[ids[p, a], d]
    length = 0.0
    length_gradient[:] = 0.0
    if want_hessian:
        length_hessian[:, :] = 0.0
    t = np.empty(3)
    local = np.empty((3, 3))
    for p in range(count):
        segment = 0.0
        for d in range(3):
            t[d] = points[p + 1, d] - points[p, d]
            segment += t[d] * t[d]
        segment = np.sqrt(segment)
        length += segment
        for d in range(3):
            t[d] /= segment
        for a in range(ids.shape[1]):
            for d in range(3):
                length_gradient[slot[p, a] * 3 + d] += weights[p, a] * t[d]
                if p > 0:
                    length_gradient[slot[p - 1, a] * 3 + d] -= weights[p - 1, a] * t[d]
        if want_hessian:
            for d in range(3):
                for c in range(3):
                    local[d, c] = -t[d] * t[c] / segment
                local[d, d] += 1.0 / segment
            for side_i in range(2):
                if p == 0 and side_i == 1:
                    continue  # the pull point is fixed
                for side_j in range(2):
                    if p == 0 and side_j == 1:
                        continue
                    sign = 1.0 if side_i == side_j else -1.0
                    for a in range(ids.shape[1]):
                        row = slot[p - side_i, a] * 3
                        wi = weights[p - side_i, a] * sign
                        for b in range(ids.shape[1]):
                            column = slot[p - side_j, b] * 3
                            w = wi * weights[p - side_j, b]
                            for d in range(3):
                                for c in range(3):
                                    length_hessian[row + d, column + c] += w * local[d, c]
    return length


class Cable(Constraint):
    """Frictionless cable from a fixed pull point through embedded points; the last point is its anchor.

    delta [m] is the shortening, rest length minus length; effort [N] is the tension.

    Args:
        name: identifier.
        embedding: the points in order from the pull point to the anchor.
        pull_point: fixed point where the cable leaves the body [m], shape (3,).
        unilateral: a real cable cannot push. False lets it, as some published scenes do.

    Raises:
        ValueError: if two successive points coincide.
    """

    size = 1

    def __init__(
        self, name: str, embedding: EmbeddedPoints, pull_point: np.ndarray, *, unilateral: bool = True
    ) -> None:
        self.name = name
        self.embedding = embedding
        self.pull_point = np.asarray(pull_point, dtype=float)
        self.unilateral = unilateral
        nodes, slot = np.unique(embedding.node_ids, return_inverse=True)
        self._slot = slot.reshape(embedding.node_ids.shape)
        self.dofs = (3 * nodes[:, None] + np.arange(3)).ravel()
        self._gradient = np.empty(len(self.dofs))
        self._hessian = np.empty((len(self.dofs), len(self.dofs)))
        rest = np.vstack([self.pull_point, embedding.points])
        segments = np.linalg.norm(np.diff(rest, axis=0), axis=1)
        if not (segments > 1e-9).all():
            raise ValueError(f"cable '{name}' has a segment of zero length: points {rest.tolist()} m")
        self.rest_length = float(segments.sum())

    def path(self, x: np.ndarray) -> np.ndarray:
        """Return the polyline [m], shape (p + 1, 3), pull point first."""
        return np.vstack([self.pull_point, self.embedding.positions(x)])

    def _length(self, x: np.ndarray, want_hessian: bool) -> float:
        return _cable_length(
            x,
            self.embedding.node_ids,
            self.embedding.weights,
            self.pull_point,
            self._slot,
            self._gradient,
            self._hessian,
            want_hessian,
        )

    def value(self, x: np.ndarray) -> np.ndarray:
        return np.array([self.rest_length - self._length(x, False)])

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        self._length(x, False)
        return -self._gradient[None, :]

    def hessian(self, x: np.ndarray, effort: np.ndarray) -> np.ndarray:
        self._length(x, True)
        return -effort[0] * self._hessian
