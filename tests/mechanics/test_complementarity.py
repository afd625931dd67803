"""The complementarity problem of slack cables, against an oracle that tries every set of active rows."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import nnls

from softgym_envs.mechanics.solvers.complementarity import solve_complementarity


def enumerate_sets(W, gap, unilateral):
    """The least violated of all solutions with a set of unilateral rows at zero."""
    m = len(gap)
    best, fault = np.zeros(m), np.inf
    for zero in itertools.product([False, True], repeat=m):
        if (np.array(zero) & ~unilateral).any():
            continue
        on = np.flatnonzero(~np.array(zero))
        y = np.zeros(m)
        y[on] = np.linalg.solve(W[np.ix_(on, on)], -gap[on])
        force = -(y * np.diag(W))[unilateral].min(initial=0.0)
        opening = -(W @ y + gap)[unilateral].min(initial=0.0)
        if max(force, opening) < fault:
            best, fault = y, max(force, opening)
    assert fault <= 1e-9 * np.abs(gap).max(initial=0.0)
    return best


@st.composite
def problems(draw):
    """Batches of definite problems, of the sizes of cables (1e-4 m/N) and of pneumatic chambers (1e-12 m3/Pa)."""
    m, batch = draw(st.integers(1, 5)), draw(st.integers(1, 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    unilateral = np.array(draw(st.lists(st.booleans(), min_size=m, max_size=m)))
    half = rng.standard_normal((batch, m, m + 2))
    W = draw(st.sampled_from([1.0, 1e-4, 1e-12, 1e6])) * (half @ np.swapaxes(half, 1, 2) + 0.01 * np.eye(m))
    return W, draw(st.sampled_from([1.0, 1e-3, 1e-9])) * rng.standard_normal((batch, m)), unilateral


@settings(max_examples=150)
@given(problems())
def test_against_enumeration(problem):
    W, gap, unilateral = problem
    found = solve_complementarity(W, gap, unilateral)
    for b in range(len(gap)):
        expected = enumerate_sets(W[b], gap[b], unilateral)
        # Condition numbers reach about 1e4, so round-off is 1e-12 relative to the largest effort.
        np.testing.assert_allclose(found[b], expected, rtol=0, atol=1e-9 * np.abs(expected).max(initial=0.0))
    assert (found[:, unilateral] >= 0.0).all()


@settings(max_examples=50)
@given(problems())
def test_all_unilateral_against_non_negative_least_squares(problem):
    W, gap, _ = problem
    found = solve_complementarity(W, gap, np.ones(gap.shape[1], dtype=bool))
    for b in range(len(gap)):
        lower = np.linalg.cholesky(W[b] / W[b].max())
        expected = nnls(lower.T, np.linalg.solve(lower, -gap[b] / np.abs(gap[b]).max()))[0]
        expected *= np.abs(gap[b]).max() / W[b].max()
        np.testing.assert_allclose(found[b], expected, rtol=0, atol=1e-8 * np.abs(expected).max(initial=0.0))


def test_small_cases_by_hand():
    W = np.array([[[2.0, 0.5], [0.5, 1.0]]])
    both = np.array([True, True])
    np.testing.assert_array_equal(solve_complementarity(W, np.array([[0.1, 0.0]]), both), 0.0)
    # The second cable would have to push (-0.5 / 1.75 N): it hangs slack.
    np.testing.assert_allclose(solve_complementarity(W, np.array([[-2.0, -0.4]]), both), [[1.0, 0.0]])
    pushing = solve_complementarity(W, np.array([[-2.0, -0.4]]), np.array([True, False]))
    np.testing.assert_allclose(pushing, np.linalg.solve(W[0], [2.0, 0.4])[None])
    assert pushing[0, 1] < 0.0


def test_at_the_limit_of_slackness():
    """A gap that just closes: round-off must not leave it without a solution."""
    W = np.array([[[3.0, 1.0, 0.2], [1.0, 2.0, 0.3], [0.2, 0.3, 1.5]]]) * 1e-4
    for y in itertools.product([0.0, 1.0 / 3.0, 7.7], repeat=3):
        found = solve_complementarity(W, -(W @ np.array(y)), np.ones(3, dtype=bool))
        np.testing.assert_allclose(found[0], y, atol=1e-10)


def test_an_indefinite_matrix_without_a_solution_is_an_error():
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        solve_complementarity(np.array([[[-1.0]]]), np.array([[-1.0]]), np.array([True]))


def test_too_many_actuators_are_rejected():
    with pytest.raises(ValueError, match="at most 16"):
        solve_complementarity(np.eye(17)[None], np.ones((1, 17)), np.ones(17, dtype=bool))
