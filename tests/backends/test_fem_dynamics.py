"""The finite-element backend in dynamics: static limit, torque limits, failures and environments."""

from __future__ import annotations

import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import softgym_envs  # noqa: F401  (registers the environments)
from softgym_envs import make_robot
from softgym_envs.backends.backend import PointForce
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.errors import ConvergenceError
from softgym_envs.surrogate.domain import FOLDED
from tests.verification import robot_dynamics as cases

SMALL = {"SoftGym/FingerReach-v0": {}, "SoftGym/DiamondReach-v0": {"mesh_size": 30e-3}}


def weak(limit):
    """A Tetrapod whose servos have a torque limit [N m]."""
    robot = make_robot("tetrapod")
    robot.actuators = tuple(replace(actuator, max_effort=limit) for actuator in robot.actuators)
    return robot


# -- the static limit ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(cases.ROBOTS))
def test_a_slow_motion_ends_in_the_static_equilibrium(name):
    after, later = cases.quasi_static([name], rest=30)
    print(after.error, later.error)
    assert after.error < 1e-3 and later.error < 1e-6


def test_a_moving_body_starts_at_rest():
    robot = make_robot("tetrapod")
    still, moving = FEMBackend(robot), FEMBackend(robot, dynamics=True)
    np.testing.assert_allclose(moving.state.effector, still.state.effector, atol=1e-12)
    assert moving.moving and not still.moving
    assert not moving.state.velocity.any() and moving.state.motion is None
    state = moving.step(np.zeros(4))
    np.testing.assert_allclose(state.effector, still.state.effector, atol=1e-8)
    assert np.abs(state.velocity).max() < 1e-6


def test_control_steps_are_divided_and_commands_ramped():
    """Three time steps of at most 0.02 s in a control step of 0.05 s, compared with steps made by hand."""
    robot = make_robot("tetrapod")
    backend = FEMBackend(robot, dynamics=True, time_step=0.02, stiffness_damping=0.01)
    start = backend.state
    by_hand = cases.Dynamics(backend.model, step=0.05 / 3.0, stiffness_damping=0.01, tolerance=1e-9)
    by_hand.restore(start.nodes, start.condensed.effort)
    command = np.array([0.15, -0.1, 0.05, 0.0])
    state = backend.step(command)
    for k in range(3):
        motion = by_hand.advance((k + 1) / 3.0 * command)
    np.testing.assert_allclose(state.nodes, motion.equilibrium.x, atol=1e-9)
    assert state.motion.time == pytest.approx(0.05)
    np.testing.assert_allclose(state.velocity[0], by_hand.effector_velocity()[:3], atol=1e-6)


def test_a_displacement_after_an_effort_begins_where_the_actuators_are():
    backend = FEMBackend(make_robot("tetrapod"), dynamics=True)
    reached = backend.step(np.full(4, 0.02), "effort").displacement
    seen = []
    advance = backend._dynamics.advance_compiled
    backend._dynamics.advance_compiled = lambda commands, *rest, **named: (
        seen.extend(commands),
        advance(commands, *rest, **named),
    )[1]
    backend.step(np.zeros(4))
    count = len(seen)
    assert count > 1
    expected = [(1.0 - (k + 1) / count) * reached for k in range(count)]
    np.testing.assert_allclose(seen, expected, atol=1e-12)


def test_the_velocity_is_that_of_the_effector():
    backend = FEMBackend(make_robot("tetrapod"), dynamics=True, control_step=0.002, time_step=0.002)
    for k in range(20):
        before = backend.state.effector
        state = backend.step(0.01 * (k + 1) * np.array([1.0, 0.0, -1.0, 0.5]))
    np.testing.assert_allclose(state.velocity, (state.effector - before) / 0.002, rtol=0, atol=1e-6)
    assert np.abs(state.velocity).max() > 0.05


def test_a_push_moves_the_effector():
    backend = FEMBackend(make_robot("tetrapod"), dynamics=True)
    for _ in range(40):
        state = backend.step(np.zeros(4), force=np.array([0.1, 0.0, 0.0]))
    still = FEMBackend(make_robot("tetrapod"))
    expected = still.step(np.zeros(4), force=np.array([0.1, 0.0, 0.0])).effector
    np.testing.assert_allclose(state.effector, expected, atol=1e-4)
    assert expected[0, 0] > 8e-4


