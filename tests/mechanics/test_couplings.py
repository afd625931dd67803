"""Statics of coupled bodies: bonds, forces on effectors, driven contacts, cavities by pressure and by volume."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.extensions.beams.chamber import Chamber
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.bond import Bond
from softgym_envs.mechanics.constraints.cavity import Cavity
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.elements.quadratic import quadratic_triangles
from softgym_envs.mechanics.frames import rotation_of
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solids import SOLIDS
from softgym_envs.mechanics.solvers.statics import Statics


def relative(found, expected):
    return np.abs(found - expected).max() / np.abs(expected).max()


def compliance_by_differences(statics, state, solve, steps):
    """Columns of W from one step of each effort; ``solve(efforts)`` finds an equilibrium from the same start."""
    columns = []
    for row, step in enumerate(steps):
        ends = []
        for sign in (1, -1):
            statics.restore(state.x, state.effort)
            effort = state.condensed.effort.copy()
            effort[row] += sign * step
            ends.append(solve(effort).condensed.delta.array)
        columns.append((ends[0] - ends[1]) / (2 * step))
    return np.column_stack(columns)


# -- bonds ----------------------------------------------------------------------------------------------------------


@pytest.fixture(params=["linear", "averaged"])
def bonded(request, box):
    """A soft column with a cable and, held by three bonds, a rigid part with an effector and a contact."""
    nodes, tetrahedra = box((0.02, 0.02, 0.06), (2, 2, 5), jitter=0.2)
    body = ModelBuilder()
    body.add_solid(
        nodes,
        tetrahedra,
        fixed=nodes[:, 2] < 1e-9,
        element=request.param,
        young_modulus=2e5,
        poisson_ratio=0.45,
        density=1000.0,
    )
    turn = Rotation.from_rotvec([0.2, 0.5, -0.3]).as_matrix()
    part = body.add_frame([0.04, 0.01, 0.05], turn)
    model = body.build()
    model.add_cable(
        "cable", np.array([[0.004, 0.01, 0.02], [0.004, 0.01, 0.055]]), np.array([0.004, 0.01, -0.01]), unilateral=False
    )
    for k, point in enumerate(np.array([[0.02, 0.004, 0.05], [0.02, 0.016, 0.05], [0.02, 0.01, 0.03]])):
        local = (point - model.nodes[part]) @ turn
        model.add("b", Bond(f"bond {k}", EmbeddedPoints.in_frame(part, local, model.nodes), model.embed(point)))
    model.add("e", Point("hand", EmbeddedPoints.in_frame(part, [0.01, 0.002, 0.003], model.nodes)))
    model.add("c", Point("side", model.embed(np.array([0.0, 0.01, 0.04]))))
    return model, part


FORCE = np.array([0.05, -0.03, -0.1])


def test_bonds_hold_and_carry_the_forces_on_a_rigid_part(bonded):
    """Forces and moments on the part, by hand: its bonds against the load of its effector."""
    model, part = bonded
    found = Statics(model, tolerance=1e-13).solve([0.004], effector_force=FORCE)
    bonds = found.effort[-9:].reshape(3, 3)
    np.testing.assert_allclose(found.delta[-9:], 0.0, atol=1e-13)
    np.testing.assert_allclose(bonds.sum(axis=0), -FORCE, rtol=0, atol=1e-9)
    places = np.array([c.first.positions(found.x)[0] for c in model.constraints["b"]])
    hand = model.constraints["e"][0].value(found.x)
    moment = np.cross(places - hand, bonds).sum(axis=0)
    assert np.abs(bonds).max() > 0.1
    np.testing.assert_allclose(moment, 0.0, atol=1e-10)
    # The points on the column feel the reactions: without the part, such forces give the same shape of the column.
    alone = MechanicalModel(model.nodes[:part], model.blocks, fixed=model.fixed[:part])
    alone.add("a", model.constraints["a"][0])
    for bond, force in zip(model.constraints["b"], -bonds, strict=True):
        ids, weights = bond._ids[4:], -bond._weights[4:]  # after the frame's four rows
        np.add.at(alone.nodal_loads, ids, weights[:, None] * force)
    same = Statics(alone, tolerance=1e-13).solve([0.004])
    np.testing.assert_allclose(same.x, found.x[:part], rtol=0, atol=1e-10)
    assert same.effort[0] == pytest.approx(found.effort[0], rel=1e-8)


def test_bonds_are_eliminated_from_the_condensed_model(bonded):
    """W of cable, effector and contact, with the bonds holding, is the derivative of the equilibrium (1e-8)."""
    model, _ = bonded
    statics = Statics(model, tolerance=1e-14)
    state = statics.solve([0.003], effector_force=FORCE, contact=[0.1, 0.0, 0.05])
    assert state.condensed.roles == (("a", 1), ("e", 3), ("c", 3))
    assert model.roles[-1] == ("b", 9)
    assert state.condensed.compliance.shape == (7, 7)
    assert state.stable
    W = state.condensed.compliance
    np.testing.assert_allclose(state.condensed.delta.array, state.delta[:7], atol=1e-14)
    found = compliance_by_differences(
        statics,
        state,
        lambda e: statics.solve(e[:1], "effort", effector_force=e[1:4], contact=e[4:]),
        [1e-3, *(6 * [1e-4])],
    )
    for row in range(7):
        assert relative(found[:, row], W[:, row]) < 1e-6
    assert np.linalg.eigvalsh(W)[0] > 0.0


def test_the_stiffness_of_bonds_has_no_effect(bonded):
    model, _ = bonded
    states = []
    stiffness = model.assembly.bond_stiffness
    assert stiffness > 0.0
    for factor in (1.0, 0.03, 30.0):
        model.assembly.bond_stiffness = factor * stiffness
        states.append(Statics(model, tolerance=1e-13).solve([0.004], effector_force=FORCE))
    for other in states[1:]:
        np.testing.assert_allclose(other.x, states[0].x, rtol=0, atol=1e-11)
        np.testing.assert_allclose(other.effort, states[0].effort, rtol=0, atol=1e-8)
        assert relative(other.condensed.compliance, states[0].condensed.compliance) < 1e-8


def test_a_bond_to_a_point_in_space_and_a_gap(box):
    """The free end of a bar is pulled to the anchor and gap of its bond, by Hooke's force."""
    nodes, tetrahedra = box((0.1, 0.01, 0.01), (8, 1, 1))
    model = MechanicalModel.from_mesh(
        nodes, tetrahedra, fixed=nodes[:, 0] == 0.0, young_modulus=1e6, poisson_ratio=0.0, element="linear"
    )
    tip = model.embed(np.array([0.1, 0.005, 0.005]))
    model.add("b", Bond("hook", tip, np.array([0.1, 0.005, 0.0]), gap=np.array([0.0, 0.0, 0.01])))
    statics = Statics(model)
    assert statics.unilateral.size == 0
    found = statics.solve([])
    np.testing.assert_allclose(tip.positions(found.x)[0], [0.1, 0.005, 0.01], atol=1e-10)
    assert found.effort[2] > 0.0 and found.condensed.roles == ()
    # The same, as the force of a contact.
    plain = MechanicalModel.from_mesh(
        nodes, tetrahedra, fixed=nodes[:, 0] == 0.0, young_modulus=1e6, poisson_ratio=0.0, element="linear"
    )
    plain.add("c", Point("tip", tip))
    driven = Statics(plain).solve([], contact=found.effort)
    np.testing.assert_allclose(driven.x, found.x, rtol=0, atol=1e-9)


