"""Quadratic programs with complementarity constraints, solved to the global optimum by branch and bound.

Each pair holds ``0 <= y _|_ w >= 0``: a contact is open (no force ``y``) or closed (no gap ``w``). With k pairs there
are 2^k sets of closed contacts, each an ordinary convex quadratic program. Branch and bound need not solve all of them:
a program that leaves some pairs undecided bounds the objective of every set that agrees with the decided ones.

See the note on patents in the file NOTICE.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import daqp
import numpy as np

from softgym_envs.control.inverse_qp import UNBOUNDED
from softgym_envs.errors import ConvergenceError
from softgym_envs.wording import counted

_INEQUALITY, _EQUALITY = 0, 5
# Exit codes of DAQP.
_SOLVED, _INFEASIBLE = 1, -1


@dataclass(frozen=True)
class ComplementarityQP:
    """Minimise ``1/2 z^T H z + g^T z`` subject to bounds, rows and complementary pairs.

        lower <= z <= upper,   rows_lower <= rows z <= rows_upper,
        0 <= z[pairs] _|_ pair_rows z + pair_offset >= 0.

    Scale variables, rows and objective to order one.

    Attributes:
        hessian: symmetric, positive definite, shape (n, n).
        gradient: shape (n,).
        lower: smallest variables, shape (n,); 0 or less for those in pairs, which are never negative in any case.
        upper: largest variables, shape (n,).
        rows: shape (m, n).
        rows_lower: shape (m,).
        rows_upper: shape (m,).
        pairs: variables of the pairs, integers, shape (k,).
        pair_rows: shape (k, n).
        pair_offset: shape (k,).
    """

    hessian: np.ndarray
    gradient: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    rows: np.ndarray
    rows_lower: np.ndarray
    rows_upper: np.ndarray
    pairs: np.ndarray
    pair_rows: np.ndarray
    pair_offset: np.ndarray

    @cached_property
    def _bounds(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lower and upper bounds of variables, rows and undecided pairs, and the matrix of the latter two."""
        lower = np.concatenate([self.lower, self.rows_lower, -self.pair_offset])
        lower[self.pairs] = 0.0
        upper = np.concatenate([self.upper, self.rows_upper, np.full(len(self.pairs), UNBOUNDED)])
        return lower, upper, np.ascontiguousarray(np.concatenate([self.rows, self.pair_rows]))

    def gaps(self, z: np.ndarray) -> np.ndarray:
        """Return ``w``, shape (k,)."""
        return self.pair_rows @ z + self.pair_offset

    def value(self, z: np.ndarray) -> float:
        """Return the objective."""
        return float(z @ (0.5 * (self.hessian @ z) + self.gradient))

    def minimise(self, closed: np.ndarray, opened: np.ndarray) -> np.ndarray | None:
        """Return the optimum with some pairs closed, some open and the others merely not negative; None if infeasible.

        Args:
            closed: pairs with ``w = 0``, booleans, shape (k,).
            opened: pairs with ``y = 0``, shape (k,).

        Raises:
            ConvergenceError: if DAQP stops for any other reason.
        """
        found = self.solve_set(closed, opened)
        return None if found is None else found[0]

    def solve_set(self, closed: np.ndarray, opened: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the optimum as `minimise` does, and the pull of each pair.

        The pull is by how much the objective falls for each unit by which the zero of a pair, ``w`` if it is closed and
        ``y`` if it is open, grows. Where the other one is zero as well, the pair can be changed to gain from it.

        Raises:
            ConvergenceError: as `minimise`.
        """
        lower, upper, matrix = self._bounds
        upper = upper.copy()
        sense = np.full(len(upper), _INEQUALITY, dtype=np.int32)
        sense[len(self.lower) + np.flatnonzero(self.rows_lower == self.rows_upper)] = _EQUALITY
        fixed = np.concatenate([self.pairs[opened], len(upper) - len(self.pairs) + np.flatnonzero(closed)])
        upper[fixed] = lower[fixed]
        sense[fixed] = _EQUALITY
        z, _, status, info = daqp.solve(
            self.hessian, self.gradient, matrix, upper, lower, sense, primal_tol=1e-10, dual_tol=1e-11
        )
        if status == _INFEASIBLE:
            return None
        if status != _SOLVED:
            raise ConvergenceError(f"DAQP stopped with exit code {status}")
        multipliers = info["lam"]
        return z, np.where(closed, multipliers[len(multipliers) - len(self.pairs) :], multipliers[self.pairs])


@dataclass(frozen=True)
class Optimum:
    """Solution of a `ComplementarityQP`.

    Attributes:
        z: variables, shape (n,).
        value: objective.
        closed: pairs with ``w = 0``, booleans, shape (k,); the others have ``y = 0``.
        programs: number of quadratic programs that were solved.
        proven: no other set has a smaller objective; False if the search ended at its limit.
    """

    z: np.ndarray
    value: float
    closed: np.ndarray
    programs: int
    proven: bool


def solve_qpcc(
    problem: ComplementarityQP,
    start: np.ndarray | None = None,
    *,
    max_programs: int = 1000,
    tolerance: float = 1e-9,
) -> Optimum:
    """Return the global optimum, or the best point found with ``max_programs`` quadratic programs.

    The sets of ``start`` are improved first: while a pair of which both sides are zero pulls, it is changed. The result
    is a local optimum, and it bounds what follows. The search then goes depth first. It branches on the pair with the
    largest product ``y w`` and first takes the side that the relaxed optimum is closer to, so it descends at once to a
    good set.

    Args:
        problem: the problem.
        start: closed pairs of known sets, booleans, shape (s, k): the result is never worse than the best of them.
        max_programs: see above.
        tolerance: by which ``min(y, w)`` may exceed zero in a relaxed optimum that counts as complementary, and by
            which, relative to the objective, a set must be better than the best so far.

    Raises:
        ConvergenceError: if no set is feasible, or none was found within ``max_programs``.
    """
    k = len(problem.pairs)
    best: Optimum | None = None
    value, programs, pull = np.inf, 0, np.zeros(k)

    def visit(closed: np.ndarray, opened: np.ndarray) -> np.ndarray | None:
        """Solve one program; return its optimum if a set below it can be better than the best so far."""
        nonlocal best, value, programs, pull
        programs += 1
        found = problem.solve_set(closed, opened)
        if found is None:
            return None
        z, pull = found
        bound = problem.value(z)
        if not bound < value - tolerance * (1.0 + abs(bound)):
            return None
        if (closed | opened).all():
            best, value = Optimum(z, bound, closed, programs, False), bound
            return None
        return z

    def improve(closed: np.ndarray) -> None:
        """Change pairs of a set, all that pull and then the strongest one alone, while that makes it better."""
        before = value
        visit(closed, ~closed)
        while value < before and programs < max_programs:
            before = value
            assert best is not None
            other = np.where(best.closed, best.z[problem.pairs], problem.gaps(best.z))
            gain = np.where(np.abs(other) <= tolerance, pull, 0.0)
            for change in (gain > tolerance, gain == max(float(gain.max(initial=0.0)), tolerance)):
                if change.any() and not value < before:
                    visit(best.closed ^ change, ~(best.closed ^ change))

    for row in np.zeros((0, k), dtype=bool) if start is None else np.atleast_2d(start):
        improve(row)
    none_active = np.zeros(k, dtype=bool)
    stack = [(none_active, none_active)]
    while stack and programs < max_programs:
        closed, opened = stack.pop()
        z = visit(closed, opened)
        if z is None:
            continue
        y, w = z[problem.pairs], problem.gaps(z)
        free = ~(closed | opened)
        if (np.minimum(y, w)[free] <= tolerance).all():
            # Complementary already: solve once more with the set fixed, which also makes the zeros exact.
            visit(closed | (free & (w <= y)), opened | (free & (w > y)))
            bound = problem.value(z)
            if value <= bound + 2.0 * tolerance * (1.0 + abs(bound)):
                continue
        branch = int(np.argmax(np.where(free, y * w, -1.0)))
        one = np.zeros(k, dtype=bool)
        one[branch] = True
        sides = [(closed, opened | one), (closed | one, opened)]
        stack += sides if w[branch] < y[branch] else sides[::-1]
    if best is None:
        raise ConvergenceError(
            f"no set of the {k} complementary pairs is feasible within {counted(programs, 'program')}"
        )
    return Optimum(best.z, best.value, best.closed, programs, not stack)
