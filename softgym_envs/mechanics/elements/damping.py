"""Compiled stress of solids against strain rates, the same for an observer who turns with the body.

The rate of the Green strain ``E = (F^T F - 1) / 2`` does not change if a rotation is added to the motion, in a time
step of any length. A stress proportional to the rate of the linear strain does not have this property: in a step that
turns a body by an angle ``t`` it sees a strain of ``cos t - 1``.

With the deformation gradient ``F_0`` at the start of the step, ``K = F_0^-1`` and ``G = F K``, the rate is
``D = K^T E' K``. The dissipated power per rest volume is ``2 mu D : D + lame (tr D)^2``, and the stress ``G S K^T``
with ``S = 2 mu D + lame tr D``. For small steps, ``D`` is the rate of deformation.
"""

from __future__ import annotations

import numpy as np

from softgym_envs.mechanics.compilation import njit

FIRST = np.array([0, 1, 2, 0, 0, 1])
SECOND = np.array([0, 1, 2, 1, 2, 2])
"""The six components of a symmetric matrix."""


@njit(cache=True, error_model="numpy")
def strain_rates(start, middle, velocity, inverse, rates, traces):
    """Fill ``K`` (m, 9), the components of ``D`` (m, 6) and its trace (m,), with ``E' = sym(middle^T velocity)``.

    All arguments are gradients (m, 9): of the rows at the start, of those at which the velocity acts, and of the
    velocity. At the middle of a step, ``E'`` is the change of ``E`` over the step divided by its duration.
    """
    green = np.empty((3, 3))
    for e in range(start.shape[0]):
        f, m, v, k = start[e], middle[e], velocity[e], inverse[e]
        for i in range(3):
            for j in range(3):
                a, b, p, q = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
                k[3 * j + i] = f[3 * a + p] * f[3 * b + q] - f[3 * a + q] * f[3 * b + p]
        k /= f[0] * k[0] + f[1] * k[3] + f[2] * k[6]
        for i in range(3):
            for j in range(3):
                value = 0.0
                for d in range(3):
                    value += m[3 * d + i] * v[3 * d + j] + m[3 * d + j] * v[3 * d + i]
                green[i, j] = 0.5 * value
        for s in range(6):
            p, q = FIRST[s], SECOND[s]
            value = 0.0
            for i in range(3):
                for j in range(3):
                    value += k[3 * i + p] * green[i, j] * k[3 * j + q]
            rates[e, s] = value
        traces[e] = rates[e, 0] + rates[e, 1] + rates[e, 2]


@njit(cache=True, error_model="numpy")
def resist(F, inverse, rates, mu, lame, pressure, factor, power, stress, slope, tangent):
    """Fill the power, the stress and, unless it is empty, its tangent at the deformation gradients ``F`` (m, 9).

    Args:
        F: deformation gradients at the end of the step, shape (m, 9).
        inverse: ``K``, shape (m, 9).
        rates: components of ``D``, shape (m, 6).
        mu: shear viscosity [Pa s], shape (m,).
        lame: volumetric viscosity [Pa s], shape (m,).
        pressure: further volumetric stress [Pa], shape (m,).
        factor: derivative of velocities with respect to displacements [1/s].
        power: output [W/m3], shape (m,).
        stress: output [Pa], shape (m, 9).
        slope: output, the derivative ``G K^T`` of the trace of ``D`` by the gradient of the velocity, shape (m, 9).
        tangent: output [Pa], shape (m, 9, 9) or (0, 9, 9).
    """
    g, s, t, w = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((6, 9))
    for e in range(F.shape[0]):
        f, k, d = F[e], inverse[e], rates[e]
        volumetric = lame[e] * (d[0] + d[1] + d[2]) + pressure[e]
        value = 0.0
        for c in range(6):
            i, j = FIRST[c], SECOND[c]
            s[i, j] = 2.0 * mu[e] * d[c]
            if i == j:
                s[i, j] += volumetric
            s[j, i] = s[i, j]
            value += (1.0 if i == j else 2.0) * s[i, j] * d[c]
        power[e] = value
        for i in range(3):
            for j in range(3):
                g[i, j] = f[3 * i] * k[j] + f[3 * i + 1] * k[3 + j] + f[3 * i + 2] * k[6 + j]
        # The stress F (K S K^T)
        for i in range(3):
            for j in range(3):
                value = 0.0
                for p in range(3):
                    for q in range(3):
                        value += k[3 * i + p] * s[p, q] * k[3 * j + q]
                t[i, j] = value
        for i in range(3):
            for j in range(3):
                stress[e, 3 * i + j] = f[3 * i] * t[0, j] + f[3 * i + 1] * t[1, j] + f[3 * i + 2] * t[2, j]
                slope[e, 3 * i + j] = g[i, 0] * k[3 * j] + g[i, 1] * k[3 * j + 1] + g[i, 2] * k[3 * j + 2]
        if tangent.shape[0] == 0:
            continue
        # Rows: derivatives of the components of D by the gradient of the velocity, sqrt(2) times those of shear.
        for c in range(6):
            p, q = FIRST[c], SECOND[c]
            scale = 0.5 if p == q else np.sqrt(0.5)
            for i in range(3):
                for j in range(3):
                    w[c, 3 * i + j] = scale * (g[i, p] * k[3 * j + q] + g[i, q] * k[3 * j + p])
        for a in range(9):
            for b in range(a + 1):
                value = 0.0
                for c in range(6):
                    value += w[c, a] * w[c, b]
                value = factor * (2.0 * mu[e] * value + lame[e] * slope[e, a] * slope[e, b])
                if a // 3 == b // 3:
                    value += t[a % 3, b % 3]
                tangent[e, a, b] = value
                tangent[e, b, a] = value
