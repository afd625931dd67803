"""Mass of rigid parts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from softgym_envs.mechanics.elements.block import ElementBlock, StrainRates, lower_pairs

if TYPE_CHECKING:
    from softgym_envs.mechanics.model import MechanicalModel


def box_inertia(mass: float, half_extents: np.ndarray) -> np.ndarray:
    """Inertia tensor [kg m2] of a box about its centre, shape (3, 3)."""
    squares = np.asarray(half_extents, dtype=float) ** 2
    return mass / 3.0 * np.diag(squares.sum() - squares)


def sphere_inertia(mass: float, radius: float) -> np.ndarray:
    """Inertia tensor [kg m2] of a ball about its centre, shape (3, 3)."""
    return 0.4 * mass * radius**2 * np.eye(3)


class RigidBody(ElementBlock):
    """Mass of a rigid part whose centre of mass is the origin of its frame.

    Args:
        nodes: rest rows [m], shape (n, 3).
        row: first row of its frame.
        mass: [kg].
        inertia: about the centre of mass, along the directors [kg m2], shape (3, 3).
        payload: what it carries at the origin of its frame [kg].

    Raises:
        ValueError: for a mass that is not positive, a negative payload, or an inertia that no body can have.
    """

    volume = 0.0
    stiffness = 0.0

    def __init__(self, nodes: np.ndarray, row: int, *, mass: float, inertia: np.ndarray, payload: float = 0.0) -> None:
        inertia = np.asarray(inertia, dtype=float)
        if not (np.isfinite(mass) and mass > 0.0):
            raise ValueError(f"mass = {mass} kg of a rigid body must be positive and finite")
        if not (np.isfinite(payload) and payload >= 0.0):
            raise ValueError(f"payload = {payload} kg of a rigid body must be finite and not negative")
        if inertia.shape != (3, 3) or not np.allclose(inertia, inertia.T):
            raise ValueError(f"inertia must be a symmetric matrix (3, 3), got {inertia.tolist()}")
        # Kinetic energy in terms of directors: 1/2 sum_kl E_kl d_k' . d_l' with Euler's tensor E.
        self._euler = 0.5 * np.trace(inertia) * np.eye(3) - inertia
        if np.linalg.eigvalsh(self._euler)[0] < -1e-9 * np.trace(inertia):
            raise ValueError(f"inertia {inertia.tolist()} kg m2 violates the triangle inequality: no body can have it")
        self.row = int(row)
        self._own_mass, self._own_payload = float(mass), float(payload)
        self.carry(None)
        self.nodes_used = self.row + np.arange(4)

    def carry(self, payload: float | None) -> None:
        """Carry a mass [kg] at the origin of its frame in place of what it carried before; None: its own payload."""
        self.mass = self._own_mass + (self._own_payload if payload is None else payload)

    def stencils(self) -> list[tuple[np.ndarray, np.ndarray]]:
        return [lower_pairs((3 * self.nodes_used[:, None] + np.arange(3)).reshape(1, 12))]

    def add(
        self, x: np.ndarray, gradient: np.ndarray, values: np.ndarray | None, scatter: list[np.ndarray] | None
    ) -> tuple[float, int]:
        return 0.0, 0

    def add_damping(
        self,
        x: np.ndarray,
        rates: StrainRates,
        gradient: np.ndarray,
        values: np.ndarray | None,
        scatter: list[np.ndarray] | None,
    ) -> float:
        """A rigid part has no strain."""
        return 0.0

    def nodal_masses(self, count: int) -> np.ndarray:
        masses = np.zeros(count)
        masses[self.row] = self.mass
        return masses

    def mass_entries(self, lumped: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        matrix = np.zeros((4, 4))
        matrix[0, 0] = self.mass
        matrix[1:, 1:] = self._euler
        i, j = np.tril_indices(4)
        return self.row + i, self.row + j, matrix[i, j]

    def add_warped(self, x: np.ndarray, step: np.ndarray, out: np.ndarray) -> None:
        """A rigid part is not warped."""

    def laplacian_entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0)


def carry(model: MechanicalModel, payload: float | None) -> None:
    """Let the rigid part at the frame of the first effector carry a mass in place of what it carried before.

    It counts in gravity from the next `MechanicalModel.set_gravity` on, and in solvers that are made afterwards.

    Args:
        model: the body.
        payload: [kg]; None: its own.

    Raises:
        ValueError: if there is no rigid part.
    """
    row = min(model.constraints["e"][0].dofs, default=-1) // 3
    part = next((block for block in model.blocks if isinstance(block, RigidBody) and block.row == row), None)
    if part is None:
        raise ValueError(f"payload = {payload} kg: the first effector is in no rigid part, which could carry it")
    part.carry(payload)
