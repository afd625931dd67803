"""Equilibria found without a factorisation there: W and stability are computed later, and are the same."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.contact.obstacles import Plane
from softgym_envs.mechanics.solvers.exact_compliance import exact_at
from softgym_envs.mechanics.solvers.linearisation import Linearisation
from softgym_envs.mechanics.solvers.statics import Statics

BUCKLING = {"length": 0.0398, "height": 0.0214, "joint_height": 0.0052, "poisson_ratio": 0.307, "bar_length": 0.051}
"""A gripper that its taut cables hold where it would buckle under their tensions, beyond 0.93 of these pulls:"""
PULLS = np.array([0.016, 0.0025, 0.0195, 0.004]) * np.linspace(0.3, 1.0, 15)[:, None]


@pytest.fixture(scope="module")
def finger():
    """A finger and its commands: random, with steps of up to 1 mm."""
    commands = 5e-3 + np.cumsum(np.random.default_rng(0).uniform(-1e-3, 1e-3, (12, 2)), axis=0)
    return make_robot("finger").build(), commands


@pytest.fixture
def factorised(monkeypatch):
    """A list that grows with every factorisation of a tangent."""
    calls, factorise = [], Linearisation.factorise
    monkeypatch.setattr(
        Linearisation, "factorise", lambda *args, **options: calls.append(1) or factorise(*args, **options)
    )
    return calls


def agree(found, expected):
    """Assert that two equilibria are the same, with the same condensed model."""
    np.testing.assert_allclose(found.x, expected.x, rtol=0, atol=1e-10)
    for name in ("compliance", "effort"):
        value, known = (getattr(state.condensed, name) for state in (found, expected))
        np.testing.assert_allclose(value, known, rtol=0, atol=1e-8 * np.abs(known).max())
    np.testing.assert_allclose(found.condensed.delta.array, expected.condensed.delta.array, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(found.slack, expected.slack)
    assert found.stable == expected.stable


@pytest.mark.parametrize("late", [False, True])
def test_the_compliance_computed_later_is_that_of_the_state(finger, late):
    model, commands = finger
    exact, near = Statics(model, tolerance=1e-12), Statics(model, tolerance=1e-12, exact_compliance=False)
    expected, found, read = [], [], []
    for command in commands:
        expected.append(exact.solve(command))
        found.append(near.solve(command))
        if not late:
            read.append(exact_at(near, found[-1]))
    read = read or [exact_at(near, state) for state in found]
    for state, known in zip(read, expected, strict=True):
        agree(state, known)
    before, after = (np.array([state.condensed.compliance for state in states]) for states in (found, read))
    assert (before != after).any()  # it was that of the last iterate
    agree(exact_at(near, near.solve(commands[0])), exact.solve(commands[0]))  # nothing has moved the solver


def test_a_step_takes_one_factorisation_unless_its_compliance_is_computed(finger, factorised):
    model, commands = finger

    def factorisations(exact, reads):
        statics = Statics(model, exact_compliance=exact)
        statics.solve([0.0, 0.0])
        factorised.clear()
        for command in commands:
            state = statics.solve(command)
            if reads:
                exact_at(statics, state)
        return len(factorised) / len(commands)

    eager, lazy, read = (factorisations(*case) for case in ((True, False), (False, False), (False, True)))
    print(f"factorisations per step: {eager:.2f}, without W {lazy:.2f}, with W computed after each step {read:.2f}")
    assert lazy <= 1.25 and read <= eager + 0.1 and eager >= 1.75


def test_the_next_step_starts_with_the_factorisation_of_the_compliance(finger):
    model, commands = finger
    statics = Statics(model, exact_compliance=False)
    for command in commands[:3]:
        found = statics.solve(command)
    assert (statics.linearisation.W == found.condensed.compliance).all()
    exact = exact_at(statics, found).condensed.compliance
    assert (statics.linearisation.W == exact).all() and (exact != found.condensed.compliance).any()


def test_stability_computed_later_is_that_of_the_state():
    model, flags = make_robot("two_finger_gripper").build(BUCKLING), []
    exact, near = Statics(model), Statics(model, exact_compliance=False)
    for pull in PULLS:
        expected, found = exact.solve(pull), near.solve(pull)
        np.testing.assert_allclose(found.x, expected.x, rtol=0, atol=5e-10)
        assert exact_at(near, found).stable == expected.stable
        flags.append(expected.stable)
    assert flags[0] and not flags[-1]


@pytest.fixture
def capped(box):
    """A block with a cable, whose upper face is rigid and carries a load beside its middle."""
    nodes, tetrahedra = box((0.02, 0.02, 0.03), (2, 2, 2))
    body = ModelBuilder()
    body.add_solid(nodes, tetrahedra, fixed=nodes[:, 2] < 1e-9, young_modulus=2e5, poisson_ratio=0.45, element="linear")
    upper = np.flatnonzero(nodes[:, 2] > 0.03 - 1e-9)
    body.carry(body.add_frame([0.01, 0.01, 0.03], np.eye(3)), upper)
    model = body.build()
    model.add_cable("cable", [[0.018, 0.01, 0.005], [0.018, 0.01, 0.025]], [0.018, 0.01, -0.01])
    model.nodal_loads[upper[0]] = [0.0, 0.0, -0.4]
    return model


def test_an_earlier_state_keeps_its_loads(capped):
    exact, near = (Statics(capped, tolerance=1e-12, exact_compliance=each) for each in (True, False))
    expected, found = ([statics.solve([1e-3 * k]) for k in (1, 2)][-1] for statics in (exact, near))
    capped.nodal_loads[:] = 0.0
    near.solve([1e-3])
    near.restore(found.x, found.effort)  # with other loads
    agree(exact_at(near, found), expected)


@pytest.mark.parametrize(
    "change",
    [
        lambda model: model.solids[0].set_elasticity(4e5, 0.45),
        lambda model: model.set_contact(obstacles=[Plane([0.0, 0.0, 0.05], [0.0, 0.0, -1.0])]),
        lambda model: model.add_effector("tip", [0.01, 0.01, 0.02]),
    ],
    ids=["elasticity", "contact", "effector"],
)
def test_a_body_that_has_changed_is_refused(capped, change):
    near = Statics(capped, exact_compliance=False)
    found = [near.solve([1e-3 * k]) for k in (1, 2)][-1]
    change(capped)
    with pytest.raises(ValueError, match="elasticity of the body have changed since this equilibrium was found"):
        exact_at(near, found)


def test_another_elasticity_gives_another_compliance(capped):
    near = Statics(capped, exact_compliance=False)
    found = [near.solve([1e-3 * k]) for k in (1, 2)][-1]
    capped.solids[0].set_elasticity(4e5, 0.45)
    near.solve([1e-3])
    again = near.solve([2e-3])
    assert exact_at(near, again).condensed.compliance != pytest.approx(found.condensed.compliance)


def test_friction_that_cables_get_later_does_not_change_an_earlier_state():
    model = make_robot("finger").build()
    exact, near = Statics(model), Statics(model, exact_compliance=False)
    expected, found = ([statics.solve([x, x]) for x in (3.0e-3, 3.1e-3, 3.2e-3)] for statics in (exact, near))
    for cable in model.constraints["a"]:
        cable.friction = 0.2
    for own, known in zip(found, expected, strict=True):
        assert own.conditions is not None
        agree(exact_at(near, own), known)
