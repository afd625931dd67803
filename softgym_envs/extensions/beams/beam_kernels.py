"""Compiled strain energy of a beam at a Gauss point, for the general assembly and for the compiled equations of beams.

A state at a Gauss point is an array ``z`` (7, 3): ``r', d_1, d_2, d_3, d_1', d_2', d_3'``, which is linear in the rows.
The six strains (see `beams`) are quadratic in it. ``rows`` (k,) are the first rows of an element's frames; ``shape``
and ``slope`` (k,) the values and slopes of the shape functions at the point.

Sums run in local variables and may be reordered and fused, which compilers then keep in vector registers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from softgym_envs.mechanics.compilation import FAST, njit


class Work(NamedTuple):
    """Work arrays of the assembly, for one element, chamber or pair of frames at a time.

    Attributes:
        z: axis and directors at two Gauss points with their slopes, shape (2, 7, 3).
        pull: what a Gauss point does to them, shape (7, 3).
        stress: shape (2, 6).
        stiffness: shape (2, 6).
        spins: strains by spins of frames, shape (3, 2, 6, 3).
        crossed: displacements by spins, shape (3, 2, 3, 3).
        straight: displacements by displacements, shape (2, 3, 3).
        moments: of two frames on each other, zero on the diagonal, shape (3, 3).
        matrix: shape (3, 3).
        block: of the tangent, shape (6, 6).
        way: shape (3,).
        slope: shape (3,).
        pulled: length of a line of a chamber by the motions of three frames, shape (3, 6).
        arms: of a line of a chamber, from three frames, shape (3, 3).
    """

    z: np.ndarray
    pull: np.ndarray
    stress: np.ndarray
    stiffness: np.ndarray
    spins: np.ndarray
    crossed: np.ndarray
    straight: np.ndarray
    moments: np.ndarray
    matrix: np.ndarray
    block: np.ndarray
    way: np.ndarray
    slope: np.ndarray
    pulled: np.ndarray
    arms: np.ndarray


def make_work() -> Work:
    """Return work arrays."""
    return Work(
        z=np.zeros((2, 7, 3)),
        pull=np.zeros((7, 3)),
        stress=np.zeros((2, 6)),
        stiffness=np.zeros((2, 6)),
        spins=np.zeros((3, 2, 6, 3)),
        crossed=np.zeros((3, 2, 3, 3)),
        straight=np.zeros((2, 3, 3)),
        moments=np.zeros((3, 3)),
        matrix=np.zeros((3, 3)),
        block=np.zeros((6, 6)),
        way=np.zeros(3),
        slope=np.zeros(3),
        pulled=np.zeros((3, 6)),
        arms=np.zeros((3, 3)),
    )


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def interpolate(x, rows, shape, slope, z):
    """Fill ``z`` at rows ``x`` (n, 3); elements have two or three frames."""
    last = rows.shape[0] - 1
    i, j, k = rows[0], rows[1], rows[last]
    a, b, c = shape[0], shape[1], shape[last]
    p, q, r = slope[0], slope[1], slope[last]
    if last == 1:
        c = r = 0.0
    for d in range(3):
        z[0, d] = p * x[i, d] + q * x[j, d] + r * x[k, d]
    for m in range(1, 4):
        for d in range(3):
            u, v, w = x[i + m, d], x[j + m, d], x[k + m, d]
            z[m, d] = a * u + b * v + c * w
            z[3 + m, d] = p * u + q * v + r * w


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def strains(z, out):
    """Fill ``out`` (6,) with the strains, those at rest included."""
    a, b, c, p, q, r = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for d in range(3):
        a += z[0, d] * z[1, d]
        b += z[0, d] * z[2, d]
        c += z[0, d] * z[3, d]
        p += z[3, d] * z[5, d] - z[2, d] * z[6, d]
        q += z[1, d] * z[6, d] - z[3, d] * z[4, d]
        r += z[2, d] * z[4, d] - z[1, d] * z[5, d]
    out[0], out[1], out[2], out[3], out[4], out[5] = a, b, c, 0.5 * p, 0.5 * q, 0.5 * r


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def pull_back(z, stress, gradient):
    """Add to ``gradient`` (7, 3) the derivative by ``z`` of the work that ``stress`` (6,) does on the strains."""
    f, g, h = stress[0], stress[1], stress[2]
    p, q, r = 0.5 * stress[3], 0.5 * stress[4], 0.5 * stress[5]
    for d in range(3):
        t, a, b, c, u, v, w = z[0, d], z[1, d], z[2, d], z[3, d], z[4, d], z[5, d], z[6, d]
        gradient[0, d] += f * a + g * b + h * c
        gradient[1, d] += f * t + q * w - r * v
        gradient[2, d] += g * t + r * u - p * w
        gradient[3, d] += h * t + p * v - q * u
        gradient[4, d] += r * b - q * c
        gradient[5, d] += p * c - r * a
        gradient[6, d] += q * a - p * b


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def add_forces(gradient, rows, shape, slope, out):
    """Add the derivative by the rows to ``out`` (n, 3), given that by ``z``, ``gradient`` (7, 3)."""
    for f in range(rows.shape[0]):
        row, h, s = rows[f], shape[f], slope[f]
        for d in range(3):
            out[row, d] += s * gradient[0, d]
            out[row + 1, d] += h * gradient[1, d] + s * gradient[4, d]
            out[row + 2, d] += h * gradient[2, d] + s * gradient[5, d]
            out[row + 3, d] += h * gradient[3, d] + s * gradient[6, d]


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def spin_columns(x, row, h, s, z, out):
    """Fill ``out`` (6, 3) with derivatives of the strains by the spin of a frame, which turns its directors in ``x``.

    ``h`` and ``s`` are value and slope of its shape function. A displacement of its origin changes only the first three
    strains, by ``s`` times the directors in ``z``.
    """
    # The spin turns d into w x d, and (w x d) . g = w . (d x g).
    p, q, r = s * z[1, 0] - h * z[4, 0], s * z[1, 1] - h * z[4, 1], s * z[1, 2] - h * z[4, 2]
    t, u, v = s * z[2, 0] - h * z[5, 0], s * z[2, 1] - h * z[5, 1], s * z[2, 2] - h * z[5, 2]
    f, g, k = s * z[3, 0] - h * z[6, 0], s * z[3, 1] - h * z[6, 1], s * z[3, 2] - h * z[6, 2]
    a0, a1, a2 = x[row + 1, 0], x[row + 1, 1], x[row + 1, 2]
    b0, b1, b2 = x[row + 2, 0], x[row + 2, 1], x[row + 2, 2]
    c0, c1, c2 = x[row + 3, 0], x[row + 3, 1], x[row + 3, 2]
    e0, e1, e2 = h * z[0, 0], h * z[0, 1], h * z[0, 2]
    out[0, 0], out[0, 1], out[0, 2] = a1 * e2 - a2 * e1, a2 * e0 - a0 * e2, a0 * e1 - a1 * e0
    out[1, 0], out[1, 1], out[1, 2] = b1 * e2 - b2 * e1, b2 * e0 - b0 * e2, b0 * e1 - b1 * e0
    out[2, 0], out[2, 1], out[2, 2] = c1 * e2 - c2 * e1, c2 * e0 - c0 * e2, c0 * e1 - c1 * e0
    # Strain 3 + i changes by w . (d_j x g_k - d_k x g_j) / 2 with g = s d - h d' at the point.
    out[3, 0] = 0.5 * (b1 * k - b2 * g - c1 * v + c2 * u)
    out[3, 1] = 0.5 * (b2 * f - b0 * k - c2 * t + c0 * v)
    out[3, 2] = 0.5 * (b0 * g - b1 * f - c0 * u + c1 * t)
    out[4, 0] = 0.5 * (c1 * r - c2 * q - a1 * k + a2 * g)
    out[4, 1] = 0.5 * (c2 * p - c0 * r - a2 * f + a0 * k)
    out[4, 2] = 0.5 * (c0 * q - c1 * p - a0 * g + a1 * f)
    out[5, 0] = 0.5 * (a1 * v - a2 * u - b1 * r + b2 * q)
    out[5, 1] = 0.5 * (a2 * t - a0 * v - b2 * p + b0 * r)
    out[5, 2] = 0.5 * (a0 * u - a1 * t - b0 * q + b1 * p)


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def displacement_by_spin(z, stiffness, spin, row, h, stress, x, out):
    """Fill ``out`` (3, 3) with the tangent of a displacement by the spin of a frame, per slope of the displaced one.

    Args:
        z: state at a Gauss point.
        stiffness: of the strains, shape (6,).
        spin: what `spin_columns` gives for the frame that turns, shape (6, 3).
        row: first row of this frame.
        h: its shape function.
        stress: shape (6,).
        x: rows, shape (n, 3).
        out: shape (3, 3).
    """
    for d in range(3):
        a, b, c = stiffness[0] * z[1, d], stiffness[1] * z[2, d], stiffness[2] * z[3, d]
        out[d, 0] = a * spin[0, 0] + b * spin[1, 0] + c * spin[2, 0]
        out[d, 1] = a * spin[0, 1] + b * spin[1, 1] + c * spin[2, 1]
        out[d, 2] = a * spin[0, 2] + b * spin[1, 2] + c * spin[2, 2]
    # The stress turns with the frame: u . (w x pull), with pull = h sum_i force_i d_i
    f, g, k = h * stress[0], h * stress[1], h * stress[2]
    p = f * x[row + 1, 0] + g * x[row + 2, 0] + k * x[row + 3, 0]
    q = f * x[row + 1, 1] + g * x[row + 2, 1] + k * x[row + 3, 1]
    r = f * x[row + 1, 2] + g * x[row + 2, 2] + k * x[row + 3, 2]
    out[0, 1] += r
    out[0, 2] -= q
    out[1, 2] += p
    out[1, 0] -= r
    out[2, 0] += q
    out[2, 1] -= p


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def spin_by_spin(first, second, stiffness, block):
    """Fill the part (3, 3) of a block that belongs to both spins with the terms of the stiffness.

    ``first`` and ``second`` (2, 6, 3) are what `spin_columns` gives at two Gauss points, ``stiffness`` (2, 6).
    """
    a, b, c, p, q, r, t, u, v = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for g in range(2):
        for s in range(6):
            k = stiffness[g, s]
            f0, f1, f2 = k * first[g, s, 0], k * first[g, s, 1], k * first[g, s, 2]
            e0, e1, e2 = second[g, s, 0], second[g, s, 1], second[g, s, 2]
            a += f0 * e0
            b += f0 * e1
            c += f0 * e2
            p += f1 * e0
            q += f1 * e1
            r += f1 * e2
            t += f2 * e0
            u += f2 * e1
            v += f2 * e2
    block[3, 3], block[3, 4], block[3, 5] = a, b, c
    block[4, 3], block[4, 4], block[4, 5] = p, q, r
    block[5, 3], block[5, 4], block[5, 5] = t, u, v


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def add_turned(x, one, other, m, block):
    """Add the second derivative of ``sum_ij m_ij (w x p_i) . (v x q_j)`` by two spins to a block (6, 6).

    ``p`` and ``q`` are the directors of frames with first rows ``one`` and ``other``; ``m`` has shape (3, 3).
    """
    a, b, c, p, q, r, t, u, v = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(3):
        f0, f1, f2 = 0.0, 0.0, 0.0
        for i in range(3):
            k = m[i, j]
            f0 += k * x[one + 1 + i, 0]
            f1 += k * x[one + 1 + i, 1]
            f2 += k * x[one + 1 + i, 2]
        e0, e1, e2 = x[other + 1 + j, 0], x[other + 1 + j, 1], x[other + 1 + j, 2]
        a += e0 * f0
        b += e0 * f1
        c += e0 * f2
        p += e1 * f0
        q += e1 * f1
        r += e1 * f2
        t += e2 * f0
        u += e2 * f1
        v += e2 * f2
    # (p . q) 1 - q p^T
    block[3, 3] += q + v
    block[3, 4] -= b
    block[3, 5] -= c
    block[4, 3] -= p
    block[4, 4] += a + v
    block[4, 5] -= r
    block[5, 3] -= t
    block[5, 4] -= u
    block[5, 5] += a + q
