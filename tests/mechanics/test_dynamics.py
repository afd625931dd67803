"""Dynamics: conservation, convergence, frequencies, energies, commands, divided steps and invalid input."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.beams.servo import Servo
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.elements.rigid import sphere_inertia
from softgym_envs.mechanics.solvers.dynamics import SCHEMES, Dynamics
from tests.verification import dynamics as cases


def by_case(rows):
    """Lists of rows by case, in the order of their settings."""
    result = {}
    for row in rows:
        result.setdefault(row.case, []).append(row)
    for case, group in result.items():
        print(case, [f"{r.setting}: {r.value:.5g}, {r.error:.2e} ({r.order:.2f})" for r in group])
    return result


def ball(**options):
    """A free ball of 2 kg with a radius of 0.1 m."""
    body = ModelBuilder(floating=True, gravity=cases.GRAVITY)
    frame = body.add_frame([0.0, 0.0, 0.0])
    body.add_mass(frame, 2.0, sphere_inertia(2.0, 0.1))
    model = body.build()
    model.add("e", Point("middle", EmbeddedPoints.in_frame(frame, np.zeros(3), model.nodes)))
    return Dynamics(model, **options)


# -- conservation and convergence -----------------------------------------------------------------------------------


def test_free_bodies_keep_energy_and_momenta():
    """Over 1000 steps of bending and spinning; measured: energy 1e-4 (beam, coarse steps), angular momentum 5e-5."""
    drifts = by_case(cases.conservation(1000))
    assert len(drifts) == 6
    for case, (row,) in drifts.items():
        assert row.error < (1e-10 if "linear" in case else 1e-3)


def test_orders_of_the_schemes():
    for case, group in by_case(cases.order(levels=(64, 128), fine=512)).items():
        if "euler" in case:
            assert 0.6 < group[-1].order < 1.3, case
        else:
            assert 1.8 < group[-1].order < 2.4, case
            assert group[-1].error < 5e-3


def test_the_spectral_radius_damps_motions_that_the_step_does_not_resolve():
    """With 1 the energy is constant; with less it falls, first that of fast motions, while the slow one remains."""
    kept = {}
    model = cases.rod(clamped=True, elements=3)
    (first, last), modes = (a[..., [0, -1]] for a in cases.eigenmodes(model, lumped=False, count=model.equations))
    for radius in (1.0, 0.5, 0.0):
        for name, mode, w in (("slow", modes[:, 0], first), ("fast", modes[:, 1], last)):
            step = 0.05 / first
            assert step * last > 50.0
            solver = Dynamics(model, step=step, scheme="generalised_alpha", spectral_radius=radius, tolerance=1e-13)
            solver.launch(1e-6 * mode / np.abs(mode).max() * w)
            start = sum(solver.energies())
            for _ in range(20):
                motion = solver.advance([])
            kept[name, radius] = motion.energy / start
    print(kept)
    assert kept["slow", 1.0] == pytest.approx(1.0, abs=1e-3) and kept["fast", 1.0] == pytest.approx(1.0, abs=1e-3)
    assert kept["slow", 0.5] > 0.99 and kept["slow", 0.0] > 0.98
    assert kept["fast", 0.5] < 1e-3 and kept["fast", 0.0] < 1e-3


@pytest.mark.parametrize("scheme", SCHEMES)
def test_free_fall(scheme):
    """The second order scheme is exact under a constant force; Euler's is late by half a step."""
    solver = ball(step=0.01, scheme=scheme)
    solver.launch(np.array([1.0, 0.0, 2.0, 0.0, 0.0, 5.0]))
    for _ in range(50):
        motion = solver.advance([])
    t = 0.5
    late = -0.5 * 9.81 * t * 0.01 if scheme == "euler" else 0.0
    expected = [t, 0.0, 2.0 * t - 0.5 * 9.81 * t**2 + late]
    np.testing.assert_allclose(motion.equilibrium.delta[:3], expected, rtol=0, atol=1e-9)
    assert motion.time == pytest.approx(t)
    np.testing.assert_allclose(solver.effector_velocity(), [1.0, 0.0, 2.0 - 9.81 * t], atol=1e-9)
    # Euler's directors move along chords, which also damps a spin.
    turning = 0.5 * 0.008 * 25.0
    kinetic = 0.5 * 2.0 * (1.0 + (2.0 - 9.81 * t) ** 2) + turning
    assert motion.kinetic == pytest.approx(kinetic, abs=0.25 * turning if scheme == "euler" else 1e-9)