def test_a_body_held_by_bonds_alone(box):
    """Four bonds at corners instead of a clamp: statically indeterminate, yet stable; it hangs under its weight."""
    nodes, tetrahedra = box((0.02, 0.02, 0.04), (2, 2, 3))
    body = ModelBuilder(gravity=(0.0, 0.0, -9.81))
    wall = body.add_frame([0.0, 0.0, 0.0], fixed=True, fixed_spin=True)
    body.add_solid(nodes, tetrahedra, fixed=[], young_modulus=1e5, poisson_ratio=0.4, density=1000.0, element="linear")
    model = body.build()
    for k, corner in enumerate([[0, 0, 0.04], [0.02, 0, 0.04], [0, 0.02, 0.04], [0.02, 0.02, 0.04]]):
        here = EmbeddedPoints.in_frame(wall, corner, model.nodes)
        model.add("b", Bond(str(k), model.embed(np.array(corner)), here))
    found = Statics(model, tolerance=1e-13).solve([])
    assert found.stable
    np.testing.assert_allclose(found.effort.reshape(4, 3).sum(axis=0), [0, 0, 1000 * 16e-6 * 9.81], rtol=0, atol=1e-9)
    assert found.x[4:, 2].min() < -1e-5


def test_a_rigid_pendulum_hangs_in_line_with_its_load(box):
    """Only the geometric stiffness of load and bond holds it, not an element."""
    body = ModelBuilder()
    body.add_solid(*box(), fixed=lambda x: x[:, 0] == 0.0, element="linear")
    base = body.add_frame([0.0, 0.0, 0.5], fixed=True, fixed_spin=True)
    link = body.add_frame([0.1, 0.0, 0.5], fixed_spin=(True, False, True))
    model = body.build()
    pin, joint = (
        EmbeddedPoints.in_frame(row, local, model.nodes) for row, local in ((link, [-0.1, 0, 0]), (base, [0, 0, 0]))
    )
    model.add("b", Bond("pin", pin, joint))
    model.add("e", Point("bob", EmbeddedPoints.in_frame(link, [0.0, 0.0, 0.0], model.nodes)))
    force = np.array([0.03, 0.0, -0.04])  # 53 degrees below the link
    statics = Statics(model)
    statics.restore(model.nodes, np.concatenate([force, -force]))  # without load the tangent is singular
    found = statics.solve([], effector_force=force)
    np.testing.assert_allclose(found.delta[:3], [0.06, 0.0, 0.42], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.effort[3:], -force, atol=1e-9)
    # It swings across its load with stiffness F / L, and is rigid along it.
    across, along = np.array([0.8, 0.0, 0.6]), np.array([0.6, 0.0, -0.8])
    W = found.condensed.W.ee
    np.testing.assert_allclose(W @ across, across * 0.1 / 0.05, atol=1e-6)
    np.testing.assert_allclose(W @ along, 0.0, atol=1e-6)


