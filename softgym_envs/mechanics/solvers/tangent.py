"""Factorisation of a tangent whose sparsity pattern grows with contacts."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix, tril

from softgym_envs.mechanics.solvers.linear import CholmodSolver, LinearSolver, SuperLUSolver, make_solver
from softgym_envs.mechanics.solvers.ordering import nested_dissection
from softgym_envs.mechanics.solvers.split import SplitCholesky


def _distinct(keys: np.ndarray) -> np.ndarray:
    """Sorted distinct values; for integers, sorting is far faster than `numpy.unique`."""
    keys = np.sort(keys)
    return keys[np.append(True, keys[1:] != keys[:-1])]


class Tangent:
    """Factorises symmetric matrices: a fixed pattern, to which contacts add entries.

    The pattern is analysed again only when an entry lies outside it. It keeps what it has, until it is twice as large
    as without contacts.

    Args:
        indptr: CSC column pointers of the lower triangle without contacts, shape (N + 1,).
        indices: its sorted row indices.
        solver: name of the linear solver, see `make_solver`.

    Attributes:
        solver: what the matrix was last factorised with.
        analyses: how often the pattern was analysed again.
    """

    def __init__(self, indptr: np.ndarray, indices: np.ndarray, solver: str) -> None:
        self._name = solver
        self._size = len(indptr) - 1
        self._order = nested_dissection(indptr, indices)
        self._preferred: LinearSolver = make_solver(solver, indptr, indices, self._order)
        self._fallback: SplitCholesky | None = None
        self._base: np.ndarray | None = None
        self._own = (indptr, indices)
        self.solver = self._preferred
        self.analyses = 0

    def factorise(self, values: np.ndarray, extra: csr_matrix | None, *, fallback: bool = True) -> bool:
        """Factorise the matrix with the lower-triangle values of the fixed pattern, plus a symmetric matrix (N, N).

        Returns:
            False if the matrix is singular or, without the fallback, not positive definite.
        """
        if extra is not None:
            values = self._merge(values, extra)
        self.solver = self._preferred
        if self._preferred.factorise(values):
            return fallback or self._preferred.positive_definite
        if not fallback or not isinstance(self._preferred, CholmodSolver):
            return False
        # Cholesky fails on a tangent that is indefinite although the constrained problem is stable.
        if self._fallback is None:
            self._fallback = SplitCholesky(self._preferred)
        self.solver = self._fallback
        if self._fallback.factorise(values):
            return True
        if not self._fallback.singular:
            return False
        # Parts that move freely matter only if something loads them, and LU passes over them.
        self.solver = SuperLUSolver(self._preferred.indptr, self._preferred.indices)
        return self.solver.factorise(values)

    def _merge(self, values: np.ndarray, extra: csr_matrix) -> np.ndarray:
        """Return the values of the sum in the pattern, which grows if it has to."""
        if self._base is None:
            indptr, indices = self._own
            columns = np.repeat(np.arange(self._size, dtype=np.int64), np.diff(indptr))
            self._base = self._keys = columns * self._size + indices
            self._place = np.arange(len(self._base))
        entries = tril(extra, format="coo")
        keys = entries.col.astype(np.int64) * self._size + entries.row
        at = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        if (self._keys[at] != keys).any():
            kept = self._keys if len(self._keys) < 2 * len(self._base) else self._base
            self._keys = _distinct(np.concatenate([kept, keys]))
            self._place = np.searchsorted(self._keys, self._base)
            indptr = np.searchsorted(self._keys, np.arange(self._size + 1, dtype=np.int64) * self._size)
            self._preferred = make_solver(self._name, indptr, self._keys % self._size, self._order)
            self._fallback = None
            self.analyses += 1
            at = np.searchsorted(self._keys, keys)
        merged = np.zeros(len(self._keys))
        merged[self._place] = values
        np.add.at(merged, at, entries.data)
        return merged
