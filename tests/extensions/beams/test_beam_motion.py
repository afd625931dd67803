"""Compiled steps of bodies of beams: factorisation, equations, motions and fallbacks against the general solver."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from softgym_envs.backends.fem import FEMBackend
from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.extensions.beams.robots.stiff_flop import StiffFlop
from softgym_envs.extensions.beams.robots.tetrapod import Tetrapod
from softgym_envs.extensions.beams.solver import block_cholesky, block_elimination
from softgym_envs.extensions.beams.solver.body import is_beam_body
from softgym_envs.extensions.beams.solver.equations import Step, assemble, point_strains
from softgym_envs.extensions.beams.solver.frames import motion_of, move
from softgym_envs.extensions.beams.solver.motion import BeamMotion
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.solvers.dynamics import Dynamics
from softgym_envs.mechanics.solvers.schemes import ImplicitEuler
from softgym_envs.mechanics.solvers.statics import Statics
from tests.helpers import dense_tangent

H = 0.01
ORIGINS = slice(0, None, 4)  # rows of the origins of frames


def moving_tetrapod(seed=0, **options):
    """A Tetrapod with two elements in each leg, in the middle of a random motion, with random efforts."""
    rng = np.random.default_rng(seed)
    robot = Tetrapod(elements=2, payload=0.1)
    design = robot.design_space.sample(rng)
    solver = Dynamics(robot.build(design), step=H, tolerance=1e-12, compiled=False, **options)
    solver.advance(rng.uniform(-0.3, 0.3, 4))
    solver.effort += rng.uniform(-0.05, 0.05, 7)
    return solver


def equations_at(solver, x, *, full=True):
    """The compiled equations of one step of a solver that ends at rows ``x``."""
    beams = BeamMotion(solver.model, solver._mass)
    body = beams.body
    start = np.zeros((len(body.elements.frames), 2, 6))
    point_strains(body.elements, solver.x, start)
    step = Step(
        solver.x,
        solver.velocity,
        start,
        solver.model.loads,
        solver.step,
        solver.mass_damping,
        solver.stiffness_damping,
        None,
    )
    assemble(body, x, solver.effort, step, beams.equations, full)
    return body, beams.equations


def numbers_of(model, body):
    """Equation of each component of the blocks, -1 where it is held, shape (b, 6)."""
    kinematics = model.kinematics
    frames = np.searchsorted(model.frames.rows, body.frames.rows)
    numbers = np.full((len(body.frames.rows), 6), -1)
    numbers[body.frames.block, :3] = kinematics.number[3 * body.frames.rows[:, None] + np.arange(3)]
    numbers[body.frames.block, 3:] = kinematics.spin_number[frames]
    return numbers


@pytest.mark.parametrize("shift", [40.0, 5.0])
def test_block_factors_solve_like_dense_ones(rng, shift):
    count = 9
    pairs = [(i, j) for i in range(count) for j in range(i) if rng.random() < 0.3]
    dense = np.zeros((count, 6, count, 6))
    for i, j in pairs:
        dense[i, :, j] = rng.normal(size=(6, 6))
    dense = dense.reshape(54, 54)
    dense += dense.T + shift * np.eye(54)
    place, pattern = block_cholesky.analyse(count, pairs)
    values = np.zeros((pattern.blocks, 6, 6))
    order = np.argsort(place)
    for i in range(count):
        for j in range(i, count):
            block = dense[6 * order[i] : 6 * order[i] + 6, 6 * order[j] : 6 * order[j] + 6]
            if block.any():
                values[pattern.place(i, j)] = block
    right = rng.normal(size=(count, 6))
    solution = right[order].copy()
    signs = np.zeros((count, 6))
    negative = int((np.linalg.eigvalsh(dense) < 0.0).sum())
    assert (negative > 0) == (shift < 40.0)
    assert block_cholesky.factorise(values, pattern.pointers, pattern.targets, signs) == negative
    assert (signs < 0.0).sum() == negative
    block_cholesky.solve_lower(values, pattern.pointers, pattern.columns, solution)
    solution *= signs
    block_cholesky.solve_upper(values, pattern.pointers, pattern.columns, solution)
    assert solution[place].ravel() == pytest.approx(np.linalg.solve(dense, right.ravel()), rel=1e-9, abs=1e-11)
    values[0] = 0.0
    assert block_cholesky.factorise(values, pattern.pointers, pattern.targets, signs) == -1


def test_blocks_that_are_not_symmetric_solve_like_dense_ones(rng):
    count = 9
    pairs = [(i, j) for i in range(count) for j in range(i) if rng.random() < 0.3]
    _, pattern = block_cholesky.analyse(count, pairs)
    dense = np.zeros((count, 6, count, 6))
    for i in range(count):
        dense[i, :, i] = 15.0 * np.eye(6) + rng.normal(size=(6, 6))
        for j in pattern.columns[pattern.pointers[i] : pattern.pointers[i + 1]]:
            dense[i, :, j], dense[j, :, i] = rng.normal(size=(2, 6, 6))
    upper, lower = np.zeros((pattern.blocks, 6, 6)), np.zeros((len(pattern.columns), 6, 6))
    for i in range(count):
        upper[i] = dense[i, :, i]
        for p in range(pattern.pointers[i], pattern.pointers[i + 1]):
            upper[count + p], lower[p] = dense[i, :, pattern.columns[p]], dense[pattern.columns[p], :, i]
    right = rng.normal(size=(count, 6))
    solution = right.copy()
    assert block_elimination.eliminate_blocks(upper, lower, pattern.pointers, pattern.targets, np.zeros(6))
    block_elimination.solve_blocks(upper, lower, pattern.pointers, pattern.columns, solution)
    expected = np.linalg.solve(dense.reshape(54, 54), right.ravel())
    assert solution.ravel() == pytest.approx(expected, rel=1e-9, abs=1e-11)
    upper[0] = 0.0
    assert not block_elimination.eliminate_blocks(upper, lower, pattern.pointers, pattern.targets, np.zeros(6))


def compare_equations(model, found, body, equations):
    """Assert that compiled equations are those of the general assembly."""
    numbers = numbers_of(model, body)
    held = numbers < 0

    def in_equations(values):
        out = np.zeros(model.equations)
        out[numbers[~held]] = values[~held]
        return out

    size = np.abs(found.residual).max()
    assert in_equations(equations.residual) == pytest.approx(found.residual, abs=1e-11 * size)
    assert equations.delta == pytest.approx(found.delta, rel=1e-12, abs=1e-14)
    for row in range(len(found.delta)):
        assert in_equations(equations.H[row]) == pytest.approx(found.gradients[:, row], rel=1e-12, abs=1e-13)
    assert equations.energy[0] == pytest.approx(found.energy, rel=1e-12)
    # The tangent, through its action on random motions.
    tangent = dense_tangent(model, found.tangent)
    block = np.zeros((len(numbers), 6, len(numbers), 6))
    pattern = body.pattern
    for i in range(pattern.size):
        block[i, :, i] = equations.tangent[i]
        for p in range(pattern.pointers[i], pattern.pointers[i + 1]):
            block[i, :, pattern.columns[p]] = equations.tangent[pattern.size + p]
            block[pattern.columns[p], :, i] = equations.tangent[pattern.size + p].T
    block = block.reshape(numbers.size, numbers.size)
    free = numbers.ravel() >= 0
    mine = np.zeros_like(tangent)
    chosen = numbers.ravel()[free]
    mine[np.ix_(chosen, chosen)] = block[np.ix_(free, free)]
    assert np.abs(mine - tangent).max() < 1e-11 * np.abs(tangent).max()
    assert (block[~free] == np.eye(len(free))[~free]).all()


@pytest.mark.parametrize("damping", [{}, {"mass_damping": 0.7, "stiffness_damping": 0.02}])
def test_equations_of_a_time_step_are_those_of_the_general_assembly(damping):
    """Residual, tangent and constraint gradients in mid-motion, for a random design and random efforts."""
    solver = moving_tetrapod(**damping)
    model, start = solver.model, solver.x
    x = start + model.kinematics.displacement(start, 1e-2 * np.random.default_rng(1).normal(size=model.equations))
    inertia = ImplicitEuler(start, solver.velocity, H, solver._body)
    found = model.assembly.evaluate(x, solver.effort, model.loads, inertia)
    compare_equations(model, found, *equations_at(solver, x))


def test_equations_of_an_equilibrium_are_those_of_the_general_assembly(rng):
    """With chambers under random pressures, in a random shape."""
    model = StiffFlop(elements=2, gravity=(0.0, 0.0, -9.81)).build()
    x = model.nodes + model.kinematics.displacement(model.nodes, 1e-3 * rng.normal(size=model.equations))
    effort = 1e4 * rng.uniform(size=9) * np.repeat([1.0, 1e-6], [6, 3])
    found = model.assembly.evaluate(x, effort, model.loads)
    beams = BeamMotion(model, model.assembly.mass_matrix())
    start = np.zeros((len(beams.body.elements.frames), 2, 6))
    step = Step(x, np.zeros_like(x), start, model.loads, np.inf, 0.0, 0.0, None)
    assemble(beams.body, x, effort, step, beams.equations, True)
    compare_equations(model, found, beams.body, beams.equations)


def test_tangent_is_the_derivative_of_the_residual():
    solver = moving_tetrapod(stiffness_damping=0.02)
    body, equations = equations_at(solver, solver.x.copy())
    rng = np.random.default_rng(3)
    motion = rng.normal(size=body.components.free.shape) * body.components.free
    pattern, tangent = body.pattern, equations.tangent
    expected = 0.0
    for i in range(pattern.size):
        expected += motion[i] @ tangent[i] @ motion[i]
        for p in range(pattern.pointers[i], pattern.pointers[i + 1]):
            expected += 2.0 * motion[i] @ tangent[pattern.size + p] @ motion[pattern.columns[p]]
    along = []
    for size in (1e-6, -1e-6):
        x = solver.x.copy()
        move(body.frames, x, size * motion, np.zeros((3, 3)))
        _, moved = equations_at(solver, x, full=False)
        along.append(float((moved.residual * motion).sum()))
    assert (along[0] - along[1]) / 2e-6 == pytest.approx(expected, rel=1e-6)


def test_motions_are_those_of_the_kinematics(rng):
    solver = moving_tetrapod()
    body = BeamMotion(solver.model, solver._mass).body
    kinematics, numbers = solver.model.kinematics, numbers_of(solver.model, body)
    step = rng.normal(size=solver.model.equations)
    for size in (1e-3, 1.0):
        motion = np.where(numbers >= 0, size * step[numbers], 0.0)
        x = solver.x.copy()
        move(body.frames, x, motion, np.zeros((3, 3)))
        assert x == pytest.approx(solver.x + kinematics.displacement(solver.x, size * step), abs=1e-10)
    velocity = kinematics.row_velocity(solver.x, step)
    found = np.zeros_like(motion)
    motion_of(body.frames, body.components.free, solver.x, velocity, 0.5, found)
    assert found == pytest.approx(0.5 * np.where(numbers >= 0, step[numbers], 0.0), abs=1e-12)


def both(robot, design=None, **options):
    """Two backends in motion: with compiled steps, and with the general solver alone."""
    pair = [FEMBackend(robot, design, dynamics=True, **options) for _ in range(2)]
    pair[1]._dynamics._compiled = False
    for backend in pair:  # to compare what remains beyond the tolerance of Newton's method
        backend._dynamics.tolerance = 1e-12
    return pair


def compare(fast, general):
    """Assert that two states in motion are equal, with their efforts, energies and ``W``."""
    assert np.abs(fast.nodes - general.nodes)[ORIGINS].max() < 1e-9
    assert fast.velocity == pytest.approx(general.velocity, abs=1e-7)
    assert fast.effort == pytest.approx(general.effort, abs=1e-8)
    assert fast.displacement == pytest.approx(general.displacement, abs=1e-9)
    scale = np.abs(general.condensed.compliance).max()
    assert np.abs(fast.condensed.compliance - general.condensed.compliance).max() < 1e-7 * scale
    for name in ("time", "kinetic", "potential", "work", "dissipated"):
        assert getattr(fast.motion, name) == pytest.approx(getattr(general.motion, name), rel=1e-7, abs=1e-10), name
    assert fast.stable == general.stable


def compiled_steps(backend, command):
    """How many of the five time steps to a command are taken in compiled code, without taking them."""
    solver = copy.copy(backend._dynamics)
    parts = backend.state.command + np.arange(1, 6)[:, None] / 5 * (command - backend.state.command)
    return solver.advance_compiled(parts)[0]


@pytest.mark.parametrize("payload", [0.0, 1.0])
def test_same_motion_for_random_designs_commands_and_forces(rng, payload):
    robot = Tetrapod(elements=3, payload=payload)
    compiled = []
    for _ in range(2):
        fast, general = both(robot, robot.design_space.sample(rng), mass_damping=0.3)
        command = np.zeros(4)
        for k in range(6):
            command = np.clip(command + rng.uniform(-1, 1, 4) * robot.rates, robot.lower, robot.upper)
            force = rng.uniform(-0.2, 0.2, 3) if k % 2 else None
            compiled.append(compiled_steps(fast, command))
            states = [backend.step(command, force=force) for backend in (fast, general)]
            if states[1].motion.substeps > 1:  # a snap magnifies the differences of the steps before it
                break
            compare(*states)
        assert general._dynamics._special is None
    assert np.mean(compiled) == 5.0


def test_same_motion_where_only_servos_keep_the_body_stable_and_legs_snap():
    """The way of Newton's method decides which solution a snapping leg finds, so both solvers must go the same way."""
    robot = Tetrapod(elements=3, payload=1.0)
    fast, general = both(robot)
    goal = np.array([1.0, 1.0, 1.0, -1.0]) * robot.upper
    command, seen = np.zeros(4), set()
    for _ in range(9):
        command = np.clip(goal, command - robot.rates, command + robot.rates)
        general.restore(fast.state)  # a snap magnifies the differences of the steps before it
        assert compiled_steps(fast, command) == 5
        state, other = (backend.step(command) for backend in (fast, general))
        assert np.abs(state.nodes - other.nodes)[ORIGINS].max() < 1e-9
        scale = np.abs(other.condensed.compliance).max()
        assert np.abs(state.condensed.compliance - other.condensed.compliance).max() < 1e-6 * scale
        assert (state.stable, state.motion.substeps) == (other.stable, other.motion.substeps)
        seen |= {state.stable, state.motion.substeps}
    assert {False, True, 2, 4} <= seen