def test_redundant_bonds_are_rejected_or_solved(bonded):
    """A bond added twice shares its force arbitrarily; everything else is as with one bond."""
    model, _ = bonded
    one = Statics(model, tolerance=1e-13).solve([0.004], effector_force=FORCE)
    model.add("b", model.constraints["b"][0])
    try:
        two = Statics(model, tolerance=1e-13).solve([0.004], effector_force=FORCE)
    except ConvergenceError:
        return
    np.testing.assert_allclose(two.x, one.x, rtol=0, atol=1e-11)
    np.testing.assert_allclose(two.effort[-3:] + two.effort[-12:-9], one.effort[-9:-6], rtol=0, atol=1e-8)
    assert relative(two.condensed.compliance, one.condensed.compliance) < 1e-8


def test_a_part_that_is_not_held_is_an_error(box):
    nodes, tetrahedra = box((0.02, 0.02, 0.04), (2, 2, 3))
    body = ModelBuilder()
    body.add_solid(nodes, tetrahedra, fixed=nodes[:, 2] == 0.0, element="linear")
    loose = body.add_frame([0.05, 0.0, 0.0])
    model = body.build()
    model.add("e", Point("loose", EmbeddedPoints.in_frame(loose, np.zeros(3), model.nodes)))
    with pytest.raises(ConvergenceError, match="singular tangent"):
        Statics(model).solve([], effector_force=[0.0, 0.0, 1.0])


