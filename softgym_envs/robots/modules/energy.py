"""The form of the energy of a symmetric module over the relative motion of its ports.

With the strains ``e`` of a superelement (`softgym_envs.mechanics.elements.superelement`), the first three over the
length of the module,

    U = 1/2 sum_i k_i g_i^2,    g_i = e_i + sum_m c_m M_m(e),

where ``M_m`` are products of two or three strains. Reflections in the three planes through the middle of a symmetric
module change only signs of strains. So they split all products into classes, and each strain is in another one. Only
products in the class of ``e_i`` correct it (`TERMS`): the energy has the symmetry of the module for any numbers ``k``
and ``c``. It is never negative and has the stiffness ``k`` at rest. The corrections express for example that a leaf
becomes shorter as it bends, at no cost of energy.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations_with_replacement

import numpy as np
from numba import njit

LARGEST_SPREAD = 0.02
"""Spread of the members from which on an energy is not trusted: an error of 2 % of the rotation that was learned."""

_SIGNS = np.array([[-1, 1, 1, 1, -1, -1], [1, -1, 1, -1, 1, -1], [-1, -1, 1, 1, 1, -1]])
"""Sign of each strain under the reflections in the planes normal to x, y and z; the last one swaps the ports."""


def _terms() -> np.ndarray:
    own = {tuple(signs): strain for strain, signs in enumerate(_SIGNS.T)}
    rows = []
    for degree in (2, 3):
        for factors in combinations_with_replacement(range(6), degree):
            target = own.get(tuple(_SIGNS[:, list(factors)].prod(axis=1)))
            if target is not None:
                rows.append([target, *factors, *([-1] * (3 - degree))])
    return np.array(rows, dtype=np.int64)


TERMS = _terms()
"""Corrections of the strains, shape (m, 4): the corrected strain, and the factors of the product; -1 for no factor."""


@njit(cache=True, error_model="numpy")
def _energy(e, terms, k, c, gradient, hessian):
    """Return the energy at strains (6,) and write its gradient (6,) and Hessian (6, 6)."""
    g, G = e.copy(), np.eye(6)
    for m in range(terms.shape[0]):
        i, a, b, d = terms[m]
        third = e[d] if d >= 0 else 1.0
        g[i] += c[m] * e[a] * e[b] * third
        G[i, a] += c[m] * e[b] * third
        G[i, b] += c[m] * e[a] * third
        if d >= 0:
            G[i, d] += c[m] * e[a] * e[b]
    energy = 0.0
    gradient[:] = 0.0
    hessian[:] = 0.0
    for i in range(6):
        energy += 0.5 * k[i] * g[i] * g[i]
        for p in range(6):
            gradient[p] += k[i] * g[i] * G[i, p]
            for q in range(6):
                hessian[p, q] += k[i] * G[i, p] * G[i, q]
    for m in range(terms.shape[0]):
        i, a, b, d = terms[m]
        factor = k[i] * g[i] * c[m]
        third = e[d] if d >= 0 else 1.0
        hessian[a, b] += factor * third
        hessian[b, a] += factor * third
        if d >= 0:
            hessian[a, d] += factor * e[b]
            hessian[d, a] += factor * e[b]
            hessian[b, d] += factor * e[a]
            hessian[d, b] += factor * e[a]
    return energy


class ModuleEnergy:
    """Energy of a symmetric module, for `softgym_envs.mechanics.elements.superelement.Superelement`.

    Args:
        length: of the module [m].
        stiffness: ``k`` [J], shape (6,).
        corrections: ``c`` of `TERMS`, shape (len(TERMS),).
        rotation: the largest load that was learned, as the angle by which it would turn the softest rotation [rad];
            see `softgym_envs.robots.modules.states.solve_states`. Default any load.
        members: ``(stiffness, corrections)`` of further energies that were learned from parts of the bodies.

    Raises:
        ValueError: for a stiffness that is not positive.
    """

    def __init__(
        self,
        length: float,
        stiffness: np.ndarray,
        corrections: np.ndarray,
        rotation: float = np.inf,
        members: Sequence[tuple[np.ndarray, np.ndarray]] = (),
    ) -> None:
        self.stiffness = np.array(stiffness, dtype=float)
        self.corrections = np.array(corrections, dtype=float)
        if not (self.stiffness > 0.0).all():
            raise ValueError(f"the stiffness of a module must be positive, got {self.stiffness.tolist()} J")
        self._scale = np.array([1.0 / length] * 3 + [1.0] * 3)
        self._rotation = rotation
        self._members = [ModuleEnergy(length, k, c) for k, c in members]
        moment = rotation * self.stiffness[3:].min()
        self._largest = np.array([2.0 * moment / length] * 3 + [moment] * 3)

    def evaluate(self, strains: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the energy [J], its gradient (6,) [N, N m] and its Hessian (6, 6) at strains (6,) [m, 1]."""
        gradient, hessian = np.empty(6), np.empty((6, 6))
        energy = _energy(self._scale * strains, TERMS, self.stiffness, self.corrections, gradient, hessian)
        return energy, self._scale * gradient, self._scale[:, None] * hessian * self._scale

    def load(self, strains: np.ndarray) -> float:
        """Return the load at strains (6,) over the largest one that was learned."""
        return float(np.linalg.norm(self.evaluate(strains)[1] / self._largest))

    def spread(self, strains: np.ndarray) -> float:
        """Return by how much the members differ at strains (6,), an estimate of the error; 0 without members.

        It is the root mean square of the strains that the differences of the members' loads would cause, over the
        rotation that was learned.
        """
        if not self._members:
            return 0.0
        _, gradient, hessian = self.evaluate(strains)
        apart = np.array([member.evaluate(strains)[1] - gradient for member in self._members])
        moved = np.linalg.solve(hessian, apart.T) * self._scale[:, None]
        return float(np.sqrt((moved**2).sum(axis=0).mean())) / self._rotation

    def knows(self, strains: np.ndarray) -> bool:
        """Whether at strains (6,) the load is at most the largest one that was learned, and the members agree."""
        return self.load(strains) <= 1.0 and self.spread(strains) <= LARGEST_SPREAD
