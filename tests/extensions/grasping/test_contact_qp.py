"""Inverse control with contact, on linear models with known answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from softgym_envs.control import InverseQP
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.grasping import ContactQP, ForceGoal
from softgym_envs.mechanics.condensation import CondensedModel, Row
from tests.verification.contact_control import random_problem, random_problems

MM = 1e-3


def finger(opening=2 * MM, force=0.0, wall=True):
    """A point in the plane, moved along x and y by two actuators of 1 mm/N; a wall bounds its x."""
    # Rows: actuators, x and y of the point, opening of the wall. Other actuators pull the point directly.
    own = np.diag([0.5 * MM, 0.5 * MM])
    motion = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
    W = 1 * MM * motion @ motion.T
    W[:2, :2] += own
    W[4, 4] += 0.2 * MM
    effort = np.array([0.0, 0.0, 0.0, 0.0, force])
    delta = np.array([0.0, 0.0, 0.0, 0.0, opening])
    rows = (*(Row(name, "m", "N") for name in ("left", "right", "x", "y", "wall")),)
    model = CondensedModel(W, delta - W @ effort, effort, (("a", 2), ("e", 2), ("c", 1)), rows)
    if wall:
        return model
    return replace(
        model,
        compliance=W[:4, :4],
        free=model.free[:4],
        effort=effort[:4],
        roles=(("a", 2), ("e", 2)),
        rows=rows[:4],
    )


def controller(**options):
    return ContactQP(np.full(2, -0.05), np.full(2, 0.05), np.full(2, 0.02), np.zeros(2, dtype=bool), **options)


def test_without_contacts_it_is_the_inverse_qp():
    for seed in range(20):
        case = random_problem(np.random.default_rng(seed), 0)
        own = case.controller
        plain = InverseQP(own.lower, own.upper, own.rates, own.unilateral, max_effort=own.max_effort)
        expected = plain.solve(case.model, case.goal, case.command)
        assert own.solve(case.model, case.goal, case.command) == pytest.approx(expected, abs=1e-8)
        assert own.effort == pytest.approx(plain.effort, abs=1e-5)


def test_a_contact_that_is_not_reached_changes_nothing():
    goal = np.array([1 * MM, 1 * MM])
    touching, free = controller(), controller()
    command = touching.solve(finger(), goal, np.zeros(2))
    assert command == pytest.approx(free.solve(finger(wall=False), goal, np.zeros(2)), abs=1e-8)
    assert touching.contact_force == pytest.approx([0.0], abs=1e-12)
    assert touching.opening == pytest.approx([1 * MM], abs=2e-6)


def test_the_wall_limits_motion_and_carries_no_force_that_does_not_help():
    qp = controller(step_weight=0.0)
    qp.solve(finger(), np.array([5 * MM, 1 * MM]), np.zeros(2))
    # Towards the goal, the wall is pressed until the barrier has yielded by as much as the effort is worth.
    assert qp.opening == pytest.approx([0.0], abs=1e-12)
    assert qp.effector[1] == pytest.approx(1 * MM, rel=1e-3)
    assert qp.contact_force[0] >= 0.0


@pytest.mark.parametrize("start", [{"opening": 2 * MM}, {"opening": 0.0, "force": 3.0}], ids=["open", "pressing"])
def test_force_goals_are_reached_from_both_sides(start):
    qp = controller(step_weight=0.0)
    qp.solve(finger(**start), None, np.zeros(2), forces=[ForceGoal({"wall": 1.0}, 1.0)])
    assert qp.contact_force == pytest.approx([1.0], rel=1e-3)
    assert qp.opening == pytest.approx([0.0], abs=1e-12)


@pytest.mark.parametrize(("lower", "upper", "expected"), [(0.0, 2.0, 0.5), (1.0, np.inf, 1.0), (0.0, 0.2, 0.2)])
def test_ranges_of_forces_act_only_at_their_ends(lower, upper, expected):
    """With the effort as the only other aim, a force inside the range drops to the cheapest end."""
    qp = controller(effort_weight=0.0, step_weight=1e-4)
    qp.solve(finger(0.0, 0.5), None, np.zeros(2), forces=[ForceGoal({"wall": 1.0}, lower, upper)])
    assert qp.contact_force == pytest.approx([expected], rel=1e-2)


def test_position_and_force_goals_together():
    qp = controller(step_weight=0.0)
    qp.goal_weights = np.array([0.0, 1.0])
    qp.solve(finger(), np.array([0.0, 3 * MM]), np.zeros(2), forces=[ForceGoal({"wall": 1.0}, 2.0)])
    assert qp.contact_force == pytest.approx([2.0], rel=1e-3)
    assert qp.effector[1] == pytest.approx(3 * MM, rel=1e-3)


def test_a_goal_behind_the_wall_is_reached_by_pushing_off():
    """Two outputs, one actuator, one contact: only the reaction of the wall moves the second output."""
    W = MM * np.array([[1.0, 1.0, 0.0, -0.5], [1.0, 2.0, 0.0, -0.5], [0.0, 0.0, 2.0, 0.8], [-0.5, -0.5, 0.8, 1.0]])
    assert np.linalg.eigvalsh(W)[0] > 0.0
    free = np.array([0.0, 0.0, 0.0, 1 * MM])
    model = CondensedModel(W, free, np.zeros(4), (("a", 1), ("e", 2), ("c", 1)))
    options = {"step_weight": 0.0, "effort_weight": 0.0, "goal_weights": np.array([0.0, 1.0])}
    qp = ContactQP(np.zeros(1), np.full(1, 0.02), np.full(1, 0.02), np.zeros(1, dtype=bool), **options)
    qp.solve(model, np.array([0.0, 2 * MM]), np.zeros(1))
    assert qp.effector[1] == pytest.approx(2 * MM, rel=1e-6)
    assert qp.contact_force == pytest.approx([2.5], rel=1e-6)


def test_results_satisfy_the_model_and_the_limits():
    for seed in range(30):
        case = random_problem(np.random.default_rng(seed), 4)
        qp, model = case.controller, case.model
        command = qp.solve(model, case.goal, case.command, forces=case.forces)
        effort = model.effort.copy()
        effort[model.slices["a"]], effort[model.slices["c"]] = qp.effort, qp.contact_force
        predicted = model.free + model.compliance @ effort
        assert predicted[model.slices["a"]] == pytest.approx(qp.displacement, abs=1e-12)
        assert predicted[model.slices["c"]] == pytest.approx(qp.opening, abs=1e-12)
        assert predicted[model.slices["e"]] == pytest.approx(qp.effector, abs=1e-12)
        assert (np.minimum(qp.contact_force, qp.opening * 1e3) <= 1e-6).all()
        assert (qp.contact_force >= -1e-9).all()
        assert (qp.opening >= -1e-12).all()
        assert (np.abs(command - case.command) <= qp.rates + 1e-12).all()
        assert (command >= 0.0).all()
        assert (command <= 0.02).all()
        assert (qp.effort <= 10.0 + 1e-6).all()


def test_results_do_not_depend_on_units():
    """Displacements in mm and forces in mN, for the same weights."""
    for seed in range(5):
        case = random_problem(np.random.default_rng(seed), 3)
        expected = case.controller.solve(case.model, case.goal, case.command)
        force = case.controller.contact_force
        own, model = case.controller, case.model
        small = replace(model, compliance=model.compliance, free=1e3 * model.free, effort=1e3 * model.effort)
        other = ContactQP(
            1e3 * own.lower, 1e3 * own.upper, 1e3 * own.rates, own.unilateral, max_effort=1e3 * own.max_effort
        )
        assert other.solve(small, 1e3 * case.goal, 1e3 * case.command) == pytest.approx(1e3 * expected, abs=1e-6)
        assert other.contact_force == pytest.approx(1e3 * force, abs=1e-3)


def test_the_enumerated_optimum_is_found():
    found = random_problems(40, seed=5)
    assert found["hit_rate"] == 1.0
    assert found["share_with_contacts_opened_or_closed"] > 0.2


def test_wrong_arguments_are_named():
    qp = controller()
    with pytest.raises(ValueError, match="contact 'floor'.*wall"):
        qp.solve(finger(), None, np.zeros(2), forces=[ForceGoal({"floor": 1.0}, 1.0)])
    with pytest.raises(ValueError, match="contact 'wall'"):
        qp.solve(finger(wall=False), None, np.zeros(2), forces=[ForceGoal({"wall": 1.0}, 1.0)])
    with pytest.raises(ValueError, match="goal must be 2"):
        qp.solve(finger(), np.zeros(3), np.zeros(2))
    for contacts, lower, upper, weight, message in (
        ({}, 0.0, None, 1.0, "factors"),
        ({"wall": np.nan}, 0.0, None, 1.0, "factors"),
        ({"wall": 1.0}, 2.0, 1.0, 1.0, "lower <= upper"),
        ({"wall": 1.0}, -np.inf, 1.0, 1.0, "lower <= upper"),
        ({"wall": 1.0}, 0.0, None, 0.0, "weight"),
    ):
        with pytest.raises(ValueError, match=message):
            ForceGoal(contacts, lower, upper, weight)


def test_limits_that_no_set_meets_raise():
    # The effort exceeds its limit by more than one step of the displacements can undo.
    model = finger()
    model = replace(model, effort=model.effort + np.array([30.0, 0.0, 0.0, 0.0, 0.0]))
    qp = controller(max_effort=np.full(2, 1.0))
    with pytest.raises(ConvergenceError, match="no set"):
        qp.solve(model, None, model.delta.a)
