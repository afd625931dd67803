"""Sparse symmetric direct solvers behind one small interface: analyse once, factorise and solve many times."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu


class LinearSolver(ABC):
    """Solver for symmetric matrices of one fixed sparsity pattern.

    Args:
        indptr: CSC column pointers of the lower triangle, shape (n + 1,).
        indices: sorted row indices of the lower triangle, shape (nnz,).
    """

    name: str

    def __init__(self, indptr: np.ndarray, indices: np.ndarray) -> None:
        self.indptr = indptr
        self.indices = indices
        self.size = len(indptr) - 1

    @abstractmethod
    def factorise(self, values: np.ndarray) -> bool:
        """Factorise the matrix with the lower-triangle values, shape (nnz,).

        Returns:
            False if this method cannot factorise it (not positive definite, or singular).
        """

    @property
    @abstractmethod
    def positive_definite(self) -> bool:
        """Whether the last factorised matrix is positive definite."""

    @property
    def negative_eigenvalues(self) -> int:
        """How many eigenvalues of the last factorised matrix are negative; -1 if that is not known."""
        return 0 if self.positive_definite else -1

    @abstractmethod
    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """Solve for the columns of ``rhs``, shape (n, k), with the last factorisation."""

    def condense(self, columns: np.ndarray, extra: csc_matrix | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return ``H^T A^-1 H`` (k, k) for columns ``H`` (n, k), and an array ``half`` (n, k) for `expand`.

        ``H`` consists of dense columns, followed by sparse ones if ``extra`` is given.
        """
        if extra is not None:
            columns = np.hstack([columns, extra.toarray()])
        solved = self.solve(columns)
        return columns.T @ solved, solved

    def expand(self, vector: np.ndarray) -> np.ndarray:
        """Return ``A^-1 H s``, shape (n,), for ``vector = half @ s`` with the array ``half`` of `condense`."""
        return vector


class CholmodSolver(LinearSolver):
    """Supernodal Cholesky of CHOLMOD, from the cvxopt wheel (GPL). Positive definite matrices only.

    Args:
        indptr: as for `LinearSolver`.
        indices: as for `LinearSolver`.
        order: an order of elimination, shape (n,). CHOLMOD compares it with that of minimum degree (AMD) and takes the
            one with fewer entries in the factor.
    """

    name = "cholmod"

    def __init__(self, indptr: np.ndarray, indices: np.ndarray, order: np.ndarray | None = None) -> None:
        super().__init__(indptr, indices)
        from cvxopt import cholmod, matrix, spmatrix

        self._cholmod, self._matrix, self._spmatrix = cholmod, matrix, spmatrix
        columns = np.repeat(np.arange(self.size), np.diff(indptr))
        self._identity = matrix((indices == columns).astype(float))
        self._lower = spmatrix(self._identity, matrix(indices.astype(np.int64)), matrix(columns.astype(np.int64)))
        self._order: np.ndarray | None = None
        options = {} if order is None else {"p": matrix(order.tolist())}
        self._factor = cholmod.symbolic(self._lower, **options)

    @property
    def operations(self) -> float:
        """Multiplications and additions of a factorisation, known once a matrix has been factorised."""
        pointers, _, _ = self._cholmod.getfactor(self._factor).CCS
        counts = np.diff(np.asarray(pointers)[:, 0]).astype(float)
        return float(counts @ counts)

    def factorise(self, values: np.ndarray) -> bool:
        self._lower.V = self._matrix(values)
        try:
            self._cholmod.numeric(self._lower, self._factor)
        except ArithmeticError as failure:
            self._failed = int(failure.args[0])
            return False
        return True

    def failed_at(self, count: int) -> np.ndarray:
        """Return where the last factorisation failed: up to ``count`` equations in the order of elimination."""
        if self._order is None:
            self._lower.V = self._identity
            self._cholmod.numeric(self._lower, self._factor)
            order = self._matrix(np.arange(self.size, dtype=float))
            self._cholmod.solve(self._factor, order, sys=7)  # P
            self._order = np.asarray(order)[:, 0].astype(np.int64)
        return self._order[self._failed : self._failed + count]

    @property
    def positive_definite(self) -> bool:
        return True  # `factorise` fails on all other matrices

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        solution = self._matrix(np.asfortranarray(rhs))
        self._cholmod.solve(self._factor, solution)
        return np.asarray(solution)

    def condense(self, columns: np.ndarray, extra: csc_matrix | None = None) -> tuple[np.ndarray, np.ndarray]:
        # With P A P^T = L L^T half of the work suffices: H^T A^-1 H = Y^T Y, L Y = P H.
        half = self._matrix(np.asfortranarray(columns))
        self._cholmod.solve(self._factor, half, sys=7)  # P
        self._cholmod.solve(self._factor, half, sys=4)  # L
        solved = np.asarray(half)
        if extra is not None:
            entries = extra.tocoo()
            rows, places = (self._matrix(index.astype(np.int64)) for index in (entries.row, entries.col))
            sparse = self._spmatrix(self._matrix(entries.data), rows, places, size=entries.shape)
            for system in (7, 4):  # about twice as fast as with dense columns
                sparse = self._cholmod.spsolve(self._factor, sparse, sys=system)
            solved = np.hstack([solved, np.asarray(self._matrix(sparse))])
        return solved.T @ solved, solved

    def expand(self, vector: np.ndarray) -> np.ndarray:
        solution = self._matrix(vector)
        self._cholmod.solve(self._factor, solution, sys=5)  # L^T
        self._cholmod.solve(self._factor, solution, sys=8)  # P^T
        return np.asarray(solution)[:, 0]


