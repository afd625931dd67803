"""The finger driven by cables and an object's pose: coordinates, efforts, W, agreement with the Soft Finger."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softgym_envs import make_robot
from softgym_envs.extensions.beams.pose import Pose
from softgym_envs.mechanics.frames import frame_rows, rotation_of
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.soft_finger import SoftFinger

MESH_SIZE = 12e-3
# Cables [m], pose [m, 1].
COMMAND = np.array([0.006, 0.004, 0.001, 0.002, 0.005, 0.05, -0.04, 0.03])


@pytest.fixture(scope="module")
def finger():
    robot = make_robot("contact_finger", mesh_size=MESH_SIZE, unilateral=False)
    return robot, robot.build()


@pytest.fixture(scope="module")
def state(finger):
    return Statics(finger[1], tolerance=1e-12).solve(COMMAND)


# -- coordinates of a pose ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rest", [np.eye(3), Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()], ids=["", "turned"])
def test_a_pose_is_measured_from_rest(rest):
    """Displacement of the origin, and sin(angle) times axis of the rotation, for any directors at rest."""
    nodes = np.vstack([np.zeros((1, 3)), frame_rows([0.1, 0.2, 0.3], rest)])
    rows = [Pose("pose", 1, component, nodes) for component in range(6)]
    assert [row.unit for row in rows] == [("m", "N")] * 3 + [("1", "N m")] * 3
    assert [row.value(nodes)[0] for row in rows] == pytest.approx(np.zeros(6), abs=1e-15)
    axis, angle, shift = np.array([2.0, -1.0, 2.0]) / 3.0, 1.3, np.array([0.01, -0.02, 0.03])
    turn = Rotation.from_rotvec(angle * axis).as_matrix()
    moved = np.vstack([np.ones((1, 3)), frame_rows([0.1, 0.2, 0.3] + shift, turn @ rest)])
    found = np.array([row.value(moved)[0] for row in rows])
    np.testing.assert_allclose(found, np.append(shift, np.sin(angle) * axis), atol=1e-14)


def test_an_unknown_component_is_rejected():
    for component in (6, -1):
        with pytest.raises(ValueError, match="component = .* is unknown; allowed: 0 to 5"):
            Pose("pose", 0, component, np.zeros((4, 3)))


# -- the robot ------------------------------------------------------------------------------------------------------


def test_attributes(finger):
    robot, model = finger
    assert robot.learning.weights == robot.name == "contact_finger"
    assert [a.name for a in robot.actuators] == [
        "finger_1_cable_1",
        "finger_1_cable_2",
        "x",
        "y",
        "z",
        "rx",
        "ry",
        "rz",
    ]
    assert [a.unit for a in robot.actuators] == ["m"] * 5 + ["1"] * 3
    assert [c.name for c in model.constraints["a"]] == [a.name for a in robot.actuators]
    assert [a.unilateral for a in make_robot("contact_finger").actuators] == [True] * 2 + [False] * 6
    assert robot.lower.shape == robot.effort_scale.shape == (8,)
    assert (robot.lower < 0.0).all() and (robot.upper > 0.0).all() and (robot.rates > 0.0).all()
    assert model.roles == (("a", 8), ("e", 3), ("b", 9))
    assert json.loads(json.dumps(robot.mechanics_key)) == robot.mechanics_key
    assert robot.design_space.names == SoftFinger(cables=2).design_space.names


def test_rest_is_zero_without_effort(finger):
    robot, model = finger
    rest = Statics(model).solve(np.zeros(8))
    np.testing.assert_allclose(rest.delta[:8], 0.0, atol=1e-12)
    np.testing.assert_allclose(rest.effort, 0.0, atol=1e-12)
    np.testing.assert_allclose(rest.condensed.delta.e, robot.effector_rest, atol=1e-12)
    W = rest.condensed.compliance
    scale = 1.0 / np.sqrt(np.diag(W))
    assert np.linalg.eigvalsh(scale[:, None] * W * scale)[0] > 0.0


def test_the_tip_keeps_some_freedom_when_all_is_held(state):
    """W_ee with cables and pose held is what a model has to learn besides the energy."""
    W = state.condensed.W
    held = W.ee - W.ea @ np.linalg.solve(W.aa, W.ea.T)
    assert np.linalg.eigvalsh(held)[0] > 1e-4 * np.trace(W.ee)


def test_commands_are_reached_by_the_frame(finger, state):
    model = finger[1]
    frame = model.frames.rows[0]
    turn = rotation_of(state.x, frame)
    np.testing.assert_allclose(state.delta[:8], COMMAND, atol=1e-12)
    np.testing.assert_allclose(state.x[frame] - model.nodes[frame], COMMAND[2:5], atol=1e-12)
    vector = Rotation.from_matrix(turn).as_rotvec()
    angle = np.linalg.norm(vector)
    np.testing.assert_allclose(np.sin(angle) / angle * vector, COMMAND[5:], atol=1e-12)


def test_efforts_are_the_wrench_on_the_contact_points(finger, state):
    """The frame's forces on the three points sum to the first three efforts; their torque matches the other three."""
    model = finger[1]
    frame = model.frames.rows[0]
    forces = state.effort[-9:].reshape(3, 3)
    points = np.array([bond.first.positions(state.x)[0] for bond in model.constraints["b"]])
    assert np.abs(forces).max() > 1.0
    np.testing.assert_allclose(forces.sum(axis=0), state.effort[2:5], atol=1e-8)
    torque = np.cross(points - state.x[frame], forces).sum(axis=0)
    R = rotation_of(state.x, frame)
    np.testing.assert_allclose(torque, 0.5 * (np.trace(R) * np.eye(3) - R).T @ state.effort[5:8], atol=1e-9)


