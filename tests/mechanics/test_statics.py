"""Statics: reference equilibria, commands of both kinds, slack cables, continuation and failure."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from softgym_envs import make_robot, unchecked
from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.equilibrium import NewtonFailure
from softgym_envs.mechanics.solvers.linear import CholmodSolver, SuperLUSolver, make_solver
from softgym_envs.mechanics.solvers.split import SplitCholesky
from softgym_envs.mechanics.solvers.statics import Statics

# -- reference ------------------------------------------------------------------------------------------------------


def notched_beam(notched, **options):
    model = MechanicalModel.from_mesh(
        notched.nodes,
        notched.tetrahedra,
        fixed=notched.fixed,
        element="linear",
        young_modulus=3.0e6,
        poisson_ratio=0.3,
        **options,
    )
    model.add_cable("cable", notched.cable_points, notched.pull_point, unilateral=False)
    return model


def test_notched_beam_agrees_with_reference_equilibria(notched):
    """Same energy, same mesh: positions within 1e-5 mm, tension within 1e-5 N (measured: 1.4e-8 mm, 8e-9 N)."""
    model = notched_beam(notched)
    assert model.volume == pytest.approx(35200e-9, rel=1e-6)
    statics = Statics(model)
    assert len(notched.displacements) == 7
    for displacement, positions, force in zip(notched.displacements, notched.positions, notched.forces, strict=True):
        found = statics.solve([displacement])  # positive is shortening
        print(
            f"{displacement * 1e3:4.1f} mm: {np.abs(found.x - positions).max() * 1e3:.1e} mm, "
            f"{abs(found.effort[0] - force):.1e} N"
        )
        assert found.delta[0] == pytest.approx(displacement, abs=1e-10)
        np.testing.assert_allclose(found.x, positions, rtol=0, atol=1e-8)
        np.testing.assert_allclose(found.effort[0], force, rtol=0, atol=1e-5)
    assert force > 40.0  # the last one, at 10 mm of shortening: in tension
    # The reference says what its own linearisation and the true derivative are at 10 mm: 0.179 and 0.200 mm/N.
    assert found.condensed.W.aa[0, 0] * 1e3 == pytest.approx(0.200, abs=5e-4)


def test_simplified_corrections_save_factorisations(notched):
    """Most levels took three iterations; each iteration factorises once, and the last one gives the exact W."""
    model = notched_beam(notched)
    statics, found = Statics(model), []
    for displacement in notched.displacements:
        found.append(statics.solve([displacement]))
    assert [state.iterations for state in found] == [0, 2, 2, 2, 2, 2, 2]
    precise = Statics(model, tolerance=1e-14).solve([notched.displacements[-1]])
    np.testing.assert_allclose(found[-1].x, precise.x, rtol=0, atol=1e-10)
    np.testing.assert_allclose(found[-1].condensed.compliance, precise.condensed.compliance, rtol=1e-8)


@pytest.mark.parametrize("solver", ["cholmod", "superlu"])
def test_the_linear_solver_does_not_matter(notched, solver):
    found = Statics(notched_beam(notched, solver=solver)).solve([0.004])
    np.testing.assert_allclose(found.x, notched.positions[3], rtol=0, atol=1e-8)


def test_a_buckled_column_is_factorised_without_lu(notched, monkeypatch):
    """Free to move sideways, the compressed beam would buckle in both directions; its driven tip does not let it."""

    def press(solver):
        model = MechanicalModel.from_mesh(
            notched.nodes, notched.tetrahedra, fixed=notched.fixed, solver=solver, element="linear"
        )
        tip = np.array([0.1, 0.01, 0.01])
        model.add_contact("tip", tip)
        return Statics(model).solve([], contact=tip - [0.002, 0.0, 0.0], contact_mode="displacement")

    expected = press("superlu")
    monkeypatch.setattr(SuperLUSolver, "factorise", lambda self, values: pytest.fail("LU is far slower"))
    found = press("cholmod")
    assert not found.stable
    assert (np.linalg.eigvalsh(found.condensed.compliance) < 0.0).sum() == 2
    np.testing.assert_allclose(found.x, expected.x, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.condensed.compliance, expected.condensed.compliance, rtol=1e-7)


# -- commands -------------------------------------------------------------------------------------------------------


def test_displacement_and_effort_driven_agree(finger):
    target = finger.robot.upper * np.array([1.0, 0.9])[: len(finger.robot.actuators)]
    by_length = finger.statics.solve(target)
    assert (by_length.effort[: len(target)] > 1.0).all()
    np.testing.assert_allclose(by_length.delta[: len(target)], target, rtol=0, atol=1e-12)
    finger.statics.reset()
    by_force = finger.statics.solve(by_length.effort[: len(target)], "effort")
    np.testing.assert_allclose(by_force.x, by_length.x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(by_force.delta, by_length.delta, rtol=0, atol=1e-9)
    np.testing.assert_allclose(by_force.condensed.compliance, by_length.condensed.compliance, rtol=1e-6, atol=1e-12)


def test_modes_may_differ_per_actuator(fingers):
    _, model = fingers(2, "corotational")
    statics = Statics(model, tolerance=1e-12)
    mixed = statics.solve([0.008, 4.0], ["displacement", "effort"])
    assert mixed.delta[0] == pytest.approx(0.008, abs=1e-11)
    assert mixed.effort[1] == pytest.approx(4.0, abs=1e-11)
    same = Statics(model, tolerance=1e-12).solve(mixed.delta[:2])
    np.testing.assert_allclose(same.x, mixed.x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(same.effort[:2], mixed.effort[:2], rtol=0, atol=1e-6)


def test_warm_and_cold_starts_give_the_same_state(finger):
    count = len(finger.robot.actuators)
    target = 0.7 * finger.robot.upper
    cold = finger.statics.solve(target)
    paths = [[1.0, 0.3], [0.2, 0.9, 0.5], [0.0]]
    for path in paths:
        for fraction in path:
            finger.statics.solve(fraction * finger.robot.upper * np.array([1.0, 0.6])[:count])
        warm = finger.statics.solve(target)
        np.testing.assert_allclose(warm.x, cold.x, rtol=0, atol=1e-9)
        np.testing.assert_allclose(warm.effort, cold.effort, rtol=0, atol=1e-6)


def test_default_tolerance_is_met(fingers):
    """The default of 1e-10 m is kept against a much tighter solve, along a path of small steps."""
    _, model = fingers(2, "corotational")
    loose, tight = Statics(model), Statics(model, tolerance=1e-14)
    for fraction in np.linspace(0.1, 1.0, 6):
        difference = loose.solve([0.02 * fraction, 0.015]).x - tight.solve([0.02 * fraction, 0.015]).x
        assert np.abs(difference).max() < 1e-10


def test_unpulled_finger_stays_at_rest(finger):
    found = finger.statics.solve(np.zeros(len(finger.robot.actuators)))
    np.testing.assert_allclose(found.x, finger.model.nodes, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.effort, 0.0, atol=1e-9)


def test_pulling_bends_towards_the_cable_and_keeps_the_clamp(finger):
    found = finger.statics.solve(finger.robot.upper)
    assert found.delta[-2] > finger.robot.effector_rest[1] + 0.05  # y of the tip
    assert found.delta[-1] > finger.robot.effector_rest[2] + 0.04  # z: it curls up
    np.testing.assert_array_equal(found.x[finger.model.fixed], finger.model.nodes[finger.model.fixed])


def test_without_actuators_only_loads_act(box):
    nodes, tetrahedra = box((0.1, 0.02, 0.02), (4, 1, 1))
    model = MechanicalModel.from_mesh(nodes, tetrahedra, fixed=nodes[:, 0] == 0.0, young_modulus=1e6, element="linear")
    found = Statics(model).solve([])
    np.testing.assert_allclose(found.x, nodes, atol=1e-15)
    model.nodal_loads[-1, 2] = -0.5
    assert Statics(model).solve([]).x[-1, 2] < nodes[-1, 2] - 1e-3


def test_equilibrium_is_a_minimum_of_the_potential(beam, rng):
    """Independent of Newton: at prescribed tensions, nearby shapes have more energy less work."""
    found = Statics(beam, tolerance=1e-12).solve([3.0, 2.5], "effort")
    assert np.abs(found.x - beam.nodes).max() > 0.01

    def potential(x):
        return beam.energy(x) - found.effort @ beam.assembly.evaluate(x, np.zeros(5), beam.loads)[3]

    least = potential(found.x)
    for _ in range(20):
        noise = 1e-5 * rng.standard_normal(found.x.shape) * ~beam.fixed[:, None]
        assert potential(found.x + noise) > least


def test_scaling_youngs_modulus_scales_the_tensions_only(fingers):
    robot, model = fingers(1, "stable_neo_hookean")
    soft = robot.build({"young_modulus": 1.0e6})
    a, b = Statics(model, tolerance=1e-12).solve([0.015]), Statics(soft, tolerance=1e-12).solve([0.015])
    np.testing.assert_allclose(a.x, b.x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(a.effort, 3.0 * b.effort, rtol=1e-6)
    np.testing.assert_allclose(3.0 * a.condensed.compliance, b.condensed.compliance, rtol=1e-6, atol=1e-12)


def test_a_mirrored_command_gives_a_mirrored_tip(fingers):
    """The finger is symmetric about x = 0, its mesh nearly: pulling the other cable bends it the other way."""
    _, model = fingers(2, "corotational")
    left = Statics(model).solve([0.01, 0.004]).delta[2:]
    right = Statics(model).solve([0.004, 0.01]).delta[2:]
    np.testing.assert_allclose(right, left * [-1, 1, 1], atol=6e-4)  # the mesh is not symmetric
    assert abs(left[0]) > 5e-3


# -- slack ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "target", [(0.02, 0.0), (0.0, 0.02), (0.003, 0.015), (-0.01, 0.004), (-0.01, -0.002), (0.01, 0.01)]
)
@pytest.mark.parametrize("material", ["corotational", "stable_neo_hookean"])
def test_unilateral_cables_are_complementary(fingers, material, target):
    _, model = fingers(2, material)
    found = Statics(model, tolerance=1e-12).solve(target)
    effort, excess = found.effort[:2], found.delta[:2] - target
    assert (effort >= 0.0).all()
    assert (excess >= -1e-11).all()
    np.testing.assert_allclose(effort * excess, 0.0, atol=1e-10)
    assert (found.slack == (effort == 0.0)).all()
    if found.slack.any():
        assert excess[found.slack].max() > 1e-4
        # A slack cable has no effect: the state is that of zero tension.
        modes = ["effort" if s else "displacement" for s in found.slack]
        free = Statics(model, tolerance=1e-12).solve(np.where(found.slack, 0.0, target), modes)
        np.testing.assert_allclose(free.x, found.x, rtol=0, atol=1e-9)


def test_a_cable_goes_slack_and_taut_again(fingers):
    _, model = fingers(2, "corotational")
    statics = Statics(model, tolerance=1e-12)
    first = statics.solve([0.01, 0.01])
    assert not first.slack.any()
    assert list(statics.solve([0.01, 0.0]).slack) == [False, True]
    assert list(statics.solve([-0.01, -0.01]).slack) == [True, True]
    again = statics.solve([0.01, 0.01])
    assert not again.slack.any()
    np.testing.assert_allclose(again.x, first.x, rtol=0, atol=1e-9)


def test_bilateral_cables_can_push(finger):
    statics, count = finger.statics, len(finger.robot.actuators)
    assert statics.unilateral.all()
    held = statics.solve(np.full(count, -0.004))
    assert held.slack.all()
    np.testing.assert_allclose(held.x, finger.model.nodes, rtol=0, atol=1e-10)
    statics.unilateral[:] = False
    pushed = statics.solve(np.full(count, -0.004))
    assert not pushed.slack.any()
    assert (pushed.effort[:count] < -0.5).all()
    np.testing.assert_allclose(pushed.delta[:count], -0.004, rtol=0, atol=1e-11)
    assert pushed.delta[-2] < 0.0  # the tip moves away from the cables


def test_bilateral_and_unilateral_cables_together(fingers):
    """One cable of each kind: the reduced complementarity problem with an eliminated bilateral row."""
    _, model = fingers(2, "corotational")
    statics = Statics(model, tolerance=1e-12)
    statics.unilateral[:] = [False, True]
    found = statics.solve([0.012, 0.0])
    assert list(found.slack) == [False, True]
    assert found.delta[0] == pytest.approx(0.012, abs=1e-11)
    pushing = statics.solve([-0.003, 0.002])
    assert pushing.delta[0] == pytest.approx(-0.003, abs=1e-11)
    assert pushing.delta[1] == pytest.approx(0.002, abs=1e-11)
    assert pushing.effort[0] < 0.0 < pushing.effort[1]


# -- failure --------------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:outer walls of the body")  # where an impossible command ends, walls may cross
@pytest.mark.parametrize("mode", ["effort", "displacement"])
def test_an_impossible_command_reports_the_reached_fraction_and_keeps_the_last_state(finger, mode):
    statics, count = finger.statics, len(finger.robot.actuators)
    command = np.full(count, 1000.0 if mode == "effort" else 0.5)
    with pytest.raises(ConvergenceError, match=r"no equilibrium .*% of the increment") as caught:
        statics.solve(command, mode)
    fraction = caught.value.fraction
    assert 0.0 < fraction < 0.5
    assert f"{100 * fraction:.1f} %" in str(caught.value)
    assert mode in str(caught.value)
    # The state kept is the equilibrium of that part of the command ...
    kept = statics.x.copy()
    same = statics.solve(fraction * command, mode)
    np.testing.assert_allclose(same.x, kept, rtol=0, atol=1e-9)
    assert np.abs(kept - finger.model.nodes).max() > 1e-3
    # ... and the solver still works.
    after = statics.solve(0.5 * finger.robot.upper)
    fresh = Statics(finger.model, tolerance=1e-12).solve(0.5 * finger.robot.upper)
    np.testing.assert_allclose(after.x, fresh.x, rtol=0, atol=1e-9)


def test_an_absurd_effort_terminates(fingers):
    _, model = fingers(2, "corotational")
    statics = Statics(model)
    with pytest.raises(ConvergenceError) as caught:
        statics.solve([1e9, 0.0], "effort")
    assert 0.0 <= caught.value.fraction < 1e-3
    assert np.isfinite(statics.x).all()


def test_continuation_towards_a_limit_terminates(fingers, monkeypatch):
    """Even if Newton's method succeeds with ever smaller steps towards a limit, the increments must end."""
    _, model = fingers(2, "corotational")
    statics = Statics(model)
    limit, position, calls = 7.0, [0.0], []

    def newton(target, driven, **options):
        calls.append(target[0])
        if len(calls) > 3000:
            raise AssertionError("endless continuation")
        if target[0] - position[0] > 0.3 * (limit - position[0]):
            raise NewtonFailure
        position[0] = target[0]
        return 1

    monkeypatch.setattr(statics, "_newton", newton)
    with pytest.raises(ConvergenceError) as caught:
        statics.solve([10.0, 0.0], "effort")
    assert 0.3 < caught.value.fraction <= 0.7


