"""How the frames of a body of beams move, and what moves with them, compiled; ``frames`` are `MovingFrames`."""

from __future__ import annotations

import numpy as np

from softgym_envs.mechanics.compilation import FAST, njit


@njit(cache=True, error_model="numpy", fastmath=FAST)
def orthonormalise(frames, x):
    """Orthonormalise the directors of the frames in place, so that round-off does not accumulate over a long motion."""
    turned, gram = np.empty((3, 3)), np.empty((3, 3))
    for f in range(frames.rows.shape[0]):
        row = frames.rows[f]
        for k in range(3):
            for d in range(3):
                turned[k, d] = x[row + 1 + k, d]
        for k in range(3):
            for m in range(3):
                gram[k, m] = turned[k, 0] * turned[m, 0] + turned[k, 1] * turned[m, 1] + turned[k, 2] * turned[m, 2]
        for k in range(3):
            for d in range(3):
                value = 1.5 * turned[k, d]
                for m in range(3):
                    value -= 0.5 * gram[k, m] * turned[m, d]
                x[row + 1 + k, d] = value


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def move(frames, x, motion, turned):
    """Move the frames in place by ``motion`` (b, 6): displacements of their origins [m], and spins [rad].

    ``turned`` (3, 3) is a work array. Call `orthonormalise` from time to time.
    """
    for f in range(frames.rows.shape[0]):
        row, step = frames.rows[f], motion[frames.block[f]]
        a, b, c = step[3], step[4], step[5]
        square = a * a + b * b + c * c
        if square < 1e-3:  # sin(t) / t and (1 - cos(t)) / t^2 to rounding
            first = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0)))
            second = 0.5 - square / 24.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0 * (1.0 - square / 90.0)))
        else:
            angle = np.sqrt(square)
            half = np.sin(0.5 * angle)
            first, second = np.sin(angle) / angle, 2.0 * half * half / square
        for k in range(3):
            p, q, r = x[row + 1 + k, 0], x[row + 1 + k, 1], x[row + 1 + k, 2]
            u, v, w = b * r - c * q, c * p - a * r, a * q - b * p
            turned[k, 0] = p + first * u + second * (b * w - c * v)
            turned[k, 1] = q + first * v + second * (c * u - a * w)
            turned[k, 2] = r + first * w + second * (a * v - b * u)
        for k in range(3):
            for d in range(3):
                x[row + 1 + k, d] = turned[k, d]
        for d in range(3):
            x[row, d] += step[d]
    for c in range(frames.mounted.shape[0]):
        row, origin = frames.mounted[c], frames.owner[c]
        for d in range(3):
            value = frames.moves[c] * x[origin, d]
            for k in range(3):
                value += frames.arm[c, k] * x[origin + 1 + k, d]
            x[row, d] = value


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def motion_of(frames, free, x, velocity, h, out):
    """Fill ``out`` (b, 6) with ``h`` times the motion of the frames at ``x`` (n, 3) with velocities of the rows."""
    for f in range(frames.rows.shape[0]):
        row, block = frames.rows[f], frames.block[f]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            out[block, i] = h * velocity[row, i]
            spin = 0.0
            for m in range(1, 4):
                spin += x[row + m, j] * velocity[row + m, k] - x[row + m, k] * velocity[row + m, j]
            out[block, 3 + i] = 0.5 * h * spin
        for i in range(6):
            out[block, i] *= free[block, i]


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def reduce_forces(frames, x, forces, out):
    """Fill ``out`` (b, 6) with the forces and moments of ``forces`` (n, 3) on the frames.

    The forces on rows that follow a frame are replaced by those on its own rows.
    """
    for k in range(frames.mounted.shape[0]):
        row, owner, arm = frames.mounted[k], frames.owner[k], frames.arm[k]
        p, q, r = forces[row, 0], forces[row, 1], forces[row, 2]
        moves, a, b, g = frames.moves[k], arm[0], arm[1], arm[2]
        for d, force in ((0, p), (1, q), (2, r)):
            forces[owner, d] += moves * force
            forces[owner + 1, d] += a * force
            forces[owner + 2, d] += b * force
            forces[owner + 3, d] += g * force
            forces[row, d] = 0.0
    for f in range(frames.rows.shape[0]):
        row, target = frames.rows[f], out[frames.block[f]]
        a, b, c = 0.0, 0.0, 0.0
        for k in range(row + 1, row + 4):
            p, q, r = x[k, 0], x[k, 1], x[k, 2]
            u, v, w = forces[k, 0], forces[k, 1], forces[k, 2]
            a += q * w - r * v
            b += r * u - p * w
            c += p * v - q * u
        target[0], target[1], target[2] = forces[row, 0], forces[row, 1], forces[row, 2]
        target[3], target[4], target[5] = a, b, c


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def add_curvature(frames, x, gradient, tangent):
    """Add the second derivative of rotations, ``(g d^T + d g^T) / 2 - (g . d) 1`` for each director.

    Forces on rows that follow a frame must have been replaced by those on its own rows.
    """
    for f in range(frames.rows.shape[0]):
        row, block = frames.rows[f], tangent[frames.block[f]]
        a, b, c, p, q, r = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(row + 1, row + 4):
            u, v, w = x[k, 0], x[k, 1], x[k, 2]
            e, h, g = gradient[k, 0], gradient[k, 1], gradient[k, 2]
            a += e * u
            b += h * v
            c += g * w
            p += e * v + h * u
            q += e * w + g * u
            r += h * w + g * v
        block[3, 3] -= b + c
        block[4, 4] -= a + c
        block[5, 5] -= a + b
        block[3, 4] += 0.5 * p
        block[4, 3] += 0.5 * p
        block[3, 5] += 0.5 * q
        block[5, 3] += 0.5 * q
        block[4, 5] += 0.5 * r
        block[5, 4] += 0.5 * r


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def rows_moved(frames, x, motion, out):
    """Fill ``out`` (n, 3) with the motion of all rows at ``x`` (n, 3) that ``motion`` (b, 6) of the frames causes."""
    out[:] = 0.0
    for f in range(frames.rows.shape[0]):
        row, step = frames.rows[f], motion[frames.block[f]]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            out[row, i] = step[i]
            for m in range(1, 4):
                out[row + m, i] = step[3 + j] * x[row + m, k] - step[3 + k] * x[row + m, j]
    for c in range(frames.mounted.shape[0]):
        row, origin = frames.mounted[c], frames.owner[c]
        for d in range(3):
            value = frames.moves[c] * out[origin, d]
            for m in range(3):
                value += frames.arm[c, m] * out[origin + 1 + m, d]
            out[row, d] = value