# -- torque limits --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dynamics", [False, True])
def test_a_servo_saturates_at_its_torque_limit_and_is_released(dynamics):
    """It rests where its largest torque leads, and follows again once the command comes back."""
    backend = FEMBackend(weak(0.04), dynamics=dynamics)
    strong = FEMBackend(make_robot("tetrapod"), dynamics=dynamics)
    command = np.zeros(4)
    for k in range(20):
        command[0] = -1.2 * min(1.0, (k + 1) / 6.0)
        state, free = backend.step(command), strong.step(command)
        assert np.abs(state.effort).max() <= 0.04 * (1.0 + 1e-9)
    assert abs(free.effort[0]) > 0.08
    assert state.effort[0] == pytest.approx(-0.04, rel=1e-9)
    assert -0.6 < state.displacement[0] < -0.3
    np.testing.assert_allclose(state.displacement[1:], 0.0, atol=1e-8)
    # The same state, commanded by the effort.
    driven = FEMBackend(make_robot("tetrapod"))
    target = np.array([state.effort[0], 0.0, 0.0, 0.0])
    found = driven._statics.solve(target, ["effort", "displacement", "displacement", "displacement"])
    np.testing.assert_allclose(found.delta[4:7], state.effector[0], atol=1e-6 if not dynamics else 1e-4)
    # The servo follows a command below the angle that it has reached.
    command[0] = -0.2
    for _ in range(20):
        state = backend.step(command)
    assert state.displacement[0] == pytest.approx(-0.2, abs=1e-8)
    strong.reset()
    for _ in range(20):
        free = strong.step(command)
    np.testing.assert_allclose(state.effector, free.effector, atol=1e-5)


@pytest.mark.parametrize("dynamics", [False, True])
def test_a_probe_obeys_the_torque_limit(dynamics):
    """Goals of tasks are probed: beyond the largest torque nothing reaches them."""
    backend, command = FEMBackend(weak(0.04), dynamics=dynamics), np.array([-1.2, 0.0, 0.0, 0.0])
    probed = backend.probe(command)
    assert probed.effort[0] == pytest.approx(-0.04, rel=1e-9)
    np.testing.assert_allclose(probed.effector, FEMBackend(weak(0.04)).step(command).effector, atol=1e-8)
    np.testing.assert_array_equal(backend.probe(command, "effort").effort, [-0.04, 0.0, 0.0, 0.0])


def test_a_probe_starts_from_the_present_shape():
    """A leg that has folded stays so on the way back, 23 mm away; that there was no probe before does not matter."""
    backend = FEMBackend(make_robot("tetrapod"), dynamics=True)
    for share in (*np.arange(1, 13) / 12, *np.linspace(1.0, 0.5, 6)):
        command = share * 0.5 * np.pi * np.array([1.0, 1.0, -1.0, 1.0])
        backend.step(command)
    first, again = (backend.probe(command) for _ in range(2))
    assert first.distrust == again.distrust == FOLDED
    np.testing.assert_allclose(first.effector, again.effector, atol=1e-9)


def test_efforts_are_cut_to_the_limit():
    backend = FEMBackend(weak(0.04))
    state = backend.step(np.array([-1.0, 0.01, 0.02, 1.0]), "effort")
    np.testing.assert_allclose(state.effort, [-0.04, 0.01, 0.02, 0.04], rtol=1e-12)


@pytest.mark.parametrize("dynamics", [False, True])
def test_random_commands_beyond_the_torque(dynamics):
    """No torque is exceeded, every loop ends, and the solver agrees with the state."""
    backend = FEMBackend(weak(0.03), **({"dynamics": True, "time_step": 0.05} if dynamics else {}))
    rng = np.random.default_rng(0)
    command = np.zeros(4)
    saturated = 0
    for _ in range(60):
        command = np.clip(command + 0.3 * rng.choice([-1.0, 1.0], 4), -1.5, 1.5)
        try:
            state = backend.step(command)
        except ConvergenceError:
            state = backend.state
        assert (np.abs(state.effort) <= 0.03 * (1.0 + 1e-9)).all()
        held = np.abs(state.effort) < 0.03 * (1.0 - 1e-6)
        np.testing.assert_allclose(state.displacement[held], state.command[held], atol=1e-6)
        saturated += int((~held).sum())
        solver = backend._dynamics if dynamics else backend._statics
        np.testing.assert_array_equal(solver.x, state.nodes)
    assert saturated > 10


# -- failures -------------------------------------------------------------------------------------------------------


def test_a_step_that_fails_leaves_the_state(monkeypatch):
    """Also time, energies and history of the motion, which continues as if the step had not been tried."""
    robot = make_robot("tetrapod")
    options = {"dynamics": True, "scheme": "generalised_alpha", "time_step": 0.025}
    backend, twin = FEMBackend(robot, **options), FEMBackend(robot, **options)
    path = [0.05 * k * np.array([1.0, -0.5, 0.2, 0.0]) for k in range(1, 9)]
    for command in path[:4]:
        backend.step(command)
        twin.step(command)
    kept = backend.state
    solve = type(backend._dynamics).solve
    calls = []

    def fail_later(self, *arguments, **keywords):
        calls.append(1)
        if len(calls) > 1:  # the first part of the control step succeeds
            raise ConvergenceError("no")
        return solve(self, *arguments, **keywords)

    with monkeypatch.context() as patch:
        patch.setattr(type(backend._dynamics), "solve", fail_later)
        with pytest.raises(ConvergenceError, match="cannot advance 0.025 s"):
            backend.step(path[4])
    assert backend.state is kept
    np.testing.assert_array_equal(backend._dynamics.x, kept.nodes)
    for command in path[4:]:
        a, b = backend.step(command), twin.step(command)
    assert (a.nodes == b.nodes).all() and a.motion.time == b.motion.time == pytest.approx(0.4)
    assert (a.motion.work, a.motion.dissipated) == (b.motion.work, b.motion.dissipated)


