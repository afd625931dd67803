"""Orthotropic elasticity for printed and fibre-reinforced bodies, with finite rotations.

Components of symmetric tensors are in the order 11, 22, 33, 23, 13, 12; shear strains are doubled.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.materials import Material

PAIRS = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
"""Axes of each component."""


def orthotropic_stiffness(young: Sequence[float], poisson: Sequence[float], shear: Sequence[float]) -> np.ndarray:
    """Return the stiffness (6, 6) of an orthotropic material in its own axes, in the unit of the moduli.

    Args:
        young: Young's moduli along the axes, E1, E2, E3.
        poisson: ratios nu23, nu13, nu12; pulled along the first axis of a pair, a bar becomes thinner along the second.
        shear: moduli G23, G13, G12.

    Raises:
        ValueError: if the stiffness is not positive definite.
    """
    E, nu, G = (np.asarray(values, dtype=float) for values in (young, poisson, shear))
    if not (E.shape == nu.shape == G.shape == (3,) and (E > 0.0).all() and (G > 0.0).all() and np.isfinite(nu).all()):
        raise ValueError(f"young = {E}, poisson = {nu}, shear = {G} must be three each; moduli positive and finite")
    compliance = np.diag(np.concatenate([1.0 / E, 1.0 / G]))
    for (i, j), ratio in zip(PAIRS[3:], nu, strict=True):
        compliance[i, j] = compliance[j, i] = -ratio / E[i]
    if not np.linalg.eigvalsh(compliance / np.sqrt(np.outer(np.diag(compliance), np.diag(compliance)))).min() > 0.0:
        raise ValueError(
            f"no material has young = {E.tolist()} with poisson = {nu.tolist()}: its energy is not positive"
        )
    return np.linalg.inv(compliance)


def turned_stiffness(stiffness: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return stiffnesses (..., 6, 6) in space of a material whose axes are the columns of rotations (..., 3, 3)."""
    # Strains in the material's axes: e' = Q^T e Q; T maps the components of e to those of e'.
    rows, columns = np.array(PAIRS).T
    Q = np.asarray(axes, dtype=float)
    left, right = Q[..., rows], Q[..., columns]  # (..., 3, 6): entry (i, p) is Q[i, a_p]
    T = np.empty((*Q.shape[:-2], 6, 6))
    for q, (i, j) in enumerate(PAIRS):
        both = 0.5 * (left[..., i, :] * right[..., j, :] + left[..., j, :] * right[..., i, :])
        T[..., :, q] = both * np.where(np.arange(6) < 3, 1.0, 2.0)
    return np.swapaxes(T, -1, -2) @ stiffness @ T


@njit(cache=True, error_model="numpy")
def _evaluate(F, stiffness, scale, energy, stress, tangent):
    count = len(stiffness)
    strain, force = np.empty(6), np.empty(6)
    slope, half = np.zeros((6, 9)), np.empty((6, 9))
    axes = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
    bad = 0
    for e in range(F.shape[0]):
        f = F[e]
        volume = (
            f[0] * (f[4] * f[8] - f[5] * f[7]) - f[1] * (f[3] * f[8] - f[5] * f[6]) + f[2] * (f[3] * f[7] - f[4] * f[6])
        )
        if not 0.0 < volume < np.inf:
            bad += 1
            continue
        c = stiffness[e * count // F.shape[0]]
        slope[:, :] = 0.0
        for p in range(6):
            a, b = axes[p]
            value = 0.0
            for k in range(3):
                value += f[3 * k + a] * f[3 * k + b]
                if a == b:
                    slope[p, 3 * k + a] = f[3 * k + a]
                else:
                    slope[p, 3 * k + a] = f[3 * k + b]
                    slope[p, 3 * k + b] = f[3 * k + a]
            strain[p] = 0.5 * (value - 1.0) if a == b else value
        energy[e] = 0.0
        for p in range(6):
            force[p] = 0.0
            for q in range(6):
                force[p] += scale[e] * c[p, q] * strain[q]
            energy[e] += 0.5 * force[p] * strain[p]
        for q in range(9):
            stress[e, q] = 0.0
            for p in range(6):
                stress[e, q] += force[p] * slope[p, q]
        if tangent.shape[0] == 0:
            continue
        for p in range(6):
            for q in range(9):
                half[p, q] = 0.0
                for r in range(6):
                    half[p, q] += scale[e] * c[p, r] * slope[r, q]
        for i in range(9):
            for j in range(9):
                tangent[e, i, j] = 0.0
                for p in range(6):
                    tangent[e, i, j] += slope[p, i] * half[p, j]
        for p in range(6):
            a, b = axes[p]
            for k in range(3):
                tangent[e, 3 * k + a, 3 * k + b] += force[p]
                if a != b:
                    tangent[e, 3 * k + b, 3 * k + a] += force[p]
    return bad


class Orthotropic(Material):
    """Orthotropic Saint Venant-Kirchhoff material: energy ``E : C : E / 2`` of the Green strain E.

    Rotations cause no stress, and strains may be moderate: compressed to less than 0.58 of its length a bar becomes
    softer and collapses. Young's modulus of the block scales the stiffness. Damping uses the isotropic moduli of the
    block.

    Args:
        stiffness: over Young's modulus of the block, in the material's axes, shape (6, 6) or (m, 6, 6).
        axes: the material's axes as columns, shape (3, 3), or (m, 3, 3) for each of m elements; default those of space.

    Raises:
        ValueError: if the stiffness is not symmetric positive definite or the axes are not orthonormal.
    """

    name = "orthotropic"

    def __init__(self, stiffness: np.ndarray, axes: np.ndarray | None = None) -> None:
        stiffness = np.asarray(stiffness, dtype=float)
        axes = np.eye(3) if axes is None else np.asarray(axes, dtype=float)
        if stiffness.shape[-2:] != (6, 6) or axes.shape[-2:] != (3, 3):
            raise ValueError(
                f"stiffness {stiffness.shape} and axes {axes.shape} must have shapes (.., 6, 6), (.., 3, 3)"
            )
        if not np.allclose(stiffness, np.swapaxes(stiffness, -1, -2)) or np.linalg.eigvalsh(stiffness).min() <= 0.0:
            raise ValueError("stiffness must be symmetric and positive definite")
        if not np.allclose(np.swapaxes(axes, -1, -2) @ axes, np.eye(3), atol=1e-9):
            raise ValueError("axes must be orthonormal")
        self.stiffness = np.ascontiguousarray(turned_stiffness(stiffness, axes).reshape(-1, 6, 6))

    def evaluate(self, F, mu, lame, energy, stress, tangent):  # noqa: D102
        if len(F) % len(self.stiffness):
            raise ValueError(f"the material has {len(self.stiffness)} elements, {len(F)} points do not fit them")
        return _evaluate(F, self.stiffness, mu * (3.0 * lame + 2.0 * mu) / (lame + mu), energy, stress, tangent)

    def dilation(self, F, dilation, gradient, hessian):
        raise ValueError("averaged elements take isotropic materials; use element = 'linear' or 'quadratic'")
