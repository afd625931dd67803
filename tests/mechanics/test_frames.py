"""Frames: rigid parts and the rows they carry move as rigid bodies, with exact derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.extensions.beams.chamber import Chamber
from softgym_envs.extensions.beams.servo import Servo
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.bond import Bond
from softgym_envs.mechanics.constraints.cable import Cable
from softgym_envs.mechanics.constraints.cavity import Cavity
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.frames import Frames, frame_rows, rotation_of, rotation_vector_matrix
from softgym_envs.mechanics.materials import MATERIALS
from softgym_envs.mechanics.solids import SOLIDS
from softgym_envs.mechanics.solvers.statics import Statics


def cap(nodes, height=0.03):
    return np.flatnonzero(np.isclose(nodes[:, 2], height, atol=1e-9))


@pytest.fixture
def capped(box):
    """Function that makes a block whose upper face is carried by a frame, with every kind of constraint on it."""

    def make(element="linear", material="corotational", bonds=True):
        nodes, tetrahedra = box((0.02, 0.02, 0.03), (2, 2, 2), jitter=0.2)
        body = ModelBuilder()
        start = body.add_solid(
            nodes,
            tetrahedra,
            fixed=nodes[:, 2] < 1e-9,
            element=element,
            material=material,
            young_modulus=2e5,
            poisson_ratio=0.45,
        )
        turn = Rotation.from_rotvec([0.3, -0.2, 0.4]).as_matrix()
        plate = body.add_frame([0.012, 0.009, 0.034], turn)
        solid_rows = np.vstack(body._rows[:1])
        body.carry(plate, start + cap(solid_rows))
        # A second rigid part next to the block, held only by three bonds, and a beam from it into space.
        part = body.add_frame([0.03, 0.01, 0.015], np.eye(3)[:, [1, 2, 0]])
        chain = [part, *(body.add_frame([0.03, 0.01 + s, 0.015], np.eye(3)[:, [1, 2, 0]]) for s in (0.02, 0.04))]
        body.add_element(Beam, chain, section=Section.circle(0.003), young_modulus=1e6, order=2)
        model = body.build()
        points = np.array([[0.02, 0.005, 0.02], [0.02, 0.016, 0.02], [0.02, 0.01, 0.008]])
        for k, point in enumerate(points):
            local = (point - model.nodes[part]) @ rotation_of(model.nodes, part)
            model.add("b", Bond(f"bond {k}", EmbeddedPoints.in_frame(part, local, model.nodes), model.embed(point)))
        return model, plate, part

    return make


def constrain(model, plate, part):
    """Add every kind of constraint, each on carried rows, frames and free nodes."""
    model.add_cable("cable", np.array([[0.005, 0.005, 0.01], [0.006, 0.005, 0.025]]), np.array([0.005, 0.005, -0.01]))
    hub = EmbeddedPoints.in_frame(plate, [[0.0, 0.0, 0.0], [0.01, 0.002, 0.003]], model.nodes)
    model.add("a", Cable("rigid cable", hub, np.array([0.04, 0.0, 0.0])))
    beam = model.blocks[1]
    model.add("a", Chamber("chamber", [beam.line(range(1), (0.001, 0.002), model.nodes)], 2e-5))
    corners = model.solids[0].corners
    faces = corners[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3)
    _, first, counts = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    model.add("a", Cavity("cavity", faces[first[counts == 1]], model.nodes))
    model.add("a", Servo("servo", plate, np.array([0.1, 0.2, 1.0]), model.nodes))
    model.add("e", Point("tip", beam.point(-1, np.array([0.001, 0.002, 0.0]), model.nodes)))
    model.add("c", Point("corner", model.embed(np.array([0.001, 0.001, 0.03]))))
    model.add("s", Point("plate", EmbeddedPoints.in_frame(plate, [0.001, 0.002, 0.003], model.nodes)))


def moved(model, rng, amplitude=1.5e-4):
    x = model.nodes
    for _ in range(4):
        x = x + model.warping.displacement(
            x, amplitude * rng.standard_normal(model.equations) / model.kinematics.dof_scale
        )
    assert np.isfinite(model.energy(x))
    return x


# -- derivatives ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("element", SOLIDS)
def test_derivatives_through_carried_nodes_frames_and_bonds(capped, derivatives, rng, element, material):
    model, plate, part = capped(element, material)
    constrain(model, plate, part)
    model.set_gravity((1.0, -2.0, -9.81))
    unit = {"Pa": 1e3, "N": 0.2, "N m": 2e-3}
    effort = rng.standard_normal(model.assembly.size) * [unit[c.unit[1]] for c, _ in model.rows for _ in range(c.size)]
    # Element boundaries of the quadratic mesh are half as far apart.
    errors = derivatives(model, moved(model, rng, 0.7e-4 if element == "quadratic" else 1.5e-4), effort)
    print(f"gradient {errors.gradient:.1e}, tangent {errors.tangent:.1e}, constraints {errors.constraints:.1e}")
    assert errors.gradient < 1e-6
    assert errors.tangent < 1e-6
    assert errors.constraints < 1e-7


def test_each_constraint_contributes_its_curvature_through_frames(capped, full_tangent, derivatives, rng):
    """One effort at a time, so large that a missing term would show."""
    model, plate, part = capped()
    constrain(model, plate, part)
    x = moved(model, rng)
    none = full_tangent(model, model.assembly.evaluate(x, np.zeros(model.assembly.size), model.loads)[1])
    for constraint, rows in model.rows:
        effort = np.zeros(model.assembly.size)
        effort[rows] = {"Pa": 3e4, "N": 5.0, "N m": 0.05}[constraint.unit[1]]
        errors = derivatives(model, x, effort)
        assert errors.tangent < 1e-6, constraint.name
        change = np.abs(full_tangent(model, model.assembly.evaluate(x, effort, model.loads)[1]) - none).max()
        # All involve a frame or a carried node, which rotate. Bonds contribute only if their force has a lever arm.
        assert change > 1e-4, constraint.name


def test_spins_and_origins_can_be_held_one_by_one(derivatives, rng, box):
    nodes, tetrahedra = box((0.02, 0.02, 0.03), (2, 2, 2), jitter=0.2)
    body = ModelBuilder()
    body.add_solid(nodes, tetrahedra, fixed=nodes[:, 2] < 1e-9, poisson_ratio=0.4, young_modulus=2e5, element="linear")
    hinge = body.add_frame([0.01, 0.01, 0.03], fixed=(False, True, False), fixed_spin=(True, False, True))
    body.carry(hinge, cap(nodes))
    model = body.build()
    assert model.equations == 27 + 2 + 1  # nine free nodes, two translations, one spin
    assert (model.kinematics.dof_scale[:-1] == 1.0).all() and model.kinematics.dof_scale[-1] < 1.0
    x = moved(model, rng, 1e-4)
    errors = derivatives(model, x, np.empty(0))
    assert errors.gradient < 1e-6 and errors.tangent < 1e-7
    assert x[hinge, 1] == nodes[:, 1].mean() or x[hinge, 1] == 0.01
    turn = rotation_of(x, hinge)
    np.testing.assert_allclose(turn[:, 1], [0, 1, 0], atol=1e-14)  # a turn about y alone
    assert abs(turn[0, 2]) > 1e-6


# -- kinematics -----------------------------------------------------------------------------------------------------


def test_frames_stay_orthonormal_and_rigid_over_many_moves(capped, rng):
    model, plate, part = capped()
    frames = model.frames
    x = model.nodes.copy()
    out = np.empty_like(x)
    rest = np.linalg.norm(x[frames.carried[-4]] - x[plate])
    for _ in range(10_000):
        out[:] = 0.0
        count = len(frames)
        frames.displace(x, 1e-3 * rng.standard_normal((count, 3)), 0.3 * rng.standard_normal((count, 3)), out)
        x = x + out
    for row in frames.rows:
        turn = rotation_of(x, row)
        np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=5e-15)
        assert np.linalg.det(turn) > 0.0
    # Carried rows are where the frame says, to round-off, after ten thousand moves.
    own = frames.owner == 0
    points = own & (frames.moves > 0.0)
    expected = x[plate] + frames.arm[points] @ rotation_of(x, plate).T
    np.testing.assert_allclose(x[frames.carried[points]], expected, atol=1e-14)
    assert np.linalg.norm(x[frames.carried[-4]] - x[plate]) == pytest.approx(rest, rel=1e-12)


def test_displacement_is_the_finite_motion(rng):
    nodes = np.vstack(
        [rng.standard_normal((4, 3)), frame_rows([0.1, 0.2, 0.3], Rotation.random(random_state=1).as_matrix())]
    )
    frames = Frames(nodes, [4], {0: [0, 2]})
    assert len(frames) == 1
    translation, spin = rng.standard_normal((1, 3)), rng.standard_normal((1, 3))
    out = np.full_like(nodes, 7.0)
    frames.displace(nodes, translation, spin, out)
    turn = Rotation.from_rotvec(spin[0])
    for row in (0, 2):
        expected = nodes[4] + translation[0] + turn.apply(nodes[row] - nodes[4])
        np.testing.assert_allclose(nodes[row] + out[row], expected, atol=1e-14)
    np.testing.assert_allclose(nodes[5:] + out[5:], turn.apply(nodes[5:]), atol=1e-14)
    assert (out[[1, 3]] == 7.0).all()  # rows that no frame carries are unchanged
    np.testing.assert_allclose(frames.arms(nodes)[:3], nodes[5:], atol=0)
    np.testing.assert_allclose(frames.arms(nodes)[3:], nodes[[0, 2]] - nodes[4], atol=0)


def test_rotation_vectors(rng):
    vectors = np.concatenate([rng.standard_normal((20, 3)), 1e-9 * rng.standard_normal((3, 3)), np.zeros((1, 3))])
    vectors = np.concatenate([vectors, [[np.pi, 0, 0], [0, 0, 2 * np.pi]]])
    np.testing.assert_allclose(rotation_vector_matrix(vectors), Rotation.from_rotvec(vectors).as_matrix(), atol=1e-14)
    assert rotation_vector_matrix(vectors.reshape(2, -1, 3)).shape == (2, 13, 3, 3)


def test_carried_nodes_stay_rigid_in_equilibrium(capped):
    model, plate, part = capped()
    constrain(model, plate, part)
    statics = Statics(model)
    found = statics.solve([0.002, 0.0, 0.0, 0.0, 0.0], ["displacement", *(4 * ["effort"])])
    carried = model.frames.carried[(model.frames.owner == 0) & (model.frames.moves > 0.0)]
    assert np.abs(found.x - model.nodes)[carried].max() > 5e-4

    def distances(x):
        return np.linalg.norm(x[carried][:, None] - x[carried][None], axis=2)

    np.testing.assert_allclose(distances(found.x), distances(model.nodes), atol=1e-14)
    # Their forces and those on the frame balance: moment about the plate's origin, by hand.
    forces = np.zeros_like(found.x)
    model.blocks[0].add(found.x, forces, None, None)
    np.testing.assert_allclose(
        model.assembly.evaluate(found.x, found.effort, model.loads)[0], 0.0, atol=1e-6 * np.abs(forces).max()
    )


def test_a_clamped_frame_is_a_clamp(box):
    """A face carried by a fixed frame is a fixed face."""
    nodes, tetrahedra = box((0.1, 0.02, 0.02), (4, 1, 1))
    face = nodes[:, 0] == 0.0
    options = {"element": "linear", "young_modulus": 1e6, "poisson_ratio": 0.3}
    tips = []
    for by_frame in (False, True):
        body = ModelBuilder(gravity=(0.0, 0.0, -9.81))
        body.add_solid(nodes, tetrahedra, fixed=[] if by_frame else face, **options)
        if by_frame:
            clamp = body.add_frame([0.0, 0.01, 0.01], fixed=True, fixed_spin=True)
            body.carry(clamp, np.flatnonzero(face))
        tips.append(Statics(body.build(), tolerance=1e-13).solve([]).x[len(nodes) - 1])
    np.testing.assert_allclose(tips[0], tips[1], rtol=0, atol=1e-12)
    assert tips[0][2] < 0.02 - 1e-4


# -- invalid input --------------------------------------------------------------------------------------------------


def test_malformed_frames_are_rejected():
    nodes = np.vstack([np.zeros((4, 3)), frame_rows([0, 0, 0]), frame_rows([1, 0, 0])])
    Frames(nodes, [4, 8], {1: np.array([0, 1])})
    for rows, carried, message in [
        ([4, 6], None, "overlap"),
        ([4, 4], None, "overlap"),
        ([10], None, "overlap"),
        ([4, 8], {0: [0], 1: [0]}, "carried by two frames"),
        ([4, 8], {0: [8]}, "carried by two frames"),
        ([4], {1: [0]}, "the model has 1"),
        ([4], {-1: [0]}, "the model has 1"),
        ([0], None, "directors of a frame are not orthonormal"),
    ]:
        with pytest.raises(ValueError, match=message):
            Frames(nodes, np.array(rows), carried)


def test_malformed_rotations_are_rejected():
    for rotation in (np.eye(2), 2.0 * np.eye(3), np.full((3, 3), np.nan)):
        with pytest.raises(ValueError, match="orthonormal"):
            frame_rows([0, 0, 0], rotation)
    with pytest.raises(ValueError, match="right-handed"):
        frame_rows([0, 0, 0], np.diag([1.0, 1.0, -1.0]))
