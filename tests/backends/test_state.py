"""States: when the condensed model is evaluated, and what copies of a state hold."""

from __future__ import annotations

import copy
import pickle
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends import make_backend
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


def test_a_state_is_not_changed(backend):
    with pytest.raises(FrozenInstanceError):
        backend.state.condensed = backend.state.condensed
    with pytest.raises(FrozenInstanceError):
        backend.state.trusted = False


def test_finite_elements_refuse_a_state_without_nodes(backend):
    fem = make_backend("fem", backend.robot)
    with pytest.raises(ValueError, match="no deformed nodes"):
        fem.restore(backend.state)
