"""Mesh motion on simple shapes: features, quality, corners, curves and surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs.robots.geometry.meshing import BodyMesh
from softgym_envs.robots.geometry.morphing import Cone, Cylinder, Morpher, Plane, mean_ratio


@pytest.mark.parametrize(
    "feature",
    [Plane((0.1, 0.2, 0.3), (1.0, -2.0, 2.0)), Cylinder(0.7), Cone(0.5, 0.2, -0.8)],
    ids=["plane", "cylinder", "cone"],
)
def test_features_are_signed_distances(feature, rng):
    x = rng.uniform(0.2, 1.0, (20, 3))
    distance, gradient = feature.evaluate(x)
    h = 1e-6
    for axis in range(3):
        step = h * np.eye(3)[axis]
        difference = (feature.evaluate(x + step)[0] - feature.evaluate(x - step)[0]) / (2 * h)
        np.testing.assert_allclose(gradient[:, axis], difference, atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-12)
    # One step along the gradient lands on the feature: it is a distance, not only a level set.
    np.testing.assert_allclose(feature.evaluate(x - distance[:, None] * gradient)[0], 0.0, atol=1e-12)


def test_mean_ratio():
    regular = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=float)
    turned, flat = regular[[1, 0, 2, 3]], regular * [1, 1, 0]
    nodes = np.concatenate([regular, 7.0 * regular + 3.0, turned, flat])
    quality = mean_ratio(nodes, np.arange(16).reshape(4, 4))
    sign = np.sign(quality[0])
    np.testing.assert_allclose(quality, [sign, sign, -sign, 0.0], atol=1e-12)


@pytest.fixture
def cube(box):
    """A unit cube with a classified boundary, and its six planes."""
    nodes, tetrahedra = box((1, 1, 1), (3, 3, 3), jitter=0.2)
    edges = nodes[tetrahedra][:, 1:] - nodes[tetrahedra][:, :1]
    tetrahedra[np.linalg.det(edges) < 0] = tetrahedra[np.linalg.det(edges) < 0][:, [0, 2, 1, 3]]
    faces = np.sort(
        np.concatenate([tetrahedra[:, [a, b, c]] for a, b, c in ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))])
    )
    triangles, count = np.unique(faces, axis=0, return_counts=True)
    triangles = triangles[count == 1]
    middle = nodes[triangles].mean(axis=1)
    surfaces = np.select([middle[:, a] == v for a in range(3) for v in (0.0, 1.0)], range(1, 7))
    assert (surfaces > 0).all()
    return BodyMesh(nodes, tetrahedra, triangles, surfaces)


def planes(size):
    result = {}
    for axis, name in enumerate("xyz"):
        normal = tuple(np.eye(3)[axis])
        result[f"{name} low"] = Plane((0, 0, 0), normal)
        result[f"{name} high"] = Plane(tuple(np.multiply(size, normal)), normal)
    return result


def test_a_box_follows_its_planes(cube):
    morpher = Morpher(cube, planes((1, 1, 1)))
    size = np.array([1.3, 0.8, 1.1])
    moved = morpher.move(planes(size), np.zeros_like(cube.nodes))
    boundary = np.unique(cube.triangles)
    # Every boundary node stays on its faces, edges and corners.
    for axis in range(3):
        for old, new in ((0.0, 0.0), (1.0, size[axis])):
            on = cube.nodes[:, axis] == old
            np.testing.assert_allclose(moved[on, axis], new, atol=1e-12)
    assert set(boundary) == set(np.flatnonzero(((cube.nodes == 0) | (cube.nodes == 1)).any(axis=1)))
    assert (mean_ratio(moved, cube.tetrahedra) > 0).all()
    assert morpher.quality(cube.nodes) == pytest.approx(1.0)
    assert 0.3 < morpher.quality(moved) < 1.5


def test_nothing_moves_without_a_change(cube):
    moved = Morpher(cube, planes((1, 1, 1))).move(planes((1, 1, 1)), np.zeros_like(cube.nodes))
    np.testing.assert_allclose(moved, cube.nodes, atol=1e-12)


def test_inversions_show_in_the_quality(cube):
    morpher = Morpher(cube, planes((1, 1, 1)))
    assert morpher.quality(cube.nodes * [1, 1, -1]) < 0.0


def test_a_surface_on_no_feature_is_rejected(cube):
    with pytest.raises(ValueError, match=r"mesh surface 6 lies on no feature.*'z high'"):
        Morpher(cube, planes((1, 1, 1.01)))
