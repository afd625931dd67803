"""Obstacles: exact gap, normal and curvature, surfaces for pictures, and plain records."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from softgym_envs.extensions.beams.prism import RoundedPrism
from softgym_envs.mechanics.contact.obstacles import (
    KINDS,
    Cylinder,
    MeshObstacle,
    Plane,
    Sphere,
    obstacle_from,
)

TURN = Rotation.from_euler("xyz", [0.3, -0.5, 0.8]).as_matrix().tolist()
TRIANGLE = [(-0.02, -0.01), (0.0, 0.03), (0.03, -0.015)]  # clockwise
OBSTACLES = {
    "plane": Plane([0.01, 0.0, -0.01], [1.0, 2.0, 3.0], friction=0.5, name="table"),
    "sphere": Sphere([0.0, 0.01, 0.02], 0.03),
    "cylinder": Cylinder([0.01, 0.0, 0.0], [1.0, 1.0, 0.2], 0.02, frame=4),
    "box": RoundedPrism.box([0.02, 0.03, 0.04], 0.005, centre=[0.01, 0.0, 0.0], rotation=TURN, friction=0.2),
    "hexagonal": RoundedPrism.hexagonal(0.06, 0.05, 0.002),
    "triangle": RoundedPrism(TRIANGLE, 0.01, 0.001, rotation=TURN),
}
each_obstacle = pytest.mark.parametrize("obstacle", OBSTACLES.values(), ids=OBSTACLES)


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform(-0.08, 0.08, (2000, 3))


def central(function, points, step):
    """Derivatives by the coordinates of the points, in the last axis."""
    return np.stack([(function(points + d) - function(points - d)) / (2 * step) for d in step * np.eye(3)], axis=-1)


# -- geometry -----------------------------------------------------------------------------------------------------


@each_obstacle
def test_normal_and_curvature_are_derivatives_of_the_gap(obstacle, points):
    points = points[obstacle.gap(points) > 1e-3]
    gap, normal, curvature = obstacle.geometry(points)
    np.testing.assert_array_equal(gap, obstacle.gap(points))
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, rtol=1e-12)
    step = 1e-7
    np.testing.assert_allclose(central(obstacle.gap, points, step), normal, atol=1e-6)
    # The curvature jumps where two parts of a surface meet.
    moved = [obstacle.geometry(points + d)[2] for d in np.concatenate([np.eye(3), -np.eye(3)]) * 2 * step]
    same = np.all([np.abs(each - curvature).max(axis=(1, 2)) < 0.1 for each in moved], axis=0)
    assert same.mean() > 0.95
    error = central(lambda p: obstacle.geometry(p)[1], points, step)[same] - curvature[same]
    assert np.abs(error).max() < 1e-6 * max(1.0, np.abs(curvature).max())


@each_obstacle
@given(st.lists(st.floats(-0.1, 0.1), min_size=6, max_size=6))
def test_the_gap_changes_at_most_as_the_point_moves(obstacle, coordinates):
    points = np.array(coordinates).reshape(2, 3)
    first, second = obstacle.gap(points)
    assert abs(first - second) <= np.linalg.norm(points[0] - points[1]) + 1e-14


@each_obstacle
def test_the_nearest_point_of_the_surface_lies_a_gap_away_along_the_normal(obstacle, points):
    points = points[obstacle.gap(points) > 0.0]
    gap, normal, _ = obstacle.geometry(points)
    np.testing.assert_allclose(obstacle.gap(points - gap[:, None] * normal), 0.0, atol=1e-15)


def test_gaps_of_plane_sphere_and_cylinder():
    points = np.array([[0.0, 0.0, 3.0], [4.0, 0.0, -3.0]])
    np.testing.assert_allclose(Plane([0, 0, 1], [0, 0, 5]).gap(points), [2.0, -4.0])
    np.testing.assert_allclose(Sphere([0, 0, 0], 2.0).gap(points), [1.0, 3.0])
    np.testing.assert_allclose(Cylinder([0, 0, 9], [0, 0, 2], 1.0).gap(points), [-1.0, 3.0])


def nearest_on_segment(p, a, b):
    t = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.linalg.norm(p - a - t * (b - a))


def test_the_gap_of_a_prism_is_the_distance_to_its_core_less_the_rounding(points):
    prism = OBSTACLES["triangle"]
    corners = np.array(TRIANGLE)
    sides = list(zip(corners, np.roll(corners, -1, axis=0), strict=True))
    for point, gap in zip(points[:300], prism.gap(points[:300]), strict=True):
        x, y, z = np.array(TURN).T @ point
        turns = [np.linalg.det([b - a, np.array([x, y]) - a]) for a, b in sides]
        inside = max(turns) <= 0.0  # right of all sides: the corners are clockwise
        across = 0.0 if inside else min(nearest_on_segment(np.array([x, y]), a, b) for a, b in sides)
        distance = np.hypot(across, max(abs(z) - 0.01, 0.0))
        if distance > 0.0:
            assert gap == pytest.approx(distance - 0.001, abs=1e-14)
        else:
            assert gap < -0.001


def test_the_outer_size_of_box_and_hexagon_includes_the_rounding():
    box, hexagon = RoundedPrism.box([0.02, 0.03, 0.04], 0.005), OBSTACLES["hexagonal"]
    np.testing.assert_allclose(box.gap(np.diag([0.02, 0.03, 0.04])), 0.0, atol=1e-15)
    angle = np.pi / 3.0 * np.arange(6)
    flats = 0.03 * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    np.testing.assert_allclose(hexagon.gap(np.vstack([flats, [0.0, 0.0, 0.05]])), 0.0, atol=1e-15)


def test_the_order_of_the_corners_does_not_matter(points):
    other = replace(OBSTACLES["triangle"], polygon=TRIANGLE[::-1])
    np.testing.assert_array_equal(other.gap(points), OBSTACLES["triangle"].gap(points))


@pytest.mark.parametrize("obstacle", [OBSTACLES["sphere"], OBSTACLES["cylinder"]], ids=["sphere", "cylinder"])
def test_the_centre_has_a_gap_and_no_normal(obstacle):
    centre = np.array([obstacle.centre if isinstance(obstacle, Sphere) else obstacle.point])
    gap, normal, _ = obstacle.geometry(centre)
    assert gap[0] == -obstacle.radius
    assert (normal == 0.0).all()


def test_no_points():
    for obstacle in OBSTACLES.values():
        gap, normal, curvature = obstacle.geometry(np.empty((0, 3)))
        assert (gap.shape, normal.shape, curvature.shape) == ((0,), (0, 3), (0, 3, 3))


# -- surfaces for pictures ----------------------------------------------------------------------------------------


@each_obstacle
def test_skins_lie_on_the_surface_and_face_outwards(obstacle):
    vertices, triangles = obstacle.skin(0.05)
    np.testing.assert_allclose(obstacle.gap(vertices), 0.0, atol=1e-15)
    a, b, c = vertices[triangles].swapaxes(0, 1)
    area = np.cross(b - a, c - a)
    # From a little outside the triangles, the surface lies against their normals.
    middle = (a + b + c) / 3.0
    out = area / np.linalg.norm(area, axis=1)[:, None]
    _, normal, _ = obstacle.geometry(middle + 0.01 * out)
    round_ends = isinstance(obstacle, Cylinder) & (np.einsum("ti,ti->t", out, normal) < 0.5)
    assert (np.einsum("ti,ti->t", out, normal)[~round_ends] > 0.9).all()


@pytest.mark.parametrize("name", ["sphere", "box", "hexagonal", "triangle"])
def test_skins_are_closed(name):
    vertices, triangles = OBSTACLES[name].skin()
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    assert {tuple(edge) for edge in edges} == {tuple(edge) for edge in edges[:, ::-1]}
    assert len(vertices) - len(edges) // 2 + len(triangles) == 2  # Euler


def test_the_skin_of_a_box_has_its_size():
    vertices, _ = RoundedPrism.box([0.02, 0.03, 0.04], 0.005).skin()
    np.testing.assert_allclose(vertices.max(axis=0), [0.02, 0.03, 0.04], rtol=1e-12)


# -- records ------------------------------------------------------------------------------------------------------


@each_obstacle
def test_records_make_equal_obstacles(obstacle):
    record = json.loads(json.dumps(obstacle.as_dict()))
    assert obstacle_from(record) == obstacle
    assert obstacle_from(obstacle) is obstacle
    assert hash(obstacle_from(record)) == hash(obstacle)


def test_a_record_needs_only_what_has_no_default():
    assert obstacle_from({"kind": "sphere", "centre": [0, 0, 0], "radius": 1}) == Sphere((0.0, 0.0, 0.0), 1.0)


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (
            {"radius": 1},
            r"needs a record with a kind \(plane, sphere, cylinder, mesh, rounded_prism\), got",
        ),
        ("plane", "an obstacle needs a record with a kind"),
        ({"kind": "spere"}, "unknown kind of obstacle 'spere'; did you mean 'sphere'"),
        ({"kind": ["plane"]}, "unknown kind of obstacle"),
        ({"kind": "sphere", "centre": [0, 0, 0], "radus": 1}, "unknown key of obstacle 'sphere' 'radus'; did you"),
        ({"kind": "sphere", "radius": 1}, "obstacle 'sphere': missing centre"),
    ],
)
def test_wrong_records(record, message):
    with pytest.raises(ValueError, match=message):
        obstacle_from(record)


def test_mesh_obstacles():
    vertices, triangles = Sphere([0.0, 0.0, 0.0], 0.02).skin()
    ball = MeshObstacle(vertices.tolist(), triangles.tolist(), friction=0.3, frame=8)
    assert obstacle_from(json.loads(json.dumps(ball.as_dict()))) == ball
    np.testing.assert_array_equal(ball.skin()[0], vertices)
    np.testing.assert_array_equal(ball.skin()[1], triangles)


def test_every_kind_has_its_name():
    assert all(KINDS[kind].kind == kind for kind in KINDS)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Sphere([0, 0], 1.0), r"sphere: centre must be finite numbers of shape \(3,\), got \[0, 0\]"),
        (lambda: Sphere([0, 0, np.nan], 1.0, name="ball"), "sphere 'ball': centre must be finite numbers"),
        (lambda: Sphere([0, 0, 0], 0.0), "radius must be greater than 0, got 0.0"),
        (lambda: Sphere([0, 0, 0], "big"), "radius must be a finite number, got 'big'"),
        (lambda: Sphere([0, 0, 0], 1.0, friction=-0.1), "friction must be at least 0, got -0.1"),
        (lambda: Sphere([0, 0, 0], 1.0, frame=-1), "frame must be None or a row >= 0, got -1"),
        (lambda: Sphere([0, 0, 0], 1.0, frame=1.5), "frame must be None or a row >= 0, got 1.5"),
        (lambda: Sphere([0, 0, 0], 1.0, frame=True), "frame must be None or a row >= 0, got True"),
        (lambda: Plane([0, 0, 0], [0, 0, 0]), "normal must not be zero"),
        (lambda: RoundedPrism([(0, 0), (1, 0)], 1.0, 0.1), "polygon must have at least 3 corners, got 2"),
        (lambda: RoundedPrism([(0, 0), (1, 0), (1, 0), (0, 1)], 1.0, 0.1), "two consecutive corners"),
        (lambda: RoundedPrism([(0, 0), (2, 0), (0.5, 0.5), (0, 2)], 1.0, 0.1), "must be convex and not flat"),
        (lambda: RoundedPrism([(0, 0), (1, 0), (2, 0)], 1.0, 0.1), "must be convex and not flat"),
        (lambda: RoundedPrism(TRIANGLE, 1.0, 0.1, rotation=np.diag([1, 1, 2])), "rotation must be an orthonormal"),
        (lambda: RoundedPrism(TRIANGLE, 1.0, 0.1, rotation=np.diag([1, 1, -1])), "must be right-handed"),
        (lambda: MeshObstacle(np.eye(3), [(0, 1, 3)]), "triangles must be whole numbers below 3"),
        (lambda: MeshObstacle(np.eye(3), [(0, 1, 1.5)]), "triangles must be whole numbers below 3"),
        (lambda: MeshObstacle(np.eye(3), np.empty((0, 3))), "triangles must not be empty"),
        (lambda: RoundedPrism.box([0.1, 0.1, 0.01], 0.02), "half_extents of a box must be 3 numbers > radius 0.02"),
        (lambda: RoundedPrism.hexagonal(0.1, 0.01, 0.02), "must be > radius 0.02, got 0.1 and 0.01"),
    ],
)
def test_wrong_obstacles(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_pentagram_is_not_convex():
    angle = 4.0 * np.pi / 5.0 * np.arange(5)
    with pytest.raises(ValueError, match="must be convex"):
        RoundedPrism(np.column_stack([np.cos(angle), np.sin(angle)]).tolist(), 1.0, 0.1)