def test_starting_from_an_inverted_shape_is_an_error(finger):
    x = finger.model.nodes.copy()
    x[~finger.model.fixed] *= -1.0
    finger.statics.restore(x, np.zeros(finger.model.assembly.size))
    with pytest.raises(ConvergenceError, match="starting state"):
        finger.statics.solve(np.zeros(len(finger.robot.actuators)))


def test_a_part_without_a_fixed_node_is_an_error(box):
    nodes, tetrahedra = box()
    both = np.vstack([nodes, nodes + 5.0])
    with pytest.raises((ConvergenceError, ValueError)):
        model = MechanicalModel.from_mesh(
            both, np.vstack([tetrahedra, tetrahedra + len(nodes)]), fixed=[0, 1, 3, 9], element="linear"
        )
        Statics(model).solve([])


@pytest.mark.parametrize(
    ("target", "mode", "message"),
    [
        ([np.nan, 0.0], "displacement", "finite"),
        ([0.0, np.inf], "effort", "finite"),
        ([0.01], "displacement", r"shape \(2,\)"),
        ([0.01, 0.01, 0.01], "effort", r"shape \(2,\)"),
        (0.01, "displacement", r"shape \(2,\)"),
        ([[0.01, 0.01]], "displacement", r"shape \(2,\)"),
        ([0.01, 0.01], "pressure", "mode must be"),
        ([0.01, 0.01], ["effort"], "mode must be"),
        ([0.01, 0.01], ["effort", "length"], "mode must be"),
    ],
)
def test_malformed_commands_are_rejected(fingers, target, mode, message):
    _, model = fingers(2, "corotational")
    statics = Statics(model)
    with pytest.raises(ValueError, match=message):
        statics.solve(target, mode)
    np.testing.assert_array_equal(statics.x, model.nodes)


