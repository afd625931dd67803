"""Every constraint: exact derivatives; cables: rest length and sign; points: embedding inside and outside the mesh."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softgym_envs.mechanics import constraints
from softgym_envs.mechanics.constraints import Cable, Constraint, EmbeddedPoints, Point

CLASSES = {
    name: cls
    for name, cls in vars(constraints).items()
    if inspect.isclass(cls) and issubclass(cls, Constraint) and not inspect.isabstract(cls)
}


def make_cable(nodes, tetrahedra):
    # Two points share an element, one lies outside the mesh.
    points = np.array([[0.2, 0.3, 0.4], [0.22, 0.31, 0.41], [0.7, 0.5, 0.8], [1.1, 0.4, 0.6]])
    cable = Cable("cable", EmbeddedPoints(points, nodes, tetrahedra), np.array([-0.3, 0.1, 0.2]))
    return cable


def make_point(nodes, tetrahedra):
    return Point("point", EmbeddedPoints(np.array([0.6, 0.3, 0.7]), nodes, tetrahedra))


FACTORIES = {"Cable": make_cable, "Point": make_point}


@pytest.fixture
def mesh(box):
    return box((1.0, 1.0, 1.0), (2, 2, 2), jitter=0.2)


@pytest.fixture(params=sorted(CLASSES))
def constraint(request, mesh):
    return FACTORIES[request.param](*mesh)


@pytest.fixture
def moved(mesh, rng):
    nodes, _ = mesh
    return nodes @ Rotation.random(random_state=2).as_matrix() + 0.1 * rng.standard_normal(nodes.shape)


def differences(function, x, dofs, h=1e-6):
    """Central differences of ``function(x)`` by the entries ``dofs`` of x, last axis."""
    columns = []
    for dof in dofs:
        plus, minus = x.copy(), x.copy()
        plus.ravel()[dof] += h
        minus.ravel()[dof] -= h
        columns.append((function(plus) - function(minus)) / (2 * h))
    return np.stack(columns, axis=-1)


def test_every_constraint_class_is_tested():
    assert set(CLASSES) == set(FACTORIES)


def test_shapes(constraint, mesh, moved):
    k = len(constraint.dofs)
    assert len(np.unique(constraint.dofs)) == k
    assert constraint.value(moved).shape == (constraint.size,)
    assert constraint.jacobian(moved).shape == (constraint.size, k)
    hessian = constraint.hessian(moved, np.ones(constraint.size))
    assert hessian is None or hessian.shape == (k, k)


def test_jacobian_is_the_derivative_of_the_value(constraint, moved):
    # Central differences with h = 1e-6 on values of order one: round-off 1e-10.
    np.testing.assert_allclose(
        constraint.jacobian(moved), differences(constraint.value, moved, constraint.dofs), atol=2e-9
    )


def test_value_depends_on_no_other_dof(constraint, moved, rng):
    other = moved + rng.standard_normal(moved.shape)
    other.ravel()[constraint.dofs] = moved.ravel()[constraint.dofs]
    np.testing.assert_array_equal(constraint.value(other), constraint.value(moved))


def test_hessian_is_the_derivative_of_the_jacobian(constraint, moved, rng):
    effort = rng.uniform(0.5, 2.0, constraint.size)
    expected = differences(lambda x: effort @ constraint.jacobian(x), moved, constraint.dofs)
    hessian = constraint.hessian(moved, effort)
    if hessian is None:
        np.testing.assert_allclose(expected, 0.0, atol=1e-9)
    else:
        # The short segment of the cable (about 0.1) makes entries of order ten.
        np.testing.assert_allclose(hessian, expected, atol=1e-8 * np.abs(expected).max())
        np.testing.assert_allclose(hessian, hessian.T, atol=1e-13 * np.abs(expected).max())


def test_hessian_is_linear_in_the_effort(constraint, moved, rng):
    a, b = rng.standard_normal((2, constraint.size))
    parts = [constraint.hessian(moved, effort) for effort in (a, b, 2.0 * a - b)]
    if parts[0] is not None:
        np.testing.assert_allclose(parts[2], 2.0 * parts[0] - parts[1], atol=1e-13 * np.abs(parts[0]).max())


# -- cable ----------------------------------------------------------------------------------------------------------


def test_cable_at_rest_has_its_polyline_length_and_no_displacement(mesh):
    nodes, tetrahedra = mesh
    cable = make_cable(nodes, tetrahedra)
    points = [[-0.3, 0.1, 0.2], [0.2, 0.3, 0.4], [0.22, 0.31, 0.41], [0.7, 0.5, 0.8], [1.1, 0.4, 0.6]]
    length = sum(np.linalg.norm(np.subtract(b, a)) for a, b in zip(points, points[1:], strict=False))
    assert cable.rest_length == pytest.approx(length, rel=1e-14)
    assert cable.value(nodes)[0] == pytest.approx(0.0, abs=1e-14)
    np.testing.assert_allclose(cable.path(nodes), points, atol=1e-14)


def test_shortening_is_positive_and_tension_pulls_the_anchor_towards_the_pull_point(mesh):
    nodes, tetrahedra = mesh
    cable = Cable("c", EmbeddedPoints(np.array([[0.9, 0.5, 0.5]]), nodes, tetrahedra), np.array([-1.0, 0.5, 0.5]))
    assert cable.value(nodes - [0.1, 0.0, 0.0])[0] == pytest.approx(0.1, rel=1e-12)
    assert cable.value(nodes + [0.1, 0.0, 0.0])[0] == pytest.approx(-0.1, rel=1e-12)
    force = cable.jacobian(nodes)[0].reshape(-1, 3).sum(axis=0)  # of unit tension on the body
    np.testing.assert_allclose(force, [-1.0, 0.0, 0.0], atol=1e-13)


def test_cable_forces_balance_but_for_the_pull_point(mesh, moved):
    """Inner segments exert no net force; the first one pulls with unit tension."""
    cable = make_cable(*mesh)
    first = cable.path(moved)[:2]
    expected = (first[0] - first[1]) / np.linalg.norm(first[0] - first[1])
    np.testing.assert_allclose(cable.jacobian(moved)[0].reshape(-1, 3).sum(axis=0), expected, atol=1e-13)


def test_cable_with_a_segment_of_zero_length_is_refused(mesh):
    nodes, tetrahedra = mesh
    twice = np.array([[0.5, 0.5, 0.5], [0.5, 0.5, 0.5]])
    with pytest.raises(ValueError, match="zero length"):
        Cable("c", EmbeddedPoints(twice, nodes, tetrahedra), np.zeros(3))
    with pytest.raises(ValueError, match="cable 'c'"):
        Cable("c", EmbeddedPoints(twice[:1], nodes, tetrahedra), np.full(3, np.nan))


# -- point ----------------------------------------------------------------------------------------------------------


def test_point_value_is_its_position(mesh, moved):
    nodes, tetrahedra = mesh
    point = make_point(nodes, tetrahedra)
    np.testing.assert_allclose(point.value(nodes), [0.6, 0.3, 0.7], atol=1e-14)
    np.testing.assert_allclose(point.value(moved + [1.0, 2.0, 3.0]), point.value(moved) + [1.0, 2.0, 3.0], atol=1e-13)


def test_point_needs_exactly_one_embedded_point(mesh):
    with pytest.raises(ValueError, match="exactly one"):
        Point("p", EmbeddedPoints(np.full((2, 3), 0.5), *mesh))


# -- embedding ------------------------------------------------------------------------------------------------------


def test_points_inside_follow_their_element(mesh, rng):
    nodes, tetrahedra = mesh
    points = rng.uniform(0.0, 1.0, (50, 3))
    embedded = EmbeddedPoints(points, nodes, tetrahedra)
    assert (embedded.weights >= -1e-12).all()
    np.testing.assert_allclose(embedded.weights.sum(axis=1), 1.0, atol=1e-13)
    np.testing.assert_allclose(embedded.positions(nodes), points, atol=1e-13)
    F, shift = rng.standard_normal((3, 3)), rng.standard_normal(3)
    np.testing.assert_allclose(embedded.positions(nodes @ F.T + shift), points @ F.T + shift, atol=1e-12)


def test_points_outside_are_extrapolated_from_the_nearest_element(mesh, rng):
    nodes, tetrahedra = mesh
    points = np.array([[0.3, 0.6, 1.02], [1.05, 0.4, 0.4], [-0.01, -0.01, 0.5]])
    embedded = EmbeddedPoints(points, nodes, tetrahedra)
    assert (embedded.weights.min(axis=1) < 0.0).all()
    np.testing.assert_allclose(embedded.positions(nodes), points, atol=1e-13)
    F = rng.standard_normal((3, 3))
    np.testing.assert_allclose(embedded.positions(nodes @ F.T), points @ F.T, atol=1e-12)
    # Nearest by barycentric coordinates: no other element has a larger smallest one.
    for point, weights, element in zip(points, embedded.weights, embedded.elements, strict=True):
        corners = nodes[tetrahedra]
        system = np.concatenate([np.swapaxes(corners, 1, 2), np.ones((len(tetrahedra), 1, 4))], axis=1)
        every = np.linalg.solve(system, np.broadcast_to(np.append(point, 1.0), (len(tetrahedra), 4))[..., None])[..., 0]
        assert weights.min() == pytest.approx(every.min(axis=1).max(), abs=1e-12)
        np.testing.assert_allclose(every[element], weights, atol=1e-12)


def test_a_hint_chooses_the_element_of_points_outside_only(mesh):
    nodes, tetrahedra = mesh
    inside, outside = np.array([0.47, 0.52, 0.48]), np.array([0.5, 0.4, 1.1])
    far = EmbeddedPoints(np.array([0.02, 0.03, 0.01]), nodes, tetrahedra).elements
    plain = EmbeddedPoints(np.stack([inside, outside]), nodes, tetrahedra)
    hinted = EmbeddedPoints(np.stack([inside, outside]), nodes, tetrahedra, hint=np.repeat(far, 2))
    assert hinted.elements[0] == plain.elements[0] != far[0]
    assert hinted.elements[1] == far[0] != plain.elements[1]
    np.testing.assert_allclose(hinted.positions(nodes), [inside, outside], atol=1e-12)


def test_non_finite_points_are_refused(mesh):
    with pytest.raises(ValueError, match="finite"):
        EmbeddedPoints(np.array([0.5, np.nan, 0.5]), *mesh)