def test_same_motion_under_commanded_efforts_and_with_saturated_servos(rng):
    """Limits that the motion exceeds: the compiled steps end before them, and then drive the efforts."""
    robot = Tetrapod(elements=2)
    fast, general = both(robot)
    for _ in range(3):
        efforts = rng.uniform(-0.03, 0.03, 4)
        compare(*(backend.step(efforts, "effort") for backend in (fast, general)))
    fast, general = both(robot)
    command, saturated = np.zeros(4), 0
    for backend in (fast, general):
        backend.largest_efforts = np.full(4, 0.05)
        backend._limited = True
    for _ in range(8):
        command = np.clip(command + rng.uniform(-1, 1, 4) * robot.rates, robot.lower, robot.upper)
        states = [backend.step(command) for backend in (fast, general)]
        compare(*states)
        saturated += int((np.abs(states[0].effort) >= 0.05 * (1.0 - 1e-9)).any())
    assert 0 < saturated


def both_statics(robot, design):
    """Two solvers of equilibria: compiled where possible, and the general one."""
    model = robot.build(design)
    return [Statics(model, tolerance=1e-12, compiled=compiled) for compiled in (True, False)]


def compare_equilibria(fast, general):
    """Assert that two equilibria are equal, with their efforts and ``W``."""
    assert np.abs(fast.x - general.x)[ORIGINS].max() < 1e-10
    assert fast.effort == pytest.approx(general.effort, rel=1e-7, abs=1e-9 * np.abs(general.effort).max())
    assert fast.delta == pytest.approx(general.delta, rel=1e-8, abs=1e-16)
    scale = np.sqrt(np.abs(np.diag(general.condensed.compliance)))  # negative where only driven actuators are stable
    difference = fast.condensed.compliance - general.condensed.compliance
    assert np.abs(difference / np.outer(scale, scale)).max() < 1e-7
    assert fast.condensed.free == pytest.approx(general.condensed.free, rel=1e-6, abs=1e-15)
    assert (fast.slack == general.slack).all()
    assert fast.stable == general.stable
    assert fast.condensed.rows == general.condensed.rows and fast.condensed.roles == general.condensed.roles


