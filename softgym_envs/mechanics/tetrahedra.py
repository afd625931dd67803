"""Four-node tetrahedra: shape-function gradients, deformation gradients, and assembly of forces and tangents."""

from __future__ import annotations

import numpy as np
from numba import njit

from softgym_envs.mechanics.materials import MATERIALS, Material, lame_parameters

__all__ = ["Tetrahedra"]


@njit(cache=True, error_model="numpy")
def _deformation_gradients(x, connectivity, gradients, F):
    for e in range(connectivity.shape[0]):
        for i in range(9):
            F[e, i] = 0.0
        for a in range(4):
            node = connectivity[e, a]
            for i in range(3):
                for j in range(3):
                    F[e, 3 * i + j] += x[node, i] * gradients[e, a, j]


@njit(cache=True, error_model="numpy")
def _add_forces(connectivity, gradients, volumes, stress, out):
    """Add the gradient of the energy to ``out``, shape (n, 3)."""
    for e in range(connectivity.shape[0]):
        v = volumes[e]
        for a in range(4):
            node = connectivity[e, a]
            for i in range(3):
                value = 0.0
                for j in range(3):
                    value += stress[e, 3 * i + j] * gradients[e, a, j]
                out[node, i] += v * value


@njit(cache=True, error_model="numpy")
def _add_tangent(gradients, volumes, tangent, scatter, out):
    """Add the lower triangle of each 12 x 12 element matrix to the CSC values ``out`` through ``scatter``."""
    half = np.empty((12, 9))
    for e in range(gradients.shape[0]):
        v = volumes[e]
        g = gradients[e]
        c = tangent[e]
        for a in range(4):
            for i in range(3):
                for q in range(9):
                    half[3 * a + i, q] = v * (
                        g[a, 0] * c[3 * i, q] + g[a, 1] * c[3 * i + 1, q] + g[a, 2] * c[3 * i + 2, q]
                    )
        k = 0
        for r in range(12):
            for s in range(r + 1):
                b = s // 3
                j = s - 3 * b
                target = scatter[e, k]
                k += 1
                if target >= 0:
                    out[target] += (
                        half[r, 3 * j] * g[b, 0] + half[r, 3 * j + 1] * g[b, 1] + half[r, 3 * j + 2] * g[b, 2]
                    )


@njit(cache=True, error_model="numpy")
def _add_warped(x, step, connectivity, gradients, volumes, out):
    """Add ``V (F' - F) g_a``, with F' the gradient F turned and strained by a step, to ``out``, shape (n, 3)."""
    f = np.empty((3, 3))
    d = np.empty((3, 3))
    h = np.empty((3, 3))
    turn = np.empty((3, 3))
    strained = np.empty((3, 3))
    for e in range(connectivity.shape[0]):
        f[:, :] = 0.0
        d[:, :] = 0.0
        for a in range(4):
            node = connectivity[e, a]
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
        for a in range(4):
            node = connectivity[e, a]
            for i in range(3):
                out[node, i] += (
                    d[i, 0] * gradients[e, a, 0] + d[i, 1] * gradients[e, a, 1] + d[i, 2] * gradients[e, a, 2]
                )


