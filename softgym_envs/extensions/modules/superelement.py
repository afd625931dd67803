"""Superelements: elastic parts between two rigid ports, known by their energy over the ports' relative pose.

With the axes ``n_k`` of the near port and ``f_k`` of the far one, and the line ``r`` between their middles, the strains
of a superelement are

    e_i     = r . (n_i + f_i) / 2  -  its value at rest          [m]
    e_{3+i} = (n_k . f_j - n_j . f_k) / 2,   (i, j, k) cyclic    [1]

The first three measure ``r`` in the mean of both ports' axes, the last three are the components of
``sin(angle) * axis`` of the rotation from the near to the far port. No rigid motion changes them; they are unique for
rotations of less than 90 degrees. A part that bends with constant curvature has no shear strains ``e_1``, ``e_2``, so
an energy that is quadratic in the strains holds much further than one in displacements: the strains are those of a beam
of one element (see `beams`), the energy is any function of them.

Rows are transformed first, so ports may be turned and shifted against the frames. Each strain is quadratic in the rows,
``e_i = z . A_i z / 2`` for each axis of space, which gives exact tangents for any twice differentiable energy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.elements.beams import warp_lines
from softgym_envs.mechanics.elements.block import ElementBlock, StrainRates, lower_pairs

LARGEST_ROTATION = 0.98
"""Sine of the rotation between the ports at which the strains are no longer a measure of it."""


class PortEnergy(Protocol):
    """Energy of a superelement over its strains."""

    def evaluate(self, strains: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the energy [J], its gradient (6,) [N, N m] and its Hessian (6, 6) at strains (6,)."""

    def knows(self, strains: np.ndarray) -> bool:
        """Whether the energy is known at strains (6,)."""


@runtime_checkable
class LearnedEnergy(PortEnergy, Protocol):
    """Energy of a superelement that knows how wrong it may be."""

    def possible_errors(self, strains: np.ndarray) -> np.ndarray:
        """Return independent errors that its gradient may have at strains (6,), as rows (k, 6) [N, N m]."""