# -- effectors and contacts -----------------------------------------------------------------------------------------


@pytest.fixture
def touched(box):
    """A column with a cable, an effector on top and two contact points on its side."""
    nodes, tetrahedra = box((0.02, 0.02, 0.06), (2, 2, 5), jitter=0.2)
    model = MechanicalModel.from_mesh(
        nodes,
        tetrahedra,
        fixed=nodes[:, 2] < 1e-9,
        young_modulus=2e5,
        poisson_ratio=0.45,
        density=1000.0,
        element="linear",
    )
    model.add_cable("cable", np.array([[0.004, 0.01, 0.02], [0.004, 0.01, 0.055]]), np.array([0.004, 0.01, -0.01]))
    model.add_effector("top", np.array([0.01, 0.01, 0.06]))
    for k, z in enumerate((0.03, 0.05)):
        model.add("c", Point(f"contact {k}", model.embed(np.array([0.0, 0.009, z]))))
    model.add("s", Point("sensor", model.embed(np.array([0.02, 0.01, 0.03]))))
    return model


def test_a_force_on_an_effector_is_a_force_on_its_nodes(touched):
    by_effort = Statics(touched, tolerance=1e-13).solve([0.004], effector_force=FORCE)
    embedding = touched.constraints["e"][0].embedding
    np.add.at(touched.nodal_loads, embedding.node_ids[0], embedding.weights[0][:, None] * FORCE)
    by_load = Statics(touched, tolerance=1e-13).solve([0.004])
    np.testing.assert_allclose(by_effort.x, by_load.x, rtol=0, atol=1e-11)
    np.testing.assert_allclose(by_effort.condensed.lambda_.e, FORCE)
    np.testing.assert_allclose(by_load.condensed.lambda_.e, 0.0, atol=0)
    np.testing.assert_allclose(by_effort.condensed.compliance, by_load.condensed.compliance, rtol=1e-6, atol=1e-12)
    # The two include the force in different quantities: in `effort`, or in `delta_free`.
    assert relative(by_effort.condensed.delta_free.e, by_load.condensed.delta_free.e) > 1e-3


def test_driven_contacts_reach_their_positions_and_their_forces_give_the_same_state(touched):
    statics = Statics(touched, tolerance=1e-13)
    rest = statics.solve([0.004])
    goal = rest.condensed.delta.c + np.array([0.002, 0.0, 0.0, 0.001, -0.001, 0.0])
    driven = statics.solve([0.004], contact=goal, contact_mode="displacement")
    np.testing.assert_allclose(driven.condensed.delta.c, goal, rtol=0, atol=1e-12)
    forces = driven.condensed.lambda_.c
    assert np.abs(forces).max() > 0.01
    assert not driven.condensed.lambda_.s.any()
    released = statics.solve([0.004])  # contacts are free again
    np.testing.assert_allclose(released.x, rest.x, rtol=0, atol=1e-11)
    np.testing.assert_allclose(released.condensed.lambda_.c, 0.0, atol=0)
    by_force = statics.solve([0.004], contact=forces)
    np.testing.assert_allclose(by_force.x, driven.x, rtol=0, atol=1e-11)
    np.testing.assert_allclose(by_force.condensed.compliance, driven.condensed.compliance, rtol=1e-6, atol=1e-11)
    # W predicts the forces that hold the contacts, to first order: the shift is 2 mm, the column 60 mm.
    W = rest.condensed.W
    stiffness = np.linalg.inv(W.cc - W.ca @ np.linalg.solve(W.aa, W.ac))
    assert relative(stiffness @ (goal - rest.condensed.delta.c), forces) < 0.2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"effector_force": [0.0, 0.0]}, r"effector_force must have shape \(3,\), got \(2,\)"),
        ({"effector_force": [0.0, np.nan, 0.0]}, "effector_force must be finite"),
        ({"contact": np.zeros(3)}, r"contact must have shape \(6,\), got \(3,\)"),
        ({"contact": np.full(6, np.inf)}, "contact must be finite"),
        ({"contact": np.full(6, np.nan), "contact_mode": "displacement"}, "contact must be finite"),
        ({"contact_mode": "displacement"}, "needs the positions in 'contact'"),
        (
            {"contact": np.zeros(6), "contact_mode": "force"},
            "contact_mode must be 'displacement' or 'effort', got 'force'",
        ),
    ],
)
def test_malformed_loads_are_rejected(touched, arguments, message):
    statics = Statics(touched)
    with pytest.raises(ValueError, match=message):
        statics.solve([0.001], **arguments)
    np.testing.assert_array_equal(statics.x, touched.nodes)