class Tetrahedra:
    """A block of linear tetrahedra of one material.

    Args:
        nodes: rest positions [m], shape (n, 3).
        connectivity: corner indices, shape (m, 4). Negatively oriented elements are turned.
        material: a `Material` or its name.
        young_modulus: [Pa], scalar or shape (m,).
        poisson_ratio: scalar or shape (m,), inside (-1, 0.5).
        density: [kg/m3].

    Raises:
        ValueError: for a degenerate element, an index out of range or an unknown material.
    """

    def __init__(
        self,
        nodes: np.ndarray,
        connectivity: np.ndarray,
        *,
        material: str | Material = "corotational",
        young_modulus: float = 3.0e6,
        poisson_ratio: float = 0.3,
        density: float = 1100.0,
    ) -> None:
        if isinstance(material, str):
            if material not in MATERIALS:
                raise ValueError(f"unknown material '{material}'; allowed: {', '.join(MATERIALS)}")
            material = MATERIALS[material]
        self.material = material
        self.density = float(density)
        connectivity = np.array(connectivity, dtype=np.int64)
        if connectivity.ndim != 2 or connectivity.shape[1] != 4 or len(connectivity) == 0:
            raise ValueError(f"tetrahedra must have shape (m, 4) with m > 0, got {connectivity.shape}")
        if connectivity.min() < 0 or connectivity.max() >= len(nodes):
            raise ValueError(
                f"tetrahedra refer to nodes {connectivity.min()}..{connectivity.max()}, the mesh has {len(nodes)}"
            )
        corners = nodes[connectivity]
        volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
        connectivity[volumes < 0] = connectivity[volumes < 0][:, [0, 2, 1, 3]]
        corners = nodes[connectivity]
        edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
        self.volumes = np.abs(volumes)
        size = np.abs(edges).max(axis=(1, 2))
        flat = np.flatnonzero(self.volumes < 1e-9 * size**3)
        if len(flat):
            raise ValueError(f"{len(flat)} degenerate tetrahedra, the first is number {flat[0]}")
        self.connectivity = connectivity
        inverse = np.linalg.inv(edges)
        self.gradients = np.ascontiguousarray(np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1))
        m = len(connectivity)
        self.set_elasticity(young_modulus, poisson_ratio)
        self._F = np.empty((m, 9))
        self._energy = np.empty(m)
        self._stress = np.empty((m, 9))
        self._tangent = np.empty((m, 9, 9))

    def set_elasticity(self, young_modulus: float | np.ndarray, poisson_ratio: float | np.ndarray) -> None:
        """Set Young's modulus [Pa] and Poisson's ratio, scalars or shape (m,)."""
        m = len(self.connectivity)
        young = np.broadcast_to(np.asarray(young_modulus, dtype=float), (m,))
        poisson = np.broadcast_to(np.asarray(poisson_ratio, dtype=float), (m,))
        pairs, which = np.unique(np.column_stack([young, poisson]), axis=0, return_inverse=True)
        parameters = np.array([lame_parameters(e, nu) for e, nu in pairs])[which.ravel()]
        self.mu, self.lame = np.ascontiguousarray(parameters[:, 0]), np.ascontiguousarray(parameters[:, 1])

    def add(
        self, x: np.ndarray, gradient: np.ndarray, values: np.ndarray | None, scatter: np.ndarray | None
    ) -> tuple[float, int]:
        """Add gradient (n, 3) and, if ``values`` is given, the lower-triangle tangent at positions ``x`` (n, 3).

        Returns:
            The elastic energy [J] and the number of inverted elements; with any, the outputs are not to be used.
        """
        _deformation_gradients(x, self.connectivity, self.gradients, self._F)
        inverted = self.material.evaluate(self._F, self.mu, self.lame, self._energy, self._stress, self._tangent)
        if inverted:
            return np.inf, inverted
        _add_forces(self.connectivity, self.gradients, self.volumes, self._stress, gradient)
        if values is not None:
            _add_tangent(self.gradients, self.volumes, self._tangent, scatter, values)
        return float(self._energy @ self.volumes), 0

    def add_warped(self, x: np.ndarray, step: np.ndarray, out: np.ndarray) -> None:
        """Add the right-hand side of rotation-strain warping of a ``step`` (n, 3) from ``x`` (n, 3) to ``out``."""
        _add_warped(x, step, self.connectivity, self.gradients, self.volumes, out)

    def laplacian_entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows, columns and values of the element matrices of the Laplacian, each of shape (16 m,)."""
        values = np.einsum("m,maj,mbj->mab", self.volumes, self.gradients, self.gradients)
        rows = np.repeat(self.connectivity, 4, axis=1)
        columns = np.tile(self.connectivity, (1, 4))
        return rows.ravel(), columns.ravel(), values.ravel()
