"""Cholesky factors of sparse symmetric matrices made of small dense blocks: the six motions of each frame of a beam.

The upper triangle is kept, ``A = U^T S U``, so that the innermost loops run along rows. The signs ``S`` of the pivots
are all positive if the matrix is positive definite. The order of elimination and the blocks that fill in are found
once; factorisation and solution are compiled.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from softgym_envs.mechanics.compilation import FAST, njit

SIZE = 6
"""Rows of a block."""
SMALL = 1e-7
"""Pivots of an indefinite matrix that are smaller than this part of their diagonal entry, or larger than its inverse,
lose too many digits: there is no pivoting."""


class BlockPattern(NamedTuple):
    """Places of the blocks of a matrix. Blocks are numbered in the order of elimination.

    Values have shape (blocks, 6, 6): the diagonal blocks, then those above the diagonal, row by row.

    Attributes:
        pointers: where each row's blocks above the diagonal start, shape (b + 1,).
        columns: their columns, ascending in each row.
        targets: for each row, the blocks that its elimination changes: one for each pair of the row's blocks.
    """

    pointers: np.ndarray
    columns: np.ndarray
    targets: np.ndarray

    @property
    def size(self) -> int:
        """Number of rows of blocks, b."""
        return len(self.pointers) - 1

    @property
    def blocks(self) -> int:
        """Number of blocks that are stored."""
        return self.size + len(self.columns)

    def place(self, row: int, column: int) -> int:
        """Index of a block; the column must not be smaller than the row."""
        if row == column:
            return row
        start, end = self.pointers[row], self.pointers[row + 1]
        return self.size + int(start + np.searchsorted(self.columns[start:end], column))


def analyse(count: int, pairs: Iterable[tuple[int, int]]) -> tuple[np.ndarray, BlockPattern]:
    """Order the elimination of blocks by minimum degree.

    Args:
        count: number of rows of blocks.
        pairs: blocks that are not zero, (row, column) in any order; diagonal ones need not be listed.

    Returns:
        The place of each block row in the order of elimination, shape (count,), and the pattern in this order.
    """
    neighbours: list[set[int]] = [set() for _ in range(count)]
    for i, j in pairs:
        if i != j:
            neighbours[i].add(j)
            neighbours[j].add(i)
    place = np.full(count, -1)
    later: list[list[int]] = []
    for step in range(count):
        chosen = min(np.flatnonzero(place < 0), key=lambda k: len(neighbours[k]))
        place[chosen] = step
        later.append(list(neighbours[chosen]))
        for i in neighbours[chosen]:
            neighbours[i] |= neighbours[chosen]
            neighbours[i] -= {i, int(chosen)}
    rows = [np.sort(place[row]).astype(np.int64) for row in later]
    pointers = np.concatenate([[0], np.cumsum([len(row) for row in rows])]).astype(np.int64)
    pattern = BlockPattern(pointers, np.concatenate([np.empty(0, dtype=np.int64), *rows]), np.empty(0, dtype=np.int64))
    targets = [pattern.place(row[q], row[p]) for row in rows for p in range(len(row)) for q in range(p + 1)]
    return place, pattern._replace(targets=np.array(targets, dtype=np.int64))


@njit(cache=True, error_model="numpy", _nrt=False)
def copy_values(source, out):
    """Fill an array with the values of another one of its shape, which kernels without references cannot assign."""
    flat, given = out.flat, source.flat
    for i in range(out.size):
        flat[i] = given[i]


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"})
def _invert_factor(D, diagonal, sign, negative):
    """Replace a block by the inverse of its factor (lower triangle), and fill the signs (6,) of its pivots.

    ``diagonal`` (6,) are the entries before the elimination, and ``negative`` the number of negative pivots so far.
    Returns their number, or -1 for a pivot that is too small or too large.
    """
    for j in range(SIZE):
        pivot = D[j, j]
        for m in range(j):
            pivot -= sign[m] * D[j, m] * D[j, m]
        if not pivot > 0.0:
            negative += 1
        if negative:
            part = abs(pivot / diagonal[j])
            if not (part > SMALL and part * SMALL < 1.0):
                return -1
        sign[j] = 1.0 if pivot > 0.0 else -1.0
        root = 1.0 / np.sqrt(abs(pivot))
        D[j, j] = root
        for i in range(j + 1, SIZE):
            value = D[i, j]
            for m in range(j):
                value -= sign[m] * D[i, m] * D[j, m]
            D[i, j] = sign[j] * value * root
    # The diagonal holds the inverses of the pivots.
    for j in range(SIZE):
        for i in range(j + 1, SIZE):
            value = 0.0
            for m in range(j, i):
                value -= D[i, m] * D[m, j]
            D[i, j] = value * D[i, i]
            D[j, i] = 0.0
    return negative


@njit(cache=True, error_model="numpy", _nrt=True)
def factorise(A, pointers, targets, signs):
    """Factorise a matrix in place and fill the signs (b, 6) of the pivots; diagonal blocks become inverses of factors.

    Returns the number of negative pivots, that of negative eigenvalues; or -1 if elimination without pivoting breaks
    down.
    """
    return _eliminate(A, pointers, targets, signs, np.empty((SIZE, SIZE)), np.empty(signs.shape))


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"})
def _eliminate(A, pointers, targets, signs, signed, diagonal):
    """Do what `factorise` says; ``signed`` (6, 6) and ``diagonal`` (b, 6) are work arrays."""
    count, t, negative = pointers.shape[0] - 1, 0, 0
    for k in range(count):
        for i in range(SIZE):
            diagonal[k, i] = A[k, i, i]
    for k in range(count):
        D, sign = A[k], signs[k]
        negative = _invert_factor(D, diagonal[k], sign, negative)
        if negative < 0:
            return -1
        for p in range(pointers[k], pointers[k + 1]):
            B = A[count + p]
            for i in range(SIZE - 1, -1, -1):  # row i depends on the rows before it
                a, b, c, d, e, f = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for m in range(i + 1):
                    v = D[i, m]
                    a += v * B[m, 0]
                    b += v * B[m, 1]
                    c += v * B[m, 2]
                    d += v * B[m, 3]
                    e += v * B[m, 4]
                    f += v * B[m, 5]
                s = sign[i]
                B[i, 0], B[i, 1], B[i, 2], B[i, 3], B[i, 4], B[i, 5] = s * a, s * b, s * c, s * d, s * e, s * f
                signed[i, 0], signed[i, 1], signed[i, 2], signed[i, 3], signed[i, 4], signed[i, 5] = a, b, c, d, e, f
            for q in range(pointers[k], p + 1):
                C, L = A[targets[t]], A[count + q]
                for i in range(SIZE):
                    a, b, c, d, e, f = C[i, 0], C[i, 1], C[i, 2], C[i, 3], C[i, 4], C[i, 5]
                    for m in range(SIZE):
                        v = L[m, i]
                        a -= v * signed[m, 0]
                        b -= v * signed[m, 1]
                        c -= v * signed[m, 2]
                        d -= v * signed[m, 3]
                        e -= v * signed[m, 4]
                        f -= v * signed[m, 5]
                    C[i, 0], C[i, 1], C[i, 2], C[i, 3], C[i, 4], C[i, 5] = a, b, c, d, e, f
                t += 1
    return negative


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def solve_lower(A, pointers, columns, y):
    """Solve with the lower factor ``U^T`` in place, for one vector ``y`` (b, 6). Leading zeros are passed over.

    The result is to be multiplied by the signs before `solve_upper`.
    """
    count = pointers.shape[0] - 1
    for k in range(count):
        a, b, c, d, e, f = y[k, 0], y[k, 1], y[k, 2], y[k, 3], y[k, 4], y[k, 5]
        if not (a or b or c or d or e or f):
            continue
        D = A[k]
        f = D[5, 0] * a + D[5, 1] * b + D[5, 2] * c + D[5, 3] * d + D[5, 4] * e + D[5, 5] * f
        e = D[4, 0] * a + D[4, 1] * b + D[4, 2] * c + D[4, 3] * d + D[4, 4] * e
        d = D[3, 0] * a + D[3, 1] * b + D[3, 2] * c + D[3, 3] * d
        c = D[2, 0] * a + D[2, 1] * b + D[2, 2] * c
        b = D[1, 0] * a + D[1, 1] * b
        a = D[0, 0] * a
        y[k, 0], y[k, 1], y[k, 2], y[k, 3], y[k, 4], y[k, 5] = a, b, c, d, e, f
        for p in range(pointers[k], pointers[k + 1]):
            B, row = A[count + p], columns[p]
            for j in range(SIZE):
                y[row, j] -= B[0, j] * a + B[1, j] * b + B[2, j] * c + B[3, j] * d + B[4, j] * e + B[5, j] * f


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def solve_upper(A, pointers, columns, y):
    """Solve with the upper factor ``U`` in place, for one vector ``y`` (b, 6)."""
    count = pointers.shape[0] - 1
    for k in range(count - 1, -1, -1):
        for p in range(pointers[k], pointers[k + 1]):
            B, row = A[count + p], columns[p]
            a, b, c, d, e, f = y[row, 0], y[row, 1], y[row, 2], y[row, 3], y[row, 4], y[row, 5]
            for i in range(SIZE):
                y[k, i] -= B[i, 0] * a + B[i, 1] * b + B[i, 2] * c + B[i, 3] * d + B[i, 4] * e + B[i, 5] * f
        D = A[k]
        a, b, c, d, e, f = y[k, 0], y[k, 1], y[k, 2], y[k, 3], y[k, 4], y[k, 5]
        y[k, 0] = D[0, 0] * a + D[1, 0] * b + D[2, 0] * c + D[3, 0] * d + D[4, 0] * e + D[5, 0] * f
        y[k, 1] = D[1, 1] * b + D[2, 1] * c + D[3, 1] * d + D[4, 1] * e + D[5, 1] * f
        y[k, 2] = D[2, 2] * c + D[3, 2] * d + D[4, 2] * e + D[5, 2] * f
        y[k, 3] = D[3, 3] * d + D[4, 3] * e + D[5, 3] * f
        y[k, 4] = D[4, 4] * e + D[5, 4] * f
        y[k, 5] = D[5, 5] * f
