"""Every constraint: exact derivatives; then each one: signs, rest values, invalid input; embedding of points."""

from __future__ import annotations

import inspect
from importlib import import_module
from pkgutil import iter_modules

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softgym_envs.extensions import beams
from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.extensions.beams.chamber import Chamber
from softgym_envs.extensions.beams.pose import Pose
from softgym_envs.extensions.beams.rods import add_rod
from softgym_envs.extensions.beams.servo import Servo
from softgym_envs.extensions.beams.slide import Slide
from softgym_envs.mechanics import ModelBuilder, Statics, constraints
from softgym_envs.mechanics.constraints.averaging import averaged_points
from softgym_envs.mechanics.constraints.bond import Bond
from softgym_envs.mechanics.constraints.cable import Cable
from softgym_envs.mechanics.constraints.cavity import Cavity, SealedAir, enclosed_volume
from softgym_envs.mechanics.constraints.constraint import Constraint
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.elements.quadratic import add_midside_nodes, quadratic_triangles, split_triangles
from softgym_envs.mechanics.frames import frame_rows

MODULES = [
    import_module(f"{package.__name__}.{info.name}")
    for package in (constraints, beams)
    for info in iter_modules(package.__path__)
]
CLASSES = {
    name: cls
    for module in MODULES
    for name, cls in vars(module).items()
    if inspect.isclass(cls) and issubclass(cls, Constraint) and not inspect.isabstract(cls)
}


def make_cable(nodes, tetrahedra):
    # Two points share an element, one lies outside the mesh.
    points = np.array([[0.2, 0.3, 0.4], [0.22, 0.31, 0.41], [0.7, 0.5, 0.8], [1.1, 0.4, 0.6]])
    cable = Cable("cable", EmbeddedPoints(points, nodes, tetrahedra), np.array([-0.3, 0.1, 0.2]))
    return cable


def make_averaged_cable(nodes, tetrahedra):
    # The balls share nodes; one has fewer of them than the other.
    points = averaged_points([[0.4, 0.4, 0.4], [0.8, 0.8, 1.0]], nodes, tetrahedra, lambda weights: weights, 0.2)
    return Cable("cable", points, np.array([-0.3, 0.1, 0.2]))


def make_point(nodes, tetrahedra):
    return Point("point", EmbeddedPoints(np.array([0.6, 0.3, 0.7]), nodes, tetrahedra))


def make_bond(nodes, tetrahedra):
    points = EmbeddedPoints(np.array([[0.2, 0.7, 0.4], [0.3, 0.6, 0.4]]), nodes, tetrahedra)
    first, second = (
        EmbeddedPoints.from_weights(points.node_ids[k], points.weights[k], nodes) for k in range(2)
    )  # of neighbouring elements: they share nodes
    return Bond("bond", first, second, gap=np.array([-0.1, 0.1, 0.0]))


def surface(tetrahedra):
    """Outer triangles of a mesh, consistently oriented: the faces of one tetrahedron only."""
    faces = tetrahedra[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3)
    _, first, counts = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[first[counts == 1]]


def oriented(nodes, tetrahedra):
    corners = nodes[tetrahedra]
    turned = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0.0
    return np.where(turned[:, None], tetrahedra[:, [0, 2, 1, 3]], tetrahedra)


def make_cavity(nodes, tetrahedra):
    return Cavity("cavity", surface(oriented(nodes, tetrahedra)), nodes)


def make_sealed_air(nodes, tetrahedra):
    return SealedAir(make_cavity(nodes, tetrahedra), ambient=1.3)


def make_quadratic_cavity(nodes, tetrahedra):
    """Four curved triangles between nodes of the mesh: corners 0-3, midside nodes 4-9, in general position."""
    middle = {(0, 1): 4, (1, 2): 5, (0, 2): 6, (0, 3): 7, (1, 3): 8, (2, 3): 9}
    faces = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)]
    rows = [[*f, *(middle[min(p), max(p)] for p in (f[:2], f[1:], (f[2], f[0])))] for f in faces]
    return Cavity("cavity", np.array(rows), nodes)


