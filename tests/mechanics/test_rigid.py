"""Rigid parts: inertia, free motion, joints, against exact equations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.elements.rigid import RigidBody, box_inertia, sphere_inertia
from softgym_envs.mechanics.frames import rotation_of
from softgym_envs.mechanics.solvers.dynamics import Dynamics
from tests.verification import dynamics as cases


def by_case(rows):
    result = {}
    for row in rows:
        result.setdefault(row.case, []).append(row)
    for case, group in result.items():
        print(case, [f"{r.setting}: {r.error:.2e} ({r.order:.2f})" for r in group])
    return result


def free(inertia, mass=1.0, rotation=None, **options):
    """A body without weight, at rest at the origin."""
    body = ModelBuilder(floating=True)
    frame = body.add_frame([0.0, 0.0, 0.0], rotation)
    body.add_mass(frame, mass, inertia)
    return Dynamics(body.build(), **options)


# -- inertia --------------------------------------------------------------------------------------------------------


def test_inertia_of_simple_bodies(rng):
    """By sampling points inside them."""
    points = rng.uniform(-1.0, 1.0, (400_000, 3))
    half = np.array([0.1, 0.2, 0.4])
    for found, inside in (
        (box_inertia(3.0, half), points * half),
        (sphere_inertia(3.0, 0.5), 0.5 * points[np.linalg.norm(points, axis=1) < 1.0]),
    ):
        squares = 3.0 * np.einsum("pi,pj->ij", inside, inside) / len(inside)
        sampled = np.trace(squares) * np.eye(3) - squares
        np.testing.assert_allclose(found, sampled, rtol=0, atol=5e-3 * np.trace(found))


def test_kinetic_energy_is_that_of_mass_and_inertia(rng):
    """For any inertia, rotation, velocity and spin: m v^2 / 2 + w . R I R^T w / 2; lumping does not change it."""
    squares = np.diag([0.3, 0.1, 0.05])
    turn = Rotation.random(random_state=1).as_matrix()
    inertia = turn @ (np.trace(squares) * np.eye(3) - squares) @ turn.T
    rotation = Rotation.random(random_state=2).as_matrix()
    for lumped in (False, True):
        solver = free(inertia, mass=2.0, rotation=rotation, step=0.01, lumped=lumped)
        v, w = rng.standard_normal((2, 3))
        solver.launch(np.concatenate([v, w]))
        expected = 0.5 * 2.0 * v @ v + 0.5 * w @ rotation @ inertia @ rotation.T @ w
        assert solver.energies()[0] == pytest.approx(expected, rel=1e-12)
        linear, angular = cases.momenta(solver)
        np.testing.assert_allclose(linear, 2.0 * v, rtol=1e-12)
        np.testing.assert_allclose(angular, rotation @ inertia @ rotation.T @ w, rtol=1e-12)


def test_a_body_has_weight_but_no_stiffness():
    solver = free(sphere_inertia(2.0, 0.1), mass=2.0, step=0.01)
    model = solver.model
    model.set_gravity((0.0, 0.0, -10.0))
    assert model.mass == 2.0 and model.volume == 0.0
    np.testing.assert_allclose(model.loads[0], [0.0, 0.0, -20.0])
    assert not model.loads[1:].any()
    assert model.energy(model.nodes + [[0.0, 0.0, 3.0], *np.zeros((3, 3))]) == pytest.approx(60.0)


# -- motion ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", ["euler", "generalised_alpha"])
def test_a_spin_about_a_principal_axis_is_constant(scheme):
    """The second order scheme turns by exactly w t."""
    solver = free(box_inertia(1.0, np.array([0.1, 0.2, 0.4])), step=0.01, scheme=scheme)
    solver.launch(np.array([0.5, 0.0, 0.0, 0.0, 0.0, 4.0]))
    for _ in range(100):
        solver.advance([])
    spin = solver.model.kinematics.equation_velocity(solver.x, solver.velocity)[3:]
    np.testing.assert_allclose(spin[:2], 0.0, atol=1e-9)
    if scheme == "euler":
        assert 2.0 < spin[2] < 4.0  # damped
    else:
        np.testing.assert_allclose(spin[2], 4.0, rtol=1e-10)
        turn = Rotation.from_rotvec([0.0, 0.0, 4.0]).as_matrix()
        np.testing.assert_allclose(rotation_of(solver.x, 0), turn, atol=1e-9)
    np.testing.assert_allclose(solver.x[0], [0.5, 0.0, 0.0], atol=1e-10)


def test_a_tumbling_box_and_pendulums_against_exact_equations():
    """Second order in momentum, energy and position; against Euler's equations and independent solutions of joints."""
    for case, group in by_case(cases.rigid(levels=(50, 100))).items():
        if "euler" in case:
            assert 0.6 < group[-1].order < 1.1, case
        else:
            assert group[-1].order == pytest.approx(2.0, abs=0.1), case
            assert group[-1].error < 5e-3


