"""Air that is sealed in a cavity: its energy as a function of the volume."""

from __future__ import annotations

import numpy as np

from softgym_envs.mechanics.constraints.cavity import SealedAir
from softgym_envs.mechanics.elements.block import ElementBlock, StrainRates, lower_pairs

_NO_ENTRIES = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0)


class EnclosedGas(ElementBlock):
    """Energy of the air in a sealed cavity, ``p0 V0 (V / V0 - 1 - ln(V / V0))``: Boyle's law in an ambient pressure p0.

    Its derivative by the volume V is the negative gauge pressure ``p0 (V0 / V - 1)``, its second derivative ``p0 V0 /
    V^2`` is positive. The tangent couples all nodes of the cavity's surface. Air has neither mass nor viscosity here.

    Args:
        air: the cavity and its ambient pressure.
    """

    volume = 0.0
    mass = 0.0
    stiffness = 0.0

    def __init__(self, air: SealedAir) -> None:
        self.air = air
        self.nodes_used = np.unique(air.dofs // 3)
        rows, columns = air.cavity.hessian_pattern()
        half = len(rows) // 2  # the other half mirrors it
        self._stencils = [lower_pairs(air.dofs[None, :]), (rows[:half], columns[:half])]

    def stencils(self) -> list[tuple[np.ndarray, np.ndarray]]:
        return self._stencils

    def add(
        self, x: np.ndarray, gradient: np.ndarray, values: np.ndarray | None, scatter: list[np.ndarray] | None
    ) -> tuple[float, int]:
        cavity = self.air.cavity
        volume = cavity.volume(x)
        if not volume > 0.0:
            return np.inf, 1
        pressure, slope, _ = self.air.pressure(volume)
        by_node = cavity.jacobian(x)[0]
        gradient.reshape(-1)[self.air.dofs] -= pressure * by_node
        if values is not None and scatter is not None:
            r, s = np.tril_indices(len(by_node))
            _add_entries(values, scatter[0], -slope * by_node[r] * by_node[s])
            curvature = cavity.hessian(x, np.array([-pressure]))
            _add_entries(values, scatter[1], curvature[: len(curvature) // 2])
        return self.air.energy(volume), 0

    def add_damping(
        self,
        x: np.ndarray,
        rates: StrainRates,
        gradient: np.ndarray,
        values: np.ndarray | None,
        scatter: list[np.ndarray] | None,
    ) -> float:
        return 0.0

    def nodal_masses(self, count: int) -> np.ndarray:
        return np.zeros(count)

    def mass_entries(self, lumped: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return _NO_ENTRIES

    def add_warped(self, x: np.ndarray, step: np.ndarray, out: np.ndarray) -> None:
        """Leave warping to the solid around the cavity."""

    def laplacian_entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return _NO_ENTRIES


def _add_entries(values: np.ndarray, places: np.ndarray, entries: np.ndarray) -> None:
    kept = places.ravel() >= 0
    np.add.at(values, places.ravel()[kept], entries[kept])