def test_equilibria_under_heavy_dead_loads_are_found_from_rest(fingers):
    robot, _ = fingers(2, "corotational")
    model = robot.build({"young_modulus": 1.0e6, "poisson_ratio": 0.499})
    statics = Statics(model)
    for gravity in np.linspace(20.0, 200.0, 10):  # the equilibrium exists
        with unchecked("gravity"):
            model.set_gravity((0.0, gravity, gravity))
        statics.restore(statics.x, statics.effort)
        ramped = statics.solve([0.0, 0.0], "effort")
    np.testing.assert_allclose(Statics(model).solve([0.0, 0.0], "effort").x, ramped.x, rtol=0, atol=1e-8)


def test_cholmod_is_the_default_where_it_is_installed(notched):
    assembly = notched_beam(notched).assembly
    assert isinstance(make_solver("auto", assembly.indptr, assembly.indices), CholmodSolver)


def test_loads_that_change_after_a_solve_are_applied_in_steps(fingers):
    robot, _ = fingers(2, "corotational")
    model = robot.build({"young_modulus": 1.0e6, "poisson_ratio": 0.499})
    statics = Statics(model)
    statics.solve([0.0, 0.0], "effort")
    with unchecked("gravity"):
        model.set_gravity((0.0, 200.0, 200.0))
    changed = statics.solve([0.0, 0.0], "effort")
    assert changed.increments > 1  # one increment is not enough
    np.testing.assert_allclose(changed.x, Statics(model).solve([0.0, 0.0], "effort").x, rtol=0, atol=1e-8)