def make_chamber(nodes, tetrahedra):
    # The tangents of a line are differences of points; that of the second one shares nodes with the first.
    lines = []
    for stations in ([[0.2, 0.3, 0.1], [0.3, 0.3, 0.5], [0.4, 0.2, 0.9]], [[0.6, 0.6, 0.2], [0.6, 0.7, 0.8]]):
        points = EmbeddedPoints(np.array(stations), nodes, tetrahedra)
        ids = np.hstack([points.node_ids[1:], points.node_ids[:-1]])
        lines.append(EmbeddedPoints.from_weights(ids, np.hstack([points.weights[1:], -points.weights[:-1]]), nodes))
    return Chamber("chamber", lines, area=0.7)


def make_servo(nodes, tetrahedra):
    # Derivatives hold for any three rows; only the value needs them to be directors.
    return Servo("servo", 4, np.array([0.2, 1.0, 0.3]), nodes)


def make_slide(nodes, tetrahedra):
    return Slide("slide", EmbeddedPoints(np.array([0.3, 0.3, 0.3]), nodes, tetrahedra), np.array([0.2, 1.0, -0.3]))


def make_pose(nodes, tetrahedra):
    return Pose("pose", 4, 1, nodes)


def make_turn(nodes, tetrahedra):
    return Pose("pose", 4, 5, nodes)


FACTORIES = {
    "Bond": make_bond,
    "Cable": make_cable,
    "Cable of averaged points": make_averaged_cable,
    "Cavity": make_cavity,
    "Cavity of quadratic triangles": make_quadratic_cavity,
    "Chamber": make_chamber,
    "Point": make_point,
    "Pose": make_pose,
    "Pose of a turn": make_turn,
    "SealedAir": make_sealed_air,
    "Servo": make_servo,
    "Slide": make_slide,
}


def full_hessian(constraint, x, effort):
    """The entries of `hessian` as a full matrix over all degrees of freedom."""
    entries = constraint.hessian(x, effort)
    if entries is None:
        return np.zeros((x.size, x.size))
    rows, columns = constraint.hessian_pattern()
    assert rows.shape == columns.shape and rows.size == entries.size
    out = np.zeros((x.size, x.size))
    np.add.at(out, (rows.ravel(), columns.ravel()), entries.ravel())
    return out


@pytest.fixture
def mesh(box):
    return box((1.0, 1.0, 1.0), (2, 2, 2), jitter=0.2)


@pytest.fixture(params=sorted(FACTORIES))
def constraint(request, mesh):
    return FACTORIES[request.param](*mesh)


@pytest.fixture
def moved(mesh, rng):
    nodes, _ = mesh
    return nodes @ Rotation.random(random_state=2).as_matrix() + 0.1 * rng.standard_normal(nodes.shape)


def differences(function, x, dofs, h=1e-6):
    """Central differences of ``function(x)`` with respect to the entries ``dofs`` of x, along the last axis."""
    columns = []
    for dof in dofs:
        plus, minus = x.copy(), x.copy()
        plus.ravel()[dof] += h
        minus.ravel()[dof] -= h
        columns.append((function(plus) - function(minus)) / (2 * h))
    return np.stack(columns, axis=-1)


def test_every_constraint_class_is_tested():
    assert set(CLASSES) == {name.split()[0] for name in FACTORIES}


def test_shapes(constraint, moved):
    k = len(constraint.dofs)
    assert len(np.unique(constraint.dofs)) == k
    assert constraint.value(moved).shape == (constraint.size,)
    assert constraint.jacobian(moved).shape == (constraint.size, k)
    assert len(constraint.unit) == 2
    # The model leaves out the hessian of classes that do not define one.
    linear = type(constraint).hessian is Constraint.hessian
    assert linear == (constraint.hessian(moved, np.ones(constraint.size)) is None)


