"""States: when the condensed model is evaluated, and what copies of a state hold."""

from __future__ import annotations

import copy
import pickle
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends import make_backend
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.mechanics.contact.obstacles import Plane
from softgym_envs.mechanics.solvers.linearisation import Linearisation
from softgym_envs.surrogate.potential.model import Model


@pytest.fixture
def backend():
    return make_backend("surrogate", make_robot("finger"))


def test_the_condensed_model_is_evaluated_once_and_only_when_read(backend, monkeypatch):
    calls, compliance = [], Model.compliance
    monkeypatch.setattr(Model, "compliance", lambda self, *args: calls.append(1) or compliance(self, *args))
    state = backend.step(np.array([0.005, 0.0]))
    assert not calls
    W = state.condensed.compliance
    assert state.condensed.compliance is W and len(calls) == 1
    assert (state.condensed.lambda_.a == state.effort).all()
    np.testing.assert_allclose(state.condensed.delta.e, state.effector.ravel())


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda state: pickle.loads(pickle.dumps(state)), replace])
def test_a_copy_holds_the_condensed_model_but_not_the_learned_one(backend, duplicate):
    state = duplicate(backend.step(np.array([0.005, 0.0])))
    expected = backend.state.condensed.compliance
    np.testing.assert_array_equal(state.condensed.compliance, expected)
    assert len(pickle.dumps(state)) < 4000  # the learned model has hundreds of kilobytes


@pytest.fixture
def pressed():
    """Return a function that steps a Diamond below a ceiling on FEM and returns its backend and states."""
    robot = make_robot("diamond", obstacles=[Plane((0.0, 0.0, 0.1263), (0.0, 0.0, -1.0))])
    commands = np.array([[0.1, 0.1, 0.0, 0.0], [0.2, 0.1, 0.1, 0.0], [0.5, 0.0, 0.0, 0.0], [0.1, 0.0, 0.0, 0.1]])

    def run(**attributes):
        backend = make_backend("fem", robot)
        vars(backend._statics).update(attributes)
        return backend, [backend.step(1e-3 * command) for command in commands]

    return run


def test_in_contact_finite_elements_compute_the_compliance_when_it_is_read(pressed, monkeypatch):
    calls, factorise = [], Linearisation.factorise
    monkeypatch.setattr(
        Linearisation, "factorise", lambda *args, **options: calls.append(1) or factorise(*args, **options)
    )
    _, expected = pressed(exact_compliance=True)
    eager = len(calls)
    backend, states = pressed()
    assert len(calls) - eager < eager
    assert states[-1].contacts.force.any()
    present, *earlier = reversed(states)
    copied = pickle.loads(pickle.dumps(earlier[0]))
    backend.reset({"leg_width": 1.1})  # the earlier states remain those of their body
    for state, known in zip([present, copied, *earlier[1:]], reversed(expected), strict=True):
        np.testing.assert_allclose(state.effector, known.effector, rtol=0, atol=1e-9)
        scale = np.abs(known.condensed.compliance).max()
        np.testing.assert_allclose(state.condensed.compliance, known.condensed.compliance, rtol=0, atol=1e-6 * scale)


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, lambda state: pickle.loads(pickle.dumps(state))])
def test_copies_of_states_in_contact_hold_the_condensed_model(pressed, duplicate):
    _, states = pressed()
    assert callable(vars(states[0])["condensed"])
    copied = [duplicate(state) for state in states]
    assert all(isinstance(vars(state)["condensed"], CondensedModel) for state in copied)
    for state, own in zip(copied, states, strict=True):
        np.testing.assert_array_equal(state.condensed.compliance, own.condensed.compliance)
        np.testing.assert_array_equal(state.contacts.total, own.contacts.total)


def test_reading_the_compliance_does_not_disturb_the_next_step(pressed):
    backend, states = pressed()
    assert states[1].condensed.W.aa.shape == (4, 4)
    np.testing.assert_array_equal(backend.state.nodes, states[-1].nodes)
    backend.probe(np.full(4, 1e-4))
    assert callable(vars(backend.state)["condensed"])  # going back has not computed it
    fresh, _ = pressed()
    found, known = (body.step(np.full(4, 2e-4)) for body in (backend, fresh))
    np.testing.assert_allclose(found.nodes, known.nodes, rtol=0, atol=1e-9)


def test_a_state_is_not_changed(backend):
    with pytest.raises(FrozenInstanceError):
        backend.state.condensed = backend.state.condensed
    with pytest.raises(FrozenInstanceError):
        backend.state.trusted = False


def test_finite_elements_refuse_a_state_without_nodes(backend):
    fem = make_backend("fem", backend.robot)
    with pytest.raises(ValueError, match="no deformed nodes"):
        fem.restore(backend.state)