def test_two_statics_share_a_model(fingers):
    _, model = fingers(2, "corotational")
    first, second = Statics(model), Statics(model)
    first.solve([0.005, 0.004])
    second.solve([0.012, 0.001])
    again = first.solve([0.006, 0.005])
    fresh = Statics(model).solve([0.006, 0.005])
    np.testing.assert_allclose(again.x, fresh.x, rtol=0, atol=1e-9)
    assert again.iterations <= 3  # it did not use the other solver's tangent


def test_a_copied_model_is_complete(fingers):
    _, model = fingers(2, "corotational")
    expected = Statics(model).solve([0.01, 0.01])
    found = Statics(copy.deepcopy(model)).solve([0.01, 0.01])
    np.testing.assert_allclose(found.x, expected.x, rtol=0, atol=1e-12)
    assert found.increments == expected.increments


def test_a_cable_cannot_be_commanded_to_push(fingers):
    _, model = fingers(2, "corotational")
    with pytest.raises(ValueError, match=r"effort -3 on actuator row 1.*cannot push"):
        Statics(model).solve([1.0, -3.0], "effort")


def test_at_rest_no_cable_is_slack(fingers):
    _, model = fingers(2, "corotational")
    state = Statics(model).solve([0.0, 0.0])
    assert not state.slack.any() and state.stable