def test_it_equals_the_soft_finger_with_its_contact_points_held(finger, state):
    """The same body as `SoftFinger`, its contact points driven to where the frame has them."""
    model = finger[1]
    alone = SoftFinger(cables=2, mesh_size=MESH_SIZE, unilateral=False, contacts=True).build()
    points = np.array([bond.first.positions(state.x)[0] for bond in model.constraints["b"]])
    part = Statics(alone, tolerance=1e-12).solve(COMMAND[:2], contact=points.ravel(), contact_mode="displacement")
    np.testing.assert_allclose(part.x, state.x[: len(alone.nodes)], atol=1e-10)
    np.testing.assert_allclose(part.effort[:2], state.effort[:2], atol=1e-7)
    np.testing.assert_allclose(part.condensed.delta.e, state.condensed.delta.e, atol=1e-10)


def test_W_is_the_derivative_of_the_equilibrium(finger, state):
    statics = Statics(finger[1], tolerance=1e-13)
    steps = np.array([1e-5] * 5 + [1e-4] * 3)
    columns, tips = [], []
    for k, step in enumerate(steps):
        ends = [statics.solve(COMMAND + sign * step * np.eye(8)[k]) for sign in (1, -1)]
        columns.append((ends[0].effort[:8] - ends[1].effort[:8]) / (2.0 * step))
        tips.append((ends[0].condensed.delta.e - ends[1].condensed.delta.e) / (2.0 * step))
    W = state.condensed.W
    stiffness = np.linalg.inv(W.aa)
    scale = np.sqrt(np.abs(np.diag(stiffness)))
    error = np.abs(np.array(columns).T - stiffness) / np.outer(scale, scale)
    assert error.max() < 1e-5
    jacobian = W.ea @ stiffness
    np.testing.assert_allclose(np.array(tips).T, jacobian, rtol=0, atol=1e-5 * np.abs(jacobian).max())


def test_stiffness_scales_efforts_and_nothing_else(state):
    robot = make_robot("contact_finger", mesh_size=MESH_SIZE, unilateral=False)
    assert robot.learning.stiffness_variable == "young_modulus"
    assert make_robot("contact_finger", gravity=(0.0, 0.0, -9.81)).learning.stiffness_variable is None
    stiff = Statics(robot.build({"young_modulus": 6.0e6})).solve(COMMAND)
    np.testing.assert_allclose(stiff.effort[:8], 2.0 * state.effort[:8], rtol=1e-5)
    np.testing.assert_allclose(stiff.condensed.delta.e, state.condensed.delta.e, atol=1e-9)


@pytest.mark.parametrize("unit", [-1.0, 1.0], ids=["lowest", "highest"])
def test_corners_of_the_design_space_build_and_solve(unit):
    robot = make_robot("contact_finger", mesh_size=MESH_SIZE)
    design = robot.design_space.from_unit(np.full(len(robot.design_space), unit))
    found = Statics(robot.build(design)).solve(0.5 * COMMAND)
    np.testing.assert_allclose(found.delta[2:8], 0.5 * COMMAND[2:], atol=1e-9)
    np.testing.assert_allclose(
        robot.object_frame(design), [0.0, design["height"], -2.5 * design["length"] + 0.030], atol=1e-12
    )