@pytest.mark.parametrize("unilateral", [True, False])
def test_same_equilibria_of_a_trunk(rng, unilateral):
    """For random bodies: volumes, of which some leave chambers slack, pressures, both, and forces on the tip."""
    # Chambers that may pull can buckle heavy or soft bodies: the body is then the baseline, filled and weightless.
    gravity, start = ((0.0, 0.0, -9.81), 0.0) if unilateral else ((0.0, 0.0, 0.0), 8e-9)
    robot = StiffFlop(elements=3, unilateral=unilateral, gravity=gravity)
    slack, compiled = 0, []
    for _ in range(2):
        fast, general = both_statics(robot, robot.design_space.sample(rng) if unilateral else None)
        for solver in (fast, general):
            solver.solve(np.full(6, start))
        newton, uses = fast._newton, []
        fast._newton = lambda *args, newton=newton, uses=uses: (uses.append(1), newton(*args))[1]
        command = np.full(6, start)
        for k in range(10):
            command = np.clip(command + rng.uniform(-1, 1, 6) * robot.rates, robot.lower, robot.upper)
            mode = ["displacement"] * 6
            target, force = command.copy(), rng.uniform(-2e-3, 2e-3, 3) if k % 2 else None
            if k % 3 == 2:
                mode[k % 6], target[k % 6] = "effort", 0.9 * max(general.effort[k % 6], 0.0)
            before = len(uses)
            found = [solver.solve(target, mode, effector_force=force) for solver in (fast, general)]
            compiled.append(len(uses) == before)
            compare_equilibria(*found)
            slack += found[0].slack.sum()
    assert np.mean(compiled) > 0.5
    assert (slack > 0) == unilateral