@pytest.mark.parametrize("solver", ["cholmod", "superlu"])
def test_a_column_beyond_its_buckling_load_is_not_stable(box, solver):
    nodes, tetrahedra = box((0.1, 0.01, 0.01), (10, 2, 2))
    model = MechanicalModel.from_mesh(
        nodes,
        tetrahedra,
        fixed=nodes[:, 0] < 1e-9,
        young_modulus=1e6,
        poisson_ratio=0.3,
        solver=solver,
        element="linear",
    )
    line = np.column_stack([np.linspace(0.01, 0.1, 10), np.full(10, 0.005), np.full(10, 0.005)])
    # Straight from the clamp, through the axis: its tension compresses the column.
    model.add_cable("axis", line[-1:], np.array([-0.01, 0.005, 0.005]))
    euler = np.pi**2 * 1e6 * (0.01**4 / 12) / (2 * 0.1) ** 2
    statics = Statics(model)
    assert statics.solve([0.2 * euler], "effort").stable
    assert not statics.solve([20.0 * euler], "effort").stable


def test_constraints_that_change_under_a_solver_are_detected(fingers):
    robot, _ = fingers(2, "corotational")
    model = robot.build()
    statics = Statics(model)
    statics.solve([0.0, 0.0])
    model.add_effector("late", model.nodes.mean(axis=0))
    with pytest.raises(ValueError, match="the model's constraints changed after this Statics was made; make a new one"):
        statics.solve([0.0, 0.0])
    assert len(Statics(model).solve([0.0, 0.0]).delta) == 2 + 3 + 3


