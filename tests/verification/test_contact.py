"""The validation cases of contact on coarse meshes, and derivatives of equilibria that touch in many ways."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.extensions.beams.prism import RoundedPrism
from softgym_envs.extensions.beams.skins import box_skin, tube_skin
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.contact.contact import ContactSettings, ContactState
from softgym_envs.mechanics.contact.obstacles import Cylinder, MeshObstacle, Plane, Sphere
from softgym_envs.mechanics.elements.rigid import box_inertia
from softgym_envs.mechanics.solvers.dynamics import Dynamics
from softgym_envs.mechanics.solvers.statics import Statics
from tests.helpers import box_mesh
from tests.verification import contact as cases


def within_tolerance(rows):
    for row in rows:
        print(f"{row.case}, {row.setting}: {row.error:.3g} of {row.tolerance:g}")
    assert rows
    for row in rows:
        assert abs(row.error) <= row.tolerance, f"{row.case}, {row.setting}"
    return rows


# -- exact solutions --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("element", "finest"), [("linear", 0.2), ("quadratic", 0.5)])
def test_sphere_on_a_half_space(element, finest):
    """Hertz: 8 % with linear elements and 2 % with quadratic ones, 5 % of the contact radius."""
    pytest.importorskip("gmsh")
    within_tolerance(cases.hertz(((element, finest, 0.25),)))


def test_sphere_moved_sideways_on_a_half_space():
    """Cattaneo and Mindlin on a coarse mesh, which is a few per cent too stiff; the benchmark has a finer one."""
    pytest.importorskip("gmsh")
    within_tolerance(cases.cattaneo_mindlin(0.5, 0.5, (0.5,), tolerances=(0.06, 0.06)))


def test_contact_passes_on_a_uniform_pressure():
    within_tolerance(cases.patch())


def test_hard_contact_is_the_limit_of_small_distances():
    rows = within_tolerance(cases.signorini())
    errors = np.array([row.error for row in rows])
    np.testing.assert_allclose(errors[:-1] / errors[1:], 2.0, atol=0.1)  # first order in the distance


def test_cantilever_on_a_cylinder():
    within_tolerance(cases.beam_on_cylinder())


def test_block_slides_down_as_coulomb_says():
    within_tolerance(cases.sliding())


def test_bouncing_block_loses_energy_in_order_of_the_step():
    lost = [row.value for row in within_tolerance(cases.bouncing())]
    assert 0.0 < lost[2] < lost[1] < lost[0] < 0.5
    assert lost[1] / lost[2] == pytest.approx(2.0, rel=0.15)


def test_blocks_that_collide_keep_their_momentum():
    within_tolerance(cases.collision())


def test_friction_between_surfaces_creeps_as_its_smoothing_says():
    within_tolerance(cases.creep())


# -- what holds at every step -----------------------------------------------------------------------------------------


def carried_ball(obstacle, *, friction_above=0.0):
    """A clamped soft block under an obstacle on a frame, which a beam guides along z."""
    nodes, tetrahedra = box_mesh((0.02, 0.02, 0.01), (4, 4, 2), jitter=0.1)
    builder = ModelBuilder()
    start = builder.add_solid(
        nodes - [0.01, 0.01, 0.01],
        tetrahedra,
        fixed=nodes[:, 2] == 0.0,
        young_modulus=1e5,
        poisson_ratio=0.4,
        element="linear",
    )
    assert start == 0
    frame = builder.add_frame((0.001, 0.002, 0.0126), cases.UP, fixed_spin=True)
    end = builder.add_frame((0.001, 0.002, 0.06), cases.UP, fixed=True, fixed_spin=True)
    builder.add_element(Beam, [frame, end], order=1, section=Section.circle(6e-3), young_modulus=1e6)
    model = builder.build()
    model.add("a", Point("ball", EmbeddedPoints.in_frame(frame, np.zeros(3), model.nodes)))
    model.add_effector("inside", (0.0, 0.0, -0.003))
    model.set_contact(
        obstacles=[replace(obstacle, frame=frame)], settings=ContactSettings(distance=4e-4, stiffness=1e4)
    )
    return model


BALL = Sphere((0.0, 0.0, 0.0), 0.012, name="ball")
DOWN = np.array([0.001, 0.002, 0.0126 - 2.2e-3])


def test_action_and_reaction():
    """The forces and moments of contact between a body and a carried obstacle cancel."""
    model = carried_ball(replace(BALL, friction=0.5))
    found = Statics(model).solve(DOWN)
    statics = Statics(model)
    statics.solve(DOWN)
    found = statics.solve(DOWN + [4e-4, 2e-4, 0.0])
    assert found.contacts.sliding.any() and not found.contacts.sliding.all()
    state = ContactState(model.contact, model.kinematics, model.nodes)
    state.memory = statics.memory
    gradient = state.evaluate(found.x).gradient
    frame = model.contact.obstacles[0].frame
    directors = slice(frame + 1, frame + 4)
    force = gradient.sum(axis=0) - gradient[directors].sum(axis=0)
    moment = np.cross(found.x, gradient).sum(axis=0)
    assert np.abs(gradient).max() > 0.01
    np.testing.assert_allclose(force, 0.0, atol=1e-12)
    np.testing.assert_allclose(moment, 0.0, atol=1e-14)


def test_gaps_are_positive_at_every_accepted_step(monkeypatch):
    """Also within Newton's method, after long steps."""
    model = carried_ball(BALL)
    statics = Statics(model)
    linear, gaps = statics.linearisation, []
    factorise = linear.factorise

    def recorded(assembled, x, **options):
        gaps.append(min(pair.gaps(x).min() for pair in linear.contact.pairs))
        return factorise(assembled, x, **options)

    monkeypatch.setattr(linear, "factorise", recorded)
    for depth in (0.006, 0.0, 0.005):
        statics.solve([0.001, 0.002, 0.0126 - depth])
    assert len(gaps) > 10 and min(gaps) > 0.0 and min(gaps) < 3e-4