def test_the_box_turns_over():
    """Dzhanibekov: a spin near the middle axis changes sign repeatedly, at the times of Euler's equations."""
    inertia = box_inertia(1.0, np.array([0.1, 0.2, 0.4]))
    solver = free(inertia, step=0.01, scheme="generalised_alpha", spectral_radius=1.0)
    solver.launch(np.concatenate([np.zeros(3), cases.SPIN]))
    middle = []
    for k in range(600):
        solver.advance([])
        spin = solver.model.kinematics.equation_velocity(solver.x, solver.velocity)[3:]
        middle.append(rotation_of(solver.x, 0)[:, 1] @ spin)
        if k in (199, 599):
            rotation, exact = cases.tumbling(0.01 * (k + 1), cases.SPIN, inertia)
            np.testing.assert_allclose(spin, exact, atol=0.02)
            np.testing.assert_allclose(rotation_of(solver.x, 0), rotation, atol=0.02)
    flips = np.flatnonzero(np.diff(np.sign(middle)))
    assert len(flips) >= 2
    assert max(middle) > 2.9 and min(middle) < -2.9
    # Directors stay orthonormal.
    np.testing.assert_allclose(rotation_of(solver.x, 0).T @ rotation_of(solver.x, 0), np.eye(3), atol=1e-13)


def test_bonds_hold_in_motion():
    solver = cases.pendulum(2, [3.0, 0.5, 1.0], step=0.01, scheme="generalised_alpha")
    for _ in range(50):
        solver.advance([])
        for bond in solver.model.constraints["b"]:
            np.testing.assert_allclose(bond.value(solver.x), 0.0, atol=1e-10)


def test_a_small_swing_of_a_bar_has_its_period():
    """About a fixed end: T = 2 pi sqrt(I / (m g l))."""
    solver = cases.pendulum(1, [0.0, 0.0, 0.0], joint="frame", step=0.005, scheme="generalised_alpha")
    solver.model.set_gravity((9.81, 0.0, 0.0))
    length = cases.BAR[2]
    inertia = box_inertia(1.0, cases.BAR)[1, 1] + length**2
    period = 2.0 * np.pi * np.sqrt(inertia / (9.81 * length))
    solver.launch(np.array([0.0, 0.02, 0.0]))
    heights = np.array([solver.advance([]).equilibrium.delta[2] for _ in range(int(2.2 * period / 0.005))])
    last = np.flatnonzero(heights[:-1] * heights[1:] < 0.0)
    crossings = 0.005 * (last + 1 + heights[last] / (heights[last] - heights[last + 1]))
    assert 2.0 * np.diff(crossings).mean() == pytest.approx(period, rel=2e-4)


# -- invalid input --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mass", [0.0, -1.0, np.nan, np.inf])
def test_an_impossible_mass_is_rejected(mass):
    with pytest.raises(ValueError, match=f"mass = {mass} kg of a rigid body must be positive and finite"):
        RigidBody(np.zeros((4, 3)), 0, mass=mass, inertia=np.eye(3))


@pytest.mark.parametrize(
    ("inertia", "message"),
    [
        (np.ones(3), r"inertia must be a symmetric matrix \(3, 3\)"),
        (np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), "symmetric"),
        (np.full((3, 3), np.nan), "symmetric"),
        (np.diag([1.0, 1.0, 2.1]), "violates the triangle inequality"),
        (np.diag([1.0, 1.0, -1.0]), "violates the triangle inequality"),
    ],
)
def test_an_impossible_inertia_is_rejected(inertia, message):
    with pytest.raises(ValueError, match=message):
        RigidBody(np.zeros((4, 3)), 0, mass=1.0, inertia=inertia)


def test_a_thin_rod_is_a_valid_body():
    """The limit of the triangle inequality."""
    RigidBody(np.zeros((4, 3)), 0, mass=1.0, inertia=np.diag([0.0, 1.0, 1.0]))
    RigidBody(np.zeros((4, 3)), 0, mass=1.0, inertia=np.diag([1.0, 1.0, 2.0]))