def test_jacobian_is_the_derivative_of_the_value(constraint, moved):
    # Central differences with h = 1e-6 on values of order one: round-off 1e-10.
    np.testing.assert_allclose(
        constraint.jacobian(moved), differences(constraint.value, moved, constraint.dofs), atol=2e-9
    )


def test_value_depends_only_on_its_dofs(constraint, moved, rng):
    other = moved + rng.standard_normal(moved.shape)
    other.ravel()[constraint.dofs] = moved.ravel()[constraint.dofs]
    np.testing.assert_array_equal(constraint.value(other), constraint.value(moved))


def test_hessian_is_the_derivative_of_the_jacobian(constraint, moved, rng):
    effort = rng.uniform(0.5, 2.0, constraint.size)
    expected = differences(lambda x: effort @ constraint.jacobian(x), moved, constraint.dofs)
    hessian = full_hessian(constraint, moved, effort)
    inside = np.ix_(constraint.dofs, constraint.dofs)
    # The short segment of the cable (about 0.1) makes entries of order ten.
    size = max(0.1, np.abs(expected).max())
    np.testing.assert_allclose(hessian[inside], expected, atol=1e-8 * size)
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-13 * size)
    hessian[inside] = 0.0
    assert not hessian.any()


def test_hessian_is_linear_in_the_effort(constraint, moved, rng):
    a, b = rng.standard_normal((2, constraint.size))
    parts = [full_hessian(constraint, moved, effort) for effort in (a, b, 2.0 * a - b)]
    np.testing.assert_allclose(parts[2], 2.0 * parts[0] - parts[1], atol=1e-12)


def test_a_motion_of_the_whole_body_changes_only_what_is_held_in_space(constraint, mesh, moved):
    turn, shift = Rotation.random(random_state=7).as_matrix(), np.array([0.3, -0.2, 0.1])
    turned = moved @ turn.T + shift
    if isinstance(constraint, Cavity | Chamber):  # of the body alone
        np.testing.assert_allclose(constraint.value(turned), constraint.value(moved), atol=1e-13)
    elif isinstance(constraint, Point):
        np.testing.assert_allclose(constraint.value(turned), turn @ constraint.value(moved) + shift, atol=1e-13)


# -- slide ----------------------------------------------------------------------------------------------------------


def test_a_slide_pushes_a_rod_by_its_stiffness_along_and_across():
    # Steel wire: E A / L along it; across it 3 E I / L^3, with shear.
    length, radius, modulus = 0.2, 2e-3, 2e11
    builder = ModelBuilder()
    rod = add_rod(
        builder, [[0, 0, 0], [0, 0, length]], section=Section.circle(radius), elements=8, young_modulus=modulus
    )
    model = builder.build()
    section = Section.circle(radius)
    end = rod.points(length, (0.0, 0.0), model.nodes)
    model.add("a", Slide("along", end, [0, 0, 5.0]))
    model.add("a", Slide("across", end, [1, 0, 0]))
    effort = Statics(model).solve([-1e-8, 2e-8]).effort[:2]
    shear = 0.5 * modulus / (1.0 + 0.3) * section.area * section.shear[0]
    across = 1.0 / (length**3 / (3.0 * modulus * section.inertia[0]) + length / shear)
    np.testing.assert_allclose(effort, [-1e-8 * modulus * section.area / length, 2e-8 * across], rtol=1e-4)


@pytest.mark.parametrize("direction", [[0.0, 0.0, 0.0], [1.0, 0.0], [np.inf, 0.0, 0.0]])
def test_a_slide_needs_a_direction(mesh, direction):
    with pytest.raises(ValueError, match="direction of slide 'push' must be three numbers"):
        Slide("push", EmbeddedPoints(np.full((1, 3), 0.5), *mesh), direction)


def test_a_slide_moves_one_point(mesh):
    with pytest.raises(ValueError, match="slide 'push' needs exactly one embedded point, got 2"):
        Slide("push", EmbeddedPoints(np.full((2, 3), 0.5), *mesh), [1.0, 0.0, 0.0])


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