def test_an_unreachable_contact_reports_the_reached_fraction(touched):
    statics = Statics(touched)
    with pytest.raises(ConvergenceError, match="% of the increment") as caught:
        statics.solve([0.0], contact=np.full(6, -3.0), contact_mode="displacement")
    assert 0.0 <= caught.value.fraction < 1.0
    np.testing.assert_allclose(statics.solve([0.0]).x, touched.nodes, atol=1e-9)


def test_nodes_may_be_held_along_some_axes(box):
    """A bar between two rollers under its own weight shortens by g L^2 rho / 2 E, and grows sideways freely."""
    nodes, tetrahedra = box((0.01, 0.01, 0.1), (2, 2, 10), jitter=0.2)
    young, density, gravity = 1e6, 1000.0, 0.1
    model = MechanicalModel.from_mesh(
        nodes,
        tetrahedra,
        fixed=np.isclose(nodes, 0.0, atol=1e-12),
        young_modulus=young,
        poisson_ratio=0.3,
        density=density,
        gravity=(0.0, 0.0, -gravity),
        element="linear",
    )
    assert not model.fixed[1:].any() and model.fixed[0]
    x = Statics(model, tolerance=1e-15).solve([]).x
    np.testing.assert_array_equal(x[nodes == 0.0], 0.0)
    top = np.isclose(nodes[:, 2], 0.1)
    shortening = density * gravity * 0.1**2 / (2 * young)
    np.testing.assert_allclose(nodes[top, 2] - x[top, 2], shortening, rtol=0.03)
    assert x[np.isclose(nodes[:, 0], 0.01), 0].max() > 0.01 + 1e-11


def test_no_node_needs_to_be_held_along_all_axes(box):
    """Three planes of symmetry without the node they share: the result is the same, and this node moves correctly."""
    nodes, tetrahedra = box((0.02, 0.02, 0.04), (2, 2, 4), jitter=0.2)
    held = np.isclose(nodes, 0.0, atol=1e-12)
    held[held.all(axis=1)] = False
    model = MechanicalModel.from_mesh(
        nodes, tetrahedra, fixed=held, young_modulus=1e5, poisson_ratio=0.4, element="linear"
    )
    assert not model.fixed.any()
    model.nodal_loads[np.isclose(nodes[:, 2], 0.04), 2] = 0.8
    found = Statics(model, tolerance=1e-13).solve([])
    assert found.iterations <= 6  # steps are warped: the stretch is large
    assert found.x[-1, 2] > 0.045
    np.testing.assert_array_equal(found.x[held], nodes[held])
    np.testing.assert_allclose(model.assembly.evaluate(found.x, np.zeros(0), model.loads)[0], 0.0, atol=1e-9)


def test_a_body_that_is_not_held_along_an_axis_is_rejected(box):
    nodes, tetrahedra = box((0.02, 0.02, 0.04), (2, 2, 4))
    held = np.isclose(nodes, 0.0, atol=1e-12)
    held[:, 2] = False
    with pytest.raises(ValueError, match=r"the body is a mechanism: it can slide along \[0.0, 0.0, 1.0\]"):
        MechanicalModel.from_mesh(nodes, tetrahedra, fixed=held, element="linear")


