"""The Diamond: published size, symmetry, exact condensed model, and its published trajectory."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends import make_backend
from softgym_envs.control import InverseQP
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.geometry.meshing import BodyMesh
from softgym_envs.robots.geometry.morphing import mean_ratio
from softgym_envs.robots.geometry.symmetry import mirrored


@pytest.fixture(scope="module")
def diamond():
    """A Diamond whose cables may push, so that differences about the rest state exist."""
    return make_robot("diamond", unilateral=False)


@pytest.fixture(scope="module")
def model(diamond):
    return diamond.build()


def area(contour):
    x, y = contour.T
    return 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)


def crossings(contour):
    """Whether any two edges of a closed contour that are not neighbours cross."""

    def turn(a, b, c):
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    edges = list(zip(contour, np.roll(contour, -1, axis=0), strict=True))
    return any(
        turn(*p, q[0]) * turn(*p, q[1]) < 0.0 and turn(*q, p[0]) * turn(*q, p[1]) < 0.0
        for (i, p), (j, q) in itertools.combinations(enumerate(edges), 2)
        if j - i > 1
    )


def test_published_size(diamond, model):
    mesh = diamond.body()
    assert model.volume == pytest.approx(392e-6, rel=0.02)
    assert model.mass == pytest.approx(0.5, rel=1e-4)
    assert (len(mesh.nodes), len(mesh.tetrahedra)) == (1529, 5272)
    assert mean_ratio(mesh.nodes, mesh.tetrahedra).min() > 0.3
    np.testing.assert_allclose(mesh.nodes.min(axis=0), [-0.097, -0.097, -0.037], atol=1e-9)
    np.testing.assert_allclose(mesh.nodes.max(axis=0), [0.097, 0.097, 0.126], atol=1e-9)
    fixed = mesh.nodes[model.fixed]
    assert (np.abs(fixed[:, :2]) <= 0.015).all()
    assert len(fixed) == pytest.approx(58, rel=0.3)  # of the published mesh
    for cable in model.constraints["a"]:
        assert cable.rest_length == pytest.approx(0.0882836338, abs=1e-9)


def test_every_corner_of_the_design_box_has_a_sound_outline(diamond):
    space = diamond.design_space
    for signs in itertools.product((-1.0, 1.0), repeat=4):
        design = space.from_unit(np.array([*signs, 0.0, 0.0]))
        side, plan = diamond.side_view(design), diamond.plan_view(design)
        assert area(side) > 0.0
        assert area(plan) > 0.0
        assert not crossings(side)
        assert not crossings(plan)
        elbow = side[np.argmax(side[:, 0])]
        np.testing.assert_allclose(elbow, [design["elbow_radius"], design["elbow_height"]], atol=1e-12)


def test_elbows_and_top_are_nodes_of_every_mesh(diamond):
    design = diamond.design_space.from_unit(np.array([0.7, -0.6, 0.5, -0.8, 0.0, 0.0]))
    nodes = diamond.body(design).nodes
    r, z = design["elbow_radius"], design["elbow_height"]
    for point in ((r, 0, z), (-r, 0, z), (0, r, z), (0, -r, z), (0, 0, design["top_height"])):
        assert np.linalg.norm(nodes - point, axis=1).min() < 1e-9


def test_the_clamp_holds_the_same_nodes_in_every_moved_body(diamond, model, rng):
    for _ in range(3):
        other = diamond.build(diamond.design_space.sample(rng))
        np.testing.assert_array_equal(other.fixed, model.fixed)


def test_quarter_turns_change_nothing(diamond, model):
    """Turning the command turns the response: exact, since the body is mirrored from one eighth."""
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # north to west
    statics = Statics(model)
    command = np.array([0.021, 0.003, 0.0, 0.008])
    states = []
    for k in range(4):
        statics.solve(np.zeros(4))
        states.append(statics.solve(np.roll(command, k)))
    for k in range(1, 4):
        expected = np.linalg.matrix_power(turn, k) @ states[0].delta[4:]
        np.testing.assert_allclose(states[k].delta[4:], expected, rtol=0, atol=1e-8)
        np.testing.assert_allclose(states[k].effort[:4], np.roll(states[0].effort[:4], k), rtol=1e-5)


@pytest.mark.parametrize("command", [[0.0, 0.0, 0.0, 0.0], [0.020, 0.004, -0.003, 0.009]], ids=["rest", "actuated"])
def test_compliance_is_the_derivative_of_the_equilibrium(model, command):
    statics = Statics(model, tolerance=1e-12)
    effort = statics.solve(np.array(command)).effort[:4]
    W = statics.solve(effort, "effort").condensed.compliance
    step = 0.05  # N
    for k in range(4):
        ends = [statics.solve(effort + sign * step * np.eye(4)[k], "effort").delta for sign in (1.0, -1.0)]
        difference = (ends[0] - ends[1]) / (2.0 * step)
        assert np.abs(difference - W[:, k]).max() < 1e-5 * np.abs(W[:, k]).max()


def test_without_gravity_stiffness_does_not_change_the_motion(diamond):
    command = np.array([0.015, 0.0, 0.006, 0.0])
    deltas = [Statics(diamond.build({"young_modulus": E})).solve(command).delta for E in (1.8e5, 3.0e6)]
    np.testing.assert_allclose(deltas[0], deltas[1], rtol=0, atol=1e-7)


def test_the_soft_heavy_body_of_the_published_scene_sags():
    robot = make_robot("diamond", gravity=(0.0, 0.0, -9.81))
    assert robot.learning.stiffness_variable is None
    state = Statics(robot.build({"young_modulus": 1.8e5})).solve(np.zeros(4), "effort")
    sag = robot.effector_rest - state.delta[4:]
    np.testing.assert_allclose(sag[:2], 0.0, atol=1e-9)
    assert 0.01 < sag[2] < 0.06


def follow(robot, laps, hold):
    """Distances [m] from the goals of the reference path, after the approach."""
    fem = make_backend("fem", robot)
    controller = InverseQP.for_robot(robot)
    path, state, distances = robot.reference_path(), fem.state, []
    for goal in [path[0]] * 12 + [goal for goal in np.tile(path, (laps, 1)) for _ in range(hold)]:
        state = fem.step(controller.solve(state.condensed, goal, state.command, state.slack))
        distances.append(np.linalg.norm(state.effector[0] - goal))
    return np.array(distances[12:])[hold - 1 :: hold]


def test_follows_the_published_circle(diamond):
    """Measured: 0.017 mm at most, two steps per goal."""
    distances = follow(diamond, 1, 2)
    assert distances.shape == (30,)
    assert distances.max() < 1e-4


def test_cables_that_cannot_push_stay_near_the_published_circle():
    """Cables that cannot push do not lower the top far enough: 1.17 mm off at most, 0.53 mm on average (measured)."""
    robot = make_robot("diamond")
    distances = follow(robot, 1, 2)
    assert distances.max() < 1.3e-3
    assert distances.mean() < 6e-4


def test_reference_path(diamond):
    path = diamond.reference_path(20)
    assert path.shape == (20, 3)
    np.testing.assert_allclose(np.hypot(path[:, 0], path[:, 1]), 0.020)
    np.testing.assert_allclose(path[:, 2], 0.133)
    assert len(diamond.reference_path()) == 30


# -- mirroring ------------------------------------------------------------------------------------------------------

CORNER = BodyMesh(
    nodes=np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]),
    tetrahedra=np.array([[0, 1, 2, 3]]),
    triangles=np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
    surfaces=np.array([1, 2, 3, 4]),
)


def test_mirrored():
    whole = mirrored(CORNER, (2.0, 0.0, 0.0))
    assert len(whole.nodes) == 5
    np.testing.assert_allclose(whole.nodes[4], [-1, 0, 0])
    corners = whole.nodes[whole.tetrahedra]
    np.testing.assert_allclose(np.linalg.det(corners[:, 1:] - corners[:, :1]), 1.0)
    # The face in the plane is gone; the others appear twice, as distinct surfaces.
    assert len(whole.triangles) == 6
    assert len(set(whole.surfaces)) == 6
    octahedron = mirrored(mirrored(whole, (0, 1, 0)), (0, 0, 1))
    assert len(octahedron.nodes) == 7
    assert len(octahedron.tetrahedra) == len(octahedron.triangles) == 8


def test_a_part_across_the_plane_is_rejected():
    with pytest.raises(ValueError, match="both sides"):
        mirrored(CORNER, (1, -1, 0))