def test_cable_forces_balance_except_at_the_pull_point(mesh, moved):
    """Inner segments exert no net force; the first one pulls with unit tension."""
    cable = make_cable(*mesh)
    first = cable.path(moved)[:2]
    expected = (first[0] - first[1]) / np.linalg.norm(first[0] - first[1])
    np.testing.assert_allclose(cable.jacobian(moved)[0].reshape(-1, 3).sum(axis=0), expected, atol=1e-13)


def test_cable_with_a_segment_of_zero_length_is_rejected(mesh):
    nodes, tetrahedra = mesh
    twice = np.array([[0.5, 0.5, 0.5], [0.5, 0.5, 0.5]])
    with pytest.raises(ValueError, match="zero length"):
        Cable("c", EmbeddedPoints(twice, nodes, tetrahedra), np.zeros(3))
    with pytest.raises(ValueError, match="cable 'c'"):
        Cable("c", EmbeddedPoints(twice[:1], nodes, tetrahedra), np.full(3, np.nan))


# -- cavity ---------------------------------------------------------------------------------------------------------


def test_cavity_grows_as_the_volume_inside(mesh, rng):
    nodes, tetrahedra = mesh
    cavity = make_cavity(nodes, tetrahedra)
    assert cavity.rest_volume == pytest.approx(1.0, rel=1e-12)
    assert cavity.value(nodes)[0] == pytest.approx(0.0, abs=1e-14)
    F = np.eye(3) + 0.2 * rng.standard_normal((3, 3))
    assert cavity.value(nodes @ F.T)[0] == pytest.approx(np.linalg.det(F) - 1.0, rel=1e-12)
    assert cavity.volume(nodes + 100.0) == pytest.approx(1.0, rel=1e-11)
    assert cavity.unit == ("m3", "Pa")


def icosphere(levels):
    """Unit sphere: nodes on it and triangles."""
    golden = 0.5 * (1.0 + np.sqrt(5.0))
    nodes = [[s, t * golden, 0.0] for s in (-1, 1) for t in (-1, 1)]
    nodes = np.array([np.roll(node, k) for k in range(3) for node in nodes], dtype=float)
    nodes /= np.linalg.norm(nodes[0])
    near = np.linalg.norm(nodes[:, None] - nodes[None], axis=2) < 1.2
    triangles = [
        (a, b, c) for a in range(12) for b in range(a) for c in range(b) if near[a, b] and near[b, c] and near[a, c]
    ]
    triangles = [t if np.linalg.det(nodes[list(t)]) > 0.0 else t[::-1] for t in triangles]
    for _ in range(levels):
        nodes, middle, finer = list(nodes), {}, []
        for t in triangles:
            m = []
            for a, b in zip(t, (*t[1:], t[0]), strict=True):
                key = (min(a, b), max(a, b))
                if key not in middle:
                    middle[key] = len(nodes)
                    point = nodes[a] + nodes[b]
                    nodes.append(point / np.linalg.norm(point))
                m.append(middle[key])
            finer += [(t[0], m[0], m[2]), (m[0], t[1], m[1]), (m[2], m[1], t[2]), tuple(m)]
        triangles = finer
    return np.array(nodes), np.array(triangles)


def test_volume_of_a_sphere_and_its_gradient():
    errors = []
    for levels in (1, 2, 3):
        nodes, triangles = icosphere(levels)
        assert len(triangles) == 20 * 4**levels
        cavity = Cavity("sphere", triangles, nodes)
        errors.append(1.0 - cavity.rest_volume / (4.0 / 3.0 * np.pi))
        # Unit pressure pushes outward along the radius, with no net force or moment; dV = surface times dr.
        force = cavity.jacobian(nodes).reshape(-1, 3)
        np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-13)
        np.testing.assert_allclose(np.cross(nodes, force).sum(axis=0), 0.0, atol=1e-13)
        assert np.vdot(force, nodes) == pytest.approx(3.0 * cavity.rest_volume, rel=1e-12)
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert errors[2] < 0.01
    assert ((orders > 1.9) & (orders < 2.1)).all()


