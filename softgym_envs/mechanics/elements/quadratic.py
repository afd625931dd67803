"""Ten-node tetrahedra: the most accurate solid elements, which hardly lock."""

from __future__ import annotations

import math
from typing import Unpack

import numpy as np

from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.elements.tetrahedra import SolidBlock, SolidOptions, element_masses, orient_corners

EDGES = np.array([(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)])
"""Corners at the ends of the edges on which midside nodes 4 to 9 lie."""


def add_midside_nodes(nodes: np.ndarray, tetrahedra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Turn linear elements into quadratic ones: nodes (n, 3) and tetrahedra (m, 4) -> (n + edges, 3) and (m, 10)."""
    pairs = np.sort(tetrahedra[:, EDGES], axis=2).reshape(-1, 2)
    edges, which = np.unique(pairs, axis=0, return_inverse=True)
    middle = 0.5 * (nodes[edges[:, 0]] + nodes[edges[:, 1]])
    return np.vstack([nodes, middle]), np.column_stack([tetrahedra, len(nodes) + which.reshape(-1, 6)])


def quadratic_triangles(triangles: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Add the midside nodes of tetrahedra (m, 10) to triangles (k, 3) of their corners: (k, 6), edges 01, 12, 20."""
    middle: dict[tuple[int, int], int] = {}
    for slot, (a, b) in enumerate(EDGES):
        low = np.minimum(tetrahedra[:, a], tetrahedra[:, b])
        high = np.maximum(tetrahedra[:, a], tetrahedra[:, b])
        middle.update(zip(zip(low.tolist(), high.tolist(), strict=True), tetrahedra[:, 4 + slot].tolist(), strict=True))
    try:
        middles = [
            [middle[min(p, q), max(p, q)] for p, q in ((a, b), (b, c), (c, a))] for a, b, c in triangles.tolist()
        ]
    except KeyError as error:
        first, second = error.args[0]
        raise ValueError(f"nodes {first} and {second} are not joined by an edge of the quadratic elements") from None
    return np.hstack([triangles, np.array(middles, dtype=np.int64).reshape(-1, 3)])


def split_triangles(triangles: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Split boundary triangles (k, 3) of corners into four at the midside nodes of tetrahedra (m, 10): (4 k, 3).

    For pictures. Use `quadratic_triangles` for a cavity: on split triangles the pressure is not distributed according
    to the elements' shape functions, which reduces their accuracy.
    """
    parts = quadratic_triangles(triangles, tetrahedra)[:, [[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]]]
    return parts.reshape(-1, 3)


def _shape(barycentric: np.ndarray) -> np.ndarray:
    """Shape functions (..., 10) at barycentric coordinates (..., 4)."""
    corner = barycentric * (2.0 * barycentric - 1.0)
    return np.concatenate([corner, 4.0 * barycentric[..., EDGES[:, 0]] * barycentric[..., EDGES[:, 1]]], axis=-1)


def _shape_slopes(barycentric: np.ndarray) -> np.ndarray:
    """Derivatives (10, 4) of the shape functions with respect to the barycentric coordinates (4,)."""
    slopes = np.zeros((10, 4))
    slopes[:4] = np.diag(4.0 * barycentric - 1.0)
    for k, (a, b) in enumerate(EDGES):
        slopes[4 + k, a], slopes[4 + k, b] = 4.0 * barycentric[b], 4.0 * barycentric[a]
    return slopes


def _unit_mass() -> np.ndarray:
    """Mass matrix (10, 10) of a straight-edged element of unit mass, by exact integration of polynomials."""
    # Shape functions as polynomials of the barycentric coordinates: {exponents: factor}.
    unit = np.eye(4, dtype=int)
    functions = [{tuple(2 * unit[k]): 2.0, tuple(unit[k]): -1.0} for k in range(4)]
    functions += [{tuple(unit[a] + unit[b]): 4.0} for a, b in EDGES]
    matrix = np.zeros((10, 10))
    for i, first in enumerate(functions):
        for j, second in enumerate(functions):
            for p, u in first.items():
                for q, v in second.items():
                    powers = np.add(p, q)
                    matrix[i, j] += (
                        u * v * 6.0 * math.prod(map(math.factorial, powers)) / math.factorial(powers.sum() + 3)
                    )
    return matrix


_UNIT_MASS = _unit_mass()

# Four Gauss points, exact to degree two.
_A, _B = (5.0 + 3.0 * 5.0**0.5) / 20.0, (5.0 - 5.0**0.5) / 20.0
_GAUSS = np.full((4, 4), _B) + (_A - _B) * np.eye(4)


@njit(cache=True, error_model="numpy")
def _add_tangent(connectivity, points, gradients, weights, tangent, scatter, out):
    k = connectivity.shape[1]
    half = np.empty(9)
    element = np.empty((3 * k, 3 * k))
    for e in range(connectivity.shape[0]):
        element[:, :] = 0.0
        for q in range(e * points, (e + 1) * points):
            g = gradients[q]
            c = tangent[q]
            w = weights[q]
            for a in range(k):
                g0, g1, g2 = w * g[a, 0], w * g[a, 1], w * g[a, 2]
                for i in range(3):
                    for p in range(9):
                        half[p] = g0 * c[3 * i, p] + g1 * c[3 * i + 1, p] + g2 * c[3 * i + 2, p]
                    for b in range(a + 1):
                        for j in range(3):
                            element[3 * a + i, 3 * b + j] += (
                                half[3 * j] * g[b, 0] + half[3 * j + 1] * g[b, 1] + half[3 * j + 2] * g[b, 2]
                            )
        m = 0
        for r in range(3 * k):
            for s in range(r + 1):
                target = scatter[e, m]
                m += 1
                if target >= 0:
                    out[target] += element[r, s]


class QuadraticTetrahedra(SolidBlock):
    """A block of quadratic (ten-node) tetrahedra of one material, with straight or curved edges.

    Four Gauss points. Does not lock in bending as linear tetrahedra do, and hardly as Poisson's ratio nears 0.5.

    Args:
        nodes: rest positions [m], shape (n, 3).
        connectivity: corners, then midside nodes of the edges 01, 12, 02, 03, 13, 23, shape (m, 10); see
            `add_midside_nodes`.
        **options: material, young_modulus, poisson_ratio and density, see `SolidBlock`.

    Raises:
        ValueError: for a degenerate or negatively oriented element, an index out of range or an unknown material.
    """

    element = "quadratic"

    def __init__(self, nodes: np.ndarray, connectivity: np.ndarray, **options: Unpack[SolidOptions]) -> None:
        connectivity = np.array(connectivity, dtype=np.int64)
        if connectivity.ndim != 2 or connectivity.shape[1] != 10:
            raise ValueError(f"quadratic tetrahedra must have shape (m, 10), got {connectivity.shape}")
        corners, _, turned = orient_corners(nodes, connectivity[:, :4])
        if connectivity.min() < 0 or connectivity.max() >= len(nodes):
            raise ValueError(
                f"tetrahedra refer to nodes {connectivity.min()}..{connectivity.max()}, the mesh has {len(nodes)}"
            )
        # Reorienting an element swaps corners 1 and 2, and with them the edges 01/02 and 13/23.
        connectivity[turned] = connectivity[turned][:, [0, 2, 1, 3, 6, 5, 4, 7, 9, 8]]
        assert (connectivity[:, :4] == corners).all()
        x = nodes[connectivity]
        gradients = np.empty((len(connectivity), 4, 10, 3))
        weights = np.empty((len(connectivity), 4))
        for q, point in enumerate(_GAUSS):
            slopes = _shape_slopes(point)
            local = slopes[:, 1:] - slopes[:, :1]
            jacobian = np.einsum("mad,ak->mdk", x, local)
            determinant = np.linalg.det(jacobian)
            if not (determinant > 0.0).all():
                raise ValueError(f"quadratic tetrahedron {int(np.argmin(determinant))} is inverted by its curved edges")
            gradients[:, q] = np.einsum("ak,mkd->mad", local, np.linalg.inv(jacobian))
            weights[:, q] = determinant / 24.0
        super().__init__(connectivity, gradients.reshape(-1, 10, 3), weights.ravel(), **options)

    def shape(self, barycentric: np.ndarray) -> np.ndarray:
        return _shape(barycentric)

    def embed(self, points: np.ndarray, nodes: np.ndarray, hint: np.ndarray | None = None) -> EmbeddedPoints:
        # Barycentric coordinates of the corners: exact for straight edges.
        linear = EmbeddedPoints(points, nodes, self.corners, hint)
        embedded = EmbeddedPoints.from_weights(self.connectivity[linear.elements], _shape(linear.weights), nodes)
        embedded.elements = linear.elements
        return embedded

    def nodal_masses(self, count: int) -> np.ndarray:
        shares = _shape(_GAUSS)
        masses = self.density * self.weights.reshape(-1, 4) @ shares
        return np.bincount(self.connectivity.ravel(), weights=masses.ravel(), minlength=count)

    def mass_entries(self, lumped: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return element_masses(self.connectivity, self.density * self.volumes, _UNIT_MASS, lumped)

    def _add_stiffness(self, tangent: np.ndarray, values: np.ndarray, scatter: list[np.ndarray]) -> None:
        _add_tangent(self.connectivity, self.points, self.gradients, self.weights, tangent, scatter[0], values)
