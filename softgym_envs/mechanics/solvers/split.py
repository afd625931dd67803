"""Indefinite symmetric matrices by Cholesky: the few equations that make a matrix indefinite are split off."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_matrix

from softgym_envs.mechanics.solvers.linear import CholmodSolver, LinearSolver

_LARGEST_RATIO = 1e3
"""Largest entry of ``A11^-1 A12``; more would cost digits. It compares displacements, so it is moderate in a body."""


class SplitCholesky(LinearSolver):
    """Factorises indefinite matrices of which all but a few equations are positive definite.

    Tangents have few negative eigenvalues where a structure buckles or snaps. With a few equations, 2, split off, what
    is left is positive definite:

        A = [A11 A12; A21 A22],    A11 = L L^T,    S = A22 - A21 A11^-1 A12.

    ``S`` is small and dense, and it has as many negative eigenvalues as ``A`` (Haynsworth 1968). So a few Cholesky
    factorisations with the order of elimination of the pattern suffice. LU with row exchanges took 13 times as long as
    one of them on a finger of 36,000 equations.

    Cholesky itself tells which equations to split off: the one where it fails and those that are eliminated next, twice
    as many with every failure. Where the rest stays nearly singular, the equation that moves most follows. They are
    kept for the next matrix.

    Args:
        cholesky: factorises the positive definite part. Its own factorisations are lost.
        most: number of equations that are split off at most.

    Attributes:
        singular: whether the last matrix was singular to rounding: a part of the body moves freely.
    """

    name = "split"

    def __init__(self, cholesky: CholmodSolver, most: int = 200) -> None:
        super().__init__(cholesky.indptr, cholesky.indices)
        self._cholesky = cholesky
        self._most = most
        self._columns = np.repeat(np.arange(self.size), np.diff(self.indptr))
        self._split = np.empty(0, dtype=np.int64)

    def factorise(self, values: np.ndarray) -> bool:
        """Factorise the matrix. False if it is `singular`, or if too many equations would have to be split off."""
        more, self.singular = 3, False
        while len(self._split) <= self._most:
            if not self._factorise(values):
                further = self._cholesky.failed_at(more)
                more *= 2
            else:
                corner = self._couple(values)
                largest = np.abs(self._bridge).max(axis=1, initial=0.0)
                if largest.max() <= _LARGEST_RATIO:
                    return self._complete(corner)
                further = np.array([np.argmax(largest)])  # the rest is nearly singular
            self._split = np.union1d(self._split, further)
        self._split = np.empty(0, dtype=np.int64)
        return False

    def _factorise(self, values: np.ndarray) -> bool:
        """Factorise the matrix with the equations that are split off replaced by uncoupled ones."""
        inside = np.zeros(self.size, dtype=bool)
        inside[self._split] = True
        kept = np.where(inside[self.indices] | inside[self._columns], 0.0, values)
        kept[self.indptr[self._split]] = np.abs(values[self.indptr[:-1]]).mean() or 1.0
        return self._cholesky.factorise(kept)

    def _couple(self, values: np.ndarray) -> np.ndarray:
        """Set A21 and ``A11^-1 A12``, and return A22."""
        split = self._split
        place = np.full(self.size, -1)
        place[split] = np.arange(len(split))
        self._rows = np.zeros((len(split), self.size))
        for first, second in ((self.indices, self._columns), (self._columns, self.indices)):
            entries = np.flatnonzero(place[first] >= 0)
            self._rows[place[first[entries]], second[entries]] = values[entries]
        corner = self._rows[:, split]
        self._rows[:, split] = 0.0
        self._bridge = self._cholesky.solve(self._rows.T)
        return corner

    def _complete(self, corner: np.ndarray) -> bool:
        """Invert S. False if it is singular."""
        schur = corner - self._rows @ self._bridge
        self._eigenvalues, vectors = np.linalg.eigh(0.5 * (schur + schur.T))
        sizes = np.abs(self._eigenvalues)
        self.singular = bool(len(sizes) and sizes.min() <= 1e-14 * np.abs(corner).max())
        if self.singular:
            return False
        self._inverse = vectors / self._eigenvalues @ vectors.T
        return True

    @property
    def negative_eigenvalues(self) -> int:
        """How many eigenvalues of the last factorised matrix are negative."""
        return int((self._eigenvalues < 0.0).sum())

    @property
    def positive_definite(self) -> bool:
        return self.negative_eigenvalues == 0

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        own = rhs[self._split]
        solution = self._cholesky.solve(self._without_split(rhs))
        beside = self._inverse @ (own - self._bridge.T @ rhs)  # the bridge is zero in the rows that are split off
        solution -= self._bridge @ beside
        solution[self._split] = beside
        return solution

    def condense(self, columns: np.ndarray, extra: csc_matrix | None = None) -> tuple[np.ndarray, np.ndarray]:
        if extra is not None:
            columns = np.hstack([columns, extra.toarray()])
        gram, half = self._cholesky.condense(self._without_split(columns))
        beside = columns[self._split] - self._bridge.T @ columns
        return gram + beside.T @ self._inverse @ beside, np.vstack([half, beside])

    def expand(self, vector: np.ndarray) -> np.ndarray:
        half, beside = np.split(vector, [self.size])
        beside = self._inverse @ beside
        solution = self._cholesky.expand(half) - self._bridge @ beside
        solution[self._split] = beside
        return solution

    def _without_split(self, columns: np.ndarray) -> np.ndarray:
        """Return a copy of columns (n, k), zero in the rows that are split off."""
        columns = columns.copy(order="F")
        columns[self._split] = 0.0
        return columns
