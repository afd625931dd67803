"""Gradients through time steps, against central differences: free, standing, walking and sliding bodies."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.beams.recorder import Recorder
from softgym_envs.extensions.beams.robots.tetrapod import Tetrapod
from softgym_envs.extensions.beams.rollout import roll_out
from softgym_envs.mechanics.contact.obstacles import Cylinder, Plane, Sphere
from softgym_envs.mechanics.solvers.dynamics import Dynamics
from softgym_envs.robots.soft_finger import SoftFinger
from tests.verification.walkers import H, dynamics, ground, trot, walker

EXACT = 1e-4
"""Allowed error of a directional derivative, as a part of it: that of the differences."""


class Start:
    """A body in a state from which rollouts start."""

    def __init__(self, solver):
        self.solver = solver
        self.state = solver.x.copy(), solver.effort.copy(), solver.velocity.copy()
        self.memory = solver.memory

    def roll(self, commands, *, mode="displacement", velocity=0.0, force=None):
        x, effort, speed = self.state
        self.solver.restore(x, effort, speed + velocity, memory=self.memory)
        return roll_out(self.solver, commands, mode, None if force is None else np.tile(force, (len(commands), 1)))


@pytest.fixture(scope="module")
def walking():
    """A walker on a plane after some steps, with feet that stick and feet that slide."""
    solver = dynamics(walker([ground()]), tolerance=1e-11)
    for _ in range(10):
        solver.advance_compiled(np.zeros((5, 8)))
    solver.advance_compiled(np.array([trot(H * (k + 1)) for k in range(12)]))
    return Start(solver)


def check_commands(start, commands, sizes, *, mode="displacement", seed=0, trials=3):
    """Compare the derivatives of where the trunk ends by commands with differences."""
    weights = np.random.default_rng(seed).normal(size=3)

    def value(values):
        rollout = start.roll(values, mode=mode)
        return float(weights @ rollout.x[-1, 0]), rollout

    _, rollout = value(commands)
    by_x = np.zeros_like(rollout.x[0])
    by_x[0] = weights
    gradient = rollout.gradient(by_x=by_x).commands
    assert gradient.shape == commands.shape
    rng = np.random.default_rng(seed + 1)
    for _ in range(trials):
        way = rng.normal(size=commands.shape) * sizes
        difference = (value(commands + way)[0] - value(commands - way)[0]) / 2.0
        assert (gradient * way).sum() == pytest.approx(difference, rel=EXACT, abs=1e-13)
    return rollout


@pytest.mark.parametrize("steps", [1, 25, 100])
def test_derivatives_by_commands_of_a_walk(walking, steps):
    commands = np.array([trot(H * (k + 13)) for k in range(steps)])
    rollout = check_commands(walking, commands, 3e-14)
    feet = rollout.dynamics.linearisation.contact.contacts(rollout.x[-1])
    assert feet.count > 2


def test_derivatives_of_a_body_that_slides():
    """On a slippery ground, pushed: all feet slide all the time."""
    solver = dynamics(walker([ground(0.1)]), tolerance=1e-11)
    for _ in range(10):
        solver.advance_compiled(np.zeros((5, 8)))
    solver.velocity[::4] += [0.4, 0.1, 0.0]
    solver.advance_compiled(np.zeros((3, 8)))
    start = Start(solver)
    commands = np.array([trot(H * (k + 1)) for k in range(20)])
    rollout = check_commands(start, commands, 3e-14)
    assert rollout.dynamics.linearisation.contact.contacts(rollout.x[-1]).count > 2


def test_derivatives_on_curved_obstacles():
    obstacles = [
        Sphere((0.042, 0.027, -0.02), 0.02, friction=0.5, name="ball"),
        Cylinder((0.04, -0.025, -0.01), (1.0, 0.2, 0.0), 0.01, friction=0.4, name="bar"),
        Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), friction=0.6, name="ground"),
    ]
    solver = dynamics(walker(obstacles, clearance=0.002), tolerance=1e-11)
    solver.advance_compiled(np.zeros((8, 8)))
    rollout = check_commands(Start(solver), np.array([trot(H * (k + 1)) for k in range(15)]), 3e-14)
    assert rollout.dynamics.linearisation.contact.contacts(rollout.x[-1]).count > 2


def test_derivatives_by_the_state_at_the_start(walking):
    """By velocities, of a scalar of rows, velocities and efforts at all times."""
    rng = np.random.default_rng(3)
    commands = np.array([trot(H * (k + 13)) for k in range(20)])
    shape = (20, *walking.solver.x.shape)
    by_x, by_velocity = rng.normal(size=shape), 0.01 * rng.normal(size=shape)
    by_effort = 1e-7 * rng.normal(size=(20, 11)) * (np.arange(11) < 8)
    kinematics = walking.solver.model.kinematics
    way = kinematics.row_velocity(walking.state[0], rng.normal(size=walking.solver.model.equations))

    def value(size):
        found = walking.roll(commands, velocity=size * way)
        total = (by_x * found.x).sum() + (by_velocity * found.velocity).sum() + (by_effort * found.effort).sum()
        return float(total), found

    gradient = value(0.0)[1].gradient(by_x=by_x, by_velocity=by_velocity, by_effort=by_effort)
    difference = (value(1e-7)[0] - value(-1e-7)[0]) / 2e-7
    assert (gradient.velocity * way).sum() == pytest.approx(difference, rel=EXACT)


def test_derivatives_by_pressures(walking):
    pressures = np.tile(walking.state[1][:8], (10, 1))
    check_commands(walking, pressures, 1e-2, mode="effort")


def test_derivatives_of_a_body_that_touches_nothing():
    solver = Dynamics(Tetrapod(elements=2).build(), step=H, stiffness_damping=0.02, mass_damping=0.5, tolerance=1e-11)
    commands = 0.01 * np.random.default_rng(2).normal(size=(20, 4)).cumsum(axis=0)
    check_commands(Start(solver), commands, 1e-6)


def recorded(start, parts, push):
    """Record a motion as an environment takes it, with the commands of each control step in one call."""
    solver, (x, effort, speed) = start.solver, start.state
    solver.restore(x, effort, speed, memory=start.memory)
    recorder = Recorder(solver)
    with solver.solved_by(recorder):
        motions = [solver.advance_compiled(commands, effector_force=push)[1] for commands in parts]
    return recorder, motions


def test_steps_that_are_taken_anyway_can_be_recorded(walking):
    """Control steps of five, two and one time steps, with a push."""
    commands, push = np.array([trot(H * (k + 13)) for k in range(8)]), np.array([0.1, 0.2, 0.0])
    x, effort, speed = walking.state
    walking.solver.restore(x, effort, speed, memory=walking.memory)
    plain = walking.solver.advance_compiled(commands, effector_force=push)[1]
    whole = walking.roll(commands, force=push)
    recorder, motions = recorded(walking, (commands[:5], commands[5:7], commands[7:]), push)
    found = recorder.rollout()
    assert motions[-1].equilibrium.x == pytest.approx(plain.equilibrium.x, abs=1e-10)
    assert motions[-1].work == pytest.approx(plain.work, rel=1e-6)
    assert motions[-1].dissipated == pytest.approx(plain.dissipated, rel=1e-6)
    assert found.x == pytest.approx(whole.x, abs=1e-10) and found.effort.shape == whole.effort.shape
    by_x = np.zeros_like(whole.x)
    by_x[[2, -1], 0] = [0.3, 0.4, 0.5]
    one, other = (rollout.gradient(by_x=by_x).commands for rollout in (found, whole))
    assert one == pytest.approx(other, rel=1e-5, abs=1e-6 * np.abs(other).max())


def test_what_was_not_recorded_has_no_gradient(walking):
    with pytest.raises(ValueError, match="no motion was recorded"):
        Recorder(walking.solver).rollout()
    recorder, motions = recorded(walking, [np.full((2, 8), 1.0)], None)  # a million times the volume of a leg
    assert motions == [None]
    with pytest.raises(ConvergenceError, match="cannot be recorded"):
        recorder.rollout()
    with pytest.raises(ValueError, match="gradients need a body that compiled code can solve"):
        Recorder(Dynamics(SoftFinger(mesh_size=0.02).build(), step=0.01))


def test_what_cannot_be_rolled_out():
    solver = Dynamics(Tetrapod(elements=2).build(), step=H)
    with pytest.raises(ValueError, match=r"shape \(k, 4\), got shape \(3,\)"):
        roll_out(solver, np.zeros(3))
    with pytest.raises(ValueError, match="mode must be 'displacement' or 'effort'"):
        roll_out(solver, np.zeros((1, 4)), "speed")
    rollout = roll_out(solver, np.zeros((2, 4)))
    with pytest.raises(ValueError, match="by_x must have shape"):
        rollout.gradient(by_x=np.zeros(3))
    solid = Dynamics(SoftFinger().build(), step=H)
    with pytest.raises(ValueError, match="gradients need a body that compiled code can solve: it has no beams"):
        roll_out(solid, np.zeros((1, 2)))


def test_a_rollout_that_fails_leaves_the_body_where_it_was():
    solver = Dynamics(Tetrapod(elements=2).build(), step=H, max_cuts=0)
    before = solver.x.copy()
    with pytest.raises(ConvergenceError, match="cannot record 1 time steps"):
        roll_out(solver, np.full((1, 4), 3.0) * [1.0, -1.0, 1.0, -1.0])
    assert (solver.x == before).all()
