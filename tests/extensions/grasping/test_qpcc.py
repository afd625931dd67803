"""Quadratic programs with complementarity: against enumeration with another solver, and properties of the search."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.grasping.control.qpcc import ComplementarityQP, solve_qpcc
from tests.verification.contact_control import enumerated_optimum


def random_problem(seed, contacts, actuators=2):
    """A random condensed model, scaled; some contacts penetrate at first, and some problems are infeasible."""
    rng = np.random.default_rng(seed)
    n = actuators + contacts
    half = rng.normal(size=(n + 2, n + 4))
    W = half @ half.T / (n + 2)
    J = W[n:, :n]
    return ComplementarityQP(
        hessian=J.T @ J + 1e-3 * W[:n, :n],
        gradient=J.T @ rng.normal(size=2),
        lower=np.zeros(n),
        upper=np.append(np.full(actuators, 3.0), np.full(contacts, 1e6)),
        rows=W[:actuators, :n],
        rows_lower=np.full(actuators, -0.5),
        rows_upper=np.full(actuators, 1.0),
        pairs=np.arange(actuators, n),
        pair_rows=W[actuators:n, :n],
        pair_offset=rng.uniform(-0.4, 0.6, contacts),
    )


@pytest.mark.parametrize("contacts", [1, 2, 3, 4, 5])
def test_the_enumerated_optimum_is_found(contacts):
    infeasible = 0
    for seed in range(20):
        problem = random_problem(seed, contacts)
        best = enumerated_optimum(problem)
        if np.isinf(best):
            infeasible += 1
            with pytest.raises(ConvergenceError, match="no set"):
                solve_qpcc(problem)
            continue
        found = solve_qpcc(problem)
        assert found.proven
        assert found.value == pytest.approx(best, rel=1e-6, abs=1e-8)
    assert infeasible < 10


@given(seed=st.integers(0, 2**32 - 1), contacts=st.integers(1, 7))
@settings(max_examples=60, deadline=None)
def test_results_are_complementary_and_within_bounds(seed, contacts):
    problem = random_problem(seed, contacts)
    try:
        found = solve_qpcc(problem)
    except ConvergenceError:
        return
    y, w = found.z[problem.pairs], problem.gaps(found.z)
    assert (y >= -1e-9).all()
    assert (w >= -1e-9).all()
    assert np.abs(np.where(found.closed, w, y)).max() <= 1e-9
    assert (found.z >= problem.lower - 1e-9).all()
    assert (found.z <= problem.upper + 1e-9).all()
    moved = problem.rows @ found.z
    assert (moved >= problem.rows_lower - 1e-9).all()
    assert (moved <= problem.rows_upper + 1e-9).all()


@given(seed=st.integers(0, 2**32 - 1), contacts=st.integers(1, 7), sets=st.integers(0, 2**7 - 1))
@settings(max_examples=60, deadline=None)
def test_results_are_never_worse_than_the_start_even_if_the_search_ends_there(seed, contacts, sets):
    problem = random_problem(seed, contacts)
    start = np.array([bool(sets >> k & 1) for k in range(contacts)])
    z = problem.minimise(start, ~start)
    if z is None:
        return
    for limit in (1, 3, 1000):
        found = solve_qpcc(problem, start, max_programs=limit)
        assert found.value <= problem.value(z) + 1e-12
        assert found.programs <= limit + 1
    assert not solve_qpcc(problem, start, max_programs=1).proven


def test_a_search_that_ends_before_any_set_is_found_raises():
    problem = random_problem(0, 5)
    with pytest.raises(ConvergenceError, match="within 1 program$"):
        solve_qpcc(problem, max_programs=1)


def test_one_contact_by_hand():
    """A unit spring whose end is pushed to a wall 1 away: the goal decides whether the wall is touched."""

    def answer(goal):
        # Variables: effort and contact force; position = effort - force; opening = 1 - position.
        J = np.array([[1.0, -1.0]])
        problem = ComplementarityQP(
            hessian=J.T @ J + 1e-6 * np.eye(2),
            gradient=-goal * J[0],
            lower=np.array([-10.0, 0.0]),
            upper=np.array([10.0, 1e6]),
            rows=np.zeros((0, 2)),
            rows_lower=np.zeros(0),
            rows_upper=np.zeros(0),
            pairs=np.array([1]),
            pair_rows=-J,
            pair_offset=np.ones(1),
        )
        return solve_qpcc(problem)

    free, pressed = answer(0.5), answer(2.0)
    assert not free.closed[0]
    assert free.z == pytest.approx([0.5, 0.0], abs=1e-5)
    # Beyond the wall more effort does not help, so there is no force either.
    assert pressed.z == pytest.approx([1.0, 0.0], abs=1e-5)


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_pulls_of_pairs_are_the_derivatives_of_the_optimum(seed):
    """The multipliers of Karush, Kuhn and Tucker: by how much the objective falls as the zero of a pair grows."""
    problem, step, seen = random_problem(seed, 3), 1e-5, 0
    for number in range(8):
        closed = np.array([bool(number >> k & 1) for k in range(3)])
        found = problem.solve_set(closed, ~closed)
        if found is None:
            continue
        z, pull = found
        for k in range(3):
            values = []
            for shift in (step, -step):
                offset, lower = problem.pair_offset.copy(), problem._bounds[0].copy()
                moved = replace(problem, pair_offset=offset)
                if closed[k]:
                    offset[k] -= shift
                else:
                    lower[problem.pairs[k]] = shift
                    moved.__dict__["_bounds"] = (lower, *problem._bounds[1:])
                there = moved.solve_set(closed, ~closed)
                values.append(np.nan if there is None else moved.value(there[0]))
            if np.isfinite(values).all():
                seen += 1
                assert pull[k] == pytest.approx((values[1] - values[0]) / (2.0 * step), rel=1e-4, abs=1e-6)
    assert seen >= 3


def test_the_start_is_improved_until_no_pair_of_zeros_pulls():
    """Without any search by branches, the result is a local optimum: single changes of its pairs do not improve it."""
    improved = 0
    for seed in range(30):
        problem = random_problem(seed, 5)
        start = np.zeros(5, dtype=bool)
        first = problem.minimise(start, ~start)
        if first is None:
            continue
        found = solve_qpcc(problem, start, max_programs=12)
        improved += found.value < problem.value(first) - 1e-9
        y, w = found.z[problem.pairs], problem.gaps(found.z)
        for k in np.flatnonzero((np.abs(y) < 1e-9) & (np.abs(w) < 1e-9)) if found.programs < 12 else ():
            other = found.closed ^ (np.arange(5) == k)
            there = problem.minimise(other, ~other)
            assert there is None or problem.value(there) >= found.value - 1e-9
    assert improved > 3