def test_same_equilibria_of_the_tetrapod(rng):
    robot = Tetrapod(elements=3, payload=0.2)
    for solver, other in [both_statics(robot, robot.design_space.sample(rng)) for _ in range(2)]:
        command = np.zeros(4)
        for _ in range(4):
            compare_equilibria(solver.solve(command), other.solve(command))
            command = np.clip(command + rng.uniform(-1, 1, 4) * robot.rates, robot.lower, robot.upper)


def test_loads_and_far_equilibria_go_to_the_general_solver():
    model = StiffFlop(elements=2).build()
    fast, general = (Statics(model, compiled=compiled) for compiled in (True, False))
    far = np.array([30e-9, 0.0, 0.0, 30e-9, 0.0, 0.0])
    none = fast._special
    assert none is None and np.abs(fast.solve(far).x - general.solve(far).x).max() < 1e-7
    model.nodal_loads[-4, 2] = -0.01  # ramped from the last loads
    assert fast._balance(np.zeros(9), np.arange(6)) is None
    assert np.abs(fast.solve(far).x - general.solve(far).x).max() < 1e-7
    # A force too large for one step of Newton's method
    assert fast._balance(np.concatenate([np.zeros(6), [0.0, 0.5, 0.0]]), np.arange(6)) is None


def test_a_free_beam_keeps_the_energy_that_the_general_solver_keeps():
    """A beam without supports spins and bends; implicit Euler dissipates, and both by the same amount."""
    body = ModelBuilder(floating=True)
    frames = [body.add_frame([0.05 * k, 0.0, 0.0]) for k in range(5)]
    body.add_element(Beam, frames, section=Section.circle(5e-3), young_modulus=1e7)
    model = body.build()
    model.add("e", Point("tip", EmbeddedPoints.in_frame(frames[-1], np.array([0.0, 0.01, 0.0]), model.nodes)))
    solvers = [Dynamics(model, step=1e-3, tolerance=1e-12, compiled=compiled) for compiled in (True, False)]
    motions = []
    for solver in solvers:
        velocity = np.zeros(model.equations)
        velocity[1:15:3] = [0.3, 0.0, -0.2, 0.0, 0.3]
        velocity[15:] = np.tile([4.0, 0.5, 2.0], 5)
        solver.launch(velocity)
        motions.append([solver.advance([], effector_force=[0.0, 0.0, 0.01 * (k < 5)]) for k in range(20)])
    assert solvers[0]._special is not None
    for fast, general in zip(*motions, strict=True):
        assert fast.energy == pytest.approx(general.energy, rel=1e-9)
        assert np.abs(fast.equilibrium.x - general.equilibrium.x)[ORIGINS].max() < 1e-10


