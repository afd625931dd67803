"""Linear tetrahedra whose volume change is averaged at the nodes: no locking as Poisson's ratio nears 0.5."""

from __future__ import annotations

from typing import Unpack

import numpy as np

from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.elements.block import StrainRates
from softgym_envs.mechanics.elements.tetrahedra import (
    SolidOptions,
    Tetrahedra,
    add_forces,
    deformation_gradients,
)


@njit(cache=True)
def _add_patches(pointers, gradients, stiffness, scatter, starts, out):
    """Add ``stiffness_n g_n g_n^T`` of every node's patch, lower triangle row by row."""
    for n in range(pointers.shape[0] - 1):
        g = gradients[pointers[n] : pointers[n + 1]]
        k = starts[n]
        for r in range(g.shape[0]):
            w = stiffness[n] * g[r]
            for s in range(r + 1):
                target = scatter[k]
                k += 1
                if target >= 0:
                    out[target] += w * g[s]


@njit(cache=True)
def _patch_gradients(element_slots, shares, gradients, dilation_gradient, out):
    """Sum the derivative of each element's dilation into the gradients of the mean dilation of its four nodes."""
    out[:] = 0.0
    for e in range(gradients.shape[0]):
        for a in range(4):
            for i in range(3):
                value = 0.0
                for j in range(3):
                    value += dilation_gradient[e, 3 * i + j] * gradients[e, a, j]
                for n in range(4):
                    out[element_slots[e, n, a] + i] += shares[e, n] * value


class AveragedTetrahedra(Tetrahedra):
    """Linear tetrahedra with the volumetric energy of nodal averages.

    Element energies keep all but Lame's first term, which acts on the mean dilation of each node's patch:

        sum_e V_e psi(F_e; mu, 0)  +  sum_n V_n lambda_n / 2 (theta_n)^2,
        theta_n = sum_e V_e theta(F_e) / (4 V_n),  V_n = sum_e V_e / 4,

    with theta = tr(R^T F) - 3 (corotational) or J - 1 (stable neo-Hookean). After the average nodal pressure element of
    Bonet and Burton (1998), written as an energy, so that forces and tangent are consistent. There is one volume
    constraint per node instead of one per element (about five times fewer), so linear elements do not lock. The price
    is a wider stencil: the tangent couples all nodes of a patch.

    Args: as for `Tetrahedra`.
    """

    element = "averaged"

    def __init__(self, nodes: np.ndarray, connectivity: np.ndarray, **options: Unpack[SolidOptions]) -> None:
        super().__init__(nodes, connectivity, **options)
        m = len(self.connectivity)
        used, slot = np.unique(self.connectivity, return_inverse=True)
        slot = slot.reshape(m, 4)
        #: Patch of each node: the nodes of all its elements.
        pairs = np.unique(np.column_stack([np.repeat(slot, 4, axis=1).ravel(), np.tile(slot, (1, 4)).ravel()]), axis=0)
        counts = np.bincount(pairs[:, 0], minlength=len(used))
        first = np.concatenate([[0], np.cumsum(counts)])
        self._patch = used[pairs[:, 1]]
        self._pointers = 3 * first
        keys = pairs[:, 0] * len(used) + pairs[:, 1]
        place = np.searchsorted(keys, slot[:, :, None] * len(used) + slot[:, None, :])
        self._element_slots = 3 * place
        self._node_volumes = np.bincount(slot.ravel(), weights=np.repeat(0.25 * self.volumes, 4))
        self._slot = slot
        self._shares = 0.25 * self.volumes[:, None] / self._node_volumes[slot]
        sizes = 3 * counts
        self._starts = np.concatenate([[0], np.cumsum(sizes * (sizes + 1) // 2)])
        self._patch_gradient = np.empty(len(self._patch) * 3)
        self._zero = np.zeros(m)
        self._dilation = np.empty(m)
        self._dilation_gradient = np.empty((m, 9))
        self._dilation_hessian = np.empty((m, 9, 9))

    def stencils(self) -> list[tuple[np.ndarray, np.ndarray]]:
        dofs = (3 * self._patch[:, None] + np.arange(3)).ravel()
        rows, columns = [], []
        for a, b in zip(self._pointers[:-1], self._pointers[1:], strict=True):
            r, s = np.tril_indices(b - a)
            rows.append(dofs[a:b][r])
            columns.append(dofs[a:b][s])
        return [*super().stencils(), (np.concatenate(rows), np.concatenate(columns))]

    def add(
        self, x: np.ndarray, gradient: np.ndarray, values: np.ndarray | None, scatter: list[np.ndarray] | None
    ) -> tuple[float, int]:
        deformation_gradients(x, self.connectivity, self.points, self.gradients, self._F)
        tangent = self._tangent if values is not None else self._tangent[:0]
        inverted = self.material.evaluate(self._F, self.mu, self._zero, self._energy, self._stress, tangent)
        if inverted:
            return np.inf, inverted
        theta, slope, curvature = self._dilation, self._dilation_gradient, self._dilation_hessian
        self.material.dilation(self._F, theta, slope, curvature)
        mean = self._nodal_sum(theta) / self._node_volumes
        lame = self._nodal_sum(self.lame) / self._node_volumes
        pressure = (lame * mean)[self._slot].mean(axis=1)
        self._stress += pressure[:, None] * slope
        add_forces(self.connectivity, self.points, self.gradients, self.weights, self._stress, gradient)
        if values is not None:
            assert scatter is not None
            tangent += pressure[:, None, None] * curvature
            self._add_stiffness(tangent, values, scatter)
            _patch_gradients(self._element_slots, self._shares, self.gradients, slope, self._patch_gradient)
            _add_patches(
                self._pointers, self._patch_gradient, lame * self._node_volumes, scatter[1], self._starts, values
            )
        return float(self._energy @ self.volumes + 0.5 * (lame * mean**2) @ self._node_volumes), 0

    def add_damping(
        self,
        x: np.ndarray,
        rates: StrainRates,
        gradient: np.ndarray,
        values: np.ndarray | None,
        scatter: list[np.ndarray] | None,
    ) -> float:
        self._fill_rates(x, rates)
        mean = self._nodal_sum(self._traces) / self._node_volumes
        lame = rates.damping * self._nodal_sum(self.lame) / self._node_volumes
        pressure = (lame * mean)[self._slot].mean(axis=1)
        power = self._add_resistance(rates, self._zero, pressure, gradient, values, scatter)
        if values is not None:
            assert scatter is not None
            _patch_gradients(self._element_slots, self._shares, self.gradients, self._slope, self._patch_gradient)
            viscosity = rates.factor * lame * self._node_volumes
            _add_patches(self._pointers, self._patch_gradient, viscosity, scatter[1], self._starts, values)
        return power

    def _nodal_sum(self, per_element: np.ndarray) -> np.ndarray:
        """Sum of a quarter of each element's volume times its value over the elements of each node."""
        weights = np.repeat(0.25 * self.volumes * per_element, 4)
        return np.bincount(self._slot.ravel(), weights=weights, minlength=len(self._node_volumes))
