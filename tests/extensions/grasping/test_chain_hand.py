"""Hands of two learned fingers: derivatives against differences, motions with known answers, and finite elements."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest

from softgym_envs.backends.fem import FEMBackend
from softgym_envs.backends.registry import make_backend
from softgym_envs.errors import InfeasibleDesign
from softgym_envs.extensions.grasping.backends.chain_hand import (
    ChainHand,
    ChainHandBackend,
    HandMemory,
    HybridHandBackend,
)
from softgym_envs.extensions.paths import hybrid
from softgym_envs.robots.registry import make_robot
from softgym_envs.surrogate.domain import OUTSIDE

GRAVITY = 9.81
STEP = 0.05


@pytest.fixture(scope="module")
def robot():
    return make_robot("contact_aided_gripper")


def hand(robot, **design):
    return ChainHandBackend(robot, design)


def closed(backend, degrees=18.0, steps=9):
    for k in range(1, steps + 1):
        angle = np.radians(degrees * k / steps)
        state = backend.step(np.array([angle, angle, 0.0]))
    return state


def lifted(backend, height=0.005, steps=5):
    start = backend.state.command
    for k in range(1, steps + 1):
        state = backend.step(start + [0.0, 0.0, height * k / steps])
    return state


def test_the_box_rests_on_the_table(robot):
    backend = make_backend("surrogate", robot)
    assert isinstance(backend, ChainHandBackend)
    weight = GRAVITY * backend.design["object_mass"]
    np.testing.assert_allclose(backend.state.contacts.total[0], [0.0, 0.0, weight], atol=1e-9)
    np.testing.assert_allclose(backend.state.contacts.total[1], 0.0)
    np.testing.assert_allclose(backend.state.velocity, 0.0)
    # The table's triangles are not symmetric, so the box tips a little on its soft contact.
    np.testing.assert_allclose(backend.state.effector[0], robot.effector_rest + [0.0, 0.0, 5e-4], atol=1e-5)


@pytest.mark.parametrize("friction", [0.1, 0.85])
def test_derivatives_of_a_step(robot, friction):
    """W is the derivative of the end of a step, from the same start: with sticking, sliding and tipping contacts."""
    backend = hand(robot, friction=friction, object_mass=0.05)
    for k in range(1, 8):
        backend.step(np.radians([2.0 * k, 1.6 * k, 0.0]))
    start = backend.state
    target = start.command + [0.01, 0.02, 2e-4]
    state = backend.step(target)
    assert state.contacts.total[1, 2] != 0.0
    W = state.condensed.W.array if hasattr(state.condensed.W, "array") else np.asarray(state.condensed.W)
    stiffness = np.linalg.inv(W[:3, :3])
    moved = W[3:, :3] @ stiffness
    for k, size in enumerate((1e-6, 1e-6, 1e-9)):
        ends = []
        for sign in (1.0, -1.0):
            backend.restore(start)
            ends.append(backend.step(target + sign * size * np.eye(3)[k]))
        by_effort = (ends[0].effort - ends[1].effort) / (2.0 * size)
        by_effector = (ends[0].effector[0] - ends[1].effector[0]) / (2.0 * size)
        np.testing.assert_allclose(by_effort, stiffness[:, k], rtol=1e-4, atol=1e-4 * np.abs(stiffness[:, k]).max())
        np.testing.assert_allclose(by_effector, moved[:, k], rtol=1e-4, atol=1e-4 * np.abs(moved[:, k]).max())


def test_a_box_that_nothing_holds_falls_freely(robot):
    backend = hand(robot, object_gap=0.03)
    z, speed = backend.state.effector[0, 2], 0.0
    for k in range(1, 4):
        state = backend.step(np.array([0.0, 0.0, 0.1 * k]))
        speed -= GRAVITY * STEP
        z += 0.1 + STEP * speed
        assert state.effector[0, 2] == pytest.approx(z, rel=1e-9)
        assert state.velocity[0, 2] == pytest.approx(speed + 0.1 / STEP, rel=1e-9)
        np.testing.assert_allclose(state.contacts.total, 0.0, atol=1e-12)


def test_friction_carries_what_coulombs_law_allows(robot):
    backend = hand(robot, friction=0.5)
    closed(backend)
    points = backend.state.contacts
    pressed = points.pressing[points.obstacle == 1].sum()
    most = 0.5 * pressed / GRAVITY
    for share, held in ((0.9, True), (1.1, False)):
        backend = hand(robot, friction=0.5, object_mass=share * most)
        closed(backend)
        state = lifted(backend)
        assert (state.effector[0, 2] - robot.effector_rest[2] > 0.004) == held
        table, fingers = state.contacts.total[:, 2]
        assert table - fingers == pytest.approx(GRAVITY * share * most, rel=0.02)
        assert (table == 0.0) == held


def test_mirrored_commands_give_mirrored_states(robot):
    efforts, places = [], []
    for order in (slice(None), slice(None, None, -1)):
        backend = hand(robot, friction=0.1)
        for k in range(1, 10):
            angles = np.radians([2.0 * k, 1.2 * k])[order]
            state = backend.step(np.array([*angles, 0.0]))
        efforts.append(state.effort[:2][order])
        places.append(state.effector[0])
    # The triangles of the table are not symmetric.
    np.testing.assert_allclose(efforts[0], efforts[1], rtol=0.02)
    np.testing.assert_allclose(places[0] * [-1.0, 1.0, 1.0], places[1], atol=1e-4)


def test_restore_probe_and_copies(robot):
    backend = hand(robot)
    kept = closed(backend)
    target = kept.command + [0.0, 0.0, 1e-3]
    first = backend.step(target)
    for state in (kept, copy.deepcopy(kept), pickle.loads(pickle.dumps(kept))):
        backend.restore(state)
        again = backend.step(target)
        np.testing.assert_array_equal(again.effort, first.effort)
        np.testing.assert_array_equal(again.effector, first.effector)
    backend.restore(kept)
    still = backend.probe(target)
    assert backend.state is kept
    np.testing.assert_array_equal(still.velocity, 0.0)
    assert isinstance(kept.memory, HandMemory)
    with pytest.raises(ValueError, match="was not computed by a learned hand"):
        backend.restore(replace(kept, memory=None))


def test_servos_stop_at_their_largest_torque():
    weak = make_robot("contact_aided_gripper")
    weak.actuators = tuple(replace(a, max_effort=0.05) if a.unit == "rad" else a for a in weak.actuators)
    state = closed(hand(weak))
    np.testing.assert_allclose(state.effort[:2], 0.05, rtol=1e-5)
    assert (state.displacement[:2] < state.command[:2] - 0.01).all()


def test_servos_that_open_stop_at_their_largest_torque_too():
    weak = make_robot("contact_aided_gripper")
    weak.actuators = tuple(replace(a, max_effort=0.008) if a.unit == "rad" else a for a in weak.actuators)
    backend = hand(weak)
    state = backend.step(np.array([*np.radians([-15.0, -6.0]), 0.0]))
    assert state.effort[0] == pytest.approx(-0.008, rel=1e-5)
    assert state.displacement[0] > state.command[0] + 0.01
    assert state.displacement[1] == state.command[1]


def test_wrong_input(robot):
    backend = hand(robot)
    with pytest.raises(ValueError, match="mode = 'effort' is not possible on a learned hand"):
        backend.step(np.zeros(3), "effort")
    with pytest.raises(ValueError, match="3 finite numbers"):
        backend.step(np.array([0.0, np.nan, 0.0]))
    with pytest.raises(ValueError, match="control_step = 0.0 s must be positive"):
        ChainHandBackend(robot, control_step=0.0)
    with pytest.raises(ValueError, match="object = 'ball': a learned hand can hold a box only"):
        make_backend("hybrid", make_robot("contact_aided_gripper", object="ball"))
    with pytest.raises(ValueError, match="must be along z"):
        ChainHandBackend(make_robot("contact_aided_gripper", gravity=(1.0, 0.0, -9.81)))
    with pytest.raises(InfeasibleDesign):
        hand(robot, **{f"d{k}": 0.008 if k % 2 else 0.028 for k in range(12)}, e1=0.015, e3=0.01)


def test_hybrid_hands_follow_with_finite_elements(monkeypatch):
    """Another learned hand stands for the finite elements: the same motion, asked for all commands of the episode."""
    asked = []

    class Recorder(ChainHandBackend):
        def __init__(self, robot, design, *, dynamics, control_step, time_step):
            assert dynamics and time_step == control_step
            super().__init__(robot, design, control_step=control_step)

        def step(self, command, mode="displacement", *, force=None):
            asked.append(command)
            return super().step(command, mode, force=force)

    monkeypatch.setattr(hybrid, "FEMBackend", Recorder)
    robot = make_robot("contact_aided_gripper")
    backend, alone = make_backend("hybrid", robot), hand(robot)
    assert isinstance(backend, HybridHandBackend) and backend.moving
    before = closed(backend)
    np.testing.assert_array_equal(before.effector, closed(alone).effector)
    assert before.trusted and not asked
    monkeypatch.setattr(ChainHand, "distrust", property(lambda self: OUTSIDE))
    found, expected = lifted(backend), lifted(alone)
    assert len(asked) == 14  # nine to close, five to lift
    np.testing.assert_array_equal(found.contacts.total, expected.contacts.total)
    np.testing.assert_array_equal(found.velocity, expected.velocity)
    target = np.radians([20.0, 20.0, 0.3])
    np.testing.assert_array_equal(backend.probe(target).effort, alone.probe(target).effort)
    assert backend.state is found and len(asked) == 14
    monkeypatch.undo()
    backend.restore(before)
    assert backend.step(before.command).trusted
    with pytest.raises(ValueError, match="was not computed by this hybrid backend"):
        backend.restore(expected)


def test_against_finite_elements(robot):
    near = {"object_gap": 0.0085}
    learned = hand(robot, **near)
    fem = FEMBackend(robot, near, dynamics=True, time_step=STEP)
    for backend in (learned, fem):
        closed(backend, degrees=7.5, steps=3)
        lifted(backend, height=0.001, steps=1)
    assert learned.state.contacts.total[0, 2] < 0.05
    np.testing.assert_allclose(learned.state.effort[:2], fem.state.effort[:2], rtol=0.03)
    np.testing.assert_allclose(learned.state.effector, fem.state.effector, atol=1e-4)
    np.testing.assert_allclose(learned.state.contacts.total, fem.state.contacts.total, atol=5e-3)