class SuperLUSolver(LinearSolver):
    """LU of SuperLU (scipy, BSD): always available, and handles indefinite matrices."""

    name = "superlu"

    def __init__(self, indptr: np.ndarray, indices: np.ndarray) -> None:
        super().__init__(indptr, indices)
        columns = np.repeat(np.arange(self.size), np.diff(indptr))
        strict = np.flatnonzero(indices != columns)
        rows_full = np.concatenate([indices, columns[strict]])
        columns_full = np.concatenate([columns, indices[strict]])
        order = np.lexsort((rows_full, columns_full))
        self._source = np.concatenate([np.arange(len(indices)), strict])[order]
        self._rows = rows_full[order]
        self._pointers = np.concatenate([[0], np.cumsum(np.bincount(columns_full, minlength=self.size))])

    def factorise(self, values: np.ndarray) -> bool:
        full = csc_matrix((values[self._source], self._rows, self._pointers), shape=(self.size, self.size))
        try:
            self._lu = splu(full, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.01, options={"SymmetricMode": True})
        except RuntimeError:  # exactly singular
            return False
        return True

    @property
    def positive_definite(self) -> bool:
        # Without row exchanges the pivots have the signs of the eigenvalues (Sylvester).
        return self.negative_eigenvalues == 0

    @property
    def negative_eigenvalues(self) -> int:
        exchanged = (self._lu.perm_r != self._lu.perm_c).any()
        return -1 if exchanged else int((self._lu.U.diagonal() <= 0.0).sum())

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        return self._lu.solve(np.ascontiguousarray(rhs))


def make_solver(name: str, indptr: np.ndarray, indices: np.ndarray, order: np.ndarray | None = None) -> LinearSolver:
    """Return a solver by name: ``"cholmod"``, ``"superlu"``, or ``"auto"`` for the fastest one installed.

    Args:
        name: of the solver.
        indptr: as for `LinearSolver`.
        indices: as for `LinearSolver`.
        order: an order of elimination to be considered, shape (n,).

    Raises:
        ValueError: for an unknown name.
        ImportError: if ``"cholmod"`` is requested and cvxopt is not installed.
    """
    if name not in ("auto", "cholmod", "superlu"):
        raise ValueError(f"unknown linear solver '{name}'; allowed: auto, cholmod, superlu")
    if name != "superlu":
        try:
            return CholmodSolver(indptr, indices, order)
        except ImportError:
            if name == "cholmod":
                raise
    return SuperLUSolver(indptr, indices)
