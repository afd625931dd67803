"""Superelements with a closed cavity: the volume of the cavity is one more coordinate of the energy.

The volume grows with the strains between the ports, and by a bulge ``b`` of the walls that a pressure causes while the
ports are held:

    V = V_0 + growth(e) + b,    U = U(e) + b^2 / (2 c),

where ``c`` is that growth per pressure. So a pressure ``p`` gives ``b = c p`` and the port forces
``dU/de - p d(growth)/de``: what is left out is that ``c`` changes with the strains, which is of second order in ``p``.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from softgym_envs.extensions.modules.superelement import PortEnergy, Superelement
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.constraint import Constraint


class PortVolume(Protocol):
    """Volume of a cavity over the strains of a superelement."""

    bulge: float

    def evaluate(self, strains: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the growth [m3], its gradient (6,) and its Hessian (6, 6) at strains (6,)."""


class ClosedSuperelement(Superelement):
    """An elastic part with a cavity between two frames.

    Args:
        nodes: as for `Superelement`.
        ends: as there, and a row whose x is the bulge over the square of the length, its other components fixed.
        cavity: volume of the cavity.
        **options: those of `Superelement`.
    """

    def __init__(self, nodes: np.ndarray, ends: np.ndarray, *, cavity: PortVolume, **options: object) -> None:
        super().__init__(nodes, ends[:2], **options)  # type: ignore[arg-type]
        self.cavity, self.bulge = cavity, int(ends[2])
        self.nodes_used = np.append(self.rows, self.bulge)
        self.bulge_scale = self.length**2
        self._spring = self.bulge_scale**2 / cavity.bulge  # [N/m]

    def stencils(self) -> list[tuple[np.ndarray, np.ndarray]]:
        own = np.array([[3 * self.bulge]])
        return [*super().stencils(), (own, own)]

    def add(
        self, x: np.ndarray, gradient: np.ndarray, values: np.ndarray | None, scatter: list[np.ndarray] | None
    ) -> tuple[float, int]:
        energy, inverted = super().add(x, gradient, values, scatter)
        bulge = x[self.bulge, 0]
        gradient[self.bulge, 0] += self._spring * bulge
        if values is not None and scatter is not None and scatter[1][0, 0] >= 0:
            values[scatter[1][0, 0]] += self._spring
        return energy + 0.5 * self._spring * bulge**2, inverted


class PortCavity(Constraint):
    """Growth of the volume of the cavity of a superelement; delta [m3], effort [Pa] = pressure.

    Args:
        name: identifier.
        element: the superelement.
    """

    size = 1
    unit = ("m3", "Pa")

    def __init__(self, name: str, element: ClosedSuperelement) -> None:
        self.name, self._element = name, element
        rows = (3 * element.rows[:, None] + np.arange(3)).ravel()
        self.dofs = np.append(rows, 3 * element.bulge)

    def value(self, x: np.ndarray) -> np.ndarray:
        element = self._element
        return np.array([element.cavity.evaluate(element.strains(x))[0] + element.bulge_scale * x[element.bulge, 0]])

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        element = self._element
        slope = element.cavity.evaluate(element.strains(x))[1]
        return np.append(slope @ element.strain_slopes(x), element.bulge_scale)[None]

    def hessian(self, x: np.ndarray, effort: np.ndarray) -> np.ndarray:
        element = self._element
        _, slope, curvature = element.cavity.evaluate(element.strains(x))
        found = np.zeros((25, 25))
        found[:24, :24] = element.strain_hessian(x, slope, curvature)
        return effort[0] * found


def add_superelement(
    builder: ModelBuilder, near: int, far: int, energy: PortEnergy, *, cavity: PortVolume | None = None, **options: Any
) -> None:
    """Add an elastic part between two frames of a model, known by its energy alone.

    Args:
        builder: of the model.
        near: first row of the near frame.
        far: first row of the far frame.
        energy: over the strains of the ports.
        cavity: volume of its cavity, with which it is a `ClosedSuperelement`.
        **options: as for `Superelement`.
    """
    if cavity is None:
        builder.add_element(Superelement, (near, far), energy=energy, **options)
    else:
        bulge = (False, True, True)
        builder.add_element(ClosedSuperelement, (near, far), own=[bulge], energy=energy, cavity=cavity, **options)