def test_a_changed_elasticity_is_detected(fingers):
    robot, _ = fingers(2, "corotational")
    model = robot.build({"young_modulus": 1.0e6, "poisson_ratio": 0.45})
    statics = Statics(model)
    before = statics.solve([0.005, 0.0])
    model.solids[0].set_elasticity(2.0e6, 0.45)
    after = statics.solve([0.005, 0.0])
    np.testing.assert_allclose(after.effort[0], 2.0 * before.effort[0], rtol=1e-6)


def test_a_large_increment_is_divided_where_a_tangent_is_indefinite(monkeypatch):
    pytest.importorskip("cvxopt")
    design = {"length": 0.037, "height": 0.022, "joint_height": 0.008, "poisson_ratio": 0.499}
    model = make_robot("finger", cables=2, design_box="wide").build(design)
    in_steps = Statics(model)
    for pull in np.linspace(0.002, 0.02, 10):
        expected = in_steps.solve([pull, 0.0])
    factorised = []
    split = SplitCholesky.factorise
    monkeypatch.setattr(SplitCholesky, "factorise", lambda *args: factorised.append(1) or split(*args))
    found = Statics(model).solve([0.02, 0.0])
    assert found.increments > 1 and not factorised
    np.testing.assert_allclose(found.x, expected.x, atol=1e-9)


@pytest.mark.parametrize("solver", ["cholmod", "superlu"])
def test_short_increments_pass_over_indefinite_tangents(notched, solver):
    model = MechanicalModel.from_mesh(
        notched.nodes, notched.tetrahedra, fixed=notched.fixed, solver=solver, element="linear"
    )
    tip = np.array([0.1, 0.01, 0.01])
    model.add_contact("tip", tip)
    # Its driven tip does not let the compressed beam buckle, so there is no way around indefinite tangents.
    found = Statics(model).solve([], contact=tip - [0.004, 0.0, 0.0], contact_mode="displacement")
    assert not found.stable and found.increments > 1


def test_a_command_that_changes_nothing_costs_no_iteration(fingers):
    _, model = fingers(2, "corotational")
    statics = Statics(model)
    before = statics.solve([0.006, 0.005])
    again = statics.solve([0.006, 0.005])
    assert again.iterations == 0
    np.testing.assert_array_equal(again.x, before.x)
    np.testing.assert_array_equal(again.condensed.compliance, before.condensed.compliance)
    forced = statics.solve(again.effort[:2], "effort")  # the same equilibrium, commanded in another way
    assert forced.iterations == 0
    assert statics.solve(1.0001 * again.effort[:2], "effort").iterations > 0
    statics.restore(before.x, before.effort)
    assert statics.solve([0.006, 0.005]).iterations == 0
    assert Statics(model).solve([0.0, 0.0]).iterations == 0
    model.set_gravity((0.0, 0.0, -9.81))
    assert statics.solve([0.006, 0.005]).iterations > 0  # loads have changed
