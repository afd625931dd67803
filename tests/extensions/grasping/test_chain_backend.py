"""The learned chain as a backend, alone and with finite elements behind it."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest

from softgym_envs.backends.registry import make_backend
from softgym_envs.errors import InfeasibleDesign, WeightsError
from softgym_envs.extensions.grasping.backends.chain import ChainBackend, HybridChainBackend
from softgym_envs.extensions.paths import hybrid
from softgym_envs.mechanics.contact.obstacles import Sphere
from softgym_envs.robots.registry import make_robot
from softgym_envs.surrogate.domain import OUTSIDE, SELF_CONTACT

BODY = {"e1": 0.009, "e2": 0.006, "e3": 0.005}


def closed(backend, degrees, steps=6):
    for k in range(1, steps + 1):
        backend.step(np.radians([degrees * k / steps]))
    return backend.state


@pytest.fixture(scope="module")
def robot():
    return make_robot("grasping_finger")


def test_robots_choose_their_kind_of_surrogate(robot):
    assert isinstance(make_backend("surrogate", robot, design=BODY), ChainBackend)
    assert isinstance(make_backend("hybrid", robot, design=BODY), HybridChainBackend)
    with pytest.raises(WeightsError, match="trained for another robot: mesh_size = 0.008, needed 0.02"):
        make_backend("surrogate", make_robot("grasping_finger", mesh_size=0.02))


def test_state(robot):
    backend = ChainBackend(robot, BODY)
    state = closed(backend, 24.0)
    assert state.trusted
    assert state.stable
    assert 0.0 < state.uncertainty < robot.goal_tolerance
    force = state.contacts.total[0]
    assert force[0] < -0.1
    np.testing.assert_allclose(force, state.contacts.force.sum(axis=0))
    limit = backend.design["friction"] * state.contacts.pressing
    assert (np.abs(state.contacts.force[:, 1]) <= limit * (1.0 + 1e-9)).all()
    assert 0.0 < state.contacts.smallest_gap == state.contacts.gap.min() < robot.contact_distance
    assert state.condensed.delta.a[0] == pytest.approx(np.radians(24.0))
    np.testing.assert_allclose(state.condensed.delta.e, state.effector[0])


def test_restore_and_probe_go_back_on_the_path(robot):
    backend = ChainBackend(robot, BODY)
    kept = closed(backend, 20.0)
    first = backend.step(np.radians([24.0]))
    backend.restore(kept)
    np.testing.assert_array_equal(backend.probe(np.radians([24.0])).contacts.total, first.contacts.total)
    assert backend.state is kept
    for copied in (copy.deepcopy(kept), pickle.loads(pickle.dumps(kept))):
        backend.restore(copied)
        np.testing.assert_array_equal(backend.step(np.radians([24.0])).contacts.total, first.contacts.total)
    with pytest.raises(ValueError, match="was not computed by a learned chain"):
        backend.restore(replace(kept, memory=None))


def test_efforts(robot):
    backend = ChainBackend(robot, BODY)
    closed(backend, 18.0)
    start = backend.state
    wanted = 1.5 * start.effort
    state = backend.step(wanted, "effort")
    assert state.effort == pytest.approx(wanted, rel=1e-8)
    backend.restore(start)
    assert backend.step(state.displacement).effort == pytest.approx(wanted, rel=1e-6)
    with pytest.raises(ValueError, match="mode = 'force' is unknown"):
        backend.step(wanted, "force")
    with pytest.raises(ValueError, match="must be 1 finite number, got"):
        backend.step([np.nan])


def test_largest_effort(robot):
    weak = make_robot("grasping_finger")
    (servo,) = weak.actuators
    weak.actuators = (replace(servo, max_effort=0.03),)
    state = closed(ChainBackend(weak, BODY), 30.0, 15)
    assert state.effort == pytest.approx([0.03], rel=1e-7)
    assert state.command == pytest.approx(np.radians([30.0]))
    assert state.displacement[0] < np.radians(29.0)


def test_compliance_is_the_derivative_of_states(robot):
    backend = ChainBackend(robot, BODY | {"friction": 0.1})
    start = closed(backend, 20.0)
    W = backend.step(np.radians([22.0])).condensed.W
    step, reached = 1e-5, []
    for sign in (1.0, -1.0):
        backend.restore(start)
        reached.append(backend.step(np.radians([22.0]) + sign * step))
    slope = (reached[0].effort - reached[1].effort)[0] / (2.0 * step)
    motion = (reached[0].effector - reached[1].effector)[0] / (2.0 * step)
    assert 1.0 / W.aa[0, 0] == pytest.approx(slope, rel=1e-5)
    np.testing.assert_allclose(W.ea[:, 0] / W.aa[0, 0], motion, atol=1e-5 * np.abs(motion).max())


def test_contact_model_gives_the_compliance_back():
    """One point presses on a large sphere: without its row the model is that of the state."""
    sphere = Sphere((0.093, 0.098, 0.0), 0.03, name="ball")
    robot = make_robot("contact_aided_finger", obstacles=[sphere])
    backend = ChainBackend(robot, BODY)
    free = backend.contact_model()
    assert free.effort[4] == 0.0 < free.delta.c[0]
    near = None
    for degrees in np.arange(1.0, 30.0, 0.05):
        state = backend.step(np.radians([degrees]))
        if state.contacts.count == 1:
            near = state
            break
    assert near is not None
    model = backend.contact_model()
    assert model.effort[4] == pytest.approx(near.contacts.pressing.sum())
    assert model.delta.c[0] == pytest.approx(0.0, abs=1e-12)
    W = model.compliance
    eliminated = W[:3, :3] - np.outer(W[:3, 4], W[4, :3]) / W[4, 4]
    scale = np.abs(near.condensed.compliance[:3, :3]).max()
    np.testing.assert_allclose(eliminated, near.condensed.compliance[:3, :3], atol=1e-8 * scale)


def test_folds_are_not_trusted(robot):
    thin = {"e1": 0.008, "e2": 0.005, "e3": 0.004, "object_gap": 0.0301}
    backend = ChainBackend(robot, thin)
    trusted = [backend.step(np.radians([2.0 * k])).trusted for k in range(1, 21)]
    assert all(trusted[:14])
    assert not trusted[-1] and backend.state.distrust == SELF_CONTACT
    assert backend.state.contacts.smallest_gap < robot.contact_distance
    without = ChainBackend(make_robot("grasping_finger", self_contact=False), thin)
    assert closed(without, 40.0, 20).trusted


def test_bodies_that_cannot_exist(robot):
    with pytest.raises(InfeasibleDesign, match="inside obstacle object"):
        ChainBackend(make_robot("grasping_finger", object="sphere"), {"object_gap": 0.010, **_bulging()})


def _bulging():
    return {"e1": 0.015, "e3": 0.010, "d6": 0.028, "d7": 0.028}


class Recorder(ChainBackend):
    """Stands for finite elements: another chain that counts its steps."""

    steps = 0

    def step(self, command, mode="displacement", *, force=None):
        Recorder.steps += 1
        return super().step(command, mode, force=force)


def test_finite_elements_follow_the_whole_path(robot, monkeypatch):
    monkeypatch.setattr(hybrid, "FEMBackend", Recorder)
    Recorder.steps = 0
    thin = {"e1": 0.008, "e2": 0.005, "e3": 0.004, "object_gap": 0.0301}
    backend, alone = HybridChainBackend(robot, thin), ChainBackend(robot, thin)
    before = closed(backend, 30.0, 15)
    assert before.trusted and Recorder.steps == 0
    closed(alone, 30.0, 15)
    for degrees in (32.0, 34.0, 36.0, 38.0, 40.0):
        last = backend.step(np.radians([degrees]))
        expected = alone.step(np.radians([degrees]))
    assert not expected.trusted
    assert Recorder.steps >= 20
    np.testing.assert_array_equal(last.contacts.total, expected.contacts.total)
    # The same step again asks finite elements for that step only.
    asked = Recorder.steps
    backend.probe(np.radians([39.9]))
    assert Recorder.steps == asked + 1
    backend.restore(before)
    assert backend.step(np.radians([28.0])).trusted
    assert Recorder.steps == asked + 1
    assert backend.calls == 22
    assert backend.reset() is not before
    with pytest.raises(ValueError, match="was not computed by this hybrid backend"):
        backend.restore(alone.state)


def test_unknown_bodies_are_given_to_finite_elements(robot, monkeypatch):
    monkeypatch.setattr(hybrid, "FEMBackend", Recorder)
    Recorder.steps = 0
    backend = HybridChainBackend(robot, {"e3": 0.002})
    backend.step(np.radians([2.0]))
    assert backend.learned.state.distrust & OUTSIDE
    assert Recorder.steps == 1
    assert backend.fem_calls == 2


def test_copies_and_other_bodies_go_on_with_finite_elements_of_their_own(robot, monkeypatch):
    """Finite elements may be missing, or be those of another body, where a state goes on that they have found."""
    monkeypatch.setattr(hybrid, "FEMBackend", Recorder)
    thin = {"e1": 0.008, "e2": 0.005, "e3": 0.004, "object_gap": 0.0301}
    backend = HybridChainBackend(robot, thin)
    assert backend.state.trusted  # at rest, without finite elements
    closed(backend, 40.0, 20)
    kept, command = pickle.loads(pickle.dumps(backend.snapshot())), np.radians([39.0])
    expected = backend.step(command)
    assert not expected.trusted
    backend.reset({"e3": 0.002})  # finite elements of this body
    for other in (backend, HybridChainBackend(robot)):
        other.resume(kept)
        np.testing.assert_array_equal(other.step(command).contacts.total, expected.contacts.total)


def test_a_body_that_finite_elements_refuse_changes_nothing(robot, monkeypatch):
    backend, alone = HybridChainBackend(robot, BODY), ChainBackend(robot, BODY)

    def refuse(*args):
        raise InfeasibleDesign("the mesh crosses itself")

    monkeypatch.setattr(hybrid, "FEMBackend", refuse)
    with pytest.raises(InfeasibleDesign, match="crosses itself"):
        backend.reset({"e3": 0.002})
    backend.reset(BODY)
    np.testing.assert_array_equal(closed(backend, 20.0).effort, closed(alone, 20.0).effort)
