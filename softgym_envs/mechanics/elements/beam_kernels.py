"""Compiled strain energy of a beam at a Gauss point, for the general assembly and for the compiled equations of beams.

A state at a Gauss point is an array ``z`` (7, 3): ``r', d_1, d_2, d_3, d_1', d_2', d_3'``, which is linear in the rows.
The six strains (see `beams`) are quadratic in it. ``rows`` (k,) are the first rows of an element's frames; ``shape``
and ``slope`` (k,) the values and slopes of the shape functions at the point.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def interpolate(x, rows, shape, slope, z):
    """Fill ``z`` at rows ``x`` (n, 3)."""
    for v in range(7):
        for d in range(3):
            z[v, d] = 0.0
    for a in range(rows.shape[0]):
        row, h, s = rows[a], shape[a], slope[a]
        for d in range(3):
            z[0, d] += s * x[row, d]
            for i in range(1, 4):
                z[i, d] += h * x[row + i, d]
                z[3 + i, d] += s * x[row + i, d]


@njit(cache=True, error_model="numpy")
def strains(z, out):
    """Fill ``out`` (6,) with the strains, those at rest included."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        stretch, bend = 0.0, 0.0
        for d in range(3):
            stretch += z[0, d] * z[1 + i, d]
            bend += z[1 + k, d] * z[4 + j, d] - z[1 + j, d] * z[4 + k, d]
        out[i], out[3 + i] = stretch, 0.5 * bend


@njit(cache=True, error_model="numpy")
def pull_back(z, stress, gradient):
    """Add to ``gradient`` (7, 3) the derivative by ``z`` of the work that ``stress`` (6,) does on the strains."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        force, moment = stress[i], 0.5 * stress[3 + i]
        for d in range(3):
            gradient[0, d] += force * z[1 + i, d]
            gradient[1 + i, d] += force * z[0, d]
            gradient[1 + k, d] += moment * z[4 + j, d]
            gradient[4 + j, d] += moment * z[1 + k, d]
            gradient[1 + j, d] -= moment * z[4 + k, d]
            gradient[4 + k, d] -= moment * z[1 + j, d]


@njit(cache=True, error_model="numpy")
def add_forces(gradient, rows, shape, slope, out):
    """Add the derivative by the rows to ``out`` (n, 3), given that by ``z``, ``gradient`` (7, 3)."""
    for a in range(rows.shape[0]):
        row, h, s = rows[a], shape[a], slope[a]
        for d in range(3):
            out[row, d] += s * gradient[0, d]
            for i in range(1, 4):
                out[row + i, d] += h * gradient[i, d] + s * gradient[3 + i, d]


@njit(cache=True, error_model="numpy")
def strain_columns(x, rows, shape, slope, z, scale, out):
    """Fill ``out`` (18, 6) with derivatives of the strains at ``z``, times ``scale`` (6,), by the motions of 3 frames.

    A frame's motion has six components: the displacement of its origin and its spin, which turns its directors in
    ``x`` (n, 3).
    """
    for a in range(3):
        row, h, s = rows[a], shape[a], slope[a]
        u, w = 6 * a, 6 * a + 3
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            c, b = scale[i], 0.5 * scale[3 + i]
            for d in range(3):
                e, f = (d + 1) % 3, (d + 2) % 3
                out[u + d, i] = c * s * z[1 + i, d]
                out[u + d, 3 + i] = 0.0
                # The spin turns d into w x d, and (w x d) . g = w . (d x g).
                out[w + d, i] = c * h * (x[row + 1 + i, e] * z[0, f] - x[row + 1 + i, f] * z[0, e])
                out[w + d, 3 + i] = b * (
                    x[row + 1 + j, e] * (s * z[1 + k, f] - h * z[4 + k, f])
                    - x[row + 1 + j, f] * (s * z[1 + k, e] - h * z[4 + k, e])
                    + x[row + 1 + k, e] * (h * z[4 + j, f] - s * z[1 + j, f])
                    - x[row + 1 + k, f] * (h * z[4 + j, e] - s * z[1 + j, e])
                )


@njit(cache=True, error_model="numpy")
def add_turned(p, q, factor, block, row, column):
    """Add the second derivative of ``factor (w_a x p) . (w_b x q)``, ``factor ((p . q) 1 - q p^T)``, to a block."""
    dot = factor * (p[0] * q[0] + p[1] * q[1] + p[2] * q[2])
    for i in range(3):
        for j in range(3):
            block[row + i, column + j] -= factor * q[i] * p[j]
        block[row + i, column + i] += dot


@njit(cache=True, error_model="numpy")
def add_geometric(x, rows, shape, slope, stress, matrix):
    """Add the terms of the stress to an element's matrix (18, 18) over the motions of 3 frames.

    Terms of single frames, the curvature of their rotation, are left out: all forces on a frame contribute to them.
    """
    pull = np.empty((3, 3))  # sum_i force_i d_i of each frame
    for a in range(3):
        for d in range(3):
            pull[a, d] = 0.0
            for i in range(3):
                pull[a, d] += shape[a] * stress[i] * x[rows[a] + 1 + i, d]
    for a in range(3):
        for b in range(3):
            # u_a . (w_b x pull_b), and its mirror image
            s = slope[a]
            for i in range(3):
                j, k = (i + 1) % 3, (i + 2) % 3
                matrix[6 * a + i, 6 * b + 3 + j] += s * pull[b, k]
                matrix[6 * a + i, 6 * b + 3 + k] -= s * pull[b, j]
                matrix[6 * b + 3 + j, 6 * a + i] += s * pull[b, k]
                matrix[6 * b + 3 + k, 6 * a + i] -= s * pull[b, j]
            if a == b:
                continue
            c = shape[a] * slope[b] - slope[a] * shape[b]
            for i in range(3):
                j, k = 1 + (i + 1) % 3, 1 + (i + 2) % 3
                moment = 0.5 * c * stress[3 + i]
                add_turned(x[rows[a] + k], x[rows[b] + j], moment, matrix, 6 * a + 3, 6 * b + 3)
                add_turned(x[rows[a] + j], x[rows[b] + k], -moment, matrix, 6 * a + 3, 6 * b + 3)
