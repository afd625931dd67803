"""The form of the energy of a symmetric module over the relative motion of its ports.

With the strains ``e`` of a superelement (`softgym_envs.extensions.modules.superelement`), the first three over the
length of the module,

    U = 1/2 sum_i k_i g_i^2,    g_i = e_i + sum_m c_m M_m(e),

where ``M_m`` are products of up to three strains. Reflections that map a module onto itself change only signs of
strains. So they split all products into classes, and only products in the class of ``e_i`` correct it (`terms`): the
energy has the symmetry of the module for any numbers ``k`` and ``c``. If three planes mirror the module, each strain
is in a class of its own. If fewer reflections map it onto itself, strains share a class and one is coupled with the
other at rest: a strain is corrected by later ones of its class, and the stiffness is ``L D L^T``. The energy is never
negative, and its stiffness at rest is positive definite for any ``c``. The corrections express for example that a leaf
becomes shorter as it bends, at no cost of energy.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import combinations_with_replacement

import numpy as np

from softgym_envs.mechanics.compilation import njit

_SIGNS = {"x": (-1, 1, 1, 1, -1, -1), "y": (1, -1, 1, -1, 1, -1), "z": (-1, -1, 1, 1, 1, -1)}
"""Sign of each strain when an axis through the middle of the module is reversed; the last one swaps the ports."""

MIRRORED = ("x", "y", "z")
"""Symmetry of a module that three planes mirror."""


def reflections(symmetry: Sequence[str]) -> np.ndarray:
    """Return the sign of each strain under each reflection, shape (r, 6).

    Args:
        symmetry: the axes that each reflection reverses: ``"x"`` is the plane normal to x, ``"xz"`` half a turn about
            y, ``"xyz"`` the point in the middle.
    """
    return np.array([np.prod([_SIGNS[axis] for axis in axes], axis=0) for axes in symmetry])


@cache
def terms(symmetry: tuple[str, ...] = MIRRORED, order: int = 3) -> np.ndarray:
    """Return the corrections of strains that a symmetry allows; see `reflections`.

    Args:
        symmetry: of the module.
        order: 3, all products of up to three strains; or 5, also products of two squares of strains, and of two squares
            and the corrected strain: modules that bend far need them, and others would be too many to learn.

    Returns:
        Shape (m, order + 1): the corrected strain, and the factors of the product; -1 for no factor.
    """
    signs = reflections(symmetry)
    rows = []
    for degree in (1, 2, 3):
        for factors in combinations_with_replacement(range(6), degree):
            product = signs[:, list(factors)].prod(axis=1)
            for target in range(6):
                if (signs[:, target] == product).all() and (degree > 1 or target < factors[0]):
                    rows.append([target, *factors, *([-1] * (order - degree))])
    if order == 5:
        for i, j in combinations_with_replacement(range(6), 2):
            for target in range(6):
                if (signs[:, target] == 1).all():
                    rows.append([target, i, i, j, j, -1])
                rows.append([target, i, i, j, j, target])
    found = np.array(rows, dtype=np.int64)
    found.flags.writeable = False
    return found


@cache
def volume_terms(symmetry: tuple[str, ...] = MIRRORED) -> np.ndarray:
    """Return the products of strains that no reflection changes, of which the volume of a cavity may consist.

    Returns:
        Factors of each product, -1 for no factor, shape (m, 3).
    """
    signs = reflections(symmetry)
    products = [f for degree in (1, 2, 3) for f in combinations_with_replacement(range(6), degree)]
    kept = [[*f, *([-1] * (3 - len(f)))] for f in products if (signs[:, list(f)].prod(axis=1) == 1).all()]
    found = np.array(kept, dtype=np.int64)
    found.flags.writeable = False
    return found


@njit(cache=True, error_model="numpy")
def _polynomial(e, factors, b, gradient, hessian):
    """Return a sum of products of strains (6,) and write its gradient (6,) and Hessian (6, 6)."""
    x, first, second = np.ones(7), np.zeros(7), np.zeros((7, 7))
    x[:6] = e
    total = 0.0
    for m in range(factors.shape[0]):
        p, q, r = factors[m]
        total += b[m] * x[p] * x[q] * x[r]
        first[p] += b[m] * x[q] * x[r]
        first[q] += b[m] * x[p] * x[r]
        first[r] += b[m] * x[p] * x[q]
        second[p, q] += b[m] * x[r]
        second[q, p] += b[m] * x[r]
        second[p, r] += b[m] * x[q]
        second[r, p] += b[m] * x[q]
        second[q, r] += b[m] * x[p]
        second[r, q] += b[m] * x[p]
    gradient[:] = first[:6]
    hessian[:] = second[:6, :6]
    return total


class CavityVolume:
    """How the volume of the cavity of a closed module grows with the strains of a superelement.

    The walls bulge under pressure; what that adds, with the ports held, is proportional to the pressure.

    Args:
        length: of the module [m].
        coefficients: of the `volume_terms` of its symmetry [m3], shape (m,).
        bulge: growth by pressure with the ports held [m3/Pa].
        symmetry: of the module; see `reflections`.
    """

    def __init__(
        self, length: float, coefficients: np.ndarray, bulge: float, symmetry: tuple[str, ...] = MIRRORED
    ) -> None:
        self.bulge = float(bulge)
        self._coefficients = np.array(coefficients, dtype=float)
        self._terms = volume_terms(symmetry)
        self._scale = np.array([1.0 / length] * 3 + [1.0] * 3)

    def evaluate(self, strains: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the growth [m3], its gradient (6,) and its Hessian (6, 6) at strains (6,) [m, 1], without pressure."""
        gradient, hessian = np.empty(6), np.empty((6, 6))
        growth = _polynomial(self._scale * strains, self._terms, self._coefficients, gradient, hessian)
        return growth, self._scale * gradient, self._scale[:, None] * hessian * self._scale


