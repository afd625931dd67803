"""The contact-aided finger: its outline, mesh, servo and condensed model without contact."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.errors import InfeasibleDesign
from softgym_envs.extensions.grasping.robots.contact_aided_finger import HELD, ON_SERVO, SERVO_AXIS
from softgym_envs.extensions.grasping.robots.zigzag_shape import check_outline, zigzag_outline
from softgym_envs.mechanics.solvers.statics import Statics

# Design B of the thesis (fig. 3.18), in millimetres.
B = {"e1": 14.43, "e2": 11.03, "e3": 7.81}
B_DISTANCES = [18.2, 23.0, 25.5, 25.7, 24.6, 22.9, 8.7, 20.2, 13.5, 23.0, 21.4, 15.7]
B_DESIGN = {name: 1e-3 * v for name, v in B.items()} | {f"d{k}": 1e-3 * v for k, v in enumerate(B_DISTANCES)}


@pytest.fixture(scope="module")
def robot():
    return make_robot("contact_aided_finger", mesh_size=12e-3, element="linear")


@pytest.fixture(scope="module")
def model(robot):
    return robot.build()


def area(corners):
    x, y = corners.T
    return 0.5 * abs(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


# -- shape ----------------------------------------------------------------------------------------------------------


def test_outline_of_the_initial_design():
    """Both legs are straight, and the right one is vertical outside: its points are those of a frame of bars."""
    corners = zigzag_outline(8.0, 5.0, 4.0, [21.0] * 7, length=100.0, width=33.0)
    assert corners.shape == (26, 2)
    np.testing.assert_allclose(corners.min(axis=0), [0.0, -6.0])
    np.testing.assert_allclose(corners.max(axis=0), [33.0, 100.0])
    assert area(corners) == pytest.approx(8 * 106 + 25 * 5 + 4 * 101)
    heights = np.array([83.125, 71.25, 59.375, 47.5, 35.625, 23.75, 11.875])
    np.testing.assert_allclose(corners[4:11], np.column_stack([np.full(7, 33.0), heights]))


def test_outline_of_an_optimised_design():
    corners = zigzag_outline(**B, distances=B_DISTANCES, length=100.0, width=33.0)
    check_outline(corners)
    k = 7  # the point nearest to the left leg
    height = (100.0 - 11.03) * (1.0 - k / 13.0)
    np.testing.assert_allclose(corners[3 + k], [14.43 + 7.81 + 8.7, height])
    np.testing.assert_allclose(corners[32 - k], [14.43 + 8.7, height])


def test_every_design_in_the_box_has_an_outline_that_does_not_cross_itself(robot):
    rng = np.random.default_rng(0)
    space = robot.design_space
    for _ in range(200):
        unit = rng.choice([-1.0, 1.0], len(space))
        robot.outline(space.from_unit(unit))


@pytest.mark.parametrize(
    "corners",
    [
        [(0, 0), (2, 2), (2, 0), (0, 2)],  # a bow tie
        [(0, 0), (4, 0), (4, 4), (2, 0), (0, 4)],  # a corner on an edge
        [(0, 0), (4, 0), (4, 1), (3, 0), (1, 0), (0, 1)],  # two edges on one line overlap
    ],
)
def test_outlines_that_cross_or_touch_themselves_are_infeasible(corners):
    with pytest.raises(InfeasibleDesign, match="crosses itself near"):
        check_outline(np.array(corners, dtype=float))


def test_a_finger_too_narrow_for_its_legs_is_infeasible():
    narrow = make_robot("contact_aided_finger", width=0.012)
    with pytest.raises(InfeasibleDesign, match="crosses itself"):
        narrow.build()


@pytest.mark.parametrize(("points", "design"), [(7, {}), (12, B_DESIGN)])
def test_mesh_fills_the_outline(points, design):
    robot = make_robot("contact_aided_finger", control_points=points, mesh_size=12e-3, element="linear")
    mesh = robot.body(design)
    complete = robot.design_space.complete(design)
    assert robot.build(design).volume == pytest.approx(0.020 * area(robot.outline(complete)), rel=1e-9)
    np.testing.assert_allclose(np.abs(mesh.nodes[:, 2]).max(), 0.010)


def test_published_mesh_has_the_published_number_of_nodes():
    """2000 to 3000 nodes (thesis, sec. 3.4.4); the initial design is light, design B one of the heaviest."""
    light = make_robot("contact_aided_finger", control_points=7, mesh="published").body()
    heavy = make_robot("contact_aided_finger", mesh="published").body(B_DESIGN)
    assert 1950 < len(light.nodes) < len(heavy.nodes) < 3000


# -- mechanics ------------------------------------------------------------------------------------------------------


def test_feet(robot, model):
    """The right foot is held in space, the left one follows the servo."""
    fixed = model.nodes[model.fixed]
    assert len(fixed) and (fixed[:, 1] < HELD + 1e-9).all()
    carried = model.nodes[model.frames.carried[model.frames.moves > 0.0]]
    assert len(carried) and (carried[:, 1] < ON_SERVO + 1e-9).all() and (carried[:, 0] < 8e-3 + 1e-9).all()
    state = Statics(model).solve([0.4])
    moved = state.x[model.frames.carried[model.frames.moves > 0.0]]
    radius, before = (np.linalg.norm((p - SERVO_AXIS)[:, :2], axis=1) for p in (moved, carried))
    np.testing.assert_allclose(radius, before, atol=1e-12)
    assert (moved[:, 1] > carried[:, 1] + 5e-3).all()


def test_closing_moves_the_tip_towards_the_object(robot, model):
    statics = Statics(model)
    rest = statics.solve([0.0])
    np.testing.assert_allclose(rest.delta[1:], robot.effector_rest, atol=1e-12)
    closed = statics.solve([np.radians(15.0)])
    assert closed.delta[1] > rest.delta[1] + 0.02
    assert closed.effort[0] > 0.0


def test_midside_nodes_of_the_feet_move_with_them():
    model = make_robot("contact_aided_finger", mesh_size=12e-3).build()
    state = Statics(model).solve([0.3])
    x, y, _ = model.nodes[:-4].T
    foot = np.flatnonzero((y < ON_SERVO + 1e-9) & (x < 8e-3 + 1e-9))
    before, after = model.nodes[foot], state.x[foot]
    np.testing.assert_allclose(
        np.linalg.norm(after[:, None] - after, axis=2), np.linalg.norm(before[:, None] - before, axis=2), atol=1e-12
    )


def test_condensed_model_is_the_derivative_of_the_equilibrium(model):
    statics = Statics(model, tolerance=1e-12)
    angle, step = 0.2, 1e-5
    compliance = statics.solve([angle]).condensed.compliance
    low, high = (statics.solve([angle + s]) for s in (-step, step))
    stiffness = (high.effort[0] - low.effort[0]) / (2.0 * step)
    assert 1.0 / compliance[0, 0] == pytest.approx(stiffness, rel=1e-6)
    tip = (high.delta[1:] - low.delta[1:]) / (2.0 * step)
    np.testing.assert_allclose(compliance[1:, 0] / compliance[0, 0], tip, rtol=1e-5, atol=1e-8)


def test_stiffness_scales_the_torque_and_nothing_else(robot):
    soft, stiff = (Statics(robot.build({"young_modulus": e})).solve([0.3]) for e in (2e6, 4e6))
    assert stiff.effort[0] == pytest.approx(2.0 * soft.effort[0], rel=1e-9)
    np.testing.assert_allclose(stiff.delta[1:], soft.delta[1:], atol=1e-12)
    assert make_robot("contact_aided_finger", gravity=(0.0, 0.0, -9.81)).learning.stiffness_variable is None


def test_published_mesh_is_stiffer_than_the_accurate_one():
    """Linear tetrahedra lock: with 3 mm they take several times the torque of quadratic ones."""
    torque = {
        mesh: Statics(make_robot("contact_aided_finger", mesh=mesh, control_points=7).build())
        .solve([np.radians(5.0)])
        .effort[0]
        for mesh in ("published", "accurate")
    }
    assert torque["published"] > 2.0 * torque["accurate"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"control_points": 9}, "control_points = 9 is unknown; allowed: 7, 12"),
        ({"mesh": "fine"}, "unknown mesh 'fine'; allowed: published, accurate"),
        ({"length": -0.1}, "length = -0.1 must be positive"),
        ({"mesh_size": 0.0}, "mesh_size = 0.0 m must be positive"),
        ({"element": "cubic"}, "unknown element 'cubic'; .*allowed: linear, averaged, quadratic"),
    ],
    ids=str,
)
def test_wrong_options(options, message):
    with pytest.raises(ValueError, match=message):
        make_robot("contact_aided_finger", **options)
