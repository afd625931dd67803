"""Linear solvers: agreement on definite matrices, rejection of all others."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csc_matrix, random_array, tril

from softgym_envs.mechanics.solvers.linear import CholmodSolver, LinearSolver, SuperLUSolver, make_solver
from softgym_envs.mechanics.solvers.ordering import nested_dissection
from softgym_envs.mechanics.solvers.split import SplitCholesky

NAMES = ["cholmod", "superlu"]
SIZE = 60


def lower_of(matrix):
    lower = tril(csc_matrix(matrix), format="csc")
    lower.sort_indices()
    return lower


@pytest.fixture
def definite(rng):
    """A sparse symmetric positive definite matrix, dense, of condition about 100."""
    half = random_array((SIZE, SIZE), density=0.1, rng=rng).toarray()
    return half @ half.T + 0.1 * np.eye(SIZE)


@pytest.fixture
def indefinite(definite):
    """The same pattern with a few negative eigenvalues, none near zero."""
    values, vectors = np.linalg.eigh(definite)
    shift = 0.5 * (values[SIZE // 3] + values[SIZE // 3 + 1])
    matrix = definite - shift * np.eye(SIZE)
    assert np.abs(np.linalg.eigvalsh(matrix)).min() > 1e-4
    return matrix


@pytest.mark.parametrize("name", NAMES)
def test_solves_definite_systems(definite, rng, name):
    lower = lower_of(definite)
    solver = make_solver(name, lower.indptr, lower.indices)
    assert solver.name == name
    assert solver.size == SIZE
    assert solver.factorise(lower.data)
    rhs = rng.standard_normal((SIZE, 4))
    kept = rhs.copy()
    solution = solver.solve(rhs)
    np.testing.assert_array_equal(rhs, kept)
    np.testing.assert_allclose(definite @ solution, rhs, atol=1e-10)
    np.testing.assert_allclose(solver.solve(rhs[:, :1]), solution[:, :1], atol=1e-12)


def test_both_solvers_agree(definite, rng):
    lower = lower_of(definite)
    rhs = np.asfortranarray(rng.standard_normal((SIZE, 3)))
    solutions = []
    for cls in (CholmodSolver, SuperLUSolver):
        solver = cls(lower.indptr, lower.indices)
        assert solver.factorise(lower.data)
        solutions.append(solver.solve(rhs))
    np.testing.assert_allclose(*solutions, atol=1e-11 * np.abs(solutions[0]).max())


@pytest.mark.parametrize("name", NAMES)
def test_one_analysis_serves_many_factorisations(definite, rng, name):
    lower = lower_of(definite)
    solver = make_solver(name, lower.indptr, lower.indices)
    rhs = rng.standard_normal((SIZE, 1))
    for scale in (1.0, 1e6, 1e-6):
        assert solver.factorise(scale * lower.data)
        np.testing.assert_allclose(scale * definite @ solver.solve(rhs), rhs, atol=1e-10)


def test_cholmod_rejects_an_indefinite_matrix_and_recovers(definite, indefinite, rng):
    lower, other = lower_of(definite), lower_of(indefinite)
    np.testing.assert_array_equal(lower.indices, other.indices)
    solver = CholmodSolver(lower.indptr, lower.indices)
    assert not solver.factorise(other.data)
    assert solver.factorise(lower.data)
    rhs = rng.standard_normal((SIZE, 1))
    np.testing.assert_allclose(definite @ solver.solve(rhs), rhs, atol=1e-10)


def test_superlu_solves_an_indefinite_matrix(indefinite, rng):
    lower = lower_of(indefinite)
    solver = SuperLUSolver(lower.indptr, lower.indices)
    assert solver.factorise(lower.data)
    rhs = rng.standard_normal((SIZE, 2))
    np.testing.assert_allclose(indefinite @ solver.solve(rhs), rhs, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_singular_matrix_is_rejected(name):
    lower = lower_of(np.diag([1.0, 0.0, 2.0]) + np.diag([1e-300] * 3))  # the pattern keeps its diagonal
    values = np.where(lower.data < 1e-200, 0.0, lower.data)
    assert not make_solver(name, lower.indptr, lower.indices).factorise(values)


def test_auto_selects_an_available_solver(definite):
    lower = lower_of(definite)
    assert isinstance(make_solver("auto", lower.indptr, lower.indices), LinearSolver)


def test_auto_works_without_cvxopt(definite, monkeypatch, rng):
    monkeypatch.setitem(__import__("sys").modules, "cvxopt", None)
    lower = lower_of(definite)
    solver = make_solver("auto", lower.indptr, lower.indices)
    assert solver.name == "superlu"
    with pytest.raises(ImportError):
        make_solver("cholmod", lower.indptr, lower.indices)


def test_unknown_name_is_rejected(definite):
    lower = lower_of(definite)
    with pytest.raises(ValueError, match=r"unknown linear solver 'magic'; allowed: auto, cholmod, superlu"):
        make_solver("magic", lower.indptr, lower.indices)


@pytest.fixture
def cabled():
    """A grid of 3 x 3 x 80 nodes in which a cable couples all nodes of one edge and next to it."""
    nodes = np.stack(np.meshgrid(np.arange(3), np.arange(3), np.arange(80), indexing="ij"), axis=-1).reshape(-1, 3)
    coupled = np.abs(nodes[:, None] - nodes).max(axis=2) == 1
    cable = (nodes[:, :2] < 2).all(axis=1)
    coupled |= cable[:, None] & cable
    np.fill_diagonal(coupled, False)
    return np.diag(1.0 + coupled.sum(axis=1)) - coupled


def test_nested_dissection_spares_operations_where_a_cable_couples_a_long_body(cabled, rng):
    lower = lower_of(cabled)
    order = nested_dissection(lower.indptr, lower.indices)
    np.testing.assert_array_equal(np.sort(order), np.arange(len(cabled)))
    assert nested_dissection(lower.indptr, lower.indices) is order  # remembered
    plain, ordered = (CholmodSolver(lower.indptr, lower.indices, order=given) for given in (None, order))
    rhs = rng.standard_normal((len(cabled), 1))
    for solver in (plain, ordered):
        assert solver.factorise(lower.data)
        np.testing.assert_allclose(cabled @ solver.solve(rhs), rhs, atol=1e-10)
    assert ordered.operations < 0.7 * plain.operations


def test_an_order_that_fills_the_factor_is_not_used(cabled, rng):
    lower = lower_of(cabled)
    plain, ordered = (
        CholmodSolver(lower.indptr, lower.indices, order=given) for given in (None, rng.permutation(len(cabled)))
    )
    for solver in (plain, ordered):
        assert solver.factorise(lower.data)
    assert ordered.operations == plain.operations


def shifted(matrix, negative):
    """The matrix less a multiple of one, so that this many eigenvalues are negative."""
    values = np.linalg.eigvalsh(matrix)
    low = values[negative - 1] if negative else 0.0
    return matrix - 0.5 * (low + values[negative]) * np.eye(len(matrix))


@pytest.mark.parametrize("negative", [0, 1, 2, 6])
def test_split_cholesky_solves_indefinite_systems_and_counts_negative_eigenvalues(cabled, rng, negative):
    matrix = shifted(cabled + np.diag(rng.uniform(0.0, 2.0, len(cabled))), negative)
    lower = lower_of(matrix)
    cholesky = CholmodSolver(lower.indptr, lower.indices)
    assert cholesky.factorise(lower.data) is (negative == 0)
    solver = SplitCholesky(cholesky)
    for _ in range(2):  # the second time with the equations that were split off before
        assert solver.factorise(lower.data)
        assert solver.negative_eigenvalues == negative
        assert solver.positive_definite is (negative == 0)
        rhs = np.asfortranarray(rng.standard_normal((len(matrix), 3)))
        exact = np.linalg.solve(matrix, rhs)
        scale = np.abs(exact).max()
        np.testing.assert_allclose(solver.solve(rhs), exact, atol=1e-10 * scale)
        gram, half = solver.condense(rhs[:, :2], csc_matrix(rhs[:, 2:]))
        np.testing.assert_allclose(gram, rhs.T @ exact, atol=1e-10 * scale * len(rhs))
        effort = rng.standard_normal(3)
        np.testing.assert_allclose(solver.expand(half @ effort), exact @ effort, atol=1e-10 * scale)


def test_split_cholesky_says_when_it_cannot_factorise(indefinite):
    lower = lower_of(indefinite)
    cholesky = CholmodSolver(lower.indptr, lower.indices)
    assert SplitCholesky(cholesky).factorise(lower.data)
    assert not SplitCholesky(cholesky, most=10).factorise(lower.data)  # 20 eigenvalues are negative
    singular = np.zeros_like(lower.data)
    assert not SplitCholesky(cholesky).factorise(singular)