def test_frictionless_equilibria_do_not_depend_on_the_number_of_steps():
    ends = []
    for steps in (1, 5):
        statics = Statics(carried_ball(BALL), tolerance=1e-12)
        start = np.array([0.001, 0.002, 0.0126])
        for k in range(steps):
            found = statics.solve(start + (k + 1) / steps * (DOWN - start))
        ends.append(found)
    np.testing.assert_allclose(ends[0].x, ends[1].x, atol=1e-10)


# -- compliance -------------------------------------------------------------------------------------------------------


def check_compliance(model, before, after, h, tolerance, mode="effort"):
    """Changes of values and of efforts fulfil ``change(delta) = W change(effort)``, by differences of fourth order.

    Args:
        model: the body.
        before: commands of actuators and forces on effectors at which friction remembers.
        after: those at which W is tested, reached in one increment.
        h: steps of the commands and forces, shape (size,).
        tolerance: relative to the diagonal of W.
        mode: of the actuators.
    """
    statics = Statics(model, tolerance=1e-13, max_iterations=80)
    actuators = dict(model.roles).get("a", 0)

    def solve(commands):
        return statics.solve(commands[:actuators], mode, effector_force=commands[actuators:])

    solve(np.asarray(before, dtype=float))
    memory = statics.memory
    found = solve(np.asarray(after, dtype=float))
    contacts = found.contacts
    print(f"{found.increments} increments, {contacts.count} points, {contacts.sliding.sum()} slide")
    rubs = any(each.friction for each in model.contact.obstacles)
    assert found.increments == 1 or not rubs
    W, deltas, efforts = found.condensed.compliance, [], []
    for k, step in enumerate(h):
        ends = []
        for factor in (2.0, 1.0, -1.0, -2.0):
            statics.restore(found.x, found.effort, memory=memory)
            changed = np.array(after, dtype=float)
            changed[k] += factor * step
            ends.append(solve(changed))
            assert ends[-1].increments == 1
        deltas.append((8.0 * (ends[1].delta - ends[2].delta) - (ends[0].delta - ends[3].delta)) / (12.0 * step))
        efforts.append((8.0 * (ends[1].effort - ends[2].effort) - (ends[0].effort - ends[3].effort)) / (12.0 * step))
    changes, efforts = np.array(deltas).T, np.array(efforts).T
    size = np.sqrt(np.abs(np.diag(W)))
    error = np.abs(changes - W @ efforts) / size[:, None] / np.linalg.norm(size[:, None] * efforts, axis=0)
    print(f"largest error of W {error.max():.2e}")
    assert error.max() < tolerance
    return found


