"""Contact with obstacles: derivatives, friction, condensed models, statics and dynamics against exact results."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.beams.prism import RoundedPrism
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.contact.contact import ContactSettings, ContactState
from softgym_envs.mechanics.contact.law import barrier, friction, friction_energy
from softgym_envs.mechanics.contact.obstacles import Plane, Sphere
from softgym_envs.mechanics.solvers.dynamics import Dynamics
from softgym_envs.mechanics.solvers.prediction import Bend
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.quantities import unchecked
from tests.helpers import box_mesh, contact_errors
from tests.verification.contact import block_on_incline

GRAVITY = 9.81


# -- the law ----------------------------------------------------------------------------------------------------------


def test_barrier_derivatives():
    gap, h = np.linspace(0.05, 1.1, 40) * 1e-3, 1e-9
    _, first, second = barrier(gap, 1e-3)
    plus, minus = barrier(gap + h, 1e-3), barrier(gap - h, 1e-3)
    np.testing.assert_allclose((plus[0] - minus[0]) / (2 * h), first, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose((plus[1] - minus[1]) / (2 * h), second, rtol=1e-6, atol=1e-3)
    assert (first <= 0.0).all() and (second >= 0.0).all() and first[gap < 1e-3].max() < 0.0


def test_friction_is_a_spring_that_slides(rng):
    stretch = 1e-3 * rng.normal(size=(40, 3))
    normal = rng.normal(size=(40, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    stiffness, limit = rng.uniform(1e3, 1e4, 40), rng.uniform(1.0, 8.0, 40)
    found = friction(stretch, normal, stiffness, limit)
    assert 5 < found.sliding.sum() < 35
    size = np.linalg.norm(found.force, axis=1)
    np.testing.assert_allclose(size[found.sliding], limit[found.sliding], rtol=1e-12)
    assert (size <= limit * (1.0 + 1e-12)).all()
    np.testing.assert_allclose(np.einsum("ki,ki->k", found.force, normal), 0.0, atol=1e-12)

    def energy(s):
        along = friction(s, normal, stiffness, limit).stretch
        return friction_energy(np.linalg.norm(along, axis=1), stiffness, limit)

    h = 1e-8
    for axis, e in enumerate(np.eye(3)):
        slope = (energy(stretch + h * e) - energy(stretch - h * e)) / (2 * h)
        np.testing.assert_allclose(slope, found.force[:, axis], rtol=1e-5, atol=1e-6)
        plus, minus = (friction(stretch + s * h * e, normal, stiffness, limit).force for s in (1, -1))
        np.testing.assert_allclose((plus - minus) / (2 * h), found.tangent[:, :, axis], rtol=1e-5, atol=1e-3)


# -- derivatives over the equations -----------------------------------------------------------------------------------


@pytest.fixture
def pressed(rng, block_and_box):
    """The block between a fixed plane and the box, which carries an obstacle; all turned and pushed a little."""
    model, frame = block_and_box
    model.set_contact(
        obstacles=[
            Plane((0.0, 0.0, -2e-4), (0.1, 0.0, 1.0), friction=0.5),
            RoundedPrism.box((0.012, 0.009, 0.0095), 0.002, frame=frame, friction=0.4),
            Plane((0.0, 0.0, 0.0242), (0.0, 0.02, -1.0), friction=0.3),
        ],
        settings=ContactSettings(distance=6e-4),
    )
    step = 1e-4 * rng.normal(size=model.equations)
    step[-3:] = 0.006 * rng.normal(size=3)
    state = ContactState(model.contact, model.kinematics, model.nodes)
    return model, state, model.nodes + model.kinematics.displacement(model.nodes, step)


def test_gradient_and_tangent_are_exact(pressed):
    """With friction that sticks and slides, and an obstacle that moves; limits of friction are held for the energy."""
    model, state, x = pressed
    contacts = state.contacts(x)
    assert set(contacts.obstacle) == {0, 1, 2} and 0 < contacts.sliding.sum() < contacts.count
    gradient, tangent = contact_errors(model, state, x, 1e-8)
    assert gradient < 1e-7 and tangent < 1e-6


def test_nothing_passes_through_an_obstacle(rng):
    """The free part of a way ends before the first point enters, however long the way is."""
    nodes, tetrahedra = box_mesh((0.02, 0.02, 0.01), (3, 3, 2))
    builder = ModelBuilder(floating=True)
    builder.add_solid(nodes, tetrahedra, fixed=np.zeros(len(nodes), bool), element="linear")
    model = builder.build()
    thin = RoundedPrism.box((0.05, 0.05, 3e-4), 2e-4, centre=(0.0, 0.0, -0.003))
    model.set_contact(obstacles=[thin, Sphere((0.05, 0.01, 0.005), 0.004)])
    state = ContactState(model.contact, model.kinematics, model.nodes)
    for _ in range(50):
        end = model.nodes + 0.2 * rng.normal(size=3)
        part = state.free_path(model.nodes, end)
        assert 0.0 < part <= 1.0
        for t in np.linspace(0.0, part, 200):
            assert min(pair.gaps(model.nodes + t * (end - model.nodes)).min() for pair in state.pairs) > 0.0


# -- blocks on planes -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rigid", [False, True], ids=["soft", "rigid"])
def test_block_holds_up_to_the_angle_of_friction(rigid):
    """tan 26.565 degrees = 0.5."""
    for degrees in (10.0, 26.5):
        model = block_on_incline(degrees, rigid=rigid)
        contacts = Statics(model, tolerance=1e-13).solve([]).contacts
        weight, angle = GRAVITY * model.mass, np.radians(degrees)
        expected = weight * np.array([-np.sin(angle), 0.0, np.cos(angle)])
        np.testing.assert_allclose(contacts.total[0], expected, atol=1e-6 * weight)
        assert contacts.smallest_gap > 0.0
    with pytest.raises(ConvergenceError):
        Statics(block_on_incline(26.65, rigid=rigid)).solve([])


def test_tall_block_tips_over_at_the_analytical_angle():
    """A block of width b and height h tips over at tan angle = b / h, here 21.80 degrees, before it slides.

    The corner carries the whole weight shortly before; the gap to the plane, 0.05 % of the height, moves the limit by
    less than the margin.
    """
    size = (0.008, 0.02, 0.02)
    limit = np.degrees(np.arctan(size[0] / size[2]))
    Statics(block_on_incline(limit - 0.3, size=size, rigid=True, friction=0.8, distance=1e-5)).solve([])
    with pytest.raises(ConvergenceError):
        Statics(block_on_incline(limit + 0.3, size=size, rigid=True, friction=0.8, distance=1e-5)).solve([])


@pytest.mark.parametrize("rigid", [False, True], ids=["soft", "rigid"])
def test_sliding_block_accelerates_as_coulomb_says(rigid):
    """a = g (sin angle - mu cos angle), after the block has settled; what friction takes from the energy is counted."""
    degrees = 35.0
    solver = Dynamics(block_on_incline(degrees, rigid=rigid, cells=(2, 2, 1)), step=1e-3)
    motions, speeds = [], []
    for _ in range(60):
        motions.append(solver.advance([]))
        speeds.append(solver.effector_velocity()[0])
    angle = np.radians(degrees)
    exact = GRAVITY * (np.sin(angle) - 0.5 * np.cos(angle))
    assert (speeds[-1] - speeds[29]) / 0.030 == pytest.approx(exact, rel=1e-4)
    total = [motion.energy + motion.dissipated for motion in motions]
    # Implicit Euler loses h/2 of the gained kinetic energy per step, nothing else.
    lost, gained = total[29] - total[-1], motions[-1].kinetic - motions[29].kinetic
    assert 0.0 <= lost < 0.04 * gained


def test_energy_growing_scheme_is_refused():
    with pytest.raises(ValueError, match="'generalised_alpha'.*use 'euler'"):
        Dynamics(block_on_incline(0.0), step=1e-3, scheme="generalised_alpha")


# -- condensed models -------------------------------------------------------------------------------------------------


def clamped_block(obstacles, *, distance=5e-4):
    """A block clamped at its top whose lower face touches a plane, with an effector in its middle."""
    nodes, tetrahedra = box_mesh((0.02, 0.02, 0.03), (3, 3, 4), jitter=0.2)
    builder = ModelBuilder()
    fixed = nodes[:, 2] > 0.0299
    builder.add_solid(nodes, tetrahedra, fixed=fixed, young_modulus=2e5, poisson_ratio=0.4, element="linear")
    model = builder.build()
    model.add_effector("middle", (0.01, 0.01, 0.01))
    model.set_contact(obstacles=obstacles, settings=ContactSettings(distance=distance))
    return model


def solved_by_differences(statics, start, force, h):
    """Central differences of the effector by its force, each from the memory ``start`` of friction."""
    x, effort = statics.x, statics.effort
    columns = []
    for e in np.eye(3):
        ends = []
        for sign in (1.0, -1.0):
            statics.restore(x, effort, memory=start)
            ends.append(statics.solve([], effector_force=force + sign * h * e).delta)
        columns.append((ends[0] - ends[1]) / (2 * h))
    return np.array(columns).T


@pytest.mark.parametrize(
    ("coefficient", "tolerance"), [(0.0, 1e-6), (0.3, 1e-5), (0.85, 1e-5)], ids=["frictionless", "0.3", "0.85"]
)
def test_compliance_is_the_derivative_of_the_equilibrium(coefficient, tolerance):
    """W with contact, in the loading direction where points slide; then it is not symmetric."""
    plane = Plane((0.0, 0.0, -4e-4), (0.05, 0.0, 1.0), friction=coefficient)
    statics = Statics(clamped_block([plane]), tolerance=1e-13, max_iterations=60)
    statics.solve([], effector_force=[0.0, 0.0, -0.8])
    start = statics.memory
    force = np.array([0.8, 0.1, -1.6])
    found = statics.solve([], effector_force=force)
    assert found.contacts.count > 5 and found.contacts.sliding.any() == (coefficient > 0.0)
    W = found.condensed.compliance
    differences = solved_by_differences(statics, start, force, 1e-4)
    assert np.abs(differences - W).max() < tolerance * np.abs(W).max()
    asymmetry = np.abs(W - W.T).max() / np.abs(W).max()
    assert asymmetry > 1e-3 if coefficient else asymmetry < 1e-12


def test_result_without_friction_does_not_depend_on_the_way():
    plane = Plane((0.0, 0.0, -4e-4), (0.05, 0.0, 1.0))
    ends = []
    for count in (1, 7):
        statics = Statics(clamped_block([plane]), tolerance=1e-12)
        for k in range(count):
            found = statics.solve([], effector_force=np.array([0.8, 0.1, -1.6]) * (k + 1) / count)
        ends.append(found.x)
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-10)


def test_equal_increments_predict_each_other():
    """The corrections of one increment start the next closer to its end; the end stays the same."""
    plane = Plane((0.0, 0.0, -4e-3), (0.0, 0.0, 1.0))
    force, counts, ends = np.array([2.0, 0.3, 0.0]), [], []
    for forget in (False, True):
        statics, count = Statics(clamped_block([plane]), tolerance=1e-9), 0
        for k in range(1, 7):
            if forget:
                statics.restore(statics.x, statics.effort, memory=statics.memory)
            found = statics.solve([], effector_force=k * force)
            count += found.iterations
        counts.append(count)
        ends.append(found.x)
    assert counts[0] < counts[1]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9)


@pytest.mark.parametrize("coefficient", [0.0, 0.4])
def test_a_load_that_does_not_change_costs_nothing_without_friction(coefficient):
    plane = Plane((0.0, 0.0, -4e-4), (0.0, 0.0, 1.0), friction=coefficient)
    statics = Statics(clamped_block([plane]), tolerance=1e-9)
    load = np.array([0.5, 0.0, -2.0])
    first = statics.solve([], effector_force=load)
    again = statics.solve([], effector_force=load)
    assert (again.iterations == 0) == (coefficient == 0.0)
    if coefficient == 0.0:
        np.testing.assert_array_equal(again.x, first.x)
        np.testing.assert_array_equal(again.condensed.compliance, first.condensed.compliance)


def test_bend_grows_with_the_square_of_the_increment():
    bend = Bend(np.array([1.0, 2.0]), np.array([0.1, 0.0, 0.3]))
    np.testing.assert_allclose(bend.expected(np.array([0.5, 1.0])), [0.025, 0.0, 0.075])
    assert bend.expected(np.array([-1.0, -2.0])) is None
    assert bend.expected(np.array([1.0, 2.1])) is None
    assert bend.expected(np.array([3.0, 6.0])) is None
    assert Bend(np.zeros(2), np.zeros(3)).expected(np.zeros(2)) is None


def test_equilibria_without_exact_compliance_are_as_accurate():
    plane = Plane((0.0, 0.0, -4e-4), (0.05, 0.0, 1.0), friction=0.5)
    force, found = np.array([0.2, 0.03, -0.4]), {}
    for exact in (False, True):
        statics = Statics(clamped_block([plane]), tolerance=1e-9, exact_compliance=exact)
        found[exact] = [statics.solve([], effector_force=k * force) for k in range(1, 5)]
    for near, exact in zip(found[False], found[True], strict=True):
        np.testing.assert_allclose(near.x, exact.x, atol=5e-9)
        np.testing.assert_allclose(near.delta, exact.delta, atol=5e-9)
        difference = np.abs(near.condensed.compliance - exact.condensed.compliance).max()
        assert difference < 0.02 * np.abs(exact.condensed.compliance).max()


def test_friction_remembers_where_it_stuck():
    """Unloading after sliding leaves an effector displaced; going back to a memory repeats the same step exactly."""
    plane = Plane((0.0, 0.0, -4e-4), (0.0, 0.0, 1.0), friction=0.4)
    statics = Statics(clamped_block([plane]), tolerance=1e-12)
    down = np.array([0.0, 0.0, -2.0])
    first = statics.solve([], effector_force=down)
    statics.solve([], effector_force=down + [1.5, 0.0, 0.0])
    back = statics.solve([], effector_force=down)
    assert back.delta[0] - first.delta[0] > 1e-5
    statics.restore(first.x, first.effort, memory=first.memory)
    statics.solve([], effector_force=down + [1.5, 0.0, 0.0])
    again = statics.solve([], effector_force=down)
    np.testing.assert_allclose(again.x, back.x, atol=1e-11)


def test_rows_of_contacts_predict_pressing_and_opening():
    """Eliminating the row of a pressed contact gives back W; the complementarity of rows predicts the next state."""
    plane = Plane((0.0, 0.0, -4e-4), (0.0, 0.0, 1.0), name="floor")
    wall = Plane((-0.002, 0.0, 0.0), (1.0, 0.0, 0.0), name="wall")
    statics = Statics(clamped_block([plane, wall]), tolerance=1e-12)
    found = statics.solve([], effector_force=[0.0, 0.0, -2.0])
    rows = statics.contact_model()
    assert rows.roles == (("e", 3), ("c", 2)) and [row.name for row in rows.labels[3:]] == ["floor", "wall"]
    np.testing.assert_allclose(rows.delta.c[0], 0.0, atol=1e-12)
    assert rows.lambda_.c[0] == pytest.approx(found.contacts.total[0, 2], rel=1e-9) and rows.lambda_.c[1] == 0.0
    assert rows.delta.c[1] == pytest.approx(0.002 - 5e-4, rel=0.2)
    W = rows.W
    # One row for a whole face leaves out that it can turn, so it gives back the normal direction only.
    eliminated = W.ee - W.ec[:, :1] @ W.ce[:1] / W.cc[0, 0]
    assert eliminated[2, 2] == pytest.approx(found.condensed.compliance[2, 2], rel=0.01)
    points = statics.contact_model(each_point=True)
    assert points.W.cc.shape == (found.contacts.count, found.contacts.count)
    eliminated = points.W.ee - points.W.ec @ np.linalg.solve(points.W.cc, points.W.ce)
    np.testing.assert_allclose(eliminated, found.condensed.compliance, atol=1e-9 * np.abs(W.ee).max())
    step = np.array([0.0, 0.0, -0.05])
    predicted = rows.lambda_.c[0] - (W.ce[0] @ step) / W.cc[0, 0]
    after = statics.solve([], effector_force=np.array([0.0, 0.0, -2.0]) + step)
    assert after.contacts.total[0, 2] - found.contacts.total[0, 2] == pytest.approx(
        predicted - rows.lambda_.c[0], rel=0.05
    )


@pytest.mark.parametrize("friction", [20.0, 0.4], ids=["sticking", "sliding"])
def test_rows_of_friction_give_back_the_compliance_of_sticking_and_sliding(friction):
    """Eliminating all points, with their slips or limits of friction, gives back W and predicts the next increment."""
    with unchecked("friction"):
        plane = Plane((0.0, 0.0, -4e-4), (0.0, 0.0, 1.0), friction=friction)
    statics = Statics(clamped_block([plane]), tolerance=1e-12)
    statics.solve([], effector_force=[0.0, 0.0, -2.0])
    found = statics.solve([], effector_force=[1.5, 0.0, -2.0])
    model = statics.contact_model(each_point=True, friction=True)
    k, t = len(model.coefficient), len(model.owner)
    assert (k, t) == (found.contacts.count, 2 * found.contacts.count) and not model.hold.any()
    forces, rubbing = model.lambda_.c, model.lambda_.t
    np.testing.assert_allclose(forces.sum(), found.contacts.pressing.sum(), rtol=1e-9)
    np.testing.assert_allclose(np.hypot(*rubbing.reshape(-1, 2).T).max(), np.abs(rubbing).max(), rtol=1e-9)
    slides = np.abs(rubbing) > (1.0 - 1e-6) * model.coefficient[model.owner] * forces[model.owner]
    assert slides.sum() == found.contacts.sliding.sum() and (slides.any() == (friction < 1.0))
    # Openings do not change, nor do slips; friction of points that slide follows the normal forces in place of that.
    W = model.W
    ours = np.block([[W.cc, W.ct], [W.tc, W.tt]])
    outside = np.vstack([W.ce, W.te])
    for j in np.flatnonzero(slides):
        ours[k + j] = 0.0
        ours[k + j, k + j] = 1.0
        ours[k + j, model.owner[j]] = -np.sign(rubbing[j]) * model.coefficient[model.owner[j]]
        outside[k + j] = 0.0
    eliminated = W.ee - np.hstack([W.ec, W.et]) @ np.linalg.solve(ours, outside)
    if not slides.any():
        exact = found.condensed.compliance
        np.testing.assert_allclose(eliminated, exact, atol=1e-6 * np.abs(exact).max())
        return
    # The next increment starts from springs that have caught up, so it is compared with that.
    step = np.array([1e-4, 0.0, 0.0])
    after = statics.solve([], effector_force=[1.5, 0.0, -2.0] + step)
    change = after.delta - found.delta
    np.testing.assert_allclose(eliminated @ step, change, atol=0.01 * np.abs(change).max())
    sticking = W.ee - np.hstack([W.ec, W.et]) @ np.linalg.solve(
        np.block([[W.cc, W.ct], [W.tc, W.tt]]), np.vstack([W.ce, W.te])
    )
    assert np.abs(sticking @ step - change).max() > 0.1 * np.abs(change).max()
