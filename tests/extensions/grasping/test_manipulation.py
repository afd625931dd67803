"""Algorithm 1: an object moved by fingers, on linear parts with known answers and on the finite elements."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softgym_envs import make_robot
from softgym_envs.control import InverseQP
from softgym_envs.extensions.grasping import Manipulation
from softgym_envs.extensions.grasping.control.coupling import HeldObject, rotate
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.mechanics.solvers.statics import Statics

TURN = np.diag([-1.0, -1.0, 1.0])
PLACES = ((np.eye(3), np.zeros(3)), (TURN, np.array([0.03, 0.07, 0.0])), (TURN, np.array([-0.03, 0.07, 0.0])))
CENTRE = np.array([0.0, 0.035, -0.095])


def bilateral(count, *, rate=1e-3, **options):
    return InverseQP(
        np.full(count, -0.002), np.full(count, 0.02), np.full(count, rate), np.zeros(count, dtype=bool), **options
    )


class Gripper:
    """One to three fingers of the thesis (sec. 4.3.2) whose contact points are driven to where the plan has them."""

    def __init__(self, count, **body):
        robot = make_robot("finger", contacts=True, unilateral=False)
        model = robot.build()
        self.places = PLACES[:count]
        rest = np.array([point.value(model.nodes) for point in model.constraints["c"]])
        contacts = np.concatenate([rest @ R.T + shift for R, shift in self.places])
        self.body = HeldObject.around(CENTRE, contacts, **body)
        self.fingers = [Statics(model) for _ in self.places]

    def models(self, command, body):
        result = []
        for k, (finger, (R, shift)) in enumerate(zip(self.fingers, self.places, strict=True)):
            contacts = (body.contacts.reshape(-1, 3, 3)[k] - shift) @ R
            part = finger.solve(
                command[2 * k : 2 * k + 2], contact=contacts.ravel(), contact_mode="displacement"
            ).condensed
            result.append(rotate(part, R, shift))
        return result

    def unbalanced(self, models, body):
        forces = np.concatenate([model.lambda_.c for model in models])
        return np.abs(body.jacobian.T @ forces - body.load)[np.array(body.free)].max()


def test_three_fingers_carry_a_cube_along_a_circle():
    """Goals on a circle of radius 1.5 mm (thesis, sec. 4.3.2), some calls each; the cube weighs 50 g."""
    gripper = Gripper(3, load=np.array([0.0, 0.0, -0.5, 0.0, 0.0, 0.0]))
    control = Manipulation(bilateral(6), gripper.body)
    assert not control.contact_forces.any()
    command = np.zeros(6)
    models = gripper.models(command, control.body)
    errors = []
    for angle in np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False):
        goal = CENTRE + 1.5e-3 * np.array([np.cos(angle), np.sin(angle), 0.0])
        for _ in range(6):
            plan = control.solve(models, goal, command)
            assert (np.abs(plan.command - command) <= 1e-3 * (1 + 1e-9)).all()
            command = plan.command
            models = gripper.models(command, plan.body)
        errors.append(np.linalg.norm(control.body.position - goal))
    # At its final pose, the fingers hold the cube in balance, as planned.
    assert gripper.unbalanced(models, control.body) < 1e-4
    np.testing.assert_allclose(np.concatenate([m.lambda_.c for m in models]), plan.contact_forces.ravel(), atol=1e-4)
    print(f"largest error {1e3 * max(errors):.4f} mm, force up to {np.abs(plan.contact_forces).max():.1f} N")
    assert max(errors) < 2e-5


def test_a_finger_presses_a_button():
    """A cube that one finger pushes against 1 N along y, nine goals; only y is controlled."""
    gripper = Gripper(1)
    control = Manipulation(bilateral(2, goal_weights=[0.0, 1.0, 0.0]), gripper.body)
    command = np.zeros(2)
    models = gripper.models(command, control.body)
    errors, load = [], np.zeros(6)
    for y in np.linspace(0.002, 0.014, 9):
        goal = CENTRE + [0.0, y, 0.0]
        for _ in range(8):
            load[1] = max(load[1] - 0.05, -1.0)
            plan = control.solve(models, goal, command, load=load)
            command = plan.command
            models = gripper.models(command, plan.body)
        errors.append(abs(control.body.position[1] - goal[1]))
        np.testing.assert_allclose(plan.contact_forces.sum(axis=0), load[:3], atol=1e-8)
    print(f"largest error {1e3 * max(errors):.5f} mm, tensions {np.round(plan.effort, 2)} N")
    assert max(errors) < 2e-6


# -- linear parts ---------------------------------------------------------------------------------------------------


def random_part(rng, contacts):
    half = rng.standard_normal((12, 24))
    W = 1e-3 * (half @ half.T / 12 + 0.2 * np.eye(12))
    free = np.concatenate([np.zeros(3), contacts.ravel()])
    return CondensedModel(W, free, np.zeros(12), (("a", 3), ("c", 9)))


@pytest.fixture
def held(rng):
    """Three parts with three cables each, and an object they hold."""
    contacts = 0.03 * rng.standard_normal((3, 3, 3))
    return [random_part(rng, c) for c in contacts], HeldObject.around(np.zeros(3), contacts.reshape(-1, 3))


def settled(models, plan):
    """The linear parts under a plan."""
    return [
        CondensedModel(m.compliance, m.free, every, m.roles)
        for m, every in zip(models, plan.coupled.efforts(plan.effort), strict=True)
    ]


def test_position_and_orientation_reach_their_goal(held):
    models, body = held
    wide = np.full(9, 0.1)
    control = Manipulation(InverseQP(-wide, wide, 0.05 * wide, np.zeros(9, dtype=bool), effort_weight=0.0), body)
    goal, rotation = np.array([5e-4, -3e-4, 2e-4]), Rotation.from_rotvec([0.01, -0.02, 0.015]).as_matrix()
    command = np.zeros(9)
    for _ in range(40):
        plan = control.solve(models, goal, command, rotation=rotation)
        command, models = plan.command, settled(models, plan)
    np.testing.assert_allclose(plan.body.position, goal, atol=1e-7)
    np.testing.assert_allclose(plan.body.rotation, rotation, atol=1e-5)


def test_a_measured_object_and_a_new_load_take_over(held):
    models, body = held
    control = Manipulation(bilateral(9), body)
    seen = body.moved(np.array([1e-4, 0.0, 0.0, 0.0, 0.0, 1e-3]))
    load = np.array([0.0, 0.0, -0.2, 0.0, 0.0, 0.0])
    plan = control.solve(models, np.zeros(3), np.zeros(9), body=seen, load=load)
    np.testing.assert_allclose(plan.contact_forces.sum(axis=0), load[:3], atol=1e-12)
    control.reset(body)
    other = control.solve(models, np.zeros(3), np.zeros(9))
    assert np.abs(plan.command - other.command).max() > 1e-7
    np.testing.assert_array_equal(plan.body.load, load)


def test_bad_input_is_an_error_and_the_state_is_kept(held):
    models, body = held
    control = Manipulation(bilateral(9), body)
    broken = CondensedModel(models[0].compliance * np.nan, models[0].free, models[0].effort, models[0].roles)
    for arguments, expected in [
        (([broken, *models[1:]], np.zeros(3), np.zeros(9)), "not finite"),
        ((models, np.full(3, np.nan), np.zeros(9)), "goal must be 3 finite"),
        ((models, np.zeros(3), np.zeros(8)), "command must be 9 finite"),
        ((models[:2], np.zeros(3), np.zeros(6)), "9 points, but the parts have 18 contact rows"),
    ]:
        with pytest.raises(ValueError, match=expected):
            control.solve(*arguments)
        assert control.body is body
    assert np.isfinite(control.solve(models, np.zeros(3), np.zeros(9)).command).all()
