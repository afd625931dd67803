"""Superelements with a cavity, and possible errors of learned energies: exact derivatives and exact propagation."""

import numpy as np
import pytest

from softgym_envs.extensions.beams.pose import Pose
from softgym_envs.extensions.modules.closed_superelement import PortCavity, add_superelement
from softgym_envs.extensions.modules.energy import CavityVolume, ModuleEnergy, terms, volume_terms
from softgym_envs.extensions.modules.superelement import QuadraticEnergy, point_masses
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.solvers.learned_errors import possible_errors
from softgym_envs.mechanics.solvers.statics import Statics

LENGTH, AREA, BULGE = 0.03, 2e-4, 1e-12
STIFFNESS = np.diag([3e3, 3e3, 5e3, 0.3, 0.3, 0.5])


def chain(energies, cavity=None, gravity=(0.0, 0.0, 0.0), mass=0.0):
    """Model of superelements in a row on a clamped port, with the point of the last port as effector."""
    builder = ModelBuilder(gravity=gravity)
    ports = [builder.add_frame(np.zeros(3), fixed=True, fixed_spin=True)]
    for number, energy in enumerate(energies, start=1):
        ports.append(builder.add_frame([0.0, 0.0, number * LENGTH]))
        add_superelement(
            builder, *ports[-2:], energy, length=LENGTH, cavity=cavity, inertia=point_masses(mass) if mass else None
        )
    model = builder.build()
    for number, block in enumerate(model.blocks if cavity is not None else (), start=1):
        model.add("a", PortCavity(f"pressure {number}", block))
    model.add("e", Point("tip", EmbeddedPoints.in_frame(ports[-1], np.zeros(3), model.nodes)))
    return model, ports


def volume(rng=None):
    coefficients = np.zeros(len(volume_terms())) if rng is None else 1e-6 * rng.normal(size=len(volume_terms()))
    coefficients[0] = AREA * LENGTH  # of the strain along z, over the length
    return CavityVolume(LENGTH, coefficients, BULGE)


def test_only_the_stretch_changes_a_volume_to_first_order():
    first = volume_terms()[0]
    assert first.tolist() == [2, -1, -1]
    assert all(row[1] >= 0 for row in volume_terms()[1:])


def test_gradient_and_hessian_are_the_derivatives_of_the_volume():
    cavity, strains = volume(np.random.default_rng(0)), np.array([0.003, -0.002, -0.001, 0.2, -0.4, 0.3])
    _, gradient, hessian = cavity.evaluate(strains)
    for k, step in enumerate([1e-7] * 3 + [1e-5] * 3):
        move = step * np.eye(6)[k]
        (up, up_slope, _), (down, down_slope, _) = (cavity.evaluate(strains + s * move) for s in (1.0, -1.0))
        assert (up - down) / (2.0 * step) == pytest.approx(gradient[k], rel=1e-6, abs=1e-6 * abs(gradient).max())
        slope = (up_slope - down_slope) / (2.0 * step)
        np.testing.assert_allclose(slope, hessian[k], rtol=1e-6, atol=1e-6 * abs(hessian[k]).max())


def test_a_pressure_pushes_the_ports_apart_and_swells_the_cavity():
    """Series of the area over the stiffness, and the bulge; both are linear here."""
    model, _ = chain([QuadraticEnergy(STIFFNESS)], volume())
    pressure = 1.0e4
    state = Statics(model).solve(np.array([pressure]), "effort")
    moved = state.condensed.delta.e[2] - LENGTH
    assert moved == pytest.approx(pressure * AREA / STIFFNESS[2, 2], rel=1e-9)
    assert state.condensed.delta.a[0] == pytest.approx(AREA * moved + BULGE * pressure, rel=1e-9)
    back = Statics(model).solve(state.condensed.delta.a)
    assert back.effort[0] == pytest.approx(pressure, rel=1e-7)


def test_the_compliance_with_a_cavity_is_the_derivative_of_its_equilibria():
    rng = np.random.default_rng(1)
    energies = [ModuleEnergy(LENGTH, np.full(6, 0.5), 0.2 * rng.normal(size=len(terms()))) for _ in range(2)]
    model, ports = chain(energies, volume(rng))
    for component in range(6):
        model.add("a", Pose(f"tip {component}", ports[-1], component, model.nodes))
    solver = Statics(model, tolerance=1e-13)
    effort = np.array([2e4, -1e4, 0.2, 0.1, 0.3, 0.01, 0.01, 0.005])
    W = solver.solve(effort, "effort").condensed.W.array
    for k in range(len(effort)):
        step = 1e-3 * abs(effort[k]) * np.eye(len(effort))[k]
        up, down = (solver.solve(effort + s * step, "effort").delta for s in (1.0, -1.0))
        slope = (up - down) / (2.0 * step[k])
        scale = np.sqrt(np.diag(W) * W[k, k])
        np.testing.assert_allclose(slope / scale, W[:, k] / scale, atol=3e-5)


def test_possible_errors_bound_how_far_wrong_strains_put_the_tip():
    """The tip moves by at most the bound, and for the worst of many errors of the bound's size nearly by it."""
    rng = np.random.default_rng(2)
    k, c = np.array([2.0, 3.0, 4.0, 0.5, 0.3, 0.2]), 0.2 * rng.normal(size=len(terms()))
    known, learned = ModuleEnergy(LENGTH, k, c), ModuleEnergy(LENGTH, k, c, error_bounds=1e-4)
    force = np.array([1.0, -2.0, 0.5])

    def solve(energy, held):
        model, ports = chain([energy, known])
        model.add("a", Pose("tip x", ports[-1], 0, model.nodes))
        solver, command = Statics(model, tolerance=1e-13), np.array([0.004 if held else 0.0])
        state = solver.solve(command, "displacement" if held else "effort", effector_force=force)
        return solver, state

    class Wrong:
        """The energy with a constant error of its force."""

        def __init__(self, load):
            self.load = load

        def evaluate(self, strains):
            energy, gradient, hessian = known.evaluate(strains)
            return energy + self.load @ strains, gradient + self.load, hessian

        def knows(self, strains):
            return True

        def possible_errors(self, strains):
            return np.empty((0, 6))

    for held in (False, True):
        solver, middle = solve(learned, held)
        bound = possible_errors(solver, np.array([held]))
        block = solver.model.blocks[0]
        errors = learned.possible_errors(block.strains(middle.x))
        directions = rng.normal(size=(60, 6))
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        moves = np.array(
            [solve(Wrong(d @ errors), held)[1].condensed.delta.e - middle.condensed.delta.e for d in directions]
        )
        free = bound > 1e-12
        assert free.tolist() == [not held, True, True]
        largest = np.abs(moves).max(axis=0)
        assert (largest[free] <= 1.01 * bound[free]).all() and (largest[free] > 0.5 * bound[free]).all()
        assert not possible_errors(solve(known, held)[0], np.array([held])).any()


def test_half_of_the_weight_hangs_at_each_port():
    mass, g = 0.02, 9.81
    model, _ = chain([QuadraticEnergy(STIFFNESS)] * 2, gravity=(0.0, 0.0, -g), mass=mass)
    model.add("a", Pose("push", model.kinematics.frames.rows[1], 2, model.nodes))
    found = Statics(model).solve(np.zeros(1), "effort").condensed.delta.e[2]
    expected = 2.0 * LENGTH - (1.5 * mass + 0.5 * mass) * g / STIFFNESS[2, 2]
    assert found == pytest.approx(expected, rel=1e-9)
