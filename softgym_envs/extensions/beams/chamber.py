"""A fibre-reinforced chamber: a tube that only grows along its centre line."""

from __future__ import annotations

import numpy as np

from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.constraints.constraint import Constraint
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints


@njit(cache=True, error_model="numpy")
def _line_length(x, ids, weights, slot, gradient):
    """Sum of the norms of ``t_q = sum_a weights[q, a] x[ids[q, a]]`` and its gradient over the stencil."""
    length = 0.0
    gradient[:] = 0.0
    t = np.empty(3)
    for q in range(ids.shape[0]):
        t[:] = 0.0
        for a in range(ids.shape[1]):
            for d in range(3):
                t[d] += weights[q, a] * x[ids[q, a], d]
        norm = np.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
        length += norm
        for a in range(ids.shape[1]):
            for d in range(3):
                gradient[3 * slot[q, a] + d] += weights[q, a] * t[d] / norm
    return length


@njit(cache=True, error_model="numpy")
def _line_hessian(x, ids, weights, group, scale, out):
    """The second derivative, one block for each group of tangents between the same rows."""
    out[:] = 0.0
    t = np.empty(3)
    local = np.empty((3, 3))
    for q in range(ids.shape[0]):
        t[:] = 0.0
        for a in range(ids.shape[1]):
            for d in range(3):
                t[d] += weights[q, a] * x[ids[q, a], d]
        squared = t[0] * t[0] + t[1] * t[1] + t[2] * t[2]
        factor = scale / np.sqrt(squared)
        for d in range(3):
            for c in range(3):
                local[d, c] = -factor * t[d] * t[c] / squared
            local[d, d] += factor
        block = out[group[q]]
        for a in range(ids.shape[1]):
            for b in range(ids.shape[1]):
                w = weights[q, a] * weights[q, b]
                if w != 0.0:
                    for d in range(3):
                        for c in range(3):
                            block[3 * a + d, 3 * b + c] += w * local[d, c]


class Chamber(Constraint):
    """Growth of fibre-reinforced chambers of constant cross-section; delta [m3] = sum of area x elongation.

    The fibres preserve the cross-section, so the volume depends only on the length of the centre line (Chaillou et al.
    2023). Effort [Pa] is the pressure, which does work only along the line.

    Args:
        name: identifier.
        tangents: for each centre line, its weighted tangents as linear combinations of rows (`Beam.line`):
            ``node_ids`` (q, k) and ``weights`` (q, k), whose norms add up to the length.
        area: cross-section of one line [m2].

    Attributes:
        ids: rows of all tangents, shape (q, k).
        weights: their weights, shape (q, k).
        rest_length: length of all lines at rest [m].
    """

    size = 1
    unit = ("m3", "Pa")

    def __init__(self, name: str, tangents: list[EmbeddedPoints], area: float) -> None:
        if not (np.isfinite(area) and area > 0.0):
            raise ValueError(f"chamber '{name}': area = {area} m2 must be positive and finite")
        self.name = name
        self.area = area
        self.ids = np.concatenate([line.node_ids for line in tangents])
        self.weights = np.concatenate([line.weights for line in tangents])
        nodes, slot = np.unique(self.ids, return_inverse=True)
        self._slot = slot.reshape(self.ids.shape)
        self.dofs = (3 * nodes[:, None] + np.arange(3)).ravel()
        self._gradient = np.empty(len(self.dofs))
        self._rows, group = np.unique(self.ids, axis=0, return_inverse=True)
        self._group = group.ravel()
        k = 3 * self.ids.shape[1]
        self._blocks = np.empty((len(self._rows), k, k))
        self.rest_length = float(sum(np.linalg.norm(line.points, axis=1).sum() for line in tangents))

    def rest_size(self) -> float:
        return self.area * self.rest_length

    def value(self, x: np.ndarray) -> np.ndarray:
        return self.linearise(x)[0]

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        return self.linearise(x)[1]

    def linearise(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        length = _line_length(x, self.ids, self.weights, self._slot, self._gradient)
        return np.array([self.area * (length - self.rest_length)]), self.area * self._gradient[None, :]

    def hessian_pattern(self) -> tuple[np.ndarray, np.ndarray]:
        # Only rows of the same element depend on each other.
        dofs = (3 * self._rows[:, :, None] + np.arange(3)).reshape(len(self._rows), -1)
        k = dofs.shape[1]
        return np.repeat(dofs, k, axis=1).ravel(), np.tile(dofs, (1, k)).ravel()

    def hessian(self, x: np.ndarray, effort: np.ndarray) -> np.ndarray:
        _line_hessian(x, self.ids, self.weights, self._group, effort[0] * self.area, self._blocks)
        return self._blocks
