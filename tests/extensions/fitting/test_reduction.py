"""Reduced motion: against beam theory, against the motion of the whole body, and invalid bodies."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import eigh, null_space
from scipy.sparse import csc_matrix

from softgym_envs.extensions.fitting.reduction import reduce_motion
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.soft_finger import SoftFinger
from tests.verification import dynamics as cases

LENGTH, RADIUS, YOUNG, DENSITY, BETA = 1.0, 0.005, 1e7, 1000.0, 0.02
"""The rod of `tests.verification.dynamics` and the damping of the tests [m, m, Pa, kg/m3, s]."""


@pytest.fixture(scope="module")
def cantilever():
    return Statics(cases.rod(clamped=True, elements=8, radius=RADIUS))


def test_cantilever_against_beam_theory(cantilever):
    """A cantilever bent by its tip has 33/140 of its mass there; one stretched by its tip a third."""
    reduced = reduce_motion(cantilever, mass_damping=0.5, stiffness_damping=BETA)
    area, inertia = np.pi * RADIUS**2, np.pi * RADIUS**4 / 4.0
    total = DENSITY * area * LENGTH
    bending = 3.0 * YOUNG * inertia / LENGTH**3
    mass = total * np.array([1.0 / 3.0, 33.0 / 140.0, 33.0 / 140.0])
    stiffness = np.array([YOUNG * area / LENGTH, bending, bending])
    np.testing.assert_allclose(np.diag(reduced.mass), mass, rtol=2e-3)
    np.testing.assert_allclose(np.diag(reduced.stiffness), stiffness, rtol=2e-3)
    np.testing.assert_allclose(reduced.damping, 0.5 * reduced.mass + BETA * reduced.stiffness, atol=1e-6 * stiffness[0])
    np.testing.assert_allclose(np.diag(reduced.damping), 0.5 * mass + BETA * stiffness, rtol=3e-3)


def test_frequencies_bound_those_of_the_body(cantilever):
    """The first bending frequency lies above that of the body, by 1.5 % as in beam theory."""
    reduced = reduce_motion(cantilever)
    square = eigh(reduced.stiffness, reduced.mass, eigvals_only=True)[0]
    exact = cases.eigenmodes(cantilever.model, lumped=False, count=1)[0][0]
    assert 1.010 < np.sqrt(square) / exact < 1.020


def test_bent_state_matches_energies_of_the_whole_body():
    """About a bent state, modes are slopes of equilibria, and the mass gives the kinetic energy along them."""
    statics = Statics(cases.rod(clamped=True, elements=8, radius=RADIUS))
    bent = np.array([0.8, 0.5, 0.2])
    load = np.array([-1e-3, 4e-3, 1e-3])
    statics.solve([], effector_force=load)
    reduced = reduce_motion(statics)
    assert np.linalg.norm(statics.linearisation.delta - [LENGTH, 0.0, 0.0]) > 0.1
    step, middle, speed = 1e-6, statics.x.copy(), bent
    ends = []
    for sign in (-1.0, 1.0):
        statics.solve([], effector_force=load + sign * step * reduced.stiffness @ speed)
        ends.append(statics.x.copy())
    rows = (ends[1] - ends[0]) / (2.0 * step)
    expected = statics.model.kinematics.row_velocity(middle, reduced.modes @ speed)
    np.testing.assert_allclose(rows, expected, atol=2e-4 * np.abs(expected).max())
    kinetic = 0.5 * float(np.vdot(rows, statics.model.assembly.mass_matrix().rows @ rows))
    assert 0.5 * speed @ reduced.mass @ speed == pytest.approx(kinetic, rel=1e-3)
    assert np.linalg.eigvalsh(reduced.mass)[0] > 0.0


@pytest.mark.parametrize("command", [[0.0, 0.0], [0.01, 0.0], [0.015, 0.005]])
def test_swings_of_the_finger_with_held_cables(command):
    """Its two swings are 1.5 to 7 % too fast in the condensed coordinates, straight and bent."""
    robot = SoftFinger()
    model = robot.build(robot.design_space.complete(None))
    statics = Statics(model)
    statics.solve(command)
    reduced = reduce_motion(statics)
    held, free = slice(0, 2), slice(2, None)
    squares = eigh(reduced.stiffness[free, free], reduced.mass[free, free], eigvals_only=True)[:2]
    # The whole body, in all motions that keep the lengths of the cables
    assembly = model.assembly
    assembled = assembly.evaluate(statics.x, statics.effort, model.loads)
    assert assembled is not None
    lower = csc_matrix((assembled.tangent, assembly.indices, assembly.indptr)).toarray()
    stiffness = lower + np.tril(lower, -1).T
    rows = np.array([model.kinematics.row_velocity(statics.x, unit).ravel() for unit in np.eye(model.equations)])
    moved = (assembly.mass_matrix().rows @ rows.T.reshape(len(statics.x), -1)).reshape(rows.T.shape)
    basis = null_space(assembled.gradients[:, held].T)
    exact = eigh(
        basis.T @ stiffness @ basis, basis.T @ (rows @ moved) @ basis, eigvals_only=True, subset_by_index=[0, 1]
    )
    excess = np.sqrt(squares / exact) - 1.0
    print(np.sqrt(exact) / (2.0 * np.pi), excess)
    assert (excess > 0.0).all() and (excess < 0.07).all()


def test_dependent_values_are_rejected():
    model = cases.rod(clamped=True, elements=2, radius=RADIUS)
    (tip,) = model.constraints["e"]
    assert isinstance(tip, Point)
    model.add("e", Point("again", tip.embedding))
    with pytest.raises(ValueError, match="depend on each other"):
        reduce_motion(Statics(model))


def test_inner_modes_of_the_cantilever():
    """In each plane a static and an inner mode: the first bending frequency to 1e-5, the second 8 % too high."""
    statics = Statics(cases.rod(clamped=True, elements=8, radius=RADIUS))
    statics.solve([])
    reduced = reduce_motion(statics, inner=True, stiffness_damping=BETA)
    squares = eigh(reduced.stiffness, reduced.mass, eigvals_only=True)[:4]
    exact = cases.eigenmodes(statics.model, lumped=False, count=4)[0]
    excess = np.sqrt(squares) / exact - 1.0
    assert (excess > 0.0).all() and (excess[:2] < 1e-5).all() and (excess[2:] < 0.09).all()
    # They are orthogonal to the static modes and to each other, and move no constraint.
    n = len(reduced.mass) // 2
    np.testing.assert_allclose(reduced.stiffness[n:], np.eye(2 * n)[n:], atol=1e-12)
    moved = statics.linearisation.H.T @ reduced.modes
    np.testing.assert_allclose(moved[:, :n], np.eye(n), atol=1e-9)
    np.testing.assert_allclose(moved[:, n:], 0.0, atol=1e-9 * np.abs(reduced.modes[:, n:]).max())
    np.testing.assert_allclose(reduced.damping, BETA * reduced.stiffness, atol=1e-3 * BETA * reduced.stiffness.max())


def test_inner_modes_bring_the_swings_of_the_finger_to_half_a_percent():
    robot = SoftFinger()
    statics = Statics(robot.build(robot.design_space.complete(None)))
    statics.solve([0.01, 0.0])
    lowest = []
    for inner in (False, True):
        reduced = reduce_motion(statics, inner=inner)
        free = slice(2, None)
        lowest.append(eigh(reduced.stiffness[free, free], reduced.mass[free, free], eigvals_only=True)[:2] ** 0.5)
    assert (lowest[1] < lowest[0]).all() and (lowest[0] / lowest[1] > 1.01).all()


def test_forces_on_equations_are_the_transpose_of_velocities():
    robot = SoftFinger()
    model = robot.build(robot.design_space.complete(None))
    rng = np.random.default_rng(0)
    force, velocity = rng.normal(size=model.nodes.shape), rng.normal(size=model.equations)
    kinematics = model.kinematics
    power = np.vdot(force, kinematics.row_velocity(model.nodes, velocity))
    assert kinematics.equation_force(model.nodes, force) @ velocity == pytest.approx(power)
    beams = cases.rod(clamped=True, elements=3, radius=RADIUS)  # frames turn
    force, velocity = rng.normal(size=beams.nodes.shape), rng.normal(size=beams.equations)
    power = np.vdot(force, beams.kinematics.row_velocity(beams.nodes, velocity))
    assert beams.kinematics.equation_force(beams.nodes, force) @ velocity == pytest.approx(power)