@pytest.mark.parametrize("alpha", [0.5, 3.0])
def test_mass_damping_slows_a_free_body_exponentially(alpha):
    solver = ball(step=0.005, scheme="generalised_alpha", mass_damping=alpha)
    solver.model.set_gravity((0.0, 0.0, 0.0))
    solver.launch(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 2.0]))
    for _ in range(200):
        motion = solver.advance([])
    expected = np.exp(-alpha) * np.array([1.0, 0.0, 0.0, 0.0, 0.0, 2.0])
    np.testing.assert_allclose(
        solver.model.kinematics.equation_velocity(solver.x, solver.velocity), expected, atol=2e-5
    )
    start = 0.5 * 2.0 + 0.5 * 0.008 * 4.0
    assert motion.dissipated == pytest.approx(start - motion.kinetic, rel=0.02)


def test_stiffness_damping_of_the_first_mode():
    """A mode of angular frequency w decays as exp(-beta w^2 t / 2)."""
    model = cases.rod(clamped=True, elements=3)
    frequencies, modes = cases.eigenmodes(model, lumped=False, count=1)
    w = frequencies[0]
    beta, period = 0.1 / w, 2.0 * np.pi / w
    solver = Dynamics(model, step=period / 200, scheme="generalised_alpha", spectral_radius=1.0, stiffness_damping=beta)
    solver.launch(1e-4 * modes[:, 0] / np.abs(modes[:, 0]).max())
    start = sum(solver.energies())
    for _ in range(400):
        motion = solver.advance([])
    assert motion.energy / start == pytest.approx(np.exp(-beta * w**2 * 2 * period), rel=2e-2)
    assert motion.dissipated + motion.energy == pytest.approx(start, rel=2e-2)


