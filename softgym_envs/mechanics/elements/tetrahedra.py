"""Four-node tetrahedra: shape-function gradients, deformation gradients, and assembly of forces and tangents."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar, TypedDict, Unpack

import numpy as np

from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.constraints.averaging import averaged_points
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.elements.block import ElementBlock, StrainRates, lower_pairs
from softgym_envs.mechanics.elements.damping import resist, strain_rates
from softgym_envs.mechanics.materials import Material, lame_parameters, resolve_material
from softgym_envs.quantities import check_quantity, finite_number

FACES = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
"""Corners of the faces of a positively oriented tetrahedron, seen counter-clockwise from outside."""


@njit(cache=True, error_model="numpy")
def deformation_gradients(x, connectivity, points, gradients, F):
    """Fill the deformation gradients ``F`` (m q, 9) at the quadrature points."""
    for q in range(gradients.shape[0]):
        e = q // points
        for i in range(9):
            F[q, i] = 0.0
        for a in range(connectivity.shape[1]):
            node = connectivity[e, a]
            for i in range(3):
                for j in range(3):
                    F[q, 3 * i + j] += x[node, i] * gradients[q, a, j]


@njit(cache=True, error_model="numpy")
def add_forces(connectivity, points, gradients, weights, stress, out):
    """Add the gradient of the energy to ``out``, shape (n, 3)."""
    for q in range(gradients.shape[0]):
        e = q // points
        for a in range(connectivity.shape[1]):
            node = connectivity[e, a]
            for i in range(3):
                value = 0.0
                for j in range(3):
                    value += stress[q, 3 * i + j] * gradients[q, a, j]
                out[node, i] += weights[q] * value


@njit(cache=True, error_model="numpy")
def _add_tangent(gradients, volumes, tangent, scatter, out):
    """Add the lower triangle of each 12 x 12 element matrix to the CSC values ``out`` through ``scatter``."""
    half = np.empty(9)  # one row of the element matrix before the second product with gradients
    for e in range(gradients.shape[0]):
        g = gradients[e]
        c = tangent[e]
        k = 0
        for a in range(4):
            g0, g1, g2 = volumes[e] * g[a, 0], volumes[e] * g[a, 1], volumes[e] * g[a, 2]
            for i in range(3):
                for q in range(9):
                    half[q] = g0 * c[3 * i, q] + g1 * c[3 * i + 1, q] + g2 * c[3 * i + 2, q]
                for b in range(a + 1):
                    for j in range(3 if b < a else i + 1):
                        target = scatter[e, k]
                        k += 1
                        if target >= 0:
                            out[target] += half[3 * j] * g[b, 0] + half[3 * j + 1] * g[b, 1] + half[3 * j + 2] * g[b, 2]


@njit(cache=True, error_model="numpy")
def _add_warped(x, step, connectivity, points, gradients, volumes, out):
    """Add ``V (F' - F) g_a``, with F' the gradient F rotated and strained by a step, to ``out``, shape (n, 3)."""
    f = np.empty((3, 3))
    d = np.empty((3, 3))
    h = np.empty((3, 3))
    turn = np.empty((3, 3))
    strained = np.empty((3, 3))
    for e in range(gradients.shape[0]):
        element = e // points
        f[:, :] = 0.0
        d[:, :] = 0.0
        for a in range(connectivity.shape[1]):
            node = connectivity[element, a]
            for i in range(3):
                for j in range(3):
                    f[i, j] += x[node, i] * gradients[e, a, j]
                    d[i, j] += step[node, i] * gradients[e, a, j]
        c00 = f[1, 1] * f[2, 2] - f[1, 2] * f[2, 1]
        c01 = f[1, 2] * f[2, 0] - f[1, 0] * f[2, 2]
        c02 = f[1, 0] * f[2, 1] - f[1, 1] * f[2, 0]
        inverse = 1.0 / (f[0, 0] * c00 + f[0, 1] * c01 + f[0, 2] * c02)
        for i in range(3):
            # Row i of h = d F^-1, with F^-1 the transposed cofactors over the determinant.
            h[i, 0] = inverse * (d[i, 0] * c00 + d[i, 1] * c01 + d[i, 2] * c02)
            h[i, 1] = inverse * (
                d[i, 0] * (f[0, 2] * f[2, 1] - f[0, 1] * f[2, 2])
                + d[i, 1] * (f[0, 0] * f[2, 2] - f[0, 2] * f[2, 0])
                + d[i, 2] * (f[0, 1] * f[2, 0] - f[0, 0] * f[2, 1])
            )
            h[i, 2] = inverse * (
                d[i, 0] * (f[0, 1] * f[1, 2] - f[0, 2] * f[1, 1])
                + d[i, 1] * (f[0, 2] * f[1, 0] - f[0, 0] * f[1, 2])
                + d[i, 2] * (f[0, 0] * f[1, 1] - f[0, 1] * f[1, 0])
            )
        w0 = 0.5 * (h[2, 1] - h[1, 2])
        w1 = 0.5 * (h[0, 2] - h[2, 0])
        w2 = 0.5 * (h[1, 0] - h[0, 1])
        angle2 = w0 * w0 + w1 * w1 + w2 * w2
        angle = np.sqrt(angle2)
        if angle < 1e-4:
            a1 = 1.0 - angle2 / 6.0
            a2 = 0.5 - angle2 / 24.0
        else:
            a1 = np.sin(angle) / angle
            a2 = (1.0 - np.cos(angle)) / angle2
        # Rodrigues' formula for exp([w]x).
        turn[0, 0] = 1.0 - a2 * (w1 * w1 + w2 * w2)
        turn[1, 1] = 1.0 - a2 * (w0 * w0 + w2 * w2)
        turn[2, 2] = 1.0 - a2 * (w0 * w0 + w1 * w1)
        turn[0, 1] = a2 * w0 * w1 - a1 * w2
        turn[1, 0] = a2 * w0 * w1 + a1 * w2
        turn[0, 2] = a2 * w0 * w2 + a1 * w1
        turn[2, 0] = a2 * w0 * w2 - a1 * w1
        turn[1, 2] = a2 * w1 * w2 - a1 * w0
        turn[2, 1] = a2 * w1 * w2 + a1 * w0
        for i in range(3):
            for j in range(3):
                strained[i, j] = f[i, j]
                for k in range(3):
                    strained[i, j] += 0.5 * (h[i, k] + h[k, i]) * f[k, j]
        v = volumes[e]
        for i in range(3):
            for j in range(3):
                value = -f[i, j]
                for k in range(3):
                    value += turn[i, k] * strained[k, j]
                d[i, j] = v * value
        for a in range(connectivity.shape[1]):
            node = connectivity[element, a]
            for i in range(3):
                out[node, i] += (
                    d[i, 0] * gradients[e, a, 0] + d[i, 1] * gradients[e, a, 1] + d[i, 2] * gradients[e, a, 2]
                )


def check_nodes(nodes: np.ndarray) -> np.ndarray:
    """Return nodes as a contiguous array of floats (n, 3).

    Raises:
        ValueError: if they have another shape or are not finite.
    """
    nodes = np.ascontiguousarray(nodes, dtype=float)
    if nodes.ndim != 2 or nodes.shape[1] != 3 or not np.isfinite(nodes).all():
        raise ValueError(f"nodes must be finite with shape (n, 3), got shape {nodes.shape}")
    return nodes


def orient_corners(nodes: np.ndarray, connectivity: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Check tetrahedra and reorient those that are negatively oriented.

    Args:
        nodes: rest positions [m], shape (n, 3).
        connectivity: corner indices, shape (m, 4).

    Returns:
        Corner indices (m, 4), volumes [m3] (m,), and which elements were reoriented (m,).

    Raises:
        ValueError: for a wrong shape, an index out of range or a degenerate element.
    """
    connectivity = np.array(connectivity, dtype=np.int64)
    if connectivity.ndim != 2 or connectivity.shape[1] != 4 or len(connectivity) == 0:
        raise ValueError(f"tetrahedra must have shape (m, 4) with m > 0, got {connectivity.shape}")
    if connectivity.min() < 0 or connectivity.max() >= len(nodes):
        raise ValueError(
            f"tetrahedra refer to nodes {connectivity.min()}..{connectivity.max()}, the mesh has {len(nodes)}"
        )
    corners = nodes[connectivity]
    edges = corners[:, 1:] - corners[:, :1]
    volumes = np.linalg.det(edges) / 6.0
    turned = volumes < 0
    connectivity[turned] = connectivity[turned][:, [0, 2, 1, 3]]
    flat = np.flatnonzero(np.abs(volumes) < 1e-9 * np.abs(edges).max(axis=(1, 2)) ** 3)
    if len(flat):
        place = [float(f"{value:.4g}") for value in corners[flat[0]].mean(axis=0)]
        raise ValueError(f"{len(flat)} degenerate tetrahedra, the first at index {flat[0]} near {place} m")
    return connectivity, np.abs(volumes), turned


def element_masses(
    connectivity: np.ndarray, masses: np.ndarray, shares: np.ndarray, lumped: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mass entries of elements (m, k) with masses [kg] (m,) and a mass matrix ``shares`` (k, k) of unit mass.

    Lumping keeps the diagonal, scaled to the mass (Hinton, Rock and Zienkiewicz 1976).
    """
    if lumped:
        diagonal = np.diag(shares) / np.trace(shares)
        nodes = connectivity.ravel()
        return nodes, nodes, (masses[:, None] * diagonal).ravel()
    i, j = np.tril_indices(connectivity.shape[1])
    return connectivity[:, i].ravel(), connectivity[:, j].ravel(), (masses[:, None] * shares[i, j]).ravel()


def boundary_triangles(tetrahedra: np.ndarray) -> np.ndarray:
    """Return the faces (t, 3) that belong to one tetrahedron only, seen counter-clockwise from outside.

    Args:
        tetrahedra: corner indices of positively oriented tetrahedra, shape (m, 4).
    """
    faces = tetrahedra[:, FACES].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[np.sort(first[count == 1])]


def check_density(density: float) -> float:
    """Return a density [kg/m3].

    Raises:
        ValueError: if it is negative or not finite.
    """
    found = finite_number(density, "density", "kg/m3")
    check_quantity("density", found, "density")
    return found


class SolidOptions(TypedDict, total=False):
    """Elasticity and density of a block of solid elements: keyword arguments of `SolidBlock`, which describes them."""

    material: str | Material
    young_modulus: float | np.ndarray
    poisson_ratio: float | np.ndarray
    density: float


class SolidBlock(ElementBlock):
    """Base class of blocks of solid elements: material, quadrature and warping of steps.

    Args:
        connectivity: node indices, shape (m, k).
        gradients: shape-function gradients [1/m] at the quadrature points, shape (m q, k, 3), element by element.
        weights: volumes [m3] of the quadrature points, shape (m q,).
        material: a `Material` or its name.
        young_modulus: [Pa], scalar or shape (m,).
        poisson_ratio: scalar or shape (m,), inside (-1, 0.5).
        density: [kg/m3].

    Attributes:
        element: name by which this kind of elements is asked for; empty for kinds that are not.
    """

    element: ClassVar[str] = ""

    def __init__(
        self,
        connectivity: np.ndarray,
        gradients: np.ndarray,
        weights: np.ndarray,
        *,
        material: str | Material = "corotational",
        young_modulus: float | np.ndarray = 3.0e6,
        poisson_ratio: float | np.ndarray = 0.3,
        density: float = 1100.0,
    ) -> None:
        self.material = resolve_material(material)
        self.density = check_density(density)
        self.connectivity = connectivity
        self.gradients = np.ascontiguousarray(gradients)
        self.weights = weights
        self.points = len(weights) // len(connectivity)
        self.volumes = weights.reshape(len(connectivity), -1).sum(axis=1)
        self.nodes_used = np.unique(connectivity)
        self.volume = float(weights.sum())
        self.mass = self.density * self.volume
        self._set_elasticity(young_modulus, poisson_ratio)
        count = len(weights)
        self.stiffness = float(np.mean(self.mu)) * float(np.cbrt(self.volumes).mean())
        self._F = np.empty((count, 9))
        self._energy = np.empty(count)
        self._stress = np.empty((count, 9))
        self._tangent = np.empty((count, 9, 9))
        self._inverse, self._slope = np.empty((count, 9)), np.empty((count, 9))
        self._rates, self._traces = np.empty((count, 6)), np.empty(count)

    @property
    def corners(self) -> np.ndarray:
        """Corner nodes of the elements, shape (m, 4)."""
        return self.connectivity[:, :4]

    def set_elasticity(self, young_modulus: float | np.ndarray, poisson_ratio: float | np.ndarray) -> None:
        """Set Young's modulus [Pa] and Poisson's ratio, scalars or shape (m,).

        Raises:
            ValueError: for a modulus that is probably in another unit, or a value that no material has.
        """
        values = np.ravel(np.asarray(young_modulus, dtype=float))
        check_quantity("modulus", values[values > 0.0], "young_modulus")
        self._set_elasticity(young_modulus, poisson_ratio)

    def _set_elasticity(self, young_modulus: float | np.ndarray, poisson_ratio: float | np.ndarray) -> None:
        m = len(self.connectivity)
        young = np.broadcast_to(np.asarray(young_modulus, dtype=float), (m,))
        poisson = np.broadcast_to(np.asarray(poisson_ratio, dtype=float), (m,))
        pairs, which = np.unique(np.column_stack([young, poisson]), axis=0, return_inverse=True)
        parameters = np.repeat(
            np.array([lame_parameters(e, nu) for e, nu in pairs])[which.ravel()], self.points, axis=0
        )
        self.mu, self.lame = np.ascontiguousarray(parameters[:, 0]), np.ascontiguousarray(parameters[:, 1])
        self.elasticity_version += 1

    @property
    def largest_young_modulus(self) -> float:
        """Young's modulus [Pa] of the stiffest element."""
        return float((self.mu * (3.0 * self.lame + 2.0 * self.mu) / (self.lame + self.mu)).max())

    def shape(self, barycentric: np.ndarray) -> np.ndarray:
        """Return the shape functions (..., k) at barycentric coordinates (..., 4) of an element."""
        return barycentric

    def embed(self, points: np.ndarray, nodes: np.ndarray, hint: np.ndarray | None = None) -> EmbeddedPoints:
        """Embed points [m] (p, 3) of the rest shape ``nodes`` [m] (n, 3) in the elements."""
        return EmbeddedPoints(points, nodes, self.connectivity, hint)

    def embed_average(self, points: np.ndarray, nodes: np.ndarray, radius: float) -> EmbeddedPoints:
        """Embed points [m] (p, 3) that act on the body within a radius [m] of them; see `averaged_points`."""
        return averaged_points(points, nodes, self.connectivity, self.shape, radius)

    def stencils(self) -> list[tuple[np.ndarray, np.ndarray]]:
        k = self.connectivity.shape[1]
        return [lower_pairs((3 * self.connectivity[:, :, None] + np.arange(3)).reshape(-1, 3 * k))]

    def add(
        self, x: np.ndarray, gradient: np.ndarray, values: np.ndarray | None, scatter: list[np.ndarray] | None
    ) -> tuple[float, int]:
        deformation_gradients(x, self.connectivity, self.points, self.gradients, self._F)
        tangent = self._tangent if values is not None else self._tangent[:0]
        inverted = self.material.evaluate(self._F, self.mu, self.lame, self._energy, self._stress, tangent)
        if inverted:
            return np.inf, inverted
        add_forces(self.connectivity, self.points, self.gradients, self.weights, self._stress, gradient)
        if values is not None:
            assert scatter is not None
            self._add_stiffness(tangent, values, scatter)
        return float(self._energy @ self.weights), 0

    def add_damping(
        self,
        x: np.ndarray,
        rates: StrainRates,
        gradient: np.ndarray,
        values: np.ndarray | None,
        scatter: list[np.ndarray] | None,
    ) -> float:
        self._fill_rates(x, rates)
        return self._add_resistance(rates, self.lame, np.zeros_like(self.lame), gradient, values, scatter)

    def _fill_rates(self, x: np.ndarray, rates: StrainRates) -> None:
        """Fill the strain rates, and the deformation gradients at rows ``x`` (n, 3)."""
        start, middle, velocity = (np.empty_like(self._F) for _ in range(3))
        for rows, out in ((rates.start, start), (rates.middle, middle), (rates.velocity, velocity), (x, self._F)):
            deformation_gradients(rows, self.connectivity, self.points, self.gradients, out)
        strain_rates(start, middle, velocity, self._inverse, self._rates, self._traces)

    def _add_resistance(
        self,
        rates: StrainRates,
        lame: np.ndarray,
        pressure: np.ndarray,
        gradient: np.ndarray,
        values: np.ndarray | None,
        scatter: list[np.ndarray] | None,
    ) -> float:
        """Add the damping at the strain rates, with a further pressure [Pa] (m q,), and return its power [W]."""
        beta, tangent = rates.damping, self._tangent if values is not None else self._tangent[:0]
        resist(
            self._F,
            self._inverse,
            self._rates,
            beta * self.mu,
            beta * lame,
            pressure,
            rates.factor,
            self._energy,
            self._stress,
            self._slope,
            tangent,
        )
        add_forces(self.connectivity, self.points, self.gradients, self.weights, self._stress, gradient)
        if values is not None:
            assert scatter is not None
            self._add_stiffness(tangent, values, scatter)
        return float(self._energy @ self.weights)

    @abstractmethod
    def _add_stiffness(self, tangent: np.ndarray, values: np.ndarray, scatter: list[np.ndarray]) -> None:
        """Add the element matrices of tangents (m q, 9, 9) at the quadrature points."""

    def add_warped(self, x: np.ndarray, step: np.ndarray, out: np.ndarray) -> None:
        _add_warped(x, step, self.connectivity, self.points, self.gradients, self.weights, out)

    def laplacian_entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        m, k = self.connectivity.shape
        values = (self.weights[:, None, None] * self.gradients) @ np.swapaxes(self.gradients, 1, 2)
        values = values.reshape(m, self.points, k, k).sum(axis=1)
        rows = np.repeat(self.connectivity, k, axis=1)
        columns = np.tile(self.connectivity, (1, k))
        return rows.ravel(), columns.ravel(), values.ravel()


class Tetrahedra(SolidBlock):
    """A block of linear (four-node) tetrahedra of one material.

    Args:
        nodes: rest positions [m], shape (n, 3).
        connectivity: corner indices, shape (m, 4). Negatively oriented elements are reoriented.
        **options: material, young_modulus, poisson_ratio and density, see `SolidBlock`.

    Raises:
        ValueError: for a degenerate element, an index out of range or an unknown material.
    """

    element = "linear"

    def __init__(self, nodes: np.ndarray, connectivity: np.ndarray, **options: Unpack[SolidOptions]) -> None:
        connectivity, volumes, _ = orient_corners(nodes, connectivity)
        corners = nodes[connectivity]
        inverse = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
        gradients = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
        super().__init__(connectivity, gradients, volumes, **options)

    def embed(self, points: np.ndarray, nodes: np.ndarray, hint: np.ndarray | None = None) -> EmbeddedPoints:
        return EmbeddedPoints(points, nodes, self.connectivity, hint, gradients=self.gradients[:, 1:])

    def nodal_masses(self, count: int) -> np.ndarray:
        share = np.repeat(0.25 * self.density * self.volumes, 4)
        return np.bincount(self.connectivity.ravel(), weights=share, minlength=count)

    def mass_entries(self, lumped: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return element_masses(
            self.connectivity, self.density * self.volumes, (np.ones((4, 4)) + np.eye(4)) / 20, lumped
        )

    def _add_stiffness(self, tangent: np.ndarray, values: np.ndarray, scatter: list[np.ndarray]) -> None:
        _add_tangent(self.gradients, self.volumes, tangent, scatter[0], values)
