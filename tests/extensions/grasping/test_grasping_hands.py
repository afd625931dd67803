"""Fingers that close on objects, and a hand that lifts a box and drops it."""

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.errors import InfeasibleDesign
from softgym_envs.extensions.beams.prism import RoundedPrism
from softgym_envs.extensions.grasping.grasps import KINDS
from softgym_envs.extensions.grasping.robots.carried_objects import CARRIED
from softgym_envs.extensions.grasping.robots.grasping_hands import ON_TABLE
from softgym_envs.mechanics.contact.obstacles import Plane, Sphere

COARSE = {"element": "linear", "mesh_size": 0.015}


@pytest.mark.parametrize("kind", KINDS)
def test_finger_closes_on_objects(kind):
    backend = FEMBackend(make_robot("grasping_finger", object=kind, **COARSE))
    assert not backend.state.contacts.count
    for angle in np.radians(np.arange(5.0, 41.0, 5.0)):
        state = backend.step([angle])
    force = -state.contacts.total[0]
    assert force[0] > 0.1 and abs(force[2]) < 0.1 * force[0]
    assert state.contacts.smallest_gap > 0.0
    # Coulomb's law holds at each point.
    forces, pressing = state.contacts.force, state.contacts.pressing
    along = np.sqrt((forces**2).sum(axis=1) - pressing**2)
    assert (along <= 0.85 * pressing * (1.0 + 1e-9)).all()


def test_any_object_is_a_variable():
    robot = make_robot("grasping_finger", object="any", **COARSE)
    kinds = (Plane, RoundedPrism, RoundedPrism, Sphere)
    for number, kind in enumerate(kinds):
        (obstacle,) = robot.build({"object_kind": number + 0.5}).contact.obstacles
        assert isinstance(obstacle, kind)
        assert obstacle.gap(np.array([[0.033 + 0.0301, 0.05, 0.0]]))[0] == pytest.approx(0.0, abs=1e-12)
    assert isinstance(robot.build({"object_kind": 4.0}).contact.obstacles[0], Sphere)
    with pytest.raises(ValueError, match="object = 'pyramid' is unknown; allowed: plane, hexagon"):
        make_robot("grasping_finger", object="pyramid")


def test_scene_does_not_change_the_body():
    robot = make_robot("grasping_finger", object="sphere", **COARSE)
    plain = robot.build().nodes
    for name in robot.scene:
        np.testing.assert_array_equal(robot.build({name: robot.design_space[name].high}).nodes, plain)


def test_an_object_inside_the_finger_is_infeasible():
    wide = {"e1": 0.012, "e3": 0.006, "object_gap": 0.010} | {f"d{k}": 0.028 for k in range(12)}
    with pytest.raises(InfeasibleDesign, match="at rest: the body is inside obstacle object"):
        make_robot("grasping_finger", **COARSE).build(wide)


def hand(object="box", **design):
    robot = make_robot("contact_aided_gripper", object=object, **COARSE)
    return robot, FEMBackend(robot, design, dynamics=True, time_step=0.05)


def grip_and_lift(backend, angle, height):
    for share in np.linspace(0.1, 1.0, 10):
        backend.step([share * angle, share * angle, 0.0])
    for lift in np.linspace(0.2 * height, height, 5):
        state = backend.step([angle, angle, lift])
    return state


@pytest.mark.parametrize("kind", [kind for kind in CARRIED if kind != "box"])
def test_other_objects_stand_and_are_lifted(kind):
    robot, backend = hand(kind)
    skin = backend.model.skins[-1]
    corners = skin.points.positions(backend.model.nodes)[skin.triangles]
    assert np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) > 0.0  # seen from outside
    assert corners[..., 2].min() == pytest.approx(ON_TABLE)
    rest, weight = backend.state, 9.81 * 0.020
    np.testing.assert_allclose(rest.contacts.total, [[0.0, 0.0, weight], [0.0, 0.0, 0.0]], atol=1e-5)
    state = grip_and_lift(backend, np.radians(26.0), 0.010)
    assert state.effector[0, 2] - rest.effector[0, 2] > 0.009
    np.testing.assert_allclose(state.contacts.total, [[0.0, 0.0, 0.0], [0.0, 0.0, -weight]], atol=2e-3)


@pytest.mark.parametrize("kind", CARRIED)
def test_surfaces_of_objects_are_those_that_the_fingers_touch(kind):
    """Points of the skin lie on the obstacle, but for rounded edges and the flat ends of the ball."""
    shape, nodes = CARRIED[kind]((0.04, 0.03, 0.05)), np.vstack([np.zeros(3), np.eye(3)])
    points = shape.skin(0, nodes).points.positions(nodes)
    sides = points[points[:, 2] > 1e-3 - shape.half_height]
    gaps = shape.obstacle("object", 0.5, None).gap(sides if len(sides) else points)
    assert np.abs(gaps).max() < 2e-3
    assert points[:, 0].max() == pytest.approx(shape.half_width, rel=0.02)
    assert points[:, 2].min() == pytest.approx(-shape.half_height)


def test_a_box_is_lifted_by_friction_and_falls_when_the_fingers_open():
    robot, backend = hand()
    rest = backend.state
    weight = 9.81 * 0.020
    np.testing.assert_allclose(rest.effector[0], robot.effector_rest, atol=6e-4)
    # The solver stops within 1e-10 m, and the box stands on the table with a stiffness of 1.7e5 N/m.
    np.testing.assert_allclose(rest.contacts.total, [[0.0, 0.0, weight], [0.0, 0.0, 0.0]], atol=1e-5)
    state = grip_and_lift(backend, np.radians(26.0), 0.010)
    assert state.effector[0, 2] - rest.effector[0, 2] > 0.009
    np.testing.assert_allclose(state.contacts.total, [[0.0, 0.0, 0.0], [0.0, 0.0, -weight]], atol=2e-3)
    assert np.abs(state.effector[0, :2]).max() < 1e-4
    for share in np.linspace(0.9, 0.0, 10):
        state = backend.step([share * np.radians(26.0), share * np.radians(26.0), 0.010])
    np.testing.assert_allclose(state.effector[0], rest.effector[0], atol=1e-4)
    np.testing.assert_allclose(state.contacts.total[0], [0.0, 0.0, weight], atol=2e-3)


def test_a_box_that_is_too_heavy_stays_on_the_table():
    _, backend = hand(object_mass=0.2, friction=0.1)
    rest = backend.state.effector[0, 2]
    state = grip_and_lift(backend, np.radians(20.0), 0.010)
    assert state.effector[0, 2] - rest < 2e-3
    assert state.contacts.total[0, 2] > 0.5 * 0.2 * 9.81


def test_wrong_lengths_of_the_scene():
    with pytest.raises(ValueError, match="clearance = 0.001 m must be inside"):
        make_robot("contact_aided_gripper", clearance=0.001)
