"""Motion on the surrogate: against finite elements, its energy, its derivatives, batches, and going back."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import softgym_envs  # noqa: F401  registers the environments
from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.backends.surrogate import SurrogateBackend, SurrogateBatch
from softgym_envs.backends.time_steps import TimeSteps
from softgym_envs.errors import WeightsError
from softgym_envs.extensions.motion.inertia import half_stiffness
from softgym_envs.extensions.motion.motion import SurrogateMotion
from softgym_envs.robots.registry import make_robot
from softgym_envs.surrogate.pretrained import pretrained_folder, pretrained_model

SOFT = {"young_modulus": 1.0e6}


def _walk(robot, steps, violence, seed=0):
    rng = np.random.default_rng(seed)
    command, commands = np.zeros(len(robot.actuators)), []
    for _ in range(steps):
        change = rng.uniform(-violence, violence, len(command)) * robot.rates
        command = np.clip(command + change, robot.lower, robot.upper)
        commands.append(command)
    return commands


@pytest.mark.parametrize(("name", "design", "share"), [("finger", SOFT, 0.3), ("diamond", {"young_modulus": 2e5}, 0.2)])
def test_open_loop_against_finite_elements(name, design, share):
    """A soft body swings: the error is a small part of that of the surrogate in equilibrium, and of the motion."""
    robot = make_robot(name)
    fem, moving, still = (
        FEMBackend(robot, design, dynamics=True),
        SurrogateBackend(robot, design, dynamics=True),
        SurrogateBackend(robot, design),
    )
    rest, true, found, static, speeds = fem.state.effector[0], [], [], [], []
    np.testing.assert_allclose(moving.state.effector, still.state.effector)
    for command in _walk(robot, 10, 5.0):
        states = [backend.step(command) for backend in (fem, moving, still)]
        true.append(states[0].effector[0])
        found.append(states[1].effector[0])
        static.append(states[2].effector[0])
        speeds.append((states[0].velocity[0], states[1].velocity[0]))
    true, found, static = map(np.array, (true, found, static))
    error, missed = np.linalg.norm(found - true), np.linalg.norm(static - true)
    assert error < share * missed
    assert error < 0.04 * np.linalg.norm(true - rest)
    wanted, got = np.array(speeds).swapaxes(0, 1)
    assert np.linalg.norm(got - wanted) < 0.1 * np.linalg.norm(wanted)


def test_it_comes_to_the_static_equilibrium():
    robot = make_robot("finger")
    backend = SurrogateBackend(robot, dynamics=True)
    command = np.array([0.010, 0.002])
    for _ in range(40):
        backend.step(command)
    still = SurrogateBackend(robot).step(command)
    np.testing.assert_allclose(backend.state.effector, still.effector, atol=2e-5)
    np.testing.assert_allclose(backend.state.effort, still.effort, atol=0.02)
    np.testing.assert_array_equal(backend.state.slack, still.slack)
    assert np.abs(backend.state.velocity).max() < 1e-3
    # The equilibrium can be asked for without going there.
    rest = backend.reset()
    np.testing.assert_allclose(backend.probe(command).effector, still.effector, atol=1e-6)
    assert backend.state is rest


def _energy(motion, context, body, state):
    """Kinetic energy, and elastic energy of what moves while the actuators are held [J]."""
    n_a, n = motion.model.count, motion.model.size
    q = state.place[:, :n_a]
    W = motion.model.compliance(context, q)
    K = np.zeros((2 * n, 2 * n))
    K[:n, :n], K[n:, n:] = np.linalg.inv(W[0]), np.eye(n)
    scale = np.eye(2 * n)
    scale[:n, :n] = half_stiffness(W[0], motion.inertia.sizes)
    mass = scale @ motion.inertia.periods(body, q)[0] @ scale.T
    away = state.place[0].copy()
    away[:n_a] = 0.0
    away[n_a:n] -= motion.model.effector(context, q)[0][0]
    return 0.5 * state.velocity[0] @ mass @ state.velocity[0], 0.5 * away @ K @ away


@pytest.mark.parametrize("name", ["finger", "diamond"])
def test_energy_does_not_grow_without_input(name):
    """Undamped, with held actuators, after a violent command: implicit Euler only takes energy away."""
    robot = make_robot(name, unilateral=False)
    model = pretrained_model(robot)
    motion = SurrogateMotion(model, pretrained_folder(robot), TimeSteps(stiffness_damping=0.0))
    designs = robot.design_space.baseline.array[None]
    context, body = model.context(designs), motion.inertia.body(designs)
    zero = np.zeros((1, model.count))
    state = motion.at_rest(context, zero, zero)
    command = 0.4 * robot.upper[None]
    state, found = motion.advance(context, body, state, zero, command)
    assert found.all()
    energies = []
    for _ in range(15):
        state, found = motion.advance(context, body, state, command, command)
        assert found.all()
        energies.append(sum(_energy(motion, context, body, state)))
    assert energies[0] > 1e-6 and (np.diff(energies) <= 1e-9 * energies[0]).all()


def test_condensed_model_is_that_of_the_time_step():
    """Its W is the derivative of the last time step, by finite differences with held and moved actuators."""
    robot = make_robot("finger", unilateral=False)
    moved = []
    for change in (-1e-4, 0.0, 1e-4):
        backend = SurrogateBackend(robot, SOFT, dynamics=True, control_step=0.01)
        for command in ([0.004, 0.0], [0.008, 0.001], [0.009, 0.003 + change]):
            state = backend.step(np.array(command))
        moved.append(state)
    W = moved[1].condensed.W
    slope = (moved[2].effector[0] - moved[0].effector[0]) / 2e-4
    np.testing.assert_allclose(W.ea @ np.linalg.inv(W.aa) @ [0.0, 1.0], slope, atol=0.06 * np.abs(slope).max())
    delta = moved[1].condensed.delta
    np.testing.assert_allclose(delta.e, moved[1].effector[0], atol=1e-9)
    np.testing.assert_allclose(delta.a, moved[1].displacement, atol=1e-9)


def test_batch_moves_like_single_bodies():
    robot = make_robot("finger")
    designs = np.stack([robot.design_space.complete(d).array for d in (None, SOFT, {"young_modulus": 2e6})])
    batch = SurrogateBatch(robot, designs, dynamics=True)
    alone = [
        SurrogateBackend(robot, dict(zip(robot.design_space.names, d, strict=True)), dynamics=True) for d in designs
    ]
    walks = [_walk(robot, 6, 4.0, seed) for seed in range(3)]
    for commands in zip(*walks, strict=True):
        batch.step(np.stack(commands))
        for row, (backend, command) in enumerate(zip(alone, commands, strict=True)):
            state = backend.step(command)
            np.testing.assert_allclose(batch.state.effector[row], state.effector[0], atol=1e-7)
            np.testing.assert_allclose(batch.velocity[row], state.velocity[0], atol=1e-4)
            np.testing.assert_allclose(batch.condensed.compliance[row], state.condensed.compliance, rtol=1e-3)
    # Held commands lead to the static equilibria, and rows can rest alone.
    still = SurrogateBackend(robot, SOFT).step(walks[1][-1])
    np.testing.assert_allclose(batch.settled().effector[1], still.effector[0], atol=1e-6)
    batch.rest(np.array([1]))
    assert not batch.velocity[1].any() and batch.velocity[0].any()


def test_going_back_and_copies():
    robot = make_robot("diamond")
    backend, other = SurrogateBackend(robot, dynamics=True), SurrogateBackend(robot, dynamics=True)
    first, second = _walk(robot, 2, 5.0)
    there = backend.step(first)
    after = backend.step(second)
    backend.restore(there)
    np.testing.assert_array_equal(backend.step(second).effector, after.effector)
    backend.restore(there)
    other.resume(backend.snapshot())
    np.testing.assert_array_equal(other.step(second).effector, after.effector)


def test_environments_in_motion():
    env = gymnasium.make("SoftGym/FingerReach-v0", backend_options={"dynamics": True})
    envs = gymnasium.make_vec(
        "SoftGym/FingerReach-v0",
        4,
        backend_options={"dynamics": True},
        sample_design=True,
        vectorization_mode="vector_entry_point",
    )
    still = gymnasium.make("SoftGym/FingerReach-v0")
    size = env.observation_space.shape[0]
    assert size == envs.single_observation_space.shape[0] == still.observation_space.shape[0] + 3
    env.reset(seed=0)
    envs.reset(seed=0)
    for _ in range(3):
        observation, *_ = env.step(env.action_space.sample())
        envs.step(envs.action_space.sample())
    assert np.isfinite(observation).all() and np.abs(env.unwrapped.state.velocity).max() > 1e-4


def test_what_is_refused():
    robot = make_robot("finger")
    backend = SurrogateBackend(robot, dynamics=True)
    with pytest.raises(ValueError, match="mode = 'effort' is not available in motion"):
        backend.step(np.zeros(2), "effort")
    with pytest.raises(ValueError, match="2 finite numbers"):
        backend.step(np.array([np.nan, 0.0]))
    with pytest.raises(WeightsError, match="has no learned inertia"):
        SurrogateBackend(make_robot("finger", cables=1), dynamics=True)
    with pytest.raises(ValueError, match="time_step = 0.0 s must be positive"):
        SurrogateBackend(robot, dynamics=True, time_step=0.0)
    with pytest.raises(ValueError, match="divides control_step = 0.05 s into more than 10000 steps; check their units"):
        SurrogateBackend(robot, dynamics=True, time_step=2e-6)
    with pytest.raises(ValueError, match="plant stiffness changes frequencies"):
        gymnasium.make("SoftGym/FingerReach-v0", backend_options={"dynamics": True}, plant={"stiffness": 0.9})


def test_options_of_motion_go_to_another_backend():
    """A policy that was trained in motion on the surrogate is judged in motion on finite elements."""
    config = EnvironmentConfig(
        id="SoftGym/FingerReach-v0", backend_options={"dynamics": True, "time_step": 0.02, "members": 1}
    )
    moved = config.on("fem")
    assert moved.backend_options == {"dynamics": True, "time_step": 0.02}
    assert config.on("surrogate").backend_options == config.backend_options