@njit(cache=True, error_model="numpy")
def _product(x, factors, count, left, right):
    """Return the product of ``count`` factors of ``x``, without two of them."""
    total = 1.0
    for k in range(count):
        if k != left and k != right:
            total *= x[factors[k]]
    return total


@njit(cache=True, error_model="numpy")
def _energy(e, terms, k, c, gradient, hessian):
    """Return the energy at strains (6,) and write its gradient (6,) and Hessian (6, 6)."""
    G, second = np.eye(6), np.zeros((6, 6))
    g = e.copy()
    counts = np.zeros(terms.shape[0], dtype=np.int64)
    for m in range(terms.shape[0]):
        i, factors = terms[m, 0], terms[m, 1:]
        while counts[m] < len(factors) and factors[counts[m]] >= 0:
            counts[m] += 1
        g[i] += c[m] * _product(e, factors, counts[m], -1, -1)
        for p in range(counts[m]):
            G[i, factors[p]] += c[m] * _product(e, factors, counts[m], p, -1)
    for m in range(terms.shape[0]):
        i, factors = terms[m, 0], terms[m, 1:]
        force = k[i] * g[i] * c[m]
        for p in range(counts[m]):
            for q in range(p):
                both = force * _product(e, factors, counts[m], p, q)
                second[factors[p], factors[q]] += both
                second[factors[q], factors[p]] += both
    energy = 0.0
    gradient[:] = 0.0
    hessian[:] = second
    for i in range(6):
        energy += 0.5 * k[i] * g[i] * g[i]
        for p in range(6):
            gradient[p] += k[i] * g[i] * G[i, p]
            for q in range(6):
                hessian[p, q] += k[i] * G[i, p] * G[i, q]
    return energy


class ModuleEnergy:
    """Energy of a symmetric module, for `softgym_envs.extensions.modules.superelement.Superelement`.

    Args:
        length: of the module [m].
        stiffness: ``k`` [J], shape (6,).
        corrections: ``c`` of the `terms` of its symmetry, shape (m,).
        symmetry: of the module; see `reflections`.
        order: of the `terms`.
        rotation: the largest load that was learned, as the angle by which it would turn the softest rotation [rad];
            see `softgym_envs.extensions.modules.states.solve_states`. Default any load.
        largest_strains: size of each strain that was learned, the first three over the length, shape (6,). Default any.
        error_bounds: on the errors of the strains under a load, relative to the size of all, the first three over the
            length, shape (6,). Default none.

    Raises:
        ValueError: for a stiffness that is not positive.
    """

    def __init__(
        self,
        length: float,
        stiffness: np.ndarray,
        corrections: np.ndarray,
        symmetry: tuple[str, ...] = MIRRORED,
        order: int = 3,
        rotation: float = np.inf,
        largest_strains: np.ndarray | float = np.inf,
        error_bounds: np.ndarray | float = 0.0,
    ) -> None:
        self.error_bounds = np.broadcast_to(np.asarray(error_bounds, dtype=float), 6)
        self.stiffness = np.array(stiffness, dtype=float)
        self.corrections = np.array(corrections, dtype=float)
        if not (self.stiffness > 0.0).all():
            raise ValueError(f"the stiffness of a module must be positive, got {self.stiffness.tolist()} J")
        self._terms = terms(symmetry, order)
        self._scale = np.array([1.0 / length] * 3 + [1.0] * 3)
        self._largest_strains = np.broadcast_to(largest_strains, 6) / self._scale
        moment = rotation / np.diag(np.linalg.inv(self.evaluate(np.zeros(6))[2]))[3:].max()
        self._largest_load = np.array([2.0 * moment / length] * 3 + [moment] * 3)

    def evaluate(self, strains: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the energy [J], its gradient (6,) [N, N m] and its Hessian (6, 6) at strains (6,) [m, 1]."""
        gradient, hessian = np.empty(6), np.empty((6, 6))
        energy = _energy(self._scale * strains, self._terms, self.stiffness, self.corrections, gradient, hessian)
        return energy, self._scale * gradient, self._scale[:, None] * hessian * self._scale

    def possible_errors(self, strains: np.ndarray) -> np.ndarray:
        """Return the errors of the gradient at strains (6,) that wrong strains cause, by axis: shape (6, 6) [N, N m].

        Row i is that of strains which are off along their axis i by its bound. If errors along different axes are
        independent, the root of the sum of squares of the work of all rows along a motion bounds the work of all.
        """
        off = self.error_bounds * np.linalg.norm(self._scale * strains) / self._scale
        return off[:, None] * self.evaluate(strains)[2]

    def load(self, strains: np.ndarray) -> float:
        """Return the load at strains (6,) over the largest one that was learned."""
        return self._load(self.evaluate(strains)[1])

    def _load(self, gradient: np.ndarray) -> float:
        return float(np.linalg.norm(gradient / self._largest_load))

    def knows(self, strains: np.ndarray) -> bool:
        """Whether the energy may be trusted at strains (6,).

        No strain and no load is larger than those that were learned, and the Hessian is positive definite, as it was in
        all learned states.
        """
        _, gradient, hessian = self.evaluate(strains)
        learned = bool((np.abs(strains) <= self._largest_strains).all()) and self._load(gradient) <= 1.0
        return learned and bool(np.linalg.eigvalsh(hessian)[0] > 0.0)
