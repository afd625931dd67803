"""Small linear complementarity problems, which decide which cables are taut."""

from __future__ import annotations

import numpy as np

from softgym_envs.mechanics.compilation import njit


@njit(cache=True, error_model="numpy", _nrt=False)
def _with_slack(slack, W, gap, unilateral, tolerance, y, a, index):
    """Fill y (m,) with the efforts, assuming that the actuators in ``slack`` carry none.

    Returns the actuators that contradict this assumption: taut ones that would have to push, and slack ones that would
    fall short of their commands; -1 if W of the taut ones is not positive definite. Sets of actuators are bit masks.
    """
    m = len(gap)
    k = 0
    for i in range(m):
        y[i] = 0.0
        if not slack >> i & 1:
            index[k] = i
            k += 1
    for r in range(k):
        for c in range(k):
            a[r, c] = W[index[r], index[c]]
        a[r, k] = -gap[index[r]]
    # Gaussian elimination without pivoting: fine for positive definite blocks.
    for p in range(k):
        if not a[p, p] > 0.0:
            return -1
        for r in range(p + 1, k):
            factor = a[r, p] / a[p, p]
            for c in range(p, k + 1):
                a[r, c] -= factor * a[p, c]
    for r in range(k - 1, -1, -1):
        value = a[r, k]
        for c in range(r + 1, k):
            value -= a[r, c] * y[index[c]]
        y[index[r]] = value / a[r, r]
    wrong = 0
    for i in range(m):
        if slack >> i & 1:
            value = gap[i]
            for j in range(m):
                value += W[i, j] * y[j]
            if not value >= -tolerance:  # also true for NaN
                wrong |= 1 << i
        elif unilateral[i] and not y[i] >= 0.0:
            wrong |= 1 << i
    return wrong


@njit(cache=True, error_model="numpy", _nrt=False)
def solve_row(W, gap, unilateral, y, a, index):
    """Fill y (m,) with the consistent efforts; False if there are none.

    ``a``, shape (m, m + 1), and ``index``, integers of shape (m,), are work arrays.
    """
    m = len(gap)
    scale, bilateral = 0.0, 0
    for i in range(m):
        scale = max(scale, abs(gap[i]))
        if not unilateral[i]:
            bilateral |= 1 << i
    tolerance = 1e-12 * scale
    # Start with all taut and switch every actuator that contradicts this; two or three rounds nearly always suffice.
    slack = 0 * m  # the literal 0 would be a type of its own, for which all is compiled again
    for _ in range(2 * m):
        wrong = _with_slack(slack, W, gap, unilateral, tolerance, y, a, index)
        if wrong == 0:
            return True
        if wrong < 0:
            break
        slack ^= wrong
    # The rounds may cycle, and they end early if W is not definite: then try every set.
    for slack in range(1 << m):
        if not slack & bilateral and _with_slack(slack, W, gap, unilateral, tolerance, y, a, index) == 0:
            return True
    return False


@njit(cache=True, error_model="numpy")
def _solve(W, gap, unilateral, y, found):
    """Solve the problems one by one."""
    count, m = gap.shape
    a, index = np.empty((m, m + 1)), np.empty(m, dtype=np.int64)
    for b in range(count):
        found[b] = solve_row(W[b], gap[b], unilateral, y[b], a, index)


def solve_rows(W: np.ndarray, gap: np.ndarray, unilateral: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Solve as `solve_complementarity` does, but return which rows have a solution, shape (B,), instead of raising.

    The efforts of the other rows are meaningless.

    Raises:
        ValueError: for more than 16 actuators.
    """
    if gap.shape[1] > 16:
        raise ValueError(f"complementarity problems have at most 16 actuators, got {gap.shape[1]}")
    y, found = np.empty_like(gap), np.empty(len(gap), dtype=bool)
    _solve(W, gap, unilateral, y, found)
    return y, found


def solve_complementarity(W: np.ndarray, gap: np.ndarray, unilateral: np.ndarray) -> np.ndarray:
    """Solve ``W y + gap = 0`` for bilateral rows, ``0 <= y _|_ W y + gap >= 0`` for unilateral ones.

    If W is positive definite, exactly one set of taut actuators is consistent. It is found by block principal pivoting
    (Kostreva 1978), which switches all rows that contradict a set at once; if this cycles, all sets are tried.

    Args:
        W: symmetric positive definite matrices, shape (B, m, m).
        gap: shape (B, m).
        unilateral: shape (m,).

    Raises:
        numpy.linalg.LinAlgError: if no set is consistent: a W is not positive definite.
        ValueError: for more than 16 actuators.
    """
    y, found = solve_rows(W, gap, unilateral)
    if not found.all():
        row = np.flatnonzero(~found)[0]
        raise np.linalg.LinAlgError(f"no consistent set of taut actuators in row {row}: W is not positive definite")
    return y


def held_step(W: np.ndarray, gap: np.ndarray, effort: np.ndarray, unilateral: np.ndarray) -> np.ndarray:
    """Return what `complementary_step` does, from the present set of taut actuators, for any W.

    A body that would buckle under given efforts has an indefinite W, and can be stable as long as its actuators are
    held. Several sets of taut actuators are consistent then, most of them far away, so one is sought next to the
    present one: actuators that contradict it change one by one.

    Raises:
        numpy.linalg.LinAlgError: if no consistent set is found.
    """
    offset = gap - W @ effort
    taut = ~unilateral | (effort > 0.0)
    tolerance = 1e-12 * float(np.abs(gap).max(initial=0.0))
    for _ in range(2 * len(gap)):
        new = np.zeros(len(gap))
        new[taut] = np.linalg.solve(W[taut][:, taut], -offset[taut])
        wrong = unilateral & np.where(taut, new < 0.0, W @ new + offset < -tolerance)
        if not wrong.any():
            return new - effort
        taut[np.argmax(wrong)] ^= True
    raise np.linalg.LinAlgError("no consistent set of taut actuators near the present one")


def complementary_step(W: np.ndarray, gap: np.ndarray, effort: np.ndarray, unilateral: np.ndarray) -> np.ndarray:
    """Return steps of driven efforts that close ``gap`` in bilateral rows and make no unilateral row push."""
    if not unilateral.any():
        return np.linalg.solve(W, -gap)
    if unilateral.all():
        return solve_complementarity(W[None], (gap - W @ effort)[None], unilateral)[0] - effort
    one_way, both_ways = np.flatnonzero(unilateral), np.flatnonzero(~unilateral)
    offset = gap - W @ effort
    # Eliminate the bilateral rows: only the few others can be taut or slack.
    below, right = both_ways[:, None], one_way[:, None]
    reduced = np.linalg.solve(W[below, both_ways], np.column_stack([W[below, one_way], offset[both_ways]]))
    across = W[right, both_ways] @ reduced
    new = np.empty_like(effort)
    new[one_way] = solve_complementarity(
        (W[right, one_way] - across[:, :-1])[None],
        (offset[one_way] - across[:, -1])[None],
        np.ones(len(one_way), dtype=bool),
    )[0]
    new[both_ways] = -(reduced[:, :-1] @ new[one_way] + reduced[:, -1])
    return new - effort