@pytest.mark.parametrize(
    ("friction", "tolerance"), [(0.0, 1e-6), (0.3, 1e-5)], ids=["frictionless", "with sliding points"]
)
@pytest.mark.parametrize("shape", ["sphere", "prism"])
def test_compliance_with_an_obstacle_that_moves(shape, friction, tolerance):
    box = RoundedPrism.box((0.012, 0.008, 0.007), 0.003, name="box")
    model = carried_ball(replace(BALL if shape == "sphere" else box, friction=friction))
    before = [*(DOWN + [0.0, 0.0, 4e-4]), 0.0, 0.0, 0.0]
    after = [*(DOWN + [3e-4, 2e-4, 0.0]), 0.02, 0.01, -0.05]
    h = np.array([1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4])
    found = check_compliance(model, before, after, h, tolerance, "displacement")
    assert found.contacts.count > 5 and found.contacts.sliding.any() == (friction > 0.0)


@pytest.mark.parametrize(("friction", "tolerance"), [(0.0, 1e-6), (0.4, 1e-5)], ids=["frictionless", "0.4"])
def test_compliance_of_a_bending_finger_with_cables_on_a_cylinder(friction, tolerance):
    nodes, tetrahedra = box_mesh((0.06, 0.01, 0.01), (12, 2, 2))
    builder = ModelBuilder()
    builder.add_solid(
        nodes, tetrahedra, fixed=nodes[:, 0] == 0.0, young_modulus=2e5, poisson_ratio=0.4, element="linear"
    )
    model = builder.build()
    for y in (0.003, 0.007):
        model.add_cable(f"cable {y}", [(0.055, y, 0.001), (0.03, y, 0.001)], (-0.005, y, 0.001))
    model.add_effector("tip", (0.06, 0.005, 0.005))
    cylinder = Cylinder((0.035, 0.0, -0.0085), (0.1, 1.0, 0.0), 0.008, friction=friction)
    model.set_contact(obstacles=[cylinder], settings=ContactSettings(distance=4e-4))
    h = np.array([1e-5, 1e-5, 1e-5, 1e-5, 1e-5])
    found = check_compliance(model, [0.45, 0.5, 0, 0, 0], [0.5, 0.6, 0.0, 0.003, 0.002], h, tolerance)
    assert found.contacts.count > 2 and found.contacts.sliding.any() == (friction > 0.0)


@pytest.mark.parametrize(("friction", "tolerance"), [(0.0, 1e-6), (0.3, 1e-5)], ids=["frictionless", "0.3"])
def test_compliance_of_a_beam_whose_skin_touches(friction, tolerance):
    """A beam on a sphere, with a rigid block at its tip that touches a plane."""
    builder = ModelBuilder()
    places = np.linspace(0.0, 0.1, 9)
    frames = [builder.add_frame((x, 0, 0), fixed=x == 0.0, fixed_spin=x == 0.0) for x in places]
    builder.add_element(
        Beam, frames, section=Section.rectangle(8e-3, 6e-3), order=2, young_modulus=1e6, poisson_ratio=0.3
    )
    model = builder.build()
    half = (0.004, 0.006, 0.006)
    outline = 1e-3 * np.array([(-4, -3), (4, -3), (4, 3), (-4, 3)])
    model.skins.append(tube_skin(model.blocks[0], model.nodes, outline))
    model.skins.append(box_skin(frames[-1], half, model.nodes))
    model.add("e", Point("tip", EmbeddedPoints.in_frame(frames[-1], (0.002, 0.001, 0.0), model.nodes)))
    model.set_contact(
        obstacles=[
            Sphere((0.0505, 0.001, -0.0132), 0.01, friction=friction, name="ball"),
            Plane((0.1, 0.0, -0.0085), (0.02, 0.03, 1.0), friction=friction, name="floor"),
        ],
        settings=ContactSettings(distance=4e-4, stiffness=1e4),
    )
    found = check_compliance(model, [0, 0, -0.07], [0.01, 0.01, -0.08], 1e-5 * np.ones(3), tolerance)
    assert set(found.contacts.obstacle) == {0, 1} and found.contacts.sliding.any() == (friction > 0.0)


