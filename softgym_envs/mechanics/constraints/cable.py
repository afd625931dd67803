"""A cable routed through embedded points."""

from __future__ import annotations

import numpy as np

from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.constraints.constraint import Constraint
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints


@njit(cache=True, error_model="numpy")
def _cable_points(x, ids, weights, pull, points):
    """The polyline pull -> p0 -> p1 ..., shape (p + 1, 3)."""
    points[0] = pull
    for p in range(ids.shape[0]):
        points[p + 1] = 0.0
        for a in range(ids.shape[1]):
            for d in range(3):
                points[p + 1, d] += weights[p, a] * x[ids[p, a], d]


@njit(cache=True, error_model="numpy")
def _cable_length(x, ids, weights, pull, slot, points, gradient):
    """Length of the polyline and its gradient over the stencil."""
    _cable_points(x, ids, weights, pull, points)
    length = 0.0
    gradient[:] = 0.0
    t = np.empty(3)
    for p in range(ids.shape[0]):
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
                gradient[slot[p, a] * 3 + d] += weights[p, a] * t[d]
                if p > 0:
                    gradient[slot[p - 1, a] * 3 + d] -= weights[p - 1, a] * t[d]
    return length


@njit(cache=True, error_model="numpy")
def _cable_hessian(x, ids, weights, pull, points, scale, out):
    """Blocks of the points with themselves (p), with the next one (p - 1), and their transposes (p - 1)."""
    _cable_points(x, ids, weights, pull, points)
    count, k = ids.shape
    t = np.empty(3)
    local = np.empty((3, 3))
    out[:count] = 0.0
    for p in range(count):
        segment = 0.0
        for d in range(3):
            t[d] = points[p + 1, d] - points[p, d]
            segment += t[d] * t[d]
        factor = scale / np.sqrt(segment)
        for d in range(3):
            for c in range(3):
                local[d, c] = -factor * t[d] * t[c] / segment
            local[d, d] += factor
        for a in range(k):
            for b in range(k):
                for d in range(3):
                    for c in range(3):
                        out[p, 3 * a + d, 3 * b + c] += weights[p, a] * weights[p, b] * local[d, c]
                        if p > 0:
                            out[p - 1, 3 * a + d, 3 * b + c] += weights[p - 1, a] * weights[p - 1, b] * local[d, c]
                            across = -weights[p - 1, a] * weights[p, b] * local[d, c]
                            out[count + p - 1, 3 * a + d, 3 * b + c] = across
                            out[2 * count + p - 2, 3 * b + c, 3 * a + d] = across


class Cable(Constraint):
    """Cable from a fixed pull point through embedded points; the last point is its anchor.

    delta [m] is the shortening, rest length minus length; effort [N] is the tension at the pull point.

    Attributes:
        friction: coefficient of friction on the guides between pull point and anchor, by the capstan law; `Statics`
            reads it when it is made (see `softgym_envs.mechanics.solvers.cable_friction`).

    Args:
        name: identifier.
        embedding: the points in order from the pull point to the anchor.
        pull_point: fixed point where the cable leaves the body [m], shape (3,).
        unilateral: True for a real cable, which cannot push; False lets it push, as in some published models.
        compliance: how far the cable stretches per tension [m/N], see `Constraint`; its length over EA.

    Raises:
        ValueError: if two successive points coincide, or for a negative compliance.
    """

    size = 1

    def __init__(
        self,
        name: str,
        embedding: EmbeddedPoints,
        pull_point: np.ndarray,
        *,
        unilateral: bool = True,
        compliance: float = 0.0,
    ) -> None:
        if not 0.0 <= compliance < np.inf:
            raise ValueError(f"compliance = {compliance} m/N of cable '{name}' must be finite and not negative")
        self.compliance = compliance
        self.name = name
        self.embedding = embedding
        self.pull_point = np.asarray(pull_point, dtype=float)
        self.unilateral = unilateral
        self.friction = 0.0
        nodes, slot = np.unique(embedding.node_ids, return_inverse=True)
        self._slot = slot.reshape(embedding.node_ids.shape)
        self.dofs = (3 * nodes[:, None] + np.arange(3)).ravel()
        count, k = embedding.node_ids.shape
        self._gradient = np.empty(len(self.dofs))
        self._points = np.empty((count + 1, 3))
        self._blocks = np.empty((3 * count - 2, 3 * k, 3 * k))
        rest = np.vstack([self.pull_point, embedding.points])
        segments = np.linalg.norm(np.diff(rest, axis=0), axis=1)
        if not (segments > 1e-9).all():
            raise ValueError(f"cable '{name}' has a segment of zero length: points {rest.tolist()} m")
        self.rest_length = float(segments.sum())

    def path(self, x: np.ndarray) -> np.ndarray:
        """Return the polyline [m], shape (p + 1, 3), pull point first."""
        return np.vstack([self.pull_point, self.embedding.positions(x)])

    def _length(self, x: np.ndarray) -> float:
        ids, weights = self.embedding.node_ids, self.embedding.weights
        return _cable_length(x, ids, weights, self.pull_point, self._slot, self._points, self._gradient)

    def rest_size(self) -> float:
        return self.rest_length

    def value(self, x: np.ndarray) -> np.ndarray:
        return np.array([self.rest_length - self._length(x)])

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        self._length(x)
        return -self._gradient[None, :]

    def linearise(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.array([self.rest_length - self._length(x)]), -self._gradient[None, :]

    def hessian_pattern(self) -> tuple[np.ndarray, np.ndarray]:
        # Only neighbouring points depend on each other.
        dofs = (3 * self.embedding.node_ids[:, :, None] + np.arange(3)).reshape(len(self.embedding.node_ids), -1)
        first, second = np.concatenate([dofs, dofs[:-1], dofs[1:]]), np.concatenate([dofs, dofs[1:], dofs[:-1]])
        k = dofs.shape[1]
        return np.repeat(first, k, axis=1).ravel(), np.tile(second, (1, k)).ravel()

    def hessian(self, x: np.ndarray, effort: np.ndarray) -> np.ndarray:
        ids, weights = self.embedding.node_ids, self.embedding.weights
        _cable_hessian(x, ids, weights, self.pull_point, self._points, -effort[0], self._blocks)
        return self._blocks