def test_quadratic_triangles_hold_a_curved_volume():
    """Midside nodes on the sphere: the error falls with the fourth power of the size."""
    errors = []
    for levels in (0, 1, 2):
        nodes, triangles = icosphere(levels)
        edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges, which = np.unique(edges, axis=0, return_inverse=True)
        middles = nodes[edges].sum(axis=1)
        middles /= np.linalg.norm(middles, axis=1)[:, None]
        six = np.hstack([triangles, len(nodes) + which.reshape(-1, 3)])
        nodes = np.vstack([nodes, middles])
        cavity = Cavity("sphere", six, nodes)
        errors.append(1.0 - cavity.rest_volume / (4.0 / 3.0 * np.pi))
        force = cavity.jacobian(nodes).reshape(-1, 3)
        np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-13)
        np.testing.assert_allclose(np.cross(nodes, force).sum(axis=0), 0.0, atol=1e-13)
        assert np.vdot(force, nodes) == pytest.approx(3.0 * cavity.rest_volume, rel=1e-12)
        # The opposite orientation is reversed.
        inward = Cavity("sphere", six[:, [0, 2, 1, 5, 4, 3]], nodes)
        np.testing.assert_allclose(inward.jacobian(nodes), cavity.jacobian(nodes), atol=1e-14)
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert errors[2] < 5e-4
    assert (orders > 3.5).all()


def test_flat_quadratic_triangles_are_linear_ones(mesh):
    """With midside nodes in the middle, the volume is the same; each midside node carries a third of the pressure."""
    nodes, tetrahedra = mesh
    finer, ten = add_midside_nodes(nodes, oriented(nodes, tetrahedra))
    outer = surface(oriented(nodes, tetrahedra))
    six = Cavity("six", quadratic_triangles(outer, ten), finer)
    three = Cavity("three", outer, nodes)
    split = Cavity("split", split_triangles(outer, ten), finer)
    assert six.rest_volume == pytest.approx(three.rest_volume, rel=1e-12)
    assert split.rest_volume == pytest.approx(three.rest_volume, rel=1e-12)
    forces = np.zeros_like(finer)
    forces.ravel()[six.dofs] = six.jacobian(finer)[0]
    corners = nodes[outer]
    areas = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    expected = np.zeros_like(finer)
    np.add.at(expected, quadratic_triangles(outer, ten)[:, 3:], areas[:, None] / 3.0)
    np.testing.assert_allclose(forces, expected, atol=1e-14)


def test_an_inward_surface_is_reversed(mesh):
    nodes, tetrahedra = mesh
    outward = make_cavity(nodes, tetrahedra)
    inward = Cavity("cavity", outward.triangles[:, ::-1], nodes)
    assert inward.rest_volume == pytest.approx(outward.rest_volume, rel=1e-14)
    np.testing.assert_allclose(inward.jacobian(nodes), outward.jacobian(nodes), atol=1e-15)
    assert enclosed_volume(nodes, outward.triangles[:, ::-1]) == pytest.approx(-1.0, rel=1e-12)


def test_a_surface_without_volume_is_rejected(mesh):
    nodes, tetrahedra = mesh
    triangles = make_cavity(nodes, tetrahedra).triangles
    with pytest.raises(ValueError, match="cavity 'c' is not closed"):
        Cavity("c", triangles[1:], nodes)
    flipped = triangles.copy()
    flipped[3] = flipped[3, ::-1]
    with pytest.raises(ValueError, match="not oriented consistently"):
        Cavity("c", flipped, nodes)
    with pytest.raises(ValueError, match="not closed"):
        Cavity("c", np.vstack([triangles, triangles[:1]]), nodes)
    for wrong in (triangles[:3], triangles.ravel(), np.zeros((4, 4), dtype=int)):
        with pytest.raises(ValueError, match=r"cavity 'c' needs triangles of shape \(k, 3\) or \(k, 6\)"):
            Cavity("c", wrong, nodes)
    with pytest.raises(ValueError, match="encloses no volume"):
        Cavity("c", triangles, nodes * [1.0, 1.0, 0.0])


