"""Hyperelastic materials: energy density, first Piola-Kirchhoff stress and its exact tangent.

A material is a stateless object working on batches of deformation gradients. Flattened 3x3 tensors are
row-major: ``F[3 * i + j]`` is the derivative of coordinate i with respect to reference coordinate j.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np

from softgym_envs.errors import unknown_name
from softgym_envs.mechanics.compilation import njit


def lame_parameters(young_modulus: float, poisson_ratio: float) -> tuple[float, float]:
    """Return Lame's (mu, lambda) [Pa] of Young's modulus [Pa] and Poisson's ratio.

    Raises:
        ValueError: if the modulus is not positive or the ratio is outside (-1, 0.5).
    """
    if not (math.isfinite(young_modulus) and young_modulus > 0):
        raise ValueError(f"young_modulus = {young_modulus} Pa must be positive and finite")
    if not -1.0 < poisson_ratio < 0.5:
        raise ValueError(f"poisson_ratio = {poisson_ratio} must be inside (-1, 0.5)")
    mu = young_modulus / (2.0 * (1.0 + poisson_ratio))
    return mu, young_modulus * poisson_ratio / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))


class Material(ABC):
    """Isotropic hyperelastic material with two Lame parameters."""

    name: str

    @abstractmethod
    def evaluate(
        self,
        F: np.ndarray,
        mu: np.ndarray,
        lame: np.ndarray,
        energy: np.ndarray,
        stress: np.ndarray,
        tangent: np.ndarray,
    ) -> int:
        """Fill energy density, stress and tangent of m deformation gradients.

        Args:
            F: deformation gradients, shape (m, 9).
            mu: shear modulus [Pa], shape (m,).
            lame: Lame's first parameter [Pa], shape (m,).
            energy: output [J/m3], shape (m,).
            stress: output dPsi/dF [Pa], shape (m, 9).
            tangent: output d2Psi/dF2 [Pa], shape (m, 9, 9), or (0, 9, 9) if it is not needed.

        Returns:
            The number of inverted (det F <= 0) or non-finite gradients; the outputs are meaningless if not 0.
        """

    def dilation(self, F: np.ndarray, dilation: np.ndarray, gradient: np.ndarray, hessian: np.ndarray) -> None:
        """Fill the measure of volume change that Lame's first parameter acts on: psi = psi(mu, 0) + lambda / 2 theta^2.

        Only averaged elements need it.

        Args:
            F: deformation gradients, shape (m, 9), none inverted.
            dilation: output theta, shape (m,).
            gradient: output d theta / dF, shape (m, 9).
            hessian: output d2 theta / dF2, shape (m, 9, 9).

        Raises:
            ValueError: if the material does not define it.
        """
        name = getattr(self, "name", type(self).__name__)
        raise ValueError(f"material '{name}' defines no dilation, as element 'averaged' needs; allowed: 'quadratic'")


@njit(cache=True, inline="always", error_model="numpy")
def _cofactor(f, c):
    """Cofactor matrix of a flat 3x3 matrix; returns the determinant."""
    c[0] = f[4] * f[8] - f[5] * f[7]
    c[1] = f[5] * f[6] - f[3] * f[8]
    c[2] = f[3] * f[7] - f[4] * f[6]
    c[3] = f[2] * f[7] - f[1] * f[8]
    c[4] = f[0] * f[8] - f[2] * f[6]
    c[5] = f[1] * f[6] - f[0] * f[7]
    c[6] = f[1] * f[5] - f[2] * f[4]
    c[7] = f[2] * f[3] - f[0] * f[5]
    c[8] = f[0] * f[4] - f[1] * f[3]
    return f[0] * c[0] + f[1] * c[1] + f[2] * c[2]


@njit(cache=True, error_model="numpy")
def _corotational(F, mu, lame, energy, stress, tangent):
    r = np.empty(9)
    c = np.empty(9)
    s = np.empty(9)
    g = np.empty(9)
    h = np.empty((9, 3))
    hg = np.empty((9, 3))
    bad = 0
    for e in range(F.shape[0]):
        f = F[e]
        determinant = _cofactor(f, c)
        if not 0.0 < determinant < np.inf:  # also true for NaN
            bad += 1
            continue
        # Polar rotation by Newton's iteration with norm scaling (Higham 1986): quadratic, to round-off.
        for k in range(9):
            r[k] = f[k]
        converged = False
        change = np.inf
        for _ in range(40):
            d = _cofactor(r, c)
            upscale = 0.5
            downscale = 0.5 / d
            # Scaling pays only far from a rotation; after a small change it costs two norms for nothing.
            if change > 1e-2:
                norm_r = 0.0
                norm_i = 0.0
                for k in range(9):
                    norm_r += r[k] * r[k]
                    norm_i += c[k] * c[k]
                ratio = norm_i / (norm_r * d * d)
                if ratio < 0.25 or ratio > 4.0:
                    scale = np.sqrt(np.sqrt(ratio))
                    upscale *= scale
                    downscale /= scale
            change = 0.0
            for k in range(9):
                new = upscale * r[k] + downscale * c[k]
                change += (new - r[k]) ** 2
                r[k] = new
            if change < 1e-16:  # what is left is its square
                converged = True
                break
        if not converged:
            bad += 1
            continue
        # S = R^T F, symmetric.
        for i in range(3):
            for j in range(3):
                s[3 * i + j] = r[i] * f[j] + r[3 + i] * f[3 + j] + r[6 + i] * f[6 + j]
        trace = s[0] + s[4] + s[8]
        m = mu[e]
        la = lame[e]
        psi = 0.0
        for k in range(9):
            difference = f[k] - r[k]
            psi += difference * difference
            stress[e, k] = 2.0 * m * difference + la * (trace - 3.0) * r[k]
        energy[e] = m * psi + 0.5 * la * (trace - 3.0) ** 2
        # Derivative of R: for dF = e_i (x) e_k, R^T dF has the axial vector h = e_k x R^T e_i, and dR = R [w]x with
        # (tr S I - S) w = h. Its quadratic form is h . (tr S I - S)^-1 . h.
        for k in range(9):
            s[k] = -s[k]
        s[0] += trace
        s[4] += trace
        s[8] += trace
        d = _cofactor(s, g)
        if not abs(d) > 0.0:
            bad += 1
            continue
        if tangent.shape[0] == 0:
            continue
        inverse_d = 1.0 / d
        for i in range(3):
            a0 = r[3 * i]
            a1 = r[3 * i + 1]
            a2 = r[3 * i + 2]
            h[3 * i, 0] = 0.0
            h[3 * i, 1] = -a2
            h[3 * i, 2] = a1
            h[3 * i + 1, 0] = a2
            h[3 * i + 1, 1] = 0.0
            h[3 * i + 1, 2] = -a0
            h[3 * i + 2, 0] = -a1
            h[3 * i + 2, 1] = a0
            h[3 * i + 2, 2] = 0.0
        coefficient = (la * (trace - 3.0) - 2.0 * m) * inverse_d
        for p in range(9):
            for j in range(3):
                hg[p, j] = coefficient * (h[p, 0] * g[j] + h[p, 1] * g[3 + j] + h[p, 2] * g[6 + j])
        for p in range(9):
            for q in range(p + 1):
                value = la * r[p] * r[q] + hg[p, 0] * h[q, 0] + hg[p, 1] * h[q, 1] + hg[p, 2] * h[q, 2]
                tangent[e, p, q] = value
                tangent[e, q, p] = value
            tangent[e, p, p] += 2.0 * m
    return bad


class Corotational(Material):
    """Corotational linear elasticity: ``mu |F - R|^2 + lambda/2 (tr(R^T F) - 3)^2`` with R the polar rotation of F.

    The tangent contains the derivative of R. Sources: Etzmuss et al. 2003, with the exact derivative of the polar
    decomposition as in McAdams et al. 2011.
    """

    name = "corotational"

    def evaluate(self, F, mu, lame, energy, stress, tangent):  # noqa: D102
        return _corotational(F, mu, lame, energy, stress, tangent)

    def dilation(self, F, dilation, gradient, hessian):
        # With mu = -1/2 the stress is R - F and the tangent dR/dF - I.
        count = len(F)
        _corotational(F, np.full(count, -0.5), np.zeros(count), dilation, gradient, hessian)
        gradient += F
        hessian += np.eye(9)
        dilation[:] = np.einsum("mk,mk->m", gradient, F) - 3.0


@njit(cache=True, error_model="numpy")
def _stable_neo_hookean(F, mu, lame, energy, stress, tangent):
    c = np.empty(9)
    bad = 0
    for e in range(F.shape[0]):
        f = F[e]
        # Parameters that make the small-strain limit that of Lame's mu and lambda (Smith et al. 2018, eq. 15-16).
        m = mu[e] * 4.0 / 3.0
        la = lame[e] + 5.0 / 6.0 * mu[e]
        alpha = 1.0 + m / la - m / (4.0 * la)
        J = _cofactor(f, c)
        if not 0.0 < J < np.inf:
            bad += 1
            continue
        ic = 0.0
        for k in range(9):
            ic += f[k] * f[k]
        energy[e] = 0.5 * m * (ic - 3.0) + 0.5 * la * (J - alpha) ** 2 - 0.5 * m * math.log(ic + 1.0)
        # Shift the energy so that it is zero at rest.
        energy[e] -= 0.5 * la * (1.0 - alpha) ** 2 - 0.5 * m * math.log(4.0)
        a = m * (1.0 - 1.0 / (ic + 1.0))
        b = la * (J - alpha)
        for p in range(9):
            stress[e, p] = a * f[p] + b * c[p]
        if tangent.shape[0] == 0:
            continue
        k2 = 2.0 * m / (ic + 1.0) ** 2
        for p in range(9):
            for q in range(9):
                tangent[e, p, q] = k2 * f[p] * f[q] + la * c[p] * c[q]
            tangent[e, p, p] += a
        # Second derivative of det F: e_ijk e_abc F_kc.
        for i in range(3):
            j = (i + 1) % 3
            k = (i + 2) % 3
            for n in range(3):
                o = (n + 1) % 3
                q = (n + 2) % 3
                value = b * f[3 * k + q]
                tangent[e, 3 * i + n, 3 * j + o] += value
                tangent[e, 3 * j + o, 3 * i + n] += value
                tangent[e, 3 * i + o, 3 * j + n] -= value
                tangent[e, 3 * j + n, 3 * i + o] -= value
    return bad


_LEVI_CIVITA = np.zeros((3, 3, 3))
_LEVI_CIVITA[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1.0
_LEVI_CIVITA[[0, 2, 1], [2, 1, 0], [1, 0, 2]] = -1.0
# d2 det F / dF_ia dF_jb = eps_ijk eps_abc F_kc
_DETERMINANT_CURVATURE = np.einsum("ijk,abc->kciajb", _LEVI_CIVITA, _LEVI_CIVITA).reshape(9, 81)


class StableNeoHookean(Material):
    """Stable neo-Hookean solid of Smith, de Goes and Kim 2018 (eq. 14), for large strain."""

    name = "stable_neo_hookean"

    def evaluate(self, F, mu, lame, energy, stress, tangent):  # noqa: D102
        return _stable_neo_hookean(F, mu, lame, energy, stress, tangent)

    def dilation(self, F, dilation, gradient, hessian):
        f = F.reshape(-1, 3, 3)
        dilation[:] = np.linalg.det(f) - 1.0
        for i in range(3):
            gradient[:, 3 * i : 3 * i + 3] = np.cross(f[:, (i + 1) % 3], f[:, (i + 2) % 3])
        hessian[:] = (F @ _DETERMINANT_CURVATURE).reshape(-1, 9, 9)


MATERIALS: dict[str, Material] = {material.name: material for material in (Corotational(), StableNeoHookean())}
"""Registry of materials by name."""


def resolve_material(material: str | Material) -> Material:
    """Return a material given itself or its name.

    Raises:
        ValueError: for an unknown name.
    """
    if isinstance(material, Material):
        return material
    if material not in MATERIALS:
        raise ValueError(unknown_name("material", material, MATERIALS))
    return MATERIALS[material]
