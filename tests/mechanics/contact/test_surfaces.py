"""Surfaces that touch in the mechanics of a model: of two bodies, and of meshed obstacles, fixed or on a frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from softgym_envs.extensions.beams.prism import RoundedPrism
from softgym_envs.extensions.beams.skins import box_skin
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.contact.contact import ContactSettings, ContactState
from softgym_envs.mechanics.contact.obstacles import MeshObstacle, Plane
from softgym_envs.mechanics.elements.rigid import box_inertia
from softgym_envs.mechanics.elements.tetrahedra import boundary_triangles
from softgym_envs.mechanics.solvers.statics import Statics
from tests.helpers import box_mesh, contact_errors


def mesh_box(half, cells, centre=(0.0, 0.0, 0.0), **options):
    """A meshed obstacle in the shape of a box."""
    nodes, tetrahedra = box_mesh(2.0 * np.asarray(half), cells)
    used, triangles = np.unique(boundary_triangles(tetrahedra), return_inverse=True)
    vertices = nodes[used] - half + np.asarray(centre)
    return MeshObstacle(vertices.tolist(), triangles.reshape(-1, 3).tolist(), **options)


FLOOR = mesh_box((0.03, 0.03, 0.005), (3, 3, 1), (0.01, 0.01, -0.0052), friction=0.5, name="floor")


@pytest.fixture
def pressed(rng, block_and_box):
    """The block between a meshed floor and the box, which carries a meshed obstacle around it; all moved a little."""
    model, frame = block_and_box
    lid = mesh_box((0.008, 0.007, 0.0096), (2, 2, 2), friction=0.4, frame=frame)
    model.set_contact(obstacles=[FLOOR, lid], settings=ContactSettings(distance=6e-4))
    step = 1e-5 * rng.normal(size=model.equations)
    step[-3:] = 0.004 * rng.normal(size=3)
    state = ContactState(model.contact, model.kinematics, model.nodes)
    return model, state, model.nodes + model.kinematics.displacement(model.nodes, step)


def test_gradient_and_tangent_are_exact(pressed):
    model, state, x = pressed
    assert model.contact.intersections(x) is None
    total = state.contacts(x).total
    assert total[0, 2] > 0.01 and total[1, 2] < -0.01
    gradient, tangent = contact_errors(model, state, x, 1e-9)
    assert gradient < 1e-6 and tangent < 1e-6


def test_a_part_does_not_touch_the_obstacle_that_it_carries(pressed):
    """The box lies inside the meshed obstacle on its own frame; lifted off the block and the floor, nothing acts."""
    model, state, _ = pressed
    frame = model.kinematics.frames.rows[0]
    x = model.nodes.copy()
    x[frame] += [0.0, 0.0, 0.01]
    solid = np.ones(len(x), bool)
    solid[frame : frame + 4] = False
    x[solid] += [0.0, 0.0, 0.002]
    state.begin(x)
    contacts = state.contacts(x)
    assert contacts.self_force == 0.0 and not contacts.total.any()
    assert contacts.smallest_gap == np.inf


def block_on(floor, degrees):
    angle = np.radians(degrees)
    builder = ModelBuilder(gravity=9.81 * np.array([np.sin(angle), 0.0, -np.cos(angle)]))
    nodes, tetrahedra = box_mesh((0.02, 0.02, 0.01), (3, 3, 2))
    builder.add_solid(
        nodes, tetrahedra, fixed=nodes[:, 2] > 0.0099, young_modulus=1e4, poisson_ratio=0.3, element="linear"
    )
    model = builder.build()
    model.add_effector("middle", (0.01, 0.01, 0.003))
    model.set_contact(obstacles=[floor], settings=ContactSettings(distance=4e-4))
    return model


def test_a_meshed_floor_carries_what_a_plane_carries():
    """The reaction of a soft block that hangs onto the floor; both barriers are much stiffer than the block."""
    plane = Plane((0.0, 0.0, -2e-4), (0.0, 0.0, 1.0))
    forces = []
    for floor in (FLOOR, plane):
        model = block_on(floor, 0.0)
        found = Statics(model).solve([], effector_force=[0.0, 0.0, -0.4])
        assert 0.0 < found.contacts.smallest_gap < 4e-4
        assert found.contacts.obstacles == (floor.name or "obstacle 1",)
        forces.append(found.contacts.total[0])
    assert forces[0][2] > 0.02
    assert forces[0][2] == pytest.approx(forces[1][2], rel=0.1)


def two_blocks():
    """A block that is clamped at its bottom, and a smaller one above it, clamped at its top."""
    builder = ModelBuilder()
    lower, tetrahedra = box_mesh((0.02, 0.02, 0.01), (3, 3, 2), jitter=0.1)
    builder.add_solid(
        lower, tetrahedra, fixed=lower[:, 2] < 1e-6, young_modulus=1e5, poisson_ratio=0.4, element="linear"
    )
    upper, tetrahedra = box_mesh((0.012, 0.012, 0.012), (2, 2, 3), jitter=0.1)
    upper = upper + [0.0043, 0.0037, 0.0103]
    builder.add_solid(
        upper, tetrahedra, fixed=upper[:, 2] > 0.0222, young_modulus=1e5, poisson_ratio=0.4, element="linear"
    )
    model = builder.build()
    model.add_effector("inside", (0.01, 0.01, 0.007))
    model.set_contact(settings=ContactSettings(self_contact=True, distance=4e-4))
    return model


@pytest.mark.parametrize(
    ("make", "force"),
    [
        (two_blocks, (0.1, 0.05, 1.0)),
        (lambda: block_on(replace(FLOOR, friction=0.0), 0.0), (0.005, 0.002, -0.1)),
    ],
    ids=["two bodies", "mesh"],
)
def test_compliance_is_the_derivative_of_the_equilibrium(make, force):
    statics = Statics(make(), tolerance=1e-13, max_iterations=60)
    found = statics.solve([], effector_force=force)
    W, h = found.condensed.compliance, 1e-5 * np.linalg.norm(force)
    assert found.contacts.self_force > 0.1
    columns = []
    for direction in np.eye(3):
        ends = []
        for sign in (1.0, -1.0):
            statics.restore(found.x, found.effort)
            ends.append(statics.solve([], effector_force=force + sign * h * direction).delta)
        columns.append((ends[0] - ends[1]) / (2 * h))
    assert np.abs(np.array(columns).T - W).max() < 1e-6 * np.abs(W).max()
    np.testing.assert_allclose(W, W.T, atol=1e-12 * np.abs(W).max())


def test_two_bodies_press_on_each_other_with_equal_forces():
    model = two_blocks()
    found = Statics(model, tolerance=1e-12).solve([], effector_force=[0.0, 0.0, 1.0])
    state = ContactState(model.contact, model.kinematics, model.nodes)
    force = -state.evaluate(found.x).gradient
    lower = np.arange(len(force)) < model.solids[0].corners.max() + 1
    assert force[~lower, 2].sum() > 0.1
    np.testing.assert_allclose(force[lower].sum(axis=0), -force[~lower].sum(axis=0), atol=1e-12)


def test_nothing_passes_through_a_thin_mesh(rng):
    nodes, tetrahedra = box_mesh((0.02, 0.02, 0.01), (3, 3, 2))
    builder = ModelBuilder(floating=True)
    builder.add_solid(nodes, tetrahedra, fixed=np.zeros(len(nodes), bool), element="linear")
    model = builder.build()
    thin = mesh_box((0.05, 0.05, 1e-4), (1, 1, 1), (0.0, 0.0, -0.003))
    model.set_contact(obstacles=[thin])
    state = ContactState(model.contact, model.kinematics, model.nodes)
    stopped = 0
    for _ in range(30):
        end = model.nodes + 0.1 * rng.normal(size=3)
        part = state.free_path(model.nodes, end)
        stopped += part < 1.0
        for t in np.linspace(0.0, part, 5):
            assert model.contact.intersections(model.nodes + t * (end - model.nodes)) is None
    assert 3 < stopped < 27
    assert model.contact.intersections(model.nodes - [0.0, 0.0, 0.005]) == (
        "surfaces of the body cross each other or a meshed obstacle"
    )


def box_on_a_block(shape, *, self_contact, obstacles=()):
    """A free rigid box with a skin, which an obstacle stands for, on a soft block."""
    nodes, tetrahedra = box_mesh((0.02, 0.02, 0.01), (4, 4, 2))
    builder = ModelBuilder(floating=True, gravity=(0.0, 0.0, -9.81))
    builder.add_solid(
        nodes, tetrahedra, fixed=nodes[:, 2] == 0.0, young_modulus=1e5, poisson_ratio=0.4, element="linear"
    )
    half = (0.006, 0.005, 0.004)
    frame = builder.add_frame((0.01, 0.01, 0.01 + half[2] + 3e-4))
    builder.add_mass(frame, 0.02, box_inertia(0.02, np.array(half)))
    model = builder.build()
    model.skins.append(box_skin(frame, half, model.nodes))
    model.set_contact(
        obstacles=[shape(half, frame), *obstacles], settings=ContactSettings(self_contact=self_contact, distance=4e-4)
    )
    return model


@pytest.mark.parametrize("meshed", [False, True], ids=["prism", "mesh"])
def test_a_skin_does_not_touch_beside_the_obstacle_that_stands_for_it(meshed):
    """Self-contact changes nothing: all forces are those of the obstacle, with its friction."""

    def shape(half, frame):
        if meshed:
            return mesh_box(half, (2, 2, 2), frame=frame, friction=0.5)
        return RoundedPrism.box(half, 1e-3, frame=frame, friction=0.5)

    gradients = []
    for self_contact in (False, True):
        model = box_on_a_block(shape, self_contact=self_contact)
        state = ContactState(model.contact, model.kinematics, model.nodes)
        gradients.append(state.evaluate(model.nodes).gradient)
    assert np.abs(gradients[0]).max() > 1e-3
    np.testing.assert_allclose(gradients[1], gradients[0], atol=1e-12)


def test_a_prism_that_cannot_touch_a_mesh_is_refused():
    def shape(half, frame):
        return RoundedPrism.box(half, 1e-3, frame=frame, name="box")

    assert box_on_a_block(shape, self_contact=False, obstacles=[FLOOR]).contact is not None
    with pytest.raises(ValueError, match="'box' stands for the skin .* make it a MeshObstacle"):
        box_on_a_block(shape, self_contact=True, obstacles=[FLOOR])