def test_compliance_with_self_contact_and_an_obstacle():
    """Two soft fingers that press on each other, one of which stands against a wall."""
    builder = ModelBuilder()
    for x in (0.0, 0.0063):
        nodes, tetrahedra = box_mesh((0.006, 0.008, 0.03), (2, 2, 6), jitter=0.1, seed=int(1e4 * x))
        fixed = nodes[:, 2] == 0.0
        builder.add_solid(
            nodes + [x, 0, 0], tetrahedra, fixed=fixed, young_modulus=2e5, poisson_ratio=0.4, element="linear"
        )
    model = builder.build()
    model.add("e", Point("left", model.embed(np.array([0.003, 0.004, 0.029]), block=0)))
    model.add("e", Point("right", model.embed(np.array([0.009, 0.004, 0.027]), block=1)))
    wall = Plane((0.0145, 0.0, 0.0), (-1.0, 0.05, 0.0), name="wall")
    model.set_contact(obstacles=[wall], settings=ContactSettings(self_contact=True, distance=4e-4))
    efforts = [0.2, 0.01, 0.0, 0.02, 0.005, 0.0]
    found = check_compliance(model, np.zeros(6), efforts, 1e-5 * np.ones(6), 1e-6)
    assert found.contacts.self_force > 0.1 and found.contacts.count > 3


# -- meshed obstacles -------------------------------------------------------------------------------------------------


def test_a_meshed_sphere_presses_as_the_sphere():
    """The mesh lies inside the sphere by less than a hundredth of its radius."""
    k = np.arange(800) + 0.5
    height, turn = 1.0 - 2.0 * k / len(k), np.pi * (1.0 + np.sqrt(5.0)) * k
    across = np.sqrt(1.0 - height**2)
    points = BALL.radius * np.column_stack([across * np.cos(turn), across * np.sin(turn), height])
    triangles = ConvexHull(points).simplices
    a, b, c = points[triangles].swapaxes(0, 1)
    inward = np.einsum("ti,ti->t", np.cross(b - a, c - a), a) < 0.0
    triangles[inward] = triangles[inward, ::-1]
    forces = []
    for shape in (BALL, MeshObstacle(points.tolist(), triangles.tolist(), name="ball")):
        found = Statics(carried_ball(shape), max_iterations=60).solve(DOWN)
        assert 0.0 < found.contacts.smallest_gap < 4e-4
        forces.append(found.contacts.total[0])
    assert forces[0][2] < -0.5
    np.testing.assert_allclose(forces[1], forces[0], atol=0.05 * -forces[0][2])


# -- motion -----------------------------------------------------------------------------------------------------------


def test_a_soft_and_a_rigid_block_exchange_momentum():
    """A free rigid box with an obstacle hits a free soft block: the total momentum and the energy."""
    builder = ModelBuilder(floating=True)
    nodes, tetrahedra = box_mesh((0.01, 0.01, 0.01), (3, 3, 3))
    builder.add_solid(
        nodes, tetrahedra, fixed=np.zeros(len(nodes), bool), young_modulus=1e5, poisson_ratio=0.3, element="linear"
    )
    half = np.array([0.006, 0.006, 0.004])
    frame = builder.add_frame((0.0062, 0.0047, 0.01 + half[2] + 6e-4))
    builder.add_mass(frame, 0.002, box_inertia(0.002, half))
    model = builder.build()
    model.skins.append(box_skin(frame, half.tolist(), model.nodes))
    box = RoundedPrism.box(half.tolist(), 1e-3, frame=frame, friction=0.3)
    model.set_contact(obstacles=[box], settings=ContactSettings(distance=5e-4))
    solver = Dynamics(model, step=2e-4)
    speed = np.zeros(model.equations)
    # The equations hold three components of each free row first, among them the frame's origin, and the spins last.
    speed[2 : 3 * len(nodes) : 3] = 0.3
    speed[3 * len(nodes) + 1] = 0.05
    solver.launch(speed)
    origin = np.ones(len(model.nodes))
    origin[frame + 1 : frame + 4] = 0.0
    mass = model.assembly.mass_matrix().rows
    first, energy = origin @ (mass @ solver.velocity), sum(solver.energies())
    np.testing.assert_allclose(first, [0.0, 0.05 * 0.002, 0.3 * (model.mass - 0.002)], rtol=1e-9, atol=1e-15)
    energies, touched = [energy], False
    for _ in range(50):
        motion = solver.advance([])
        touched |= bool(motion.equilibrium.contacts.count)
        energies.append(motion.energy + motion.dissipated)
    assert touched and not motion.equilibrium.contacts.count
    np.testing.assert_allclose(origin @ (mass @ motion.velocity), first, atol=1e-7 * first[2])
    assert motion.velocity[frame, 2] > 0.1
    assert np.diff(energies).max() < 1e-9 * energy
