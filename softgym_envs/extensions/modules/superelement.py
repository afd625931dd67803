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

from softgym_envs.extensions.beams.elements import ROWS, Energies, Parts, Port

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


def point_masses(mass: float) -> np.ndarray:
    """Return the inertia (8, 8) of a part whose mass [kg] is in the middles of both ports, half in each.

    Its weight is exact, with its centre in the middle between the ports; its motion in time is not.
    """
    return np.diag([0.5 * mass, 0.0, 0.0, 0.0] * 2)


class Superelement(Parts):
    """An elastic part between two frames.

    Args:
        nodes: rest rows [m], shape (n, 3).
        ends: first rows of the frames that carry the near and the far port.
        energy: over the strains.
        length: distance of the ports along the third axis of the part [m].
        origin: middle of the near port at rest [m], shape (3,); default the origin of the near frame.
        rotation: matrix whose columns are the axes of the part at rest, shape (3, 3); default those of space.
        young_modulus: of its material, from which the stiffness of contact is chosen [Pa].
        inertia: as for `Parts`; default none.
    """

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
        axes = np.eye(3) if rotation is None else np.asarray(rotation, dtype=float)
        first, last = (int(row) for row in ends)
        start = nodes[first] if origin is None else np.asarray(origin, dtype=float)
        super().__init__(
            nodes,
            [(Port(first, start, axes), Port(last, start + length * axes[:, 2], axes))],
            forms=_FORMS,
            linear=np.zeros((6, ROWS, 3)),
            length=length,
            inertia=np.zeros((ROWS, ROWS)) if inertia is None else np.asarray(inertia, dtype=float),
            young_modulus=young_modulus,
        )
        self.energy = energy
        self._rest = self.coordinates(nodes)
        self.learned = isinstance(energy, LearnedEnergy)
        self._viscous = energy.evaluate(np.zeros(6))[2][None]
        self.stiffness = float(np.trace(self._viscous[0, :3, :3]) / 3.0)

    @property
    def rows(self) -> np.ndarray:
        """Rows of both ports, shape (8,)."""
        return self.port_rows[0]

    def strains(self, x: np.ndarray) -> np.ndarray:
        """Return the strains (6,) at rows ``x`` (n, 3)."""
        return self.coordinates(x)[0]

    def strain_slopes(self, x: np.ndarray) -> np.ndarray:
        """Return the derivatives (6, 24) of the strains by the rows `rows` at rows ``x`` (n, 3)."""
        return self.slopes(x).reshape(6, 24)

    def strain_hessian(self, x: np.ndarray, gradient: np.ndarray, hessian: np.ndarray) -> np.ndarray:
        """Return the second derivatives (24, 24) by the rows of a function of the strains.

        Args:
            x: rows, shape (n, 3).
            gradient: of the function, shape (6,).
            hessian: of the function, shape (6, 6).
        """
        flat = self.strain_slopes(x)
        return flat.T @ hessian @ flat + np.kron(np.tensordot(gradient, self.forms[0], 1), np.eye(3))

    def energies(self, y: np.ndarray) -> Energies | None:
        if not (np.abs(y[0, 3:]) <= LARGEST_ROTATION).all():
            return None
        value, gradient, hessian = self.energy.evaluate(y[0])
        return Energies(np.array([value]), gradient[None], hessian[None])

    def knows(self, x: np.ndarray) -> bool:
        return self.energy.knows(self.strains(x))

    def possible_errors(self, x: np.ndarray, fields: np.ndarray) -> np.ndarray:
        if not isinstance(self.energy, LearnedEnergy):
            return super().possible_errors(x, fields)
        rates = fields[:, self.rows].reshape(len(fields), 24) @ self.strain_slopes(x).T
        return self.energy.possible_errors(self.strains(x)) @ rates.T

    def viscosity(self, start: np.ndarray) -> np.ndarray:
        return self._viscous
