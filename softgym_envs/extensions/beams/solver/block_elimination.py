"""Gaussian elimination of sparse matrices of 6 x 6 blocks that are not symmetric, compiled.

Blocks are stored as in `block_cholesky`, and those below the diagonal in another array: the block below the diagonal in
place p belongs to the one above it in place b + p. Pivots are not searched for: the matrices have positive definite
symmetric parts, or nearly so.
"""

from __future__ import annotations

from softgym_envs.extensions.beams.solver.block_cholesky import SIZE
from softgym_envs.mechanics.compilation import FAST, njit


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _invert(D):
    """Invert a block in place; whether all pivots were numbers other than zero."""
    for k in range(SIZE):
        pivot = D[k, k]
        if not abs(pivot) > 0.0:  # also true for NaN
            return False
        D[k, k] = 1.0
        for j in range(SIZE):
            D[k, j] /= pivot
        for i in range(SIZE):
            if i != k:
                part = D[i, k]
                D[i, k] = 0.0
                for j in range(SIZE):
                    D[i, j] -= part * D[k, j]
    return True


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _subtract_product(L, U, target):
    """Subtract the product of two blocks from another one."""
    for i in range(SIZE):
        T = target[i]
        a, b, c, d, e, f = T[0], T[1], T[2], T[3], T[4], T[5]
        for m in range(SIZE):
            v, R = L[i, m], U[m]
            a -= v * R[0]
            b -= v * R[1]
            c -= v * R[2]
            d -= v * R[3]
            e -= v * R[4]
            f -= v * R[5]
        T[0], T[1], T[2], T[3], T[4], T[5] = a, b, c, d, e, f


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def eliminate_blocks(upper, lower, pointers, targets, row):
    """Factorise a matrix in place, ``L D^-1 U``; whether there is a factor. ``row`` (6,) is a work array.

    Diagonal blocks become inverses of pivots, and blocks below the diagonal those of ``L``.
    """
    count, t = pointers.shape[0] - 1, 0
    for k in range(count):
        D = upper[k]
        if not _invert(D):
            return False
        for p in range(pointers[k], pointers[k + 1]):
            B = lower[p]
            for i in range(SIZE):
                for j in range(SIZE):
                    row[j] = B[i, j]
                a, b, c, d, e, f = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for m in range(SIZE):
                    v, R = row[m], D[m]
                    a += v * R[0]
                    b += v * R[1]
                    c += v * R[2]
                    d += v * R[3]
                    e += v * R[4]
                    f += v * R[5]
                B[i, 0], B[i, 1], B[i, 2], B[i, 3], B[i, 4], B[i, 5] = a, b, c, d, e, f
            for q in range(pointers[k], p + 1):
                _subtract_product(lower[q], upper[count + p], upper[targets[t]])
                if q < p:
                    _subtract_product(lower[p], upper[count + q], lower[targets[t] - count])
                t += 1
    return True


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def solve_blocks(upper, lower, pointers, columns, y):
    """Solve with the factors of `eliminate_blocks` in place, for one vector ``y`` (b, 6)."""
    count = pointers.shape[0] - 1
    for k in range(count):
        a, b, c, d, e, f = y[k, 0], y[k, 1], y[k, 2], y[k, 3], y[k, 4], y[k, 5]
        if not (a or b or c or d or e or f):
            continue
        for p in range(pointers[k], pointers[k + 1]):
            B, row = lower[p], columns[p]
            for i in range(SIZE):
                y[row, i] -= B[i, 0] * a + B[i, 1] * b + B[i, 2] * c + B[i, 3] * d + B[i, 4] * e + B[i, 5] * f
    for k in range(count - 1, -1, -1):
        for p in range(pointers[k], pointers[k + 1]):
            B, row = upper[count + p], columns[p]
            a, b, c, d, e, f = y[row, 0], y[row, 1], y[row, 2], y[row, 3], y[row, 4], y[row, 5]
            for i in range(SIZE):
                y[k, i] -= B[i, 0] * a + B[i, 1] * b + B[i, 2] * c + B[i, 3] * d + B[i, 4] * e + B[i, 5] * f
        D = upper[k]
        a, b, c, d, e, f = y[k, 0], y[k, 1], y[k, 2], y[k, 3], y[k, 4], y[k, 5]
        for i in range(SIZE):
            y[k, i] = D[i, 0] * a + D[i, 1] * b + D[i, 2] * c + D[i, 3] * d + D[i, 4] * e + D[i, 5] * f
