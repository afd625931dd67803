"""Resistance of a still fluid to beams: against what is known, and in both solvers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.extensions.beams.chamber import Chamber
from softgym_envs.extensions.beams.rollout import roll_out
from softgym_envs.extensions.beams.solver.design import Neighbours
from softgym_envs.extensions.walkers.fluid import slender_drag
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.elements.block import StrainRates
from softgym_envs.mechanics.solvers.dynamics import Dynamics

LENGTH, RADIUS, ELEMENTS = 0.12, 0.004, 4
H = 0.01


def rod(direction, drag, *, modulus=1e6, gravity=(0.0, 0.0, 0.0), chambers=False, elements=ELEMENTS):
    """A floating rod along a direction, with two rows of chambers if asked for."""
    builder = ModelBuilder(gravity=gravity, floating=True)
    axis = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
    across = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    turn = np.column_stack([axis, across, np.cross(axis, across)])
    places = np.linspace(0.0, LENGTH, 2 * elements + 1)[:, None] * axis
    frames = [builder.add_frame(place, turn) for place in places]
    builder.add_element(
        Beam,
        frames,
        section=Section.circle(RADIUS),
        young_modulus=modulus,
        poisson_ratio=0.45,
        density=1200.0,
        drag=drag,
    )
    model = builder.build()
    beam = model.blocks[0]
    for k in range(elements if chambers else 0):
        for side in (1.0, -1.0):
            line = beam.line(range(k, k + 1), (0.5 * side * RADIUS, 0.0), model.nodes)
            model.add("a", Chamber(f"chamber {k} {side:+.0f}", [line], math.pi * 0.0015**2))
    return model


def wave(time, count=ELEMENTS):
    """Volumes of the chambers [m3] of a wave that runs along the body."""
    volumes = np.empty(2 * count)
    bend = 2e-9 * min(1.0, time / 0.1) * np.sin(8.0 * time - 2.0 * np.pi * np.arange(count) / count)
    volumes[0::2], volumes[1::2] = bend, -bend
    return volumes


def test_coefficients_of_a_slender_cylinder():
    """Twice as much across as along in the limit, and Cox's corrections to it."""
    along, across = slender_drag(1.0, 1.0, 0.01)
    assert along == pytest.approx(2.0 * math.pi / (math.log(100.0) - 0.807))
    assert 1.5 < across / along < 2.0
    assert across / along < slender_drag(1.0, 1.0, 1e-12)[1] / slender_drag(1.0, 1.0, 1e-12)[0] < 2.0
    with pytest.raises(ValueError, match="length = 0.05 m of a slender body must be at least ten radii"):
        slender_drag(1.0, 0.05, 0.01)
    with pytest.raises(ValueError, match="viscosity = -1.0 must be positive"):
        slender_drag(-1.0, 1.0, 0.01)
    with pytest.raises(ValueError, match="drag = .* must be two finite numbers"):
        rod((1.0, 0.0, 0.0), (1.0, -1.0))


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("angle", [0.0, 0.5, 0.5 * math.pi])
def test_a_rod_sinks_as_it_should(angle, compiled):
    """Its weight balances drag along and across; between, it glides to the side."""
    along, across = 2.0, 3.5
    axis = np.array([math.cos(angle), 0.0, math.sin(angle)])
    model = rod(axis, (along, across), modulus=1e9, gravity=(0.0, 0.0, -9.81))
    solver = Dynamics(model, step=0.02, compiled=compiled)
    for _ in range(25):
        motion = solver.advance([])
    weight = np.array([0.0, 0.0, -9.81 * model.mass / LENGTH])
    normal = np.array([-axis[2], 0.0, axis[0]])
    expected = axis * (axis @ weight) / along + normal * (normal @ weight) / across
    middle = model.blocks[0].chain[ELEMENTS]
    assert motion.velocity[middle] == pytest.approx(expected, rel=1e-4, abs=1e-7)
    # Weight lost is heat, beyond what implicit Euler loses of the motion itself at the start.
    fallen = motion.potential + motion.kinetic + motion.dissipated
    assert -0.2 * motion.dissipated < fallen < 0.0