# -- chamber --------------------------------------------------------------------------------------------------------


def straight_beam(count=5, order=2):
    nodes = np.vstack([frame_rows([s, 0.0, 0.0]) for s in np.linspace(0.0, 0.2, count)])
    section = Section.circle(0.01)
    return nodes, Beam(nodes, 4 * np.arange(count), section=section, young_modulus=1e6, order=order)


@pytest.mark.parametrize("order", [1, 2])
def test_chamber_is_area_times_the_growth_of_its_line(order):
    nodes, beam = straight_beam(order=order)
    chamber = Chamber("c", [beam.line(range(len(beam.rows)), (0.003, -0.002), nodes)], area=4e-5)
    assert chamber.rest_length == pytest.approx(0.2, rel=1e-13)
    assert chamber.value(nodes)[0] == pytest.approx(0.0, abs=1e-18)
    assert chamber.unit == ("m3", "Pa")
    longer = nodes.copy()
    longer[::4] *= 1.1
    assert chamber.value(longer)[0] == pytest.approx(4e-5 * 0.02, rel=1e-12)
    # Wider sections change the length of no straight line.
    longer.reshape(-1, 4, 3)[:, 2:] *= 1.3
    assert chamber.value(longer)[0] == pytest.approx(4e-5 * 0.02, rel=1e-12)


def test_chamber_off_the_axis_of_a_bent_beam():
    """On an arc of radius R a line at a distance y beyond the axis is (R + y) / R times as long."""
    R, y, count = 0.15, 0.004, 41
    angles = np.linspace(0.0, 0.2 / R, count)
    nodes, beam = straight_beam(count)
    lines = [beam.line(range(len(beam.rows)), (side * y, 0.0), nodes) for side in (1.0, -1.0)]
    bent = np.empty_like(nodes)
    for k, a in enumerate(angles):
        # The axis turns to the right (towards -y): d2 points away from the centre.
        tangent, outward = np.array([np.cos(a), -np.sin(a), 0.0]), np.array([np.sin(a), np.cos(a), 0.0])
        bent[4 * k : 4 * k + 4] = [R * outward - [0.0, R, 0.0], tangent, outward, [0.0, 0.0, 1.0]]
    values = [Chamber("c", [line], area=1.0).value(bent)[0] for line in lines]
    both = Chamber("c", lines, area=2.0).value(bent)[0]
    np.testing.assert_allclose(values, [0.2 * y / R, -0.2 * y / R], rtol=1e-4)
    assert both == pytest.approx(2.0 * sum(values), abs=1e-12)


@pytest.mark.parametrize("area", [0.0, -1e-5, np.nan, np.inf])
def test_a_chamber_without_area_is_rejected(area):
    nodes, beam = straight_beam()
    with pytest.raises(ValueError, match="chamber 'c': area"):
        Chamber("c", [beam.line(range(2), (0.0, 0.0), nodes)], area=area)


# -- servo ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 0.0, -2.0), (0.3, -0.5, 0.4)])
def test_servo_measures_the_turn_of_its_frame(axis):
    start = Rotation.random(random_state=6)
    nodes = np.vstack([np.zeros((2, 3)), frame_rows([0.1, 0.2, 0.3], start.as_matrix())])
    servo = Servo("servo", 2, np.array(axis), nodes)
    assert servo.unit == ("rad", "N m")
    assert servo.value(nodes)[0] == pytest.approx(0.0, abs=1e-15)
    direction = np.array(axis) / np.linalg.norm(axis)
    for angle in (-3.0, -0.5, 1e-6, 2.0, 3.1):
        turned = nodes.copy()
        turned[2:] = frame_rows([1.0, 2.0, 3.0], (Rotation.from_rotvec(angle * direction) * start).as_matrix())
        assert servo.value(turned)[0] == pytest.approx(angle, rel=1e-12)
        # Unit torque: the moment of the forces on the directors about the axis is one.
        force = servo.jacobian(turned)[0]
        assert np.cross(turned[servo.row], force) @ direction == pytest.approx(1.0, rel=1e-12)