# -- cavities -------------------------------------------------------------------------------------------------------


def hollow_block(box, element="linear", **options):
    """A block with a cavity of a third of its width, clamped below."""
    nodes, tetrahedra = box((0.03, 0.03, 0.03), (3, 3, 3))
    centres = nodes[tetrahedra].mean(axis=1)
    tetrahedra = tetrahedra[~((centres > 0.01) & (centres < 0.02)).all(axis=1)]
    faces = np.sort(tetrahedra[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]], axis=2).reshape(-1, 3)
    faces, counts = np.unique(faces, axis=0, return_counts=True)
    middle = nodes[faces].mean(axis=1)
    faces = faces[(counts == 1) & ((middle > 0.005) & (middle < 0.025)).all(axis=1)]
    corners = nodes[faces]
    inward = np.linalg.det(corners - 0.015) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    body = ModelBuilder()
    options = {"young_modulus": 2e5, "poisson_ratio": 0.45, "density": 1000.0, **options}
    body.add_solid(nodes, tetrahedra, fixed=nodes[:, 2] < 1e-9, element=element, **options)
    model = body.build()
    if element == "quadratic":
        faces = quadratic_triangles(faces, model.blocks[0].connectivity)
    model.add("a", Cavity("cavity", faces, model.nodes))
    model.add_effector("top", np.array([0.015, 0.014, 0.03]))
    return model


@pytest.fixture(params=SOLIDS)
def hollow(request, box):
    return hollow_block(box, request.param)


def test_pressure_and_volume_drive_are_inverse(hollow):
    """The effort of one is the displacement of the other, there and back."""
    statics = Statics(hollow, tolerance=1e-14)
    by_pressure = statics.solve([2e4], "effort")
    growth = by_pressure.delta[0]
    assert growth > 0.04 * hollow.constraints["a"][0].rest_volume
    assert by_pressure.effort[0] == 2e4
    statics.reset()
    by_volume = statics.solve([growth])
    assert by_volume.effort[0] == pytest.approx(2e4, rel=1e-9)
    assert by_volume.delta[0] == pytest.approx(growth, rel=1e-10)
    np.testing.assert_allclose(by_volume.x, by_pressure.x, rtol=0, atol=1e-12)
    assert relative(by_volume.condensed.compliance, by_pressure.condensed.compliance) < 1e-8
    assert by_volume.delta[-1] > 0.03  # the top rises
    # A cavity may also suck: it is bilateral.
    assert not by_volume.slack.any() and not statics.unilateral.any()
    sucked = statics.solve([-0.1 * growth])
    assert sucked.effort[0] < 0.0
    np.testing.assert_allclose(statics.solve([0.0]).x, hollow.nodes, atol=1e-12)


def test_compliance_of_a_cavity_is_the_derivative(hollow):
    statics = Statics(hollow, tolerance=1e-15)
    state = statics.solve([1.5e4], "effort", effector_force=[0.1, 0.0, -0.2])
    found = compliance_by_differences(
        statics, state, lambda e: statics.solve(e[:1], "effort", effector_force=e[1:]), [20.0, 1e-3, 1e-3, 1e-3]
    )
    scale = np.sqrt(np.diag(state.condensed.compliance))
    scaled = np.abs(found - state.condensed.compliance) / np.outer(scale, scale)
    print(f"W against differences: {scaled.max():.1e}")
    assert scaled.max() < 1e-6


