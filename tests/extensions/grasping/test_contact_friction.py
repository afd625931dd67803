"""Inverse control that knows friction: against enumeration, by hand, and with an object that only friction holds."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.grasping import ContactQP
from softgym_envs.mechanics.condensation import ContactModel
from tests.verification.contact_friction import carry, random_friction_problem, random_problems

MM = 1e-3


@pytest.mark.parametrize("directions", [1, 2])
def test_the_enumerated_optimum_is_found(directions):
    found = random_problems({1: 10, 2: 10}, directions, seed=3)
    assert found["all"]["hit_rate"] == 1.0
    assert found["2 contacts"]["share_with_sliding"] > 0.1


@pytest.mark.parametrize("directions", [1, 2])
def test_results_obey_the_law_of_friction_and_the_model(directions):
    slid = stuck = 0
    for seed in range(25):
        case = random_friction_problem(np.random.default_rng(seed), 3, directions)
        qp, model = case.controller, case.model
        try:
            qp.solve(model, case.goal, case.command, forces=case.forces)
        except ConvergenceError:
            continue
        effort = model.effort.copy()
        for role, values in (("a", qp.effort), ("c", qp.contact_force), ("t", qp.friction_force)):
            effort[model.slices[role]] = values
        moved = model.free + model.compliance @ effort
        for role, values in (("a", qp.displacement), ("c", qp.opening), ("t", qp.slip), ("e", qp.effector)):
            assert moved[model.slices[role]] == pytest.approx(values, abs=1e-11)
        assert (np.minimum(qp.contact_force, 1e3 * qp.opening) < 1e-6).all() and (qp.opening > -1e-10).all()
        limit = (model.coefficient * qp.contact_force)[model.owner]
        left = limit - np.abs(qp.friction_force)
        assert (left > -1e-7).all()
        assert (np.abs(qp.slip[left > 1e-6]) < 1e-10).all()  # sticks
        sliding = (np.abs(qp.slip) > 1e-8) & (limit > 1e-6)
        assert (qp.slip * qp.friction_force)[sliding].max(initial=-1.0) < 0.0  # against the motion
        slid, stuck = slid + int(sliding.sum()), stuck + int((left > 1e-6).sum())
    assert slid > 5 and stuck > 5


@pytest.mark.parametrize(("coefficient", "sticks"), [(0.6, True), (0.4, False)])
def test_a_pressed_point_is_moved_only_beyond_the_limit_of_friction(coefficient, sticks):
    """One actuator pulls a point of 1 mm/N along a wall that presses it with 1 N; it may pull with up to 0.5 N."""
    W = MM * np.array([[1.0, 1.0, 0.0, 1.0], [1.0, 1.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.0], [1.0, 1.0, 0.0, 1.0]])
    W += 1e-6 * MM * np.eye(4)
    effort = np.array([0.0, 0.0, 1.0, 0.0])
    free = -W @ effort
    roles = (("a", 1), ("e", 1), ("c", 1), ("t", 1))
    known = {"coefficient": np.array([coefficient]), "owner": np.zeros(1, dtype=np.int64), "hold": np.zeros(2)}
    model = ContactModel(W, free, effort, roles, **known)
    limits = np.full(1, -0.01), np.full(1, 0.01), np.full(1, 0.01), np.zeros(1, dtype=bool)
    qp = ContactQP(*limits, max_effort=np.full(1, 0.5), effort_weight=1e-9, step_weight=0.0)
    qp.solve(model, np.array([1.0 * MM]), np.zeros(1))
    assert qp.contact_force == pytest.approx([1.0], abs=1e-6)
    assert qp.effector == pytest.approx([0.0 if sticks else 0.1 * MM], abs=1e-3 * MM)
    if not sticks:
        assert qp.friction_force == pytest.approx([-0.4], abs=1e-3) and qp.slip == pytest.approx([0.1 * MM], abs=1e-6)


def test_a_cube_that_only_friction_holds_is_carried():
    """No lower limit of the cables' forces: the controller itself keeps the grip."""
    found = carry("friction", goals=2)
    assert found["end"] == "held" and found["goals"] == 2
    assert found["largest_um"] < 10.0
    assert found["smallest_sum_of_normal_forces_N"] > 1.0
