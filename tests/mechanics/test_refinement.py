"""Near the last factor, large bodies refine with it instead of factorising again: same states, fewer factors."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs.mechanics.solvers import linear, linearisation
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.mechanics.solvers.tangent import Tangent
from softgym_envs.robots.registry import make_robot

COMMANDS = np.array([[4.0, 5.0], [4.6, 5.9], [4.1, 6.4], [3.2, 6.5], [4.0, 5.6]]) * 1e-3
BODIES = {"free": {}, "touching": {"self_contact": True, "contact_distance": 5e-4}}


@pytest.fixture
def factors(monkeypatch):
    """The factorisations of tangents so far, one entry for each."""
    found, factorise = [], Tangent.factorise

    def counted(self, *arguments, **options):
        found.append(len(found))
        return factorise(self, *arguments, **options)

    monkeypatch.setattr(Tangent, "factorise", counted)
    return found


def path(model):
    statics = Statics(model)
    return [statics.solve(command) for command in COMMANDS], statics


@pytest.mark.parametrize("body", BODIES)
def test_refined_states_are_those_of_new_factors(monkeypatch, factors, body):
    model = make_robot("finger", **BODIES[body]).build()
    assert (model.contact is not None) == (body == "touching")
    exact, _ = path(model)
    usual = len(factors)
    monkeypatch.setattr(linearisation, "REFINED_FROM", 0)
    refined, statics = path(model)
    assert len(factors) - usual < 0.75 * usual
    for one, other in zip(exact, refined, strict=True):
        assert other.iterations == one.iterations
        assert other.stable == one.stable
        np.testing.assert_allclose(other.x, one.x, atol=2e-10)
        W = one.condensed.compliance
        np.testing.assert_allclose(other.condensed.compliance, W, atol=1e-7 * W.max())
        np.testing.assert_allclose(other.effort, one.effort, rtol=1e-6, atol=1e-8)
    # The motions by unit efforts are those of a new factor too.
    effort = np.linspace(1.0, 2.0, len(statics.effort))
    moved = statics.linearisation.response(effort, 1.0)
    assert statics.linearisation.update(statics.x, statics.effort)
    expected = statics.linearisation.response(effort, 1.0)
    np.testing.assert_allclose(moved, expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("limit", ["LARGEST_REST", "NEAR", "MAX_SWEEPS"])
def test_tangents_that_are_not_near_enough_are_factorised(monkeypatch, factors, limit):
    model = make_robot("finger").build()
    exact, _ = path(model)
    usual = len(factors)
    monkeypatch.setattr(linearisation, "REFINED_FROM", 0)
    monkeypatch.setattr(linearisation, limit, 0)
    found, _ = path(model)
    assert len(factors) == 2 * usual
    for one, other in zip(exact, found, strict=True):
        np.testing.assert_array_equal(other.x, one.x)
        np.testing.assert_array_equal(other.condensed.compliance, one.condensed.compliance)


def test_other_loads_need_a_new_factor(monkeypatch, factors):
    """Where the state is linearised anew, e.g. with inertia, the last factor does not count."""
    monkeypatch.setattr(linearisation, "REFINED_FROM", 0)
    _, statics = path(make_robot("finger").build())
    before = len(factors)
    assert statics.linearisation.update(statics.x, statics.effort)
    assert len(factors) == before + 1


@pytest.mark.parametrize("count", [1, 2, 5, 9])
def test_columns_together_are_solved_as_one_by_one(monkeypatch, rng, count):
    half = rng.standard_normal((40, 40))
    rows, places = np.tril_indices(40)
    order = np.lexsort((rows, places))
    values = (half @ half.T + np.eye(40))[rows[order], places[order]]
    indptr = np.concatenate([[0], np.cumsum(40 - np.arange(40))])
    columns = np.asfortranarray(rng.standard_normal((40, count)))
    columns[:7] = 0.0
    found = []
    for least in (linear.TOGETHER_FROM, 0):
        monkeypatch.setattr(linear, "TOGETHER_FROM", least)
        solver = linear.CholmodSolver(indptr, rows[order])
        assert solver.factorise(values)
        gram, halves = solver.condense(columns)
        found.append((solver.solve(columns), gram, solver.expand(halves), solver.expand(halves[:, 0])))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(other, one, atol=1e-10)
    np.testing.assert_allclose(found[1][2], found[1][0], atol=1e-10)
    np.testing.assert_allclose(found[1][3], found[1][0][:, 0], atol=1e-10)