def test_a_probe_does_not_disturb_the_motion():
    robot = make_robot("tetrapod")
    options = {"dynamics": True, "scheme": "generalised_alpha"}
    backend, twin = FEMBackend(robot, **options), FEMBackend(robot, **options)
    for k in range(6):
        command = 0.05 * (k + 1) * np.array([1.0, -0.5, 0.2, 0.0])
        a, b = backend.step(command), twin.step(command)
        probed = backend.probe(np.array([0.3, 0.0, 0.0, 0.3]))
        assert not probed.velocity.any()
        assert backend.state is a
    assert (a.nodes == b.nodes).all() and a.motion.time == b.motion.time
    still = FEMBackend(robot).step(np.array([0.3, 0.0, 0.0, 0.3]))
    np.testing.assert_allclose(probed.effector, still.effector, atol=1e-8)


def test_restoring_a_state():
    backend = FEMBackend(make_robot("tetrapod"), dynamics=True)
    path = [0.05 * k * np.array([1.0, -0.5, 0.2, 0.0]) for k in range(1, 7)]
    for command in path[:3]:
        kept = backend.step(command)
    first = [backend.step(command).nodes for command in path[3:]]
    backend.restore(kept)
    again = [backend.step(command).nodes for command in path[3:]]
    np.testing.assert_allclose(again, first, rtol=0, atol=1e-12)
    backend.reset()
    assert backend.state.motion is None and not backend._dynamics.velocity.any()


@pytest.mark.parametrize("dynamics", [False, True])
@pytest.mark.parametrize("mode", ["torque", ["effort", "displacement", "displacement", "displacement"]])
def test_an_unknown_mode_is_refused(mode, dynamics):
    backend = FEMBackend(make_robot("tetrapod"), dynamics=dynamics)
    for call in (backend.step, backend.probe):
        with pytest.raises(ValueError, match="mode = .* is unknown; allowed: 'displacement', 'effort'"):
            call(np.zeros(4), mode)


def test_a_state_of_another_mesh_is_refused():
    backend, other = (FEMBackend(make_robot("tetrapod", elements=n)) for n in (4, 6))
    with pytest.raises(ValueError, match=r"nodes of shape \(\d+, 3\) .* but the body has"):
        backend.restore(other.state)


@pytest.mark.parametrize(("name", "wrong"), [("point", [0.0, 0.0]), ("force", [0.0, np.nan, 0.0])])
def test_a_touch_needs_finite_numbers(name, wrong):
    with pytest.raises(ValueError, match=f"{name} of a touch must be 3 finite numbers"):
        PointForce(**{"point": np.zeros(3), "force": np.zeros(3), name: wrong})


@pytest.mark.parametrize("name", ["control_step", "time_step"])
@pytest.mark.parametrize("value", [0.0, -0.1, np.nan, np.inf])
def test_bad_steps(name, value):
    with pytest.raises(ValueError, match=f"{name} = {value} s must be positive and finite"):
        FEMBackend(make_robot("tetrapod"), **{name: value})


@pytest.mark.parametrize("dynamics", [False, True])
def test_a_scheme_is_checked(dynamics):
    with pytest.raises(ValueError, match="scheme = 'verlet' is unknown; allowed: euler, generalised_alpha"):
        FEMBackend(make_robot("tetrapod"), dynamics=dynamics, scheme="verlet")


# -- environments ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("identifier", list(SMALL))
def test_environments_of_solids_in_time(identifier):
    options = {
        "backend": "fem",
        "robot_options": SMALL[identifier],
        "backend_options": {"dynamics": True, "time_step": 0.05},
    }
    still = gymnasium.make(identifier, backend="fem", robot_options=SMALL[identifier])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(identifier, **options)
        check_env(env.unwrapped, skip_render_check=True)
    size = still.observation_space.shape[0]
    assert env.observation_space.shape == (size + 3,)
    env.reset(seed=0)
    for _ in range(4):
        observation, _, _, _, info = env.step(
            np.ones(env.action_space.shape, dtype=np.float32) * [1, *[0] * (env.action_space.shape[0] - 1)]
        )
        assert info["converged"]
    speed = env.unwrapped.state.velocity[0] / env.unwrapped.robot.size
    np.testing.assert_allclose(observation[-3:], speed / (1.0 + np.abs(speed)), atol=1e-6)
    assert np.abs(observation[-3:]).max() > 1e-3


def test_random_actions_at_the_largest_rates():
    """A short version of the benchmark with 10,000 actions; held actions reach the ends of the servos."""
    rows = cases.robustness(60, 2) + cases.robustness(240, 3, ("SoftGym/TetrapodReach-v0",), hold=12)
    for row in rows:
        print(row)
        if "not finite" in row.case:
            assert row.value == 0
        if "without solution" in row.case:
            assert row.value <= 3
        if "longest" in row.case:
            assert row.value < 20.0