def test_an_undulating_filament_swims_as_gray_and_hancock_found():
    """Speed over that of the wave: b^2 k^2 (C_n - C_t) / (2 C_t + b^2 k^2 C_n), for a small slope b k."""
    along, across, slope = 1.0, 1.9, 0.15
    count, waves = 40, 2
    number = 2.0 * math.pi * waves / LENGTH
    size = slope / number
    s = np.linspace(0.0, LENGTH, 2 * count + 1)
    builder = ModelBuilder(floating=True)
    frames = []
    for x in s:
        angle = math.atan(slope * math.cos(number * x))
        c, d = math.cos(angle), math.sin(angle)
        turn = np.array([[c, -d, 0.0], [d, c, 0.0], [0.0, 0.0, 1.0]])
        frames.append(builder.add_frame((x, size * math.sin(number * x), 0.0), turn))
    options = {"young_modulus": 1e6, "poisson_ratio": 0.45, "density": 1e3, "drag": (along, across)}
    builder.add_element(Beam, frames, section=Section.circle(RADIUS), **options)
    model = builder.build()
    beam, rows = model.blocks[0], np.array(frames)
    assert isinstance(beam, Beam)

    def force(forward, wave_speed):
        velocity, gradient = np.zeros_like(model.nodes), np.zeros_like(model.nodes)
        velocity[rows, 0] = forward
        velocity[rows, 1] = -size * number * wave_speed * np.cos(number * s)
        beam.add_damping(model.nodes, StrainRates(model.nodes, model.nodes, velocity, 1.0, 0.0), gradient, None, None)
        return gradient[:, 0].sum()

    # Forces are linear in velocities, and those along the way vanish together.
    speed = -force(0.0, 1.0) / force(1.0, 0.0)
    expected = -(slope**2) * (across - along) / (2.0 * along + slope**2 * across)
    assert speed == pytest.approx(expected, rel=0.02)  # terms of the fourth power of the slope
    assert speed < 0.0  # against the wave


def test_both_solvers_swim_alike():
    drag = slender_drag(1.0, LENGTH, RADIUS)
    model = rod((1.0, 0.2, 0.1), drag, chambers=True)
    one = Dynamics(model, step=H, stiffness_damping=0.01, tolerance=1e-12)
    other = Dynamics(model, step=H, stiffness_damping=0.01, tolerance=1e-12, compiled=False)
    assert one.not_compiled is None
    for k in range(20):
        found, expected = one.advance(wave(H * (k + 1))), other.advance(wave(H * (k + 1)))
    places = model.blocks[0].chain
    assert np.abs((found.equilibrium.x - expected.equilibrium.x)[places]).max() < 1e-10
    W, exact = found.equilibrium.condensed.compliance, expected.equilibrium.condensed.compliance
    assert W == pytest.approx(exact, rel=1e-6, abs=1e-6 * np.abs(exact).max())
    assert found.dissipated == pytest.approx(expected.dissipated, rel=1e-6)
    # Without the fluid the middle of mass cannot move.
    start = rod((1.0, 0.2, 0.1), (0.0, 0.0), chambers=True)
    dry = Dynamics(start, step=H, stiffness_damping=0.01, tolerance=1e-12)
    for k in range(20):
        dry.advance(wave(H * (k + 1)))
    mass = start.assembly.mass_matrix().rows.toarray()[np.ix_(places, places)].sum(axis=0)
    assert mass.sum() == pytest.approx(start.mass)
    assert np.abs(mass @ (dry.x - start.nodes)[places]).max() / start.mass < 1e-9
    assert np.abs(mass @ (one.x - start.nodes)[places]).max() / start.mass > 1e-5


def test_derivatives_through_swimming():
    """By commands and by resistance, length and stiffness, from the undeformed body."""
    values = np.array([1.0, 0.5])

    def build(design):
        return rod(
            (1.0, 0.2, 0.1), slender_drag(1.0 * design[0], LENGTH, RADIUS), modulus=2e6 * design[1], chambers=True
        )

    def roll(design, commands):
        return roll_out(Dynamics(build(design), step=H, stiffness_damping=0.01, tolerance=1e-12), commands)

    commands = np.array([wave(H * (k + 1)) for k in range(40)])
    rollout = roll(values, commands)
    start = rollout.dynamics.model.nodes  # rest rows of all designs
    by_x = np.zeros_like(rollout.x)
    by_x[:, ::4] = np.random.default_rng(0).normal(size=by_x[:, ::4].shape)
    found = rollout.gradient(by_x=by_x, neighbours=Neighbours.of(build, values, [1e-5, 1e-5]))
    for k in range(2):
        step = 1e-3 * np.eye(2)[k]
        ends = [(by_x * (roll(values + sign * step, commands).x - start)).sum() for sign in (1.0, -1.0)]
        assert found.design[k] == pytest.approx((ends[0] - ends[1]) / 2e-3, rel=1e-5)
    way = 1e-13 * np.random.default_rng(1).normal(size=commands.shape)
    ends = [(by_x * (roll(values, commands + sign * way).x - start)).sum() for sign in (1.0, -1.0)]
    assert (found.commands * way).sum() == pytest.approx(0.5 * (ends[0] - ends[1]), rel=1e-4)
