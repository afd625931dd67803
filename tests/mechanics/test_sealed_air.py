"""Air sealed in a cavity: derivatives, Boyle's law, and the same equilibria as under a controlled pressure."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs.mechanics.constraints.cavity import ATMOSPHERE, SealedAir
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.mechanics.surfaces import cavity_around
from tests.helpers import derivative_errors

SIDE = 0.03
MIDDLE = np.array([0.5, 0.5, 0.5]) * SIDE


@pytest.fixture
def hollow(box):
    """Return a function that makes a soft block of 30 mm with a hole of 10 mm in its middle, and the hole's surface."""

    def make(young_modulus=2e5):
        nodes, tetrahedra = box((SIDE, SIDE, SIDE), (3, 3, 3))
        away = np.abs(nodes[tetrahedra].mean(axis=1) - MIDDLE).max(axis=1)
        shell = tetrahedra[away > SIDE / 6]
        model = MechanicalModel.from_mesh(
            nodes, shell, fixed=nodes[:, 2] < 1e-9, young_modulus=young_modulus, poisson_ratio=0.3, element="linear"
        )
        surface = cavity_around(model.nodes, model.solids[0].corners, MIDDLE, "hole")
        model.add_effector("top", [0.5 * SIDE, 0.5 * SIDE, SIDE])
        return model, model.cavity("hole", surface)

    return make


def deformed(model, rng, amplitude=3e-4):
    step = amplitude * rng.standard_normal(model.equations)
    return model.nodes + model.warping.displacement(model.nodes, step)


def test_energy_forces_and_tangent_are_derivatives(hollow, rng):
    model, cavity = hollow()
    model.add("s", model.seal(cavity))
    errors = derivative_errors(model, deformed(model, rng), np.zeros(4))
    assert errors.gradient < 2e-7
    assert errors.tangent < 1e-8


def test_the_air_stores_the_work_of_boyles_law(hollow):
    """Against the quadrature of the gauge pressure over the volume, down to a tenth of it."""
    _, cavity = hollow()
    air = SealedAir(cavity)
    rest = cavity.rest_volume
    for share in (0.1, 0.7, 0.999, 1.5):
        volume = share * rest
        places, weights = np.polynomial.legendre.leggauss(60)
        between = 0.5 * (rest + volume) + 0.5 * (volume - rest) * places
        work = -0.5 * (volume - rest) * weights @ [air.pressure(v)[0] for v in between]
        assert air.energy(volume) == pytest.approx(work, rel=1e-9)
        assert (air.pressure(volume)[0] + ATMOSPHERE) * volume == pytest.approx(ATMOSPHERE * rest, rel=1e-12)
        assert air.volume_at(air.pressure(volume)[0]) == pytest.approx(volume, rel=1e-12)


def test_equilibria_are_those_of_an_open_cavity_under_the_same_pressure(hollow):
    force = np.array([0.2, -0.1, -1.5])
    sealed, cavity = hollow()
    sealed.add("s", sealed.seal(cavity))
    state = Statics(sealed).solve([], effector_force=force)
    pressure = float(state.condensed.delta.s[0])
    assert pressure > 200.0
    controlled, cavity = hollow()
    controlled.add("a", cavity)
    same = Statics(controlled).solve([pressure], ["effort"], effector_force=force)
    np.testing.assert_allclose(state.x, same.x, atol=1e-9)
    volume = cavity.rest_volume + float(same.condensed.delta.a[0])
    assert (ATMOSPHERE + pressure) * volume == pytest.approx(ATMOSPHERE * cavity.rest_volume, rel=1e-6)
    # Air is a spring in series with the volume of the open cavity, and pressure its elongation times its stiffness.
    spring = (ATMOSPHERE + pressure) / volume
    W, e = same.condensed.W, state.condensed.W
    coupled = W.ea[:, 0] / (1.0 + spring * W.aa[0, 0])
    np.testing.assert_allclose(e.ee, W.ee - spring * np.outer(W.ea[:, 0], coupled), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(e.se[0], -spring * coupled, rtol=1e-5, atol=1e-6 * np.abs(spring * coupled).max())


def test_air_that_pushes_into_nothing_is_an_inverted_element(hollow):
    model, cavity = hollow()
    model.seal(cavity)
    turned = model.nodes * np.array([-1.0, 1.0, 1.0])
    assert model.energy(turned) == np.inf
    with pytest.raises(ValueError, match="ambient = 0 Pa around cavity 'hole'"):
        model.seal(cavity, ambient=0)