def test_damping_dissipates_energy_under_any_load():
    """A bar bent by a strong cable, plucked: stiffness damping dissipates energy in every step."""
    solver = cases.pulled_bar_at_rest(step=0.01, stiffness_damping=0.05)
    for k in range(20):
        solver.advance([0.002 * (k + 1)])
    taken = [solver.advance([0.04 + 0.002 * (-1.0) ** (k // 3)]).dissipated for k in range(40)]
    print(np.diff(taken).min(), taken[-1])
    assert np.diff(taken).min() > 0.0


SPINNING = {
    "linear solid": lambda: cases.solid_bar(clamped=False),
    "quadratic solid": lambda: cases.solid_bar(clamped=False, cells=(4, 1, 1), element="quadratic"),
    "averaged solid": lambda: cases.solid_bar(clamped=False, element="averaged"),
    "beam": lambda: cases.rod(clamped=False, elements=2),
}


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("name", SPINNING)
def test_a_spinning_body_is_not_damped(name, scheme):
    """Three degrees per step; linear strain rates would take 17 to 44 % of the energy (measured now: 4e-4 at most)."""
    model = SPINNING[name]()
    spin, step = 1.0, 0.05
    solver = Dynamics(model, step=step, scheme=scheme, stiffness_damping=0.1)
    velocity = np.zeros((len(model.nodes), 3))
    arms = model.nodes - model.nodes.mean(axis=0)
    arms[(model.frames.rows[:, None] + np.arange(1, 4)).ravel()] = np.tile(np.eye(3), (len(model.frames.rows), 1))
    velocity[:, 0], velocity[:, 1] = -spin * arms[:, 1], spin * arms[:, 0]
    solver.launch(model.kinematics.equation_velocity(solver.x, velocity))
    start = solver.energies()[0]
    for _ in range(40):
        motion = solver.advance([])
    print(name, scheme, motion.dissipated / start, motion.kinetic / start)
    assert 0.0 <= motion.dissipated < 1e-3 * start


# -- frequencies ----------------------------------------------------------------------------------------------------


def test_bending_frequencies():
    """Consistent masses of linear elements give higher frequencies, lumped ones lower; all within 1 %."""
    rows = cases.frequencies(elements=12)
    assert len(rows) == 12
    for row in rows:
        print(f"{row.case} {row.setting}: {row.error:.1e}")
        assert abs(row.error) < 0.012 if "order 1, consistent" in row.setting else abs(row.error) < 0.002
    by = {(row.case, row.setting): row.value for row in rows}
    for k in (1, 2, 3):
        name = f"bending frequency {k}"
        for order in (1, 2):
            kind = f"beam of order {order}, "
            assert by[name, kind + "lumped"] < by[name, kind + "consistent"]


def test_frequencies_in_time():
    """The trapezoidal rule stretches a period by (w h)^2 / 12."""
    for row in cases.history(steps=150):
        print(row)
        assert row.error == pytest.approx(-((2.0 * np.pi * 3.0 / 150) ** 2) / 12.0, rel=0.2)


@pytest.mark.parametrize("lumped", [False, True])
def test_masses(lumped):
    """Translation has the mass of the body; a turn about an axis has its moment of inertia."""
    for model in (cases.solid_bar(clamped=False), cases.rod(clamped=False), cases.rigid_box()):
        matrix = model.assembly.mass_matrix(lumped).rows
        shift = np.zeros(model.equations)
        shift[: len(model.kinematics.free_dofs)] = model.kinematics.free_dofs % 3 == 1
        velocity = model.kinematics.row_velocity(model.nodes, shift)
        assert np.vdot(velocity, matrix @ velocity) == pytest.approx(model.mass, rel=1e-12)
    inertia = {}
    for lumped_ in (False, True):
        rod = cases.rod(clamped=False, elements=10)
        velocity = np.cross([0.0, 0.0, 1.0], rod.nodes)
        inertia[lumped_] = np.vdot(velocity, rod.assembly.mass_matrix(lumped_).rows @ velocity)
    radius = 0.01
    exact = rod.mass * (1.0 / 3.0 + 0.25 * radius**2)
    assert inertia[False] == pytest.approx(exact, rel=1e-10)
    assert inertia[True] == pytest.approx(exact, rel=2e-2 if lumped else 2e-2)


# -- actuators and energy -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", SCHEMES)
def test_compliance_is_the_derivative_of_a_step(scheme):
    """The second order scheme omits gyroscopic terms of frames (measured: 5e-5) and some of damping (0.03)."""
    for row in cases.compliance(scheme):
        print(row.case, row.setting, row.error)
        omits = scheme == "generalised_alpha" and ("Tetrapod" in row.case or "Rayleigh damping" in row.setting)
        assert row.error < (0.05 if omits else 1e-6)


def test_energies_add_up():
    """Euler only loses energy; the second order scheme misses 1e-4 of the work, with damping or without."""
    for case, group in by_case(cases.book_keeping(levels=(25, 50))).items():
        if "generalised_alpha" in case:
            assert abs(group[-1].error) < 1e-4
            assert group[-1].order == pytest.approx(2.0, abs=0.2)
        else:
            assert 0.0 < group[-1].error < 0.6 * group[0].error + 1e-3
            assert group[-1].error < 1e-2


def test_a_cable_that_hangs_slack_in_motion():
    """Released suddenly, the cable goes slack while the bar swings back, and is taut again at rest."""
    solver = cases.pulled_bar_at_rest(step=0.01, mass_damping=3.0)
    for k in range(30):
        taut = solver.advance([0.02 * (k + 1) / 30.0])
    assert not taut.equilibrium.slack.any()
    slack, efforts = [], []
    for _ in range(300):
        motion = solver.advance([0.005])
        slack.append(bool(motion.equilibrium.slack[0]))
        efforts.append(motion.equilibrium.effort[0])
        assert motion.equilibrium.delta[0] >= 0.005 - 1e-9
    assert any(slack) and not slack[-1]
    assert (np.array(efforts) >= 0.0).all()


def test_slow_motion_follows_statics():
    for row in cases.quasi_static(["tetrapod"], rest=20):
        print(row.setting, row.error)
        assert row.error < (1e-6 if "later" in row.setting else 1e-3)


# -- steps that fail, and steps taken back --------------------------------------------------------------------------


JUMP = np.array([3.0, -3.0, 1.5, 0.0])
"""Servo angles that no solver reaches in one step."""


def test_a_step_that_cannot_be_solved_is_cut():
    """Its command is ramped over the parts; the last part takes the command itself."""
    solver = cases.tetrapod_at_rest(step=0.01)
    motion = solver.advance(JUMP)
    assert motion.substeps > 4 and (motion.substeps & (motion.substeps - 1)) == 0
    assert motion.time == pytest.approx(0.01, rel=1e-12)
    np.testing.assert_allclose(motion.equilibrium.delta[:4], JUMP, rtol=0, atol=1e-10)
    # The same by hand.
    other = cases.tetrapod_at_rest(step=0.01 / motion.substeps)
    for k in range(motion.substeps):
        by_hand = other.advance((k + 1) / motion.substeps * JUMP)
    np.testing.assert_allclose(by_hand.equilibrium.delta, motion.equilibrium.delta, rtol=0, atol=1e-8)
    assert by_hand.work == pytest.approx(motion.work, rel=1e-6)


def test_a_step_that_cannot_be_cut_further_leaves_the_state():
    solver = cases.tetrapod_at_rest(step=0.01, max_cuts=1)
    solver.advance(0.01 * JUMP)
    kept = solver.snapshot
    before = [np.array(part, copy=True) for part in kept if part is not None]
    with pytest.raises(ConvergenceError, match="cannot advance 0.01 s to actuators .*, even in 2 steps") as caught:
        solver.advance(JUMP)
    assert caught.value.fraction == 0.0
    for part, old in zip([p for p in solver.snapshot if p is not None], before, strict=True):
        np.testing.assert_array_equal(part, old)
    assert solver.linearisation.inertia is None
    motion = solver.advance(0.02 * JUMP)  # and continues
    np.testing.assert_allclose(motion.equilibrium.delta[:4], 0.02 * JUMP, rtol=0, atol=1e-10)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_undone_steps_can_be_repeated_exactly(scheme):
    solver = cases.tetrapod_at_rest(step=0.01, scheme=scheme, stiffness_damping=0.01)
    path = [0.02 * k * np.array([1.0, -0.5, 0.3, 0.0]) for k in range(1, 9)]
    for command in path[:4]:
        solver.advance(command)
    kept = solver.snapshot
    first = [solver.advance(command) for command in path[4:]]
    solver.snapshot = kept
    again = [solver.advance(command) for command in path[4:]]
    for a, b in zip(first, again, strict=True):
        assert (a.equilibrium.x == b.equilibrium.x).all() and (a.velocity == b.velocity).all()
        assert (a.time, a.work, a.dissipated, a.kinetic) == (b.time, b.work, b.dissipated, b.kinetic)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_motion_continues_from_positions_efforts_and_velocities(scheme):
    """A state is enough to continue: exactly for Euler, to second order for the other scheme."""
    solver = cases.swinging(cases.rod(clamped=True, elements=3), 0.5, step=0.01, scheme=scheme)
    for _ in range(20):
        solver.advance([])
    x, effort, velocity = solver.x.copy(), solver.effort.copy(), solver.velocity.copy()
    for _ in range(20):
        expected = solver.advance([])
    solver.restore(x, effort, velocity)
    assert solver.time == 0.0
    for _ in range(20):
        motion = solver.advance([])
    assert motion.time == pytest.approx(0.2)
    error = np.abs(motion.equilibrium.delta - expected.equilibrium.delta).max()
    assert error < (1e-12 if scheme == "euler" else 1e-5)


def test_rest_and_reset():
    solver = cases.swinging(cases.rod(clamped=True, elements=2), 0.5, step=0.01)
    for _ in range(3):
        solver.advance([])
    x = solver.x.copy()
    solver.rest()
    assert (solver.x == x).all() and not solver.velocity.any() and solver.time == 0.0
    solver.reset()
    assert (solver.x == solver.model.nodes).all() and not solver.velocity.any()


def test_statics_of_the_same_model_are_not_disturbed():
    """Both share the model; each has its own linearisation."""
    from softgym_envs.mechanics.solvers.statics import Statics

    model = cases.pulled_bar()
    statics, solver = Statics(model), Dynamics(model, step=0.01)
    alone = statics.solve([0.01])
    solver.advance([0.002])
    statics.reset()
    again = statics.solve([0.01])
    np.testing.assert_allclose(again.x, alone.x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(again.condensed.compliance, alone.condensed.compliance, rtol=1e-6)


# -- the start ------------------------------------------------------------------------------------------------------


def test_the_starting_acceleration_of_a_spinning_body_is_exact():
    solver = Dynamics(cases.rigid_box(), step=0.01, scheme="generalised_alpha")
    solver.launch(np.concatenate([[0.1, 0.0, 0.0], cases.SPIN]))
    inertia = cases.box_inertia(1.0, np.array([0.1, 0.2, 0.4]))
    found = solver._starting_acceleration(np.zeros(0), "displacement")
    expected = -np.linalg.solve(inertia, np.cross(cases.SPIN, inertia @ cases.SPIN))
    np.testing.assert_allclose(found, [0.0, 0.0, 0.0, *expected], atol=1e-9)


@pytest.mark.parametrize("damping", [0.0, 2.0])
def test_the_starting_acceleration_of_a_pendulum(damping):
    """Held by a bond, swinging straight through its lowest point: towards the pivot, and slowed by damping."""
    solver = cases.pendulum(1, [0.0, 3.0, 0.0], step=0.01, scheme="generalised_alpha", mass_damping=damping)
    solver.model.set_gravity((-9.81, 0.0, 0.0))  # along the bar, towards the pivot
    found = solver._starting_acceleration(np.zeros(0), "displacement")
    np.testing.assert_allclose(found[0], -(3.0**2) * 0.2, rtol=1e-6)
    assert found[4] == pytest.approx(-3.0 * damping, rel=1e-5, abs=1e-6)
    np.testing.assert_allclose(found[2], -found[4] * 0.2, atol=1e-6)


# -- invalid input --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scheme": "newmark"}, "scheme = 'newmark' is unknown; allowed: euler, generalised_alpha"),
        ({"step": 0.0}, "step = 0.0 s must be positive and finite"),
        ({"step": -0.1}, "step = -0.1 s must be positive"),
        ({"step": np.nan}, "step = nan s must be positive"),
        ({"step": np.inf}, "step = inf s must be positive"),
        ({"mass_damping": -1.0}, "mass_damping = -1.0 must be finite and not negative"),
        ({"stiffness_damping": np.inf}, "stiffness_damping = inf must be finite and not negative"),
        ({"spectral_radius": 1.1}, r"spectral_radius = 1.1 is out of bounds; allowed: \[0, 1\]"),
        ({"spectral_radius": np.nan}, "spectral_radius = nan is out of bounds"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        ball(**{"step": 0.01, **options})


def test_bad_commands_and_launches():
    body = ModelBuilder()
    frame = body.add_frame([0.0, 0.0, 0.0], fixed=True, fixed_spin=(True, False, True))
    body.add_mass(frame, 1.0, sphere_inertia(1.0, 0.02))
    model = body.build()
    model.add("a", Servo("servo", frame, np.array([0.0, 1.0, 0.0]), model.nodes))
    model.add("e", Point("tip", EmbeddedPoints.in_frame(frame, np.array([0.1, 0.0, 0.0]), model.nodes)))
    solver = Dynamics(model, step=0.01)
    start = solver.x
    for target, options, message in (
        ([0.0, 0.0], {}, r"target must have shape \(1,\), got \(2,\)"),
        ([np.nan], {}, "target must be finite"),
        ([0.0], {"mode": "force"}, "mode must be 'displacement' or 'effort'"),
        ([0.0], {"effector_force": [1.0]}, r"effector_force must have shape \(3,\)"),
        ([0.0], {"contact": [1.0]}, "contact must have shape"),
        ([0.0], {"contact_mode": "pressure"}, "contact_mode must be"),
    ):
        with pytest.raises(ValueError, match=message):
            solver.advance(target, **options)
        assert solver.linearisation.inertia is None
        np.testing.assert_array_equal(solver.x, start)
    with pytest.raises(ValueError, match=r"velocity must have shape \(1,\), got \(3,\)"):
        solver.launch(np.zeros(3))


def test_an_impossible_start_is_reported():
    solver = cases.pulled_bar_at_rest(step=0.01, scheme="generalised_alpha", max_cuts=0)
    x = solver.x.copy()
    x[:, 2] *= -1.0
    solver.restore(x, solver.effort)
    with pytest.raises(ConvergenceError, match="cannot advance 0.01 s"):
        solver.advance([0.0])
    assert solver.linearisation.inertia is None


def test_every_case_is_tested():
    assert set(cases.CASES) == {
        "conservation", "order", "frequencies", "history", "rigid", "compliance", "book_keeping", "quasi_static",
        "workspace", "hanging", "random_designs", "robustness",
    }  # fmt: skip


def test_dynamics_prints_a_table_and_returns_json_data(monkeypatch, capsys):
    import json

    rows = [cases.Row("case", "one", 1.0), cases.Row("case", "two", 1.0, 2.0, -0.5, 1.99)]
    monkeypatch.setattr(cases, "CASES", {"some": lambda: rows})
    result = cases.dynamics()
    assert json.loads(json.dumps(result))["case | one"] == {
        "value": 1.0,
        "reference": None,
        "error": None,
        "order": None,
    }
    assert "1.99" in capsys.readouterr().out
