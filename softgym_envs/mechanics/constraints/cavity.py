"""The volume of a closed cavity, and the pressure of air that is sealed in one."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.constraints.constraint import Constraint

ATMOSPHERE = 101_325.0
"""Standard atmospheric pressure [Pa]."""

# The cone of a quadratic triangle (corners a, b, c, midside nodes ab, bc, ca) has the volume sum w det(x_i, x_j, x_k)
# / 6 over these triples: the integral of x . (x_s x x_t) / 3 with its shape functions, exactly.
_TRIPLES = np.array(list(combinations(range(6), 3)))
_WEIGHTS = np.array([2, 3, -5, -5, 5, 5, -3, 4, 24, 4, -5, 3, -5, -24, -4, 4, 4, -4, -24, 16]) / 15.0


def enclosed_volume(x: np.ndarray, triangles: np.ndarray) -> float:
    """Volume [m3] inside a closed surface of triangles (k, 3), positive if they are counter-clockwise from outside."""
    return _weighted_volume(x, triangles, np.ones(len(triangles)))


def _weighted_volume(x: np.ndarray, triples: np.ndarray, weights: np.ndarray) -> float:
    a, b, c = (x[triples[:, i]] for i in range(3))
    centre = x[triples[0, 0]]  # any point near the surface keeps round-off small
    return float(np.einsum("i,ij,ij->", weights, a - centre, np.cross(b - centre, c - centre)) / 6.0)


@njit(cache=True)
def _volume_gradient(x, triples, weights, slot, out):
    out[:] = 0.0
    for t in range(triples.shape[0]):
        scale = weights[t] / 6.0
        for corner in range(3):
            a = x[triples[t, (corner + 1) % 3]]
            b = x[triples[t, (corner + 2) % 3]]
            k = 3 * slot[t, corner]
            out[k] += scale * (a[1] * b[2] - a[2] * b[1])
            out[k + 1] += scale * (a[2] * b[0] - a[0] * b[2])
            out[k + 2] += scale * (a[0] * b[1] - a[1] * b[0])


@njit(cache=True)
def _volume_hessian(x, triples, weights, effort, out):
    """Off-diagonal entries of each triple: d2 V / dx_a dx_b = -w [x_c]x / 6 for (a, b, c) in cyclic order."""
    k = 0
    for t in range(triples.shape[0]):
        scale = effort * weights[t] / 6.0
        for corner in range(3):
            c = x[triples[t, (corner + 2) % 3]]
            out[k], out[k + 1] = scale * c[2], -scale * c[1]
            out[k + 2], out[k + 3] = -scale * c[2], scale * c[0]
            out[k + 4], out[k + 5] = scale * c[1], -scale * c[0]
            k += 6


# Places of the entries of _volume_hessian in its 3 x 3 block.
_ROWS = np.array([0, 0, 1, 1, 2, 2])
_COLUMNS = np.array([1, 2, 0, 2, 0, 1])


class Cavity(Constraint):
    """Growth of the volume inside a closed surface; delta [m3] = volume - rest volume, effort [Pa] = pressure.

    The pressure follows the surface as it deforms; its exact second derivative is part of the tangent.

    Args:
        name: identifier.
        triangles: node indices of a closed surface, shape (k, 3), consistently oriented either way; or of quadratic
            elements, (k, 6) with midside nodes of the edges 01, 12, 20 (`quadratic_triangles`).
        nodes: rest positions [m], shape (n, 3).

    Raises:
        ValueError: if the surface is not closed and consistently oriented, or encloses nothing.
    """

    size = 1
    unit = ("m3", "Pa")

    def __init__(self, name: str, triangles: np.ndarray, nodes: np.ndarray) -> None:
        self.name = name
        triangles = np.array(triangles, dtype=np.int64)
        if triangles.ndim != 2 or triangles.shape[1] not in (3, 6) or len(triangles) < 4:
            raise ValueError(
                f"cavity '{name}' needs triangles of shape (k, 3) or (k, 6) with k >= 4, got {triangles.shape}"
            )
        quadratic = triangles.shape[1] == 6
        around = triangles[:, [0, 3, 1, 4, 2, 5]] if quadratic else triangles
        edges = np.stack([around, np.roll(around, -1, axis=1)], axis=2).reshape(-1, 2)
        keys = edges[:, 0] * len(nodes) + edges[:, 1]
        mirrored = edges[:, 1] * len(nodes) + edges[:, 0]
        # An edge at which a cavity pinches itself occurs more than once, equally often in both directions.
        if not np.array_equal(np.sort(keys), np.sort(mirrored)):
            raise ValueError(f"the surface of cavity '{name}' is not closed or not oriented consistently")
        # Volumes are sums of weighted determinants of triples of nodes: one for each linear triangle.
        triples, weights = triangles, np.ones(len(triangles))
        if quadratic:
            triples, weights = triangles[:, _TRIPLES].reshape(-1, 3), np.tile(_WEIGHTS, len(triangles))
        volume = _weighted_volume(nodes, triples, weights)
        if volume < 0.0:
            triangles = triangles[:, [0, 2, 1, 5, 4, 3] if quadratic else [0, 2, 1]]
            triples, volume = triples[:, ::-1].copy(), -volume
        if not volume > 0.0:
            raise ValueError(f"cavity '{name}' encloses no volume")
        self.triangles = triangles
        self._triples, self._weights = triples, weights
        self.rest_volume = volume
        used, slot = np.unique(triples, return_inverse=True)
        self._slot = slot.reshape(triples.shape)
        self.dofs = (3 * used[:, None] + np.arange(3)).ravel()
        self._gradient = np.empty(len(self.dofs))
        self._entries = np.empty(18 * len(triples))

    @property
    def flat_triangles(self) -> np.ndarray:
        """The surface as flat triangles, shape (t, 3): quadratic ones are split at their midside nodes."""
        if self.triangles.shape[1] == 3:
            return self.triangles
        return self.triangles[:, [[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]]].reshape(-1, 3)

    def rest_size(self) -> float:
        return self.rest_volume

    def volume(self, x: np.ndarray) -> float:
        """Enclosed volume [m3] at node positions ``x`` (n, 3)."""
        return _weighted_volume(x, self._triples, self._weights)

    def volume_at(self, delta: float) -> float:
        """Return the volume [m3] at a growth ``delta`` [m3]."""
        return self.rest_volume + delta

    def value(self, x: np.ndarray) -> np.ndarray:
        return np.array([self.volume(x) - self.rest_volume])

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        _volume_gradient(x, self._triples, self._weights, self._slot, self._gradient)
        return self._gradient[None, :]

    def hessian_pattern(self) -> tuple[np.ndarray, np.ndarray]:
        a = self._triples[:, :, None]
        b = np.roll(self._triples, -1, axis=1)[:, :, None]
        rows, columns = (3 * a + _ROWS).ravel(), (3 * b + _COLUMNS).ravel()
        # Every entry and its mirror image.
        return np.concatenate([rows, columns]), np.concatenate([columns, rows])

    def hessian(self, x: np.ndarray, effort: np.ndarray) -> np.ndarray:
        _volume_hessian(x, self._triples, self._weights, effort[0], self._entries)
        return np.concatenate([self._entries, self._entries])


class SealedAir(Constraint):
    """Gauge pressure of air sealed in a cavity, by Boyle's law; delta [Pa], conjugate effort [m3].

    The air is at ambient pressure when the body is undeformed, and keeps its temperature: ``p V`` is constant for the
    absolute pressure p. `EnclosedGas` has the same air's energy; this row only measures it.

    Args:
        cavity: that holds the air.
        ambient: absolute pressure around the body, and of the air at rest [Pa].

    Raises:
        ValueError: if the ambient pressure is not positive and finite.
    """

    size = 1
    unit = ("Pa", "m3")

    def __init__(self, cavity: Cavity, ambient: float = ATMOSPHERE) -> None:
        if not (np.isfinite(ambient) and ambient > 0.0):
            raise ValueError(f"ambient = {ambient} Pa around cavity '{cavity.name}' must be positive and finite")
        self.name, self.cavity, self.ambient, self.dofs = cavity.name, cavity, float(ambient), cavity.dofs

    def pressure(self, volume: float) -> tuple[float, float, float]:
        """Return the gauge pressure [Pa] at a volume [m3], and its first and second derivative by it."""
        absolute = self.ambient * self.cavity.rest_volume / volume
        return absolute - self.ambient, -absolute / volume, 2.0 * absolute / volume**2

    def volume_at(self, delta: float) -> float:
        """Return the volume [m3] at a gauge pressure ``delta`` [Pa]."""
        return self.ambient * self.cavity.rest_volume / (self.ambient + delta)

    def energy(self, volume: float) -> float:
        """Return the work [J] that compresses the air from rest to a volume [m3], less that of the ambient pressure."""
        rest = self.cavity.rest_volume
        # The difference is small against both terms.
        strain = (volume - rest) / rest
        return self.ambient * rest * float(strain - np.log1p(strain))

    def value(self, x: np.ndarray) -> np.ndarray:
        return np.array([self.pressure(self.cavity.volume(x))[0]])

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        return self.pressure(self.cavity.volume(x))[1] * self.cavity.jacobian(x)

    def hessian_pattern(self) -> tuple[np.ndarray, np.ndarray]:
        pairs, own = super().hessian_pattern(), self.cavity.hessian_pattern()
        return np.concatenate([pairs[0], own[0]]), np.concatenate([pairs[1], own[1]])

    def hessian(self, x: np.ndarray, effort: np.ndarray) -> np.ndarray:
        _, slope, curvature = self.pressure(self.cavity.volume(x))
        gradient = self.cavity.jacobian(x)[0]
        product = effort[0] * curvature * np.outer(gradient, gradient)
        return np.concatenate([product.ravel(), self.cavity.hessian(x, effort * slope)])