def test_the_work_of_pressure_is_the_energy(hollow):
    """Integral of p dV along a path, by Simpson's rule, both drives: its error falls with the fourth power."""
    statics = Statics(hollow, tolerance=1e-15)
    last = statics.solve([1.5e4], "effort")
    energy = hollow.energy(last.x)
    for mode, end in (("effort", 1.5e4), ("displacement", last.delta[0])):
        errors = []
        for steps in (2, 4):
            statics.reset()
            states = [statics.solve([t * end], mode) for t in np.linspace(0.0, 1.0, steps + 1)]
            weights = np.array([1.0, *([4.0, 2.0] * (steps // 2))])
            weights[-1] = 1.0
            # p dV and V dp by the same rule over the driven quantity; the other follows by parts.
            if mode == "displacement":
                work = weights @ [s.effort[0] for s in states] * end / (3 * steps)
            else:
                work = end * last.delta[0] - weights @ [s.delta[0] for s in states] * end / (3 * steps)
            errors.append(abs(work / energy - 1.0))
        print(f"{mode}: {errors[0]:.1e}, {errors[1]:.1e}")
        assert errors[0] < 1e-3
        assert errors[1] < 0.15 * errors[0] + 1e-9


def test_modes_may_differ_between_cavities_and_cables(box):
    model = hollow_block(box)
    model.add_cable("cable", np.array([[0.005, 0.015, 0.02], [0.005, 0.015, 0.029]]), np.array([0.005, 0.015, -0.01]))
    statics = Statics(model, tolerance=1e-14)
    mixed = statics.solve([1e4, 0.001], ["effort", "displacement"])
    assert mixed.effort[0] == 1e4 and mixed.delta[1] == pytest.approx(0.001, abs=1e-12)
    assert mixed.effort[1] > 0.0
    other = Statics(model, tolerance=1e-14).solve([mixed.delta[0], mixed.effort[1]], ["displacement", "effort"])
    np.testing.assert_allclose(other.x, mixed.x, rtol=0, atol=1e-11)
    assert other.effort[0] == pytest.approx(1e4, rel=1e-7)
    # A cable that is commanded too long hangs slack while the cavity is held.
    slack = statics.solve([mixed.delta[0], -0.05])
    assert list(slack.slack) == [False, True] and slack.effort[1] == 0.0
    # Negative pressure is allowed, negative tension is not.
    assert statics.solve([-1e3, 0.0], ["effort", "displacement"]).delta[0] < 0.0
    with pytest.raises(ValueError, match="cannot push"):
        statics.solve([-1e3, -1.0], "effort")


def test_a_chamber_bends_its_beam_with_a_moment(box):
    """Pressure in a chamber off the axis: a constant moment p A y and a tension p A, so an arc of known curvature."""
    young, area, offset, pressure = 1e6, 2e-5, 0.004, 2e4
    section = Section.circle(0.005)
    body = ModelBuilder()
    count = 9
    frames = [
        body.add_frame([s, 0.0, 0.0], fixed=k == 0, fixed_spin=k == 0)
        for k, s in enumerate(np.linspace(0.0, 0.1, count))
    ]
    body.add_element(Beam, frames, section=section, young_modulus=young, poisson_ratio=0.3)
    model = body.build()
    beam = model.blocks[0]
    model.add("a", Chamber("chamber", [beam.line(range(4), (offset, 0.0), model.nodes)], area))
    statics = Statics(model, tolerance=1e-13)
    found = statics.solve([pressure], "effort")
    turn = rotation_of(found.x, frames[-1])
    # By hand: minimum of EA/2 e^2 + EI/2 k^2 - p A (e - y k), for strains that are constant along the beam.
    curvature = -pressure * area * offset / (young * section.inertia[0])
    stretch = pressure * area / (young * section.area)
    angle = np.arctan2(turn[1, 0], turn[0, 0])
    assert angle == pytest.approx(curvature * 0.1, rel=2e-4)
    np.testing.assert_allclose(beam.strains(found.x)[..., 0], stretch, rtol=2e-3)
    growth = area * 0.1 * (stretch - offset * curvature)
    assert found.delta[0] == pytest.approx(growth, rel=1e-3)
    back = statics.solve([found.delta[0]])
    assert back.effort[0] == pytest.approx(pressure, rel=1e-9)