def test_what_the_compiled_steps_cannot_do_goes_to_the_general_solver():
    robot = Tetrapod(elements=2)
    model = robot.build()
    solver = Dynamics(model, step=H)
    with pytest.raises(ValueError, match="mode must be"):
        solver.advance(np.zeros(4), "torque")
    with pytest.raises(ValueError, match="finite"):
        solver.advance(np.full(4, np.nan))
    with pytest.raises(ValueError, match="effector_force"):
        solver.advance(np.zeros(4), effector_force=np.zeros(2))
    # A step far beyond what Newton's method does in one go is divided, as ever.
    far = Dynamics(model, step=H, max_cuts=0)
    assert far.advance_compiled(np.full((1, 4), 1.5))[0] == 0
    assert far.time == 0.0 and not far.velocity.any() and (far.x == model.nodes).all()
    assert far.advance(np.full(4, 1.5)).equilibrium.delta[:4] == pytest.approx(np.full(4, 1.5), abs=1e-9)
    other = Dynamics(model, step=H, scheme="generalised_alpha")
    assert other.advance_compiled(np.zeros((1, 4))) == (0, None)
    # Beams of order 1 and bodies that can touch something are not compiled, either.
    body = ModelBuilder()
    frames = [body.add_frame([0.05 * k, 0.0, 0.0], fixed=not k, fixed_spin=not k) for k in range(3)]
    body.add_element(Beam, frames, section=Section.circle(5e-3), young_modulus=1e7, order=1)
    assert not is_beam_body(body.build())
    assert Dynamics(body.build(), step=H).advance_compiled(np.zeros((1, 0))) == (0, None)
    assert is_beam_body(model)
    model.set_contact()
    assert not is_beam_body(model)
