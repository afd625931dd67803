"""The same elements in scikit-fem: linear problems, and a twisted column of a nonlinear material."""

from __future__ import annotations

import numpy as np
import pytest

from tests.verification import side_by_side


@pytest.mark.parametrize("element", ["linear", "quadratic"])
@pytest.mark.parametrize(
    "make",
    [lambda e: side_by_side.cantilever_problem(1, e), lambda e: side_by_side.cook_problem(2, e, 0.3)],
    ids=["cantilever", "Cook's membrane"],
)
def test_linear_problems(make, element):
    problem = make(element)
    ours, theirs = side_by_side.ours(problem), side_by_side.scikit_fem(problem)
    np.testing.assert_allclose(ours, theirs, atol=1e-9 * np.abs(ours).max())


@pytest.mark.parametrize("element", ["linear", "quadratic"])
def test_twisted_column(element, monkeypatch):
    """The strain energy after 30 degrees in one step."""
    monkeypatch.setattr(side_by_side, "TURNS", np.array([np.pi / 6.0]))
    model = side_by_side.column(1, element)
    assert side_by_side.our_column(model) == pytest.approx(side_by_side.skfem_column(model), rel=1e-10)


def test_a_code_that_is_not_installed_is_left_out(monkeypatch):
    monkeypatch.setitem(side_by_side.CODES, "PyElastica", "no_such_module")
    monkeypatch.setitem(side_by_side.CODES, "MuJoCo", "no_such_module")
    rows = list(side_by_side._relaxed())
    assert {row.code for row in rows} == {"this package"}
    assert max(abs(row.error) for row in rows) < 1e-12  # a beam of order 2 is exact