@dataclass(frozen=True)
class QuadraticEnergy:
    """Energy of a part whose strains are small: that of its stiffness at rest, shape (6, 6) [N/m, N, N m]."""

    stiffness: np.ndarray

    def __post_init__(self) -> None:
        if np.shape(self.stiffness) != (6, 6) or not np.allclose(self.stiffness, np.transpose(self.stiffness)):
            raise ValueError("the stiffness of a superelement must be a symmetric matrix (6, 6)")
        if not np.linalg.eigvalsh(self.stiffness)[0] > 0.0:
            raise ValueError("the stiffness of a superelement must be positive definite")

    def evaluate(self, strains: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        gradient = self.stiffness @ strains
        return 0.5 * float(strains @ gradient), gradient, self.stiffness

    def knows(self, strains: np.ndarray) -> bool:
        return True


def _strain_forms() -> np.ndarray:
    """Return the matrices ``A_i`` of the strains over the rows of both ports, shape (6, 8, 8)."""
    forms = np.zeros((6, 8, 8))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for axis in (1 + i, 5 + i):
            forms[i, 4, axis] += 0.5
            forms[i, 0, axis] -= 0.5
        forms[3 + i, 1 + k, 5 + j] += 0.5
        forms[3 + i, 1 + j, 5 + k] -= 0.5
    return forms + forms.transpose(0, 2, 1)


_FORMS = _strain_forms()


@njit(cache=True, error_model="numpy")
def _slopes(forms, z, slopes):
    """Write the derivatives of the strains by the rows ``z`` (8, 3), shape (6, 8, 3)."""
    for i in range(6):
        for a in range(8):
            for d in range(3):
                total = 0.0
                for b in range(8):
                    total += forms[i, a, b] * z[b, d]
                slopes[i, a, d] = total


@njit(cache=True, error_model="numpy")
def _add_tangent(forms, slopes, force, stiffness, scatter, values):
    """Add the tangent of an energy with derivatives (6,) and (6, 6) by the strains where ``scatter`` (300,) says."""
    entry = 0
    row = np.empty(6)
    for r in range(24):
        a, d = r // 3, r % 3
        for q in range(6):
            row[q] = 0.0
            for p in range(6):
                row[q] += slopes[p, a, d] * stiffness[p, q]
        for s in range(r + 1):
            target = scatter[entry]
            entry += 1
            if target < 0:
                continue
            b, e = s // 3, s % 3
            total = 0.0
            for q in range(6):
                total += row[q] * slopes[q, b, e]
                if d == e:
                    total += force[q] * forms[q, a, b]
            values[target] += total


def point_masses(mass: float) -> np.ndarray:
    """Return the inertia (8, 8) of a part whose mass [kg] is in the middles of both ports, half in each.

    Its weight is exact, with its centre in the middle between the ports; its motion in time is not.
    """
    return np.diag([0.5 * mass, 0.0, 0.0, 0.0] * 2)


class Superelement(ElementBlock):
    """An elastic part between two frames.

    Args:
        nodes: rest rows [m], shape (n, 3).
        ends: first rows of the frames that carry the near and the far port.
        energy: over the strains.
        length: distance of the ports along the third axis of the part [m].
        origin: middle of the near port at rest [m], shape (3,); default the origin of the near frame.
        rotation: matrix whose columns are the axes of the part at rest, shape (3, 3); default those of space.
        young_modulus: of its material, from which the stiffness of contact is chosen [Pa].
        inertia: kinetic energy ``1/2 sum M_ab v_a . v_b`` of the rows (middle and axes) of both ports [kg, kg m,
            kg m2], shape (8, 8); default none.
    """

    volume = 0.0
    rows: np.ndarray
    """Rows of both ports, shape (8,)."""

    def __init__(
        self,
        nodes: np.ndarray,
        ends: np.ndarray,
        *,
        energy: PortEnergy,
        length: float,
        origin: np.ndarray | None = None,
        rotation: np.ndarray | None = None,
        young_modulus: float = 0.0,
        inertia: np.ndarray | None = None,
    ) -> None:
        if not (np.isfinite(length) and length > 0.0):
            raise ValueError(f"length = {length} m of a superelement must be positive and finite")
        axes = np.eye(3) if rotation is None else np.asarray(rotation, dtype=float)
        first, last = (int(row) for row in ends)
        start = nodes[first] if origin is None else np.asarray(origin, dtype=float)
        self.energy, self.length = energy, float(length)
        self._young_modulus = float(young_modulus)
        self.rows = np.concatenate([first + np.arange(4), last + np.arange(4)])
        self.nodes_used = self.rows
        ports = np.zeros((8, 8))
        for slot, row, middle in ((0, first, start), (4, last, start + length * axes[:, 2])):
            directors = nodes[row + 1 : row + 4]
            ports[slot, slot] = 1.0
            ports[slot, slot + 1 : slot + 4] = directors @ (middle - nodes[row])
            ports[slot + 1 : slot + 4, slot + 1 : slot + 4] = (directors @ axes).T
        self._forms = np.ascontiguousarray(ports.T @ _FORMS @ ports)
        matrix = np.zeros((8, 8)) if inertia is None else np.asarray(inertia, dtype=float)
        self._inertia = ports.T @ matrix @ ports
        # The axes of each port share the inertia of its own motion; middles move by their weights in every point.
        weights = np.zeros(8)
        weights[[0, 4]] = 1.0
        self._weights = ports.T @ (matrix @ weights)
        self.mass = float(weights @ matrix @ weights)
        self._rest = np.zeros(6)
        self._rest = self.strains(nodes)
        self.learned = isinstance(energy, LearnedEnergy)
        self._viscous = energy.evaluate(np.zeros(6))[2]
        self.stiffness = float(np.trace(self._viscous[:3, :3]) / 3.0)
        self._line = (np.array([[first, last]]), np.array([[0.5, 0.5]]), np.array([[[-1.0, 1.0]]]) / length)

    @property
    def largest_young_modulus(self) -> float:
        return self._young_modulus

    def strains(self, x: np.ndarray) -> np.ndarray:
        """Return the strains (6,) at rows ``x`` (n, 3)."""
        z = x[self.rows]
        return 0.5 * (self.strain_slopes(x) @ z.ravel()) - self._rest

    def strain_slopes(self, x: np.ndarray) -> np.ndarray:
        """Return the derivatives (6, 24) of the strains by the rows `rows` at rows ``x`` (n, 3)."""
        slopes = np.empty((6, 8, 3))
        _slopes(self._forms, x[self.rows], slopes)
        return slopes.reshape(6, 24)

    def strain_hessian(self, x: np.ndarray, gradient: np.ndarray, hessian: np.ndarray) -> np.ndarray:
        """Return the second derivatives (24, 24) by the rows of a function of the strains.

        Args:
            x: rows, shape (n, 3).
            gradient: of the function, shape (6,).
            hessian: of the function, shape (6, 6).
        """
        flat = self.strain_slopes(x)
        return flat.T @ hessian @ flat + np.kron(np.tensordot(gradient, self._forms, 1), np.eye(3))

    def knows(self, x: np.ndarray) -> bool:
        return self.energy.knows(self.strains(x))

    def possible_errors(self, x: np.ndarray, fields: np.ndarray) -> np.ndarray:
        if not isinstance(self.energy, LearnedEnergy):
            return super().possible_errors(x, fields)
        rates = fields[:, self.rows].reshape(len(fields), 24) @ self.strain_slopes(x).T
        return self.energy.possible_errors(self.strains(x)) @ rates.T

    def stencils(self) -> list[tuple[np.ndarray, np.ndarray]]:
        return [lower_pairs((3 * self.rows[:, None] + np.arange(3)).reshape(1, 24))]

    def add(
        self, x: np.ndarray, gradient: np.ndarray, values: np.ndarray | None, scatter: list[np.ndarray] | None
    ) -> tuple[float, int]:
        z = x[self.rows]
        slopes = np.empty((6, 8, 3))
        _slopes(self._forms, z, slopes)
        strains = 0.5 * (slopes.reshape(6, 24) @ z.ravel()) - self._rest
        if not (np.abs(strains[3:]) <= LARGEST_ROTATION).all():
            return np.inf, 1
        energy, force, stiffness = self.energy.evaluate(strains)
        self._spread(slopes, force, stiffness, gradient, values, scatter)
        return energy, 0

    def _spread(
        self,
        slopes: np.ndarray,
        force: np.ndarray,
        stiffness: np.ndarray,
        gradient: np.ndarray,
        values: np.ndarray | None,
        scatter: list[np.ndarray] | None,
    ) -> None:
        """Add forces and tangent for the derivatives of an energy by the strains, (6,) and (6, 6)."""
        gradient[self.rows] += (force @ slopes.reshape(6, 24)).reshape(8, 3)
        if values is not None and scatter is not None:
            _add_tangent(self._forms, slopes, force, stiffness, scatter[0].ravel(), values)

    def add_damping(
        self,
        x: np.ndarray,
        rates: StrainRates,
        gradient: np.ndarray,
        values: np.ndarray | None,
        scatter: list[np.ndarray] | None,
    ) -> float:
        # As for beams: strains are quadratic in the rows, so this difference is exactly their rate over the factor.
        factor = rates.factor or 1.0
        half = 0.5 / factor * rates.velocity
        change = self.strains(rates.middle + half) - self.strains(rates.middle - half)
        viscosity = rates.damping * factor * self._viscous
        force = viscosity @ change
        self._spread(self._forms @ x[self.rows], force, viscosity, gradient, values, scatter)
        return factor * float(change @ force)

    def nodal_masses(self, count: int) -> np.ndarray:
        masses = np.zeros(count)
        masses[self.rows] = self._weights
        return masses

    def mass_entries(self, lumped: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Entries between all rows of both ports: there is no lumped mass of a superelement."""
        i, j = np.tril_indices(8)
        return self.rows[i], self.rows[j], self._inertia[i, j]

    def add_warped(self, x: np.ndarray, step: np.ndarray, out: np.ndarray) -> None:
        warp_lines(x, step, *self._line, np.array([[self.length]]), out)

    def laplacian_entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        ends, share = self._line[0][0], 1.0 / self.length
        return np.repeat(ends, 2), np.tile(ends, 2), share * np.array([1.0, -1.0, -1.0, 1.0])
