"""Grasps of the contact-aided finger: objects, objectives, and closing on a coarse mesh."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.grasping.grasps import KINDS, Grasp, GraspObject, evaluate_grasp
from softgym_envs.mechanics.solvers.statics import Statics

RECORD = Grasp(
    status="ok",
    reason="",
    angle=np.array([0.1, 0.2, 0.3, 0.4]),
    torque=np.array([0.05, 0.10, 0.30, 0.60]),
    force=np.array([[0.0, 0.0, 0.0], [1e-4, 0.0, 0.0], [2.0, 0.5, 0.0], [5.0, 1.0, 0.0]]),
    contacts=np.array([0, 1, 8, 12]),
    sliding=np.array([0, 1, 2, 0]),
    gap=np.array([np.inf, 5e-4, 4e-4, 4e-4]),
    torque_limited=False,
    nodes=100,
    iterations=np.array([3, 3, 6, 6]),
)


@pytest.fixture(scope="module")
def robot():
    """A coarse finger: it locks, but its equilibria are found in an instant."""
    return make_robot("contact_aided_finger", control_points=7, mesh_size=12e-3, element="linear")


@pytest.fixture(scope="module")
def closed(robot):
    return evaluate_grasp(robot, {}, angles=8)


# -- objectives -----------------------------------------------------------------------------------------------------


def test_objectives_of_a_recorded_grasp():
    """Equations 3.10, 3.11 and 3.13 of the thesis; a force of 0.1 mN is no contact."""
    assert RECORD.contact_force == 5.0
    assert RECORD.grasp_resistance == pytest.approx(0.60 / 5.0)
    assert RECORD.grasp_energy == pytest.approx(0.05 * 0.1 + 0.10 * 0.2 + 0.30 * 0.3 + 0.60 * 0.4)


def test_signs_do_not_matter():
    turned = replace(RECORD, torque=-RECORD.torque, force=-RECORD.force)
    for name in ("contact_force", "grasp_resistance", "grasp_energy"):
        assert getattr(turned, name) == getattr(RECORD, name)


def test_a_finger_that_reaches_nothing():
    free = replace(RECORD, force=np.zeros((4, 3)))
    assert free.contact_force == 0.0
    assert free.grasp_resistance == math.inf
    assert free.grasp_energy == RECORD.grasp_energy


# -- objects --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_nearest_point_of_each_object(kind):
    obstacle = GraspObject(kind, distance=0.030, height=0.070, offset=0.002, size=0.040, friction=0.3).obstacle(0.033)
    assert obstacle.friction == 0.3
    points = np.array([[0.060, 0.070, 0.002], [0.063, 0.070, 0.002], [0.064, 0.070, 0.002]])
    np.testing.assert_allclose(obstacle.gap(points), [0.003, 0.0, -0.001], atol=1e-12)


def test_axes_of_prisms():
    """Along its axis, a prism is as wide as at its middle; a corner lies behind the flat side that faces the finger."""
    upright, lying = (GraspObject(kind, distance=0.030).obstacle(0.033) for kind in ("hexagon", "horizontal_hexagon"))
    assert upright.gap(np.array([[0.060, 0.100, 0.0]])) == pytest.approx(0.003)
    assert lying.gap(np.array([[0.060, 0.050, 0.050]])) == pytest.approx(0.003)
    assert lying.gap(np.array([[0.063, 0.100, 0.0]])) > 0.010
    assert upright.gap(np.array([[0.063, 0.050, 0.050]])) > 0.010


def test_unknown_kinds_are_named():
    with pytest.raises(ValueError, match="unknown kind of object 'cube'; .*allowed: plane, hexagon"):
        GraspObject("cube").obstacle(0.033)


# -- closing --------------------------------------------------------------------------------------------------------


def test_closing_on_the_plane(closed):
    assert closed.status == "ok" and closed.reason == ""
    np.testing.assert_allclose(closed.angle, np.radians(30.0) * np.arange(1, 9) / 8)
    assert (np.diff(closed.torque) > 0.0).all() and closed.torque[0] > 0.0
    touches = closed.contacts > 0
    assert touches.any() and not touches[0]
    assert (closed.force[touches, 0] > 0.0).all()  # away from the finger
    np.testing.assert_array_equal(closed.force[~touches], 0.0)
    assert (closed.gap > 0.0).all() and (closed.gap[touches] < 5e-4).all()
    # Coulomb's law for the sum of all points.
    across = np.linalg.norm(closed.force[:, 1:], axis=1)
    assert (across <= 0.85 * closed.force[:, 0] + 1e-9).all()
    assert closed.contact_force == closed.force[-1, 0]


def test_torque_is_the_derivative_of_the_work(robot):
    """Without friction, contact forces derive from an energy: the work of the servo does not depend on the steps."""
    plane = GraspObject(friction=0.0)
    few, many = (evaluate_grasp(robot, {}, plane, angles=k, self_friction=0.0) for k in (4, 12))
    np.testing.assert_allclose(many.torque[2::3], few.torque, rtol=1e-4)
    np.testing.assert_allclose(many.force[2::3], few.force, rtol=1e-3, atol=1e-5)


def test_closing_stops_at_the_largest_torque(robot, closed):
    weak = make_robot("contact_aided_finger", control_points=7, mesh_size=12e-3, element="linear")
    limit = 0.5 * (closed.torque[4] + closed.torque[5])
    weak.actuators = (replace(robot.actuators[0], max_effort=limit),)
    grasp = evaluate_grasp(weak, {}, angles=8)
    assert grasp.status == "ok" and grasp.torque_limited
    np.testing.assert_allclose(grasp.torque, closed.torque[:5])
    assert not closed.torque_limited


@pytest.mark.parametrize("kind", ["sphere", "horizontal_hexagon"])
def test_closing_on_other_objects(robot, kind):
    grasp = evaluate_grasp(robot, {}, GraspObject(kind, height=0.080), angle=math.radians(25.0), angles=5)
    assert grasp.status == "ok"
    assert grasp.contact_force > 0.0
    assert (grasp.gap > 0.0).all()


def test_sliding_on_an_object_needs_no_potential(robot):
    """Friction of sliding points has no potential: good Newton steps climb what the line search takes for one."""
    design = {
        **dict(e1=0.0124, e2=0.0075, e3=0.0035),
        **{f"d{k}": d for k, d in enumerate((0.0137, 0.0269, 0.0272, 0.0209, 0.0136, 0.0222, 0.0123))},
    }
    ball = GraspObject("sphere", distance=20.1e-3, height=82e-3, offset=-1e-3, size=40e-3)
    grasp = evaluate_grasp(robot, design, ball, angle=math.radians(20.0), angles=5)
    assert grasp.status == "ok", grasp.reason
    assert grasp.sliding.max() > 0 and grasp.contact_force > 0.1
    assert grasp.iterations.sum() < 60


def test_an_object_inside_the_finger_is_infeasible(robot):
    grasp = evaluate_grasp(robot, {}, GraspObject(distance=-0.005))
    assert grasp.status == "infeasible" and "object at rest" in grasp.reason
    assert len(grasp.angle) == 0 and grasp.contact_force == 0.0 and grasp.grasp_resistance == math.inf


def test_a_body_that_cannot_be_built_is_infeasible():
    narrow = make_robot("contact_aided_finger", width=0.012)
    grasp = evaluate_grasp(narrow)
    assert grasp.status == "infeasible" and "crosses itself" in grasp.reason and grasp.nodes == 0


def test_a_finger_that_does_not_close_says_how_far_it_came(robot, closed, monkeypatch):
    solve = Statics.solve

    def fail(self, target, *args, **options):
        if target[0] > 0.25:
            raise ConvergenceError("stuck")
        return solve(self, target, *args, **options)

    monkeypatch.setattr(Statics, "solve", fail)
    grasp = evaluate_grasp(robot, {}, angles=8)
    assert grasp.status == "no equilibrium"
    assert grasp.reason == "no equilibrium beyond 11.25 degrees: stuck"
    np.testing.assert_allclose(grasp.torque, closed.torque[:3])


def test_a_finger_that_closes_too_slowly_gives_up(robot, closed, monkeypatch):
    most = int(closed.iterations[:3].sum()) - 1
    monkeypatch.setattr("softgym_envs.extensions.grasping.grasps.MAX_ITERATIONS", most)
    found = evaluate_grasp(robot, {}, angles=8)
    assert found.status == "no equilibrium" and f"more than {most} Newton iterations" in found.reason
    assert len(found.angle) == 3


def test_a_finger_closes_among_its_obstacles_with_its_law_of_contact(robot, closed):
    options = {"control_points": 7, "mesh_size": 12e-3, "element": "linear"}
    wall = GraspObject().obstacle(robot.width)
    among = make_robot("contact_aided_finger", obstacles=[wall], **options)
    grasp = evaluate_grasp(among, {}, GraspObject(distance=0.2), angles=8)
    np.testing.assert_allclose(grasp.torque, closed.torque, rtol=1e-6)
    np.testing.assert_array_equal(grasp.contacts, closed.contacts)
    np.testing.assert_array_equal(grasp.force, 0.0)  # of the object, which is far away
    wide = make_robot("contact_aided_finger", contact_distance=1e-3, **options)
    gaps = evaluate_grasp(wide, {}, angles=8).gap[closed.contacts > 0]
    assert ((gaps > 5e-4) & (gaps < 1e-3)).all()


def test_bugs_surface(robot, monkeypatch):
    monkeypatch.setattr(Statics, "solve", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        evaluate_grasp(robot)


@pytest.mark.parametrize("options", [{"angle": 0.0}, {"angle": 4.0}, {"angles": 0}])
def test_wrong_angles(robot, options):
    with pytest.raises(ValueError, match="angle"):
        evaluate_grasp(robot, **options)
