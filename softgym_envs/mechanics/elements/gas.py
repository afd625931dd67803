"""Air that is sealed in a cavity: its energy as a function of the volume."""

from __future__ import annotations

import numpy as np

from softgym_envs.mechanics.constraints.cavity import SealedAir
from softgym_envs.mechanics.elements.block import Massless, add_entries, lower_pairs


class EnclosedGas(Massless):
    """Energy of the air in a sealed cavity, ``p0 V0 (V / V0 - 1 - ln(V / V0))``: Boyle's law in an ambient pressure p0.

    Its derivative by the volume V is the negative gauge pressure ``p0 (V0 / V - 1)``, its second derivative ``p0 V0 /
    V^2`` is positive. The tangent couples all nodes of the cavity's surface. Air has neither mass nor viscosity here.

    Args:
        air: the cavity and its ambient pressure.
    """

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
            add_entries(values, scatter[0], -slope * by_node[r] * by_node[s])
            curvature = cavity.hessian(x, np.array([-pressure]))
            add_entries(values, scatter[1], curvature[: len(curvature) // 2])
        return self.air.energy(volume), 0