def test_servo_without_an_axis_is_rejected(mesh):
    with pytest.raises(ValueError, match="servo 's': axis"):
        Servo("s", 4, np.zeros(3), mesh[0])


# -- bond -----------------------------------------------------------------------------------------------------------


def test_bond_is_the_offset_beyond_the_gap(mesh, moved):
    nodes, tetrahedra = mesh
    bond = make_bond(nodes, tetrahedra)
    np.testing.assert_allclose(bond.value(nodes), 0.0, atol=1e-14)  # the gap is that at rest
    np.testing.assert_allclose(bond.value(moved + [1.0, 2.0, 3.0]), bond.value(moved), atol=1e-13)
    # A force on the first point and its reaction on the second.
    forces = bond.jacobian(moved).reshape(3, -1, 3).sum(axis=1)
    np.testing.assert_allclose(forces, 0.0, atol=1e-13)
    point = EmbeddedPoints(np.array([0.2, 0.7, 0.4]), nodes, tetrahedra)
    anchored = Bond("b", point, np.array([0.2, 0.7, 0.3]))
    np.testing.assert_allclose(anchored.value(nodes), [0.0, 0.0, 0.1], atol=1e-14)
    np.testing.assert_allclose(anchored.jacobian(nodes).reshape(3, -1, 3).sum(axis=1), np.eye(3), atol=1e-13)


def test_bond_of_a_point_with_itself_has_no_derivative(mesh):
    point = make_point(*mesh).embedding
    np.testing.assert_allclose(Bond("b", point, point).jacobian(mesh[0]), 0.0, atol=1e-15)


def test_bond_needs_one_point_on_each_side(mesh):
    nodes, tetrahedra = mesh
    two = EmbeddedPoints(np.full((2, 3), 0.5), nodes, tetrahedra)
    for pair in ((two, two), (two, np.zeros(3))):
        with pytest.raises(ValueError, match="bond 'b' needs exactly one point on each side"):
            Bond("b", *pair)


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


def test_points_of_a_frame_are_at_their_coordinates_along_its_directors(rng):
    turn = Rotation.random(random_state=4).as_matrix()
    nodes = np.vstack([np.zeros((3, 3)), frame_rows([0.1, 0.2, 0.3], turn)])
    local = rng.standard_normal((5, 3))
    points = EmbeddedPoints.in_frame(3, local, nodes)
    np.testing.assert_allclose(points.points, local @ turn.T + [0.1, 0.2, 0.3], atol=1e-14)
    other = Rotation.random(random_state=5).as_matrix()
    nodes[3:] = frame_rows([-1.0, 0.0, 2.0], other)
    np.testing.assert_allclose(points.positions(nodes), local @ other.T + [-1.0, 0.0, 2.0], atol=1e-14)


def test_points_of_given_weights(mesh, rng):
    nodes, _ = mesh
    ids, weights = rng.integers(0, len(nodes), (4, 6)), rng.standard_normal((4, 6))
    points = EmbeddedPoints.from_weights(ids, weights, nodes)
    np.testing.assert_allclose(points.points, np.einsum("pk,pkd->pd", weights, nodes[ids]), atol=1e-14)
    assert (points.elements == -1).all()


def test_non_finite_points_are_rejected(mesh):
    with pytest.raises(ValueError, match="finite"):
        EmbeddedPoints(np.array([0.5, np.nan, 0.5]), *mesh)
