"""A fibre-reinforced chamber: a tube that only grows along its centre line."""

from __future__ import annotations

import numpy as np
from numba import njit

from softgym_envs.mechanics.constraints.constraint import Constraint
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints

__all__ = ["Chamber"]


@njit(cache=True)
def _line_length(x, ids, weights, slot, gradient, hessian, want_hessian):
    """Sum of the norms of ``t_q = sum_a weights[q, a] x[ids[q, a]]``, its gradient and hessian over the stencil."""
    length = 0.0
    gradient[:] = 0.0
    if want_hessian:
        hessian[:, :] = 0.0
    t = np.empty(3)
    for q in range(ids.shape[0]):
        t[:] = 0.0
        for a in range(ids.shape[1]):
            for d in range(3):
                t[d] += weights[q, a] * x[ids[q, a], d]
        norm = np.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
        length += norm
        for d in range(3):
            t[d] /= norm
        for a in range(ids.shape[1]):
            for d in range(3):
                gradient[3 * slot[q, a] + d] += weights[q, a] * t[d]
        if want_hessian:
            for a in range(ids.shape[1]):
                for b in range(ids.shape[1]):
                    w = weights[q, a] * weights[q, b] / norm
                    for d in range(3):
                        for c in range(3):
                            hessian[3 * slot[q, a] + d, 3 * slot[q, b] + c] -= w * t[d] * t[c]
                        hessian[3 * slot[q, a] + d, 3 * slot[q, b] + d] += w
    return length


class Chamber(Constraint):
    """Growth of fibre-reinforced chambers of constant cross-section; delta [m3] = sum of area x elongation.

    The fibres keep the cross-section, so that volume changes with the length of the centre line alone (Chaillou et al.
    2023). Effort [Pa] is the pressure: work is done along the line only.

    Args:
        name: identifier.
        tangents: per centre line its tangents times quadrature weight as linear combinations of rows (`Beam.line`):
            ``node_ids`` (q, k) and ``weights`` (q, k), whose norms add up to the length.
        area: cross-section of one line [m2].
    """

    size = 1
    unit = ("m3", "Pa")

    def __init__(self, name: str, tangents: list[EmbeddedPoints], area: float) -> None:
        if not (np.isfinite(area) and area > 0.0):
            raise ValueError(f"chamber '{name}': area = {area} m2 must be positive and finite")
        self.name = name
        self.area = area
        self._ids = np.concatenate([line.node_ids for line in tangents])
        self._weights = np.concatenate([line.weights for line in tangents])
        nodes, slot = np.unique(self._ids, return_inverse=True)
        self._slot = slot.reshape(self._ids.shape)
        self.dofs = (3 * nodes[:, None] + np.arange(3)).ravel()
        self._gradient = np.empty(len(self.dofs))
        self._hessian = np.empty((len(self.dofs), len(self.dofs)))
        self.rest_length = float(sum(np.linalg.norm(line.points, axis=1).sum() for line in tangents))

    def value(self, x: np.ndarray) -> np.ndarray:
        vectors = np.einsum("qa,qad->qd", self._weights, x[self._ids])
        return np.array([self.area * (float(np.linalg.norm(vectors, axis=1).sum()) - self.rest_length)])

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        _line_length(x, self._ids, self._weights, self._slot, self._gradient, self._hessian, False)
        return self.area * self._gradient[None, :]

    def hessian(self, x: np.ndarray, effort: np.ndarray) -> np.ndarray:
        _line_length(x, self._ids, self._weights, self._slot, self._gradient, self._hessian, True)
        return effort[0] * self.area * self._hessian
