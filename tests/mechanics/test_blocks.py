"""Every element block with every material: exact derivatives, objectivity, masses, patch tests, invalid input."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.sparse import coo_matrix
from scipy.spatial.transform import Rotation

from softgym_envs.extensions.beams import beam
from softgym_envs.extensions.beams.beam import Beam, Section, are_folded
from softgym_envs.extensions.modules import superelement
from softgym_envs.extensions.modules.superelement import Superelement
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.elements import averaged, quadratic, tetrahedra
from softgym_envs.mechanics.elements.averaged import AveragedTetrahedra
from softgym_envs.mechanics.elements.block import ElementBlock, StrainRates
from softgym_envs.mechanics.elements.quadratic import QuadraticTetrahedra, add_midside_nodes, split_triangles
from softgym_envs.mechanics.elements.tetrahedra import Tetrahedra
from softgym_envs.mechanics.frames import frame_rows
from softgym_envs.mechanics.materials import MATERIALS
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solids import SOLIDS
from softgym_envs.mechanics.solvers.statics import Statics

KINDS = {
    cls
    for module in (averaged, beam, quadratic, superelement, tetrahedra)
    for cls in vars(module).values()
    if inspect.isclass(cls) and issubclass(cls, ElementBlock) and not inspect.isabstract(cls)
}


def moved(model, rng, amplitude=2e-4):
    """Positions after a large bend with noise of 0.2 mm, by warping random steps."""
    x = model.nodes
    for _ in range(3):
        x = x + model.warping.displacement(
            x, amplitude * rng.standard_normal(model.equations) / model.kinematics.dof_scale
        )
    assert np.isfinite(model.energy(x))
    return x


def symmetric(stencils, values, size):
    """The whole matrix (size, size) of stencils' values, each of which stands for itself and its mirror image."""
    rows, columns = (np.concatenate([pair[side].ravel() for pair in stencils]) for side in (0, 1))
    twice = rows != columns
    entries = np.concatenate([values, values[twice]])
    places = np.concatenate([rows, columns[twice]]), np.concatenate([columns, rows[twice]])
    return coo_matrix((entries, places), shape=(size, size)).toarray()


def places_of(stencils):
    """Scatter maps that give each entry of the stencils its own slot, and the number of slots."""
    sizes = [rows.size for rows, _ in stencils]
    places = np.split(np.arange(sum(sizes), dtype=np.int32), np.cumsum(sizes)[:-1])
    return [place.reshape(rows.shape) for place, (rows, _) in zip(places, stencils, strict=True)], sum(sizes)


def element_matrix(block, x):
    """The block's whole tangent (3 n, 3 n), gradient (n, 3) and energy [J] at rows ``x``, frames or not."""
    stencils = block.stencils()
    places, count = places_of(stencils)
    values, gradient = np.zeros(count), np.zeros_like(x)
    energy, inverted = block.add(x, gradient, values, places)
    assert inverted == 0
    return energy, gradient, symmetric(stencils, values, x.size)


STEP, BETA = 0.05, 0.01


def damping(block, x, start):
    """Power [W], forces (n, 3) and tangent (3 n, 3 n) of a block at the end ``x`` of an implicit Euler step."""
    stencils = block.stencils()
    places, count = places_of(stencils)
    values, gradient = np.zeros(count), np.zeros_like(x)
    rates = StrainRates(start, 0.5 * (start + x), (x - start) / STEP, 1.0 / STEP, BETA)
    power = block.add_damping(x, rates, gradient, values, places)
    return power, gradient, symmetric(stencils, values, x.size)


def test_every_block_is_tested():
    assert set(SOLIDS.values()) | {Beam, Superelement} == KINDS


# -- derivatives ----------------------------------------------------------------------------------------------------


def test_residual_and_tangent_are_derivatives(body, derivatives, rng):
    """Through fixed nodes, frames and warped steps: as a solver uses them (measured: 2e-8 and 3e-10)."""
    body.set_gravity((1.0, -2.0, -9.81))
    errors = derivatives(body, moved(body, rng), np.empty(0))
    print(f"gradient {errors.gradient:.1e}, tangent {errors.tangent:.1e}")
    assert errors.gradient < 2e-7
    assert errors.tangent < 1e-8


def test_derivatives_with_respect_to_all_rows(body, rng):
    """Derivatives with respect to every row of x, also with directors that are not orthonormal."""
    x = moved(body, rng) + 1e-4 * rng.standard_normal(body.nodes.shape)
    for block in body.blocks:
        _, gradient, matrix = element_matrix(block, x)
        for direction in rng.standard_normal((8, *x.shape)):
            h = 1e-6
            ends = [element_matrix(block, x + s * h * direction) for s in (1, -1)]
            slope, change = ((a - b) / (2 * h) for a, b in zip(ends[0][:2], ends[1][:2], strict=True))
            assert slope == pytest.approx(np.vdot(gradient, direction), rel=1e-5, abs=1e-7 * np.abs(gradient).max())
            expected = (matrix @ direction.ravel()).reshape(-1, 3)
            np.testing.assert_allclose(change, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_tangent_at_rest_has_no_negative_eigenvalue_and_six_rigid_motions(body):
    """Each block alone at rest: the energy is zero and minimal; solids have the six rigid motions and no others."""
    for block in body.blocks:
        energy, gradient, matrix = element_matrix(block, body.nodes)
        scale = np.abs(matrix).max()
        assert abs(energy) < 1e-12
        np.testing.assert_allclose(gradient, 0.0, atol=1e-10 * max(1.0, scale))
        touched = (3 * block.nodes_used[:, None] + np.arange(3)).ravel()
        eigenvalues = np.linalg.eigvalsh(matrix[np.ix_(touched, touched)])
        assert eigenvalues[0] > -1e-9 * scale
        if not isinstance(block, Beam | Superelement):  # frames do not allow all strains of directors
            soft = (eigenvalues < 1e-7 * scale).sum()
            assert soft == 6


def test_damping_at_rest_is_the_elastic_tangent(body):
    for block in body.blocks:
        power, gradient, matrix = damping(block, body.nodes, body.nodes)
        tangent = BETA / STEP * element_matrix(block, body.nodes)[2]
        np.testing.assert_allclose(matrix, tangent, rtol=0, atol=1e-9 * np.abs(tangent).max())
        assert power == 0.0 and not gradient.any()


def test_forces_and_tangent_of_damping_are_derivatives(body, rng):
    """Half of the power times the step is their potential."""
    start = moved(body, rng)
    x = start + 2e-3 * rng.standard_normal(start.shape)
    for block in body.blocks:
        power, gradient, matrix = damping(block, x, start)
        assert power > 0.0
        for direction in rng.standard_normal((4, *x.shape)):
            h = 1e-6
            ends = [damping(block, x + s * h * direction, start)[:2] for s in (1, -1)]
            slope, change = ((a - b) / (2 * h) for a, b in zip(*ends, strict=True))
            assert 0.5 * STEP * slope == pytest.approx(np.vdot(gradient, direction), rel=1e-5)
            expected = (matrix @ direction.ravel()).reshape(-1, 3)
            np.testing.assert_allclose(change, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_a_rigid_motion_in_a_step_is_not_damped(body, rng):
    """A rotation of any angle causes no force, and one after a deformation turns the forces and keeps the power."""
    start = moved(body, rng)
    x = start + 2e-3 * rng.standard_normal(start.shape)
    turn = Rotation.from_rotvec([0.5, -0.9, 0.4]).as_matrix()
    shifts = np.tile([0.5, -0.2, 0.3], (len(x), 1))
    shifts[(body.frames.rows[:, None] + np.arange(1, 4)).ravel()] = 0.0  # directors only turn
    for block in body.blocks:
        power, gradient, _ = damping(block, x, start)
        scale = np.abs(gradient).max()
        none, force, _ = damping(block, start @ turn.T + shifts, start)
        assert abs(none) < 1e-12 * power
        np.testing.assert_allclose(force, 0.0, atol=1e-9 * scale)
        same, force, _ = damping(block, x @ turn.T + shifts, start)
        assert same == pytest.approx(power, rel=1e-9)
        np.testing.assert_allclose(force, gradient @ turn.T, rtol=0, atol=1e-9 * scale)


def test_a_rigid_motion_causes_no_strain(body, rng):
    x = moved(body, rng)
    turn, shift = Rotation.random(random_state=3).as_matrix(), np.array([0.5, -0.2, 0.3])
    frames = body.frames.rows[:, None] + np.arange(1, 4)
    shifts = np.tile(shift, (len(x), 1))
    shifts[frames.ravel()] = 0.0  # directors only turn
    for block in body.blocks:
        energy, gradient, matrix = element_matrix(block, x)
        for rest, expected in ((body.nodes, 0.0), (x, energy)):
            found = element_matrix(block, rest @ turn.T + shifts)[0]
            assert found == pytest.approx(expected, rel=1e-11, abs=1e-13)
        turned = element_matrix(block, x @ turn.T + shifts)
        np.testing.assert_allclose(turned[1], gradient @ turn.T, rtol=0, atol=1e-10 * np.abs(gradient).max())
        big = np.kron(np.eye(len(x)), turn)
        np.testing.assert_allclose(turned[2], big @ matrix @ big.T, rtol=0, atol=1e-10 * np.abs(matrix).max())


def test_forces_and_moments_balance(body, rng):
    """A block exerts no net force and no net moment on its body; the moment includes that on the directors."""
    x = moved(body, rng)
    gradient = np.zeros_like(x)
    body.blocks[0].add(x, gradient, None, None)
    directors = np.zeros(len(x), dtype=bool)
    directors[(body.frames.rows[:, None] + np.arange(1, 4)).ravel()] = True
    np.testing.assert_allclose(gradient[~directors].sum(axis=0), 0.0, atol=1e-11 * np.abs(gradient).sum())
    np.testing.assert_allclose(np.cross(x, gradient).sum(axis=0), 0.0, atol=1e-11 * np.abs(gradient).sum())


# -- mass, volume, warping ------------------------------------------------------------------------------------------


def test_masses(body):
    for block in body.blocks:
        masses = block.nodal_masses(len(body.nodes))
        assert masses.shape == (len(body.nodes),)
        if isinstance(block, Superelement):  # its inertia is given; axes of ports have first moments
            assert masses[block.nodes_used[[0, 4]]].sum() == pytest.approx(block.mass, rel=1e-12)
        else:
            assert masses.sum() == pytest.approx(block.mass, rel=1e-12)
            assert block.mass == pytest.approx(block.density * block.volume, rel=1e-12)
        assert not masses[np.setdiff1d(np.arange(len(body.nodes)), block.nodes_used)].any()
    assert body.mass == pytest.approx(sum(block.mass for block in body.blocks))


@pytest.mark.parametrize("element", SOLIDS)
def test_weight_of_solids_acts_at_the_centre_of_mass(make_solid, element):
    model = make_solid(element, "corotational", density=1234.0)
    assert model.volume == pytest.approx(0.02 * 0.02 * 0.03, rel=1e-12)
    masses = model.blocks[0].nodal_masses(len(model.nodes))
    np.testing.assert_allclose(masses @ model.nodes / masses.sum(), [0.01, 0.01, 0.015], atol=1e-15)


@pytest.mark.parametrize("order", [1, 2])
def test_weight_of_a_beam(make_beam, order):
    model = make_beam(order, "straight", density=1234.0)
    assert model.mass == pytest.approx(1234.0 * 6e-4 * 0.2, rel=1e-12)
    masses = model.blocks[0].nodal_masses(len(model.nodes))
    np.testing.assert_allclose(masses @ model.nodes / masses.sum(), [0.1, 0.0, 0.0], atol=1e-15)
    assert not np.delete(masses, np.arange(0, len(masses), 4)).any()  # no weight on directors


def test_warping_equals_a_small_step_and_preserves_rigid_rotations(body, rng):
    x = moved(body, rng)
    step = rng.standard_normal(body.equations) / body.kinematics.dof_scale
    ratios = []
    for size in (1e-5, 1e-6):
        warped = body.warping.displacement(x, size * step).ravel()[body.kinematics.free_dofs]
        ratios.append(np.abs(warped - size * step[: len(body.kinematics.free_dofs)]).max() / size)
    assert ratios[1] < 0.15 * ratios[0] + 1e-9  # the difference is quadratic
    assert not body.warping.displacement(x, step)[body.fixed].any()


# -- patch tests ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("element", SOLIDS)
def test_patch_of_irregular_elements_reproduces_a_linear_field(box, rng, element, material):
    """Boundary nodes moved by a large linear map: inner ones follow, and the stress is the same everywhere."""
    size = np.array([0.04, 0.03, 0.03])
    nodes, tetrahedra = box(size, (4, 3, 3), jitter=0.3)
    if element == "quadratic":
        nodes, tetrahedra = add_midside_nodes(nodes, tetrahedra)
    boundary = (np.isclose(nodes, 0.0, atol=1e-12) | np.isclose(nodes, size, atol=1e-12)).any(axis=1)
    F = np.array([[1.2, 0.3, -0.1], [0.05, 0.9, 0.2], [-0.15, 0.1, 1.1]])
    exact = nodes @ F.T + [0.01, -0.02, 0.03]
    block = SOLIDS[element](nodes, tetrahedra, material=material, poisson_ratio=0.45)
    model = MechanicalModel(nodes, [block], fixed=boundary)
    start = exact.copy()
    start[~boundary] += 1e-4 * rng.standard_normal(((~boundary).sum(), 3))
    statics = Statics(model, tolerance=1e-14)
    statics.restore(start, np.zeros(0))
    solved = statics.solve(np.zeros(0)).x
    np.testing.assert_array_equal(solved[boundary], exact[boundary])
    np.testing.assert_allclose(solved, exact, rtol=0, atol=1e-12)
    energy = MATERIALS[material]
    psi, stress, tangent = np.empty(1), np.empty((1, 9)), np.empty((1, 9, 9))
    energy.evaluate(F.reshape(1, 9).copy(), block.mu[:1], block.lame[:1], psi, stress, tangent)
    assert model.energy(exact) == pytest.approx(psi[0] * 0.04 * 0.03 * 0.03, rel=1e-12)


@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("element", SOLIDS)
def test_patch_under_tension_on_its_faces(box, element, material):
    """Uniaxial tension by forces: held only by three planes of symmetry (nodes free along two axes)."""
    size = np.array([0.04, 0.03, 0.02])
    nodes, tetrahedra = box(size, (3, 2, 2), jitter=0.3)
    body = ModelBuilder()
    body.add_solid(
        nodes,
        tetrahedra,
        fixed=np.isclose(nodes, 0.0, atol=1e-12),
        element=element,
        material=material,
        young_modulus=1e5,
        poisson_ratio=0.4,
    )
    model = body.build()
    # The stress on the end face, distributed by the element's own shape functions: with one rigid frame instead, the
    # face could not contract. The gradient of a stretched block at F = diag(1 + s, 1, 1), lambda = 0, is that load.
    block = model.blocks[0]
    pull = np.zeros_like(model.nodes)
    unit = SOLIDS[element](
        model.nodes, block.connectivity, material="corotational", young_modulus=1.0, poisson_ratio=0.0
    )
    unit.add(model.nodes * [2.0, 1.0, 1.0], pull, None, None)
    end = np.isclose(model.nodes[:, 0], size[0])
    assert pull[end, 0].sum() == pytest.approx(0.03 * 0.02, rel=1e-12)
    stress = 3e4
    model.nodal_loads[end, 0] = stress * pull[end, 0]
    x = Statics(model, tolerance=1e-14).solve([]).x
    stretch = x[end, 0].mean() / size[0]
    F = np.linalg.lstsq(model.nodes, x, rcond=None)[0].T
    np.testing.assert_allclose(x, model.nodes @ F.T, rtol=0, atol=1e-12)
    if material == "corotational":  # linear in the stretches
        assert stretch == pytest.approx(1.3, rel=1e-11)
        np.testing.assert_allclose(F, np.diag([1.3, 1.0 - 0.4 * 0.3, 1.0 - 0.4 * 0.3]), atol=1e-11)


def test_a_rotated_patch_of_a_beam_has_constant_strain(make_beam):
    """An arc with a constant stretch, bend and twist: order 2 converges to it, with the exact strains."""
    kappa, stretch, twist = 2.0, 1.05, 1.5
    errors = []
    for elements in (2, 4, 8):
        model = make_beam(2, "straight", elements)
        s = np.linspace(0.0, 0.2, 2 * elements + 1)
        # A curve of constant strain in the material frame is the exponential of one generator.
        generator = np.zeros((4, 4))
        wx, wy, wz = twist, 0.3, kappa
        generator[:3, :3] = [[0, -wz, wy], [wz, 0, -wx], [-wy, wx, 0]]
        generator[:3, 3] = [stretch, 0.0, 0.0]
        x = np.empty_like(model.nodes)
        for k, t in enumerate(s):
            pose = expm(t * generator)
            x[4 * k] = pose[:3, 3]
            x[4 * k + 1 : 4 * k + 4] = pose[:3, :3].T
        strains = model.blocks[0].strains(x)
        expected = [stretch - 1.0, 0.0, 0.0, twist, 0.3, kappa]
        errors.append(np.abs(strains - expected).max())
    assert errors[2] < 2e-4
    assert np.log2(errors[0] / errors[1]) > 1.9 and np.log2(errors[1] / errors[2]) > 1.9


# -- beams ----------------------------------------------------------------------------------------------------------


def test_sections():
    circle, tube = Section.circle(0.01), Section.circle(0.01, 0.008)
    assert circle.area == pytest.approx(np.pi * 1e-4)
    assert circle.inertia[0] == pytest.approx(np.pi * 1e-8 / 4) and circle.torsion == pytest.approx(np.pi * 1e-8 / 2)
    assert tube.area == pytest.approx(np.pi * 0.36e-4)
    assert tube.torsion == pytest.approx(circle.torsion - np.pi * 0.008**4 / 2)
    square = Section.rectangle(0.02, 0.02)
    # Timoshenko and Goodier: k = 0.1406 for a square, 0.229 for 2 : 1, 1/3 for a thin strip.
    assert square.torsion == pytest.approx(0.1406 * 0.02**4, rel=1e-3)
    wide = Section.rectangle(0.04, 0.02)
    assert wide.torsion == pytest.approx(0.229 * 0.04 * 0.02**3, rel=2e-3)
    assert Section.rectangle(1.0, 1e-3).torsion == pytest.approx(1e-9 / 3, rel=1e-3)
    # Bending about d2 is thin, about d3 wide.
    np.testing.assert_allclose(wide.inertia, [0.04 * 0.02**3 / 12, 0.02 * 0.04**3 / 12])
    tall = Section.rectangle(0.02, 0.04)
    assert tall.inertia == wide.inertia[::-1] and tall.torsion == pytest.approx(wide.torsion)
    stiffness = circle.stiffness(2e6, 0.25)
    np.testing.assert_allclose(
        stiffness,
        [
            2e6 * circle.area,
            *(2 * [0.8e6 * circle.area * 0.9]),
            0.8e6 * circle.torsion,
            *(2 * [2e6 * circle.inertia[0]]),
        ],
    )


@pytest.mark.parametrize("values", [(0.0, (1.0, 1.0), 1.0), (1.0, (1.0, -1.0), 1.0), (1.0, (1.0, 1.0), np.nan)])
def test_an_impossible_section_is_rejected(values):
    with pytest.raises(ValueError, match="section values must be positive"):
        Section(*values)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(("force", "axis"), [((1.0, 0, 0), 0), ((0, 1.0, 0), 1), ((0, 0, 1.0), 2)])
def test_small_deflections_of_a_beam(make_beam, order, force, axis):
    """Tip of a cantilever of three unequal elements: order 2 has Timoshenko's deflection up to (1/6)^4."""
    model = make_beam(order, "straight")
    model.add("e", Point("tip", model.blocks[0].point(-1, np.zeros(3), model.nodes)))
    W = Statics(model).solve([]).condensed.W.ee
    assert np.abs(W - np.diag(np.diag(W))).max() < 1e-12 * np.abs(W).max()
    young, ends = 1e6 * np.array([1.0, 2.0, 3.0]), np.linspace(0.2, 0.0, 4)
    if axis == 0:
        expected = (0.2 / 3 / (young * 6e-4)).sum()
    else:
        inertia, shear = (5e-8, 0.8) if axis == 1 else (2e-8, 0.7)  # bending along d2 turns about d3
        expected = ((ends[:-1] ** 3 - ends[1:] ** 3) / (3 * young * inertia)).sum()
        expected += (0.2 / 3 / (young / 2.8 * 6e-4 * shear)).sum()
    accuracy = 1e-9 if axis == 0 else {1: 0.02, 2: 1e-3}[order]
    assert W[axis, axis] == pytest.approx(expected, rel=accuracy)


def test_a_curved_rest_shape_is_free_of_strain(make_beam):
    for order in (1, 2):
        model = make_beam(order, "curved")
        np.testing.assert_allclose(model.blocks[0].strains(model.nodes), 0.0, atol=1e-14)
        np.testing.assert_allclose(Statics(model).solve([]).x, model.nodes, atol=1e-14)


@pytest.mark.parametrize("order", [1, 2])
def test_a_beam_counts_as_folded_before_its_moment_falls(order):
    places = np.linspace(0.0, 0.1, order + 1)
    angles = np.radians(np.arange(1.0, 90.0))
    energies, folded = [], []
    nodes = np.vstack([frame_rows([s, 0.0, 0.0]) for s in places])
    beam = Beam(
        nodes,
        4 * np.arange(order + 1),
        section=Section.rectangle(0.01, 0.005),
        young_modulus=1e7,
        order=order,
    )
    for angle in angles:
        turns = Rotation.from_rotvec(angle * (np.arange(order + 1) - 0.5 * order)[:, None] * [0.0, 0.0, 1.0])
        bent = np.vstack([frame_rows([s, 0.0, 0.0], turn) for s, turn in zip(places, turns.as_matrix(), strict=True)])
        bending = beam.strains(bent)[..., 3:]
        energies.append(0.5 * (beam.weights[..., None] * beam.element_stiffness[:, None, 3:] * bending**2).sum())
        folded.append(beam.is_folded(bent))
    moments = np.gradient(energies, angles)
    largest, first = angles[moments.argmax()], angles[np.argmax(folded)]
    print(np.degrees([first, largest]))
    assert not folded[0] and folded[-1]
    assert 0.0 <= np.degrees(largest - first) + 1.1 <= 4.0


def test_folds_of_many_bodies_and_around_every_axis():
    rows = np.array([[0, 4, 8]])
    for axis in np.eye(3):
        bodies = []
        for angle in (59.0, 61.0):
            turn = Rotation.from_rotvec(np.radians(angle) * axis).as_matrix()
            bodies.append(
                np.vstack([frame_rows([s, 0, 0], r) for s, r in ((0.0, np.eye(3)), (0.1, turn), (0.2, turn))])
            )
        np.testing.assert_array_equal(are_folded(np.array(bodies), rows), [False, True])


def test_malformed_beams_are_rejected():
    nodes = np.vstack([frame_rows([s, 0, 0]) for s in (0.0, 0.1, 0.2, 0.3)])
    options = {"section": Section.circle(0.01), "young_modulus": 1e6}
    for change, message in [
        ({"order": 3}, "order = 3 of the beam is unknown"),
        ({"order": 2}, "a beam of order 2 needs 2 k . 1 frames, got 4"),
        ({"chain": [0]}, "got 1"),
        ({"order": 1, "chain": [0, 0]}, "two frames of a beam coincide"),
        ({"order": 1, "section": [Section.circle(0.01)]}, "3 elements, got 1 sections"),
        ({"order": 1, "young_modulus": 0.0}, "young_modulus = 0.0 Pa"),
        ({"order": 1, "young_modulus": np.nan}, "young_modulus"),
        ({"order": 1, "poisson_ratio": 0.5}, "poisson_ratio = 0.5"),
    ]:
        arguments = {**options, "chain": [0, 4, 8, 12], **change}
        with pytest.raises(ValueError, match=message):
            Beam(nodes, np.array(arguments.pop("chain")), **arguments)


def test_points_and_lines_of_a_beam(make_beam):
    model = make_beam(2, "curved")
    beam = model.blocks[0]
    point = beam.point(2, np.array([0.0, 0.01, -0.02]), model.nodes)
    row = beam.chain[2]
    expected = model.nodes[row] + 0.01 * model.nodes[row + 2] - 0.02 * model.nodes[row + 3]
    np.testing.assert_allclose(point.points[0], expected, atol=1e-15)
    line = beam.line(range(3), (0.0, 0.0), model.nodes)
    length = np.linalg.norm(line.points, axis=1).sum()
    assert length == pytest.approx(0.1 * np.sqrt(1.16), rel=1e-4)
    assert length == pytest.approx(beam.lengths.sum(), rel=1e-12)


# -- quadratic ------------------------------------------------------------------------------------------------------


def test_midside_nodes(box):
    nodes, tetrahedra = box((1, 1, 1), (2, 2, 2), 0.2)
    finer, ten = add_midside_nodes(nodes, tetrahedra)
    np.testing.assert_array_equal(ten[:, :4], tetrahedra)
    np.testing.assert_array_equal(finer[: len(nodes)], nodes)
    edges = {tuple(sorted(t[[a, b]])) for t in tetrahedra for a in range(4) for b in range(a)}
    assert len(finer) == len(nodes) + len(edges)
    for slot, (a, b) in enumerate([(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]):
        np.testing.assert_allclose(finer[ten[:, 4 + slot]], 0.5 * (nodes[ten[:, a]] + nodes[ten[:, b]]), atol=1e-15)


def test_split_triangles_keep_the_surface(box):
    nodes, tetrahedra = box((1, 1, 1), (1, 1, 1))
    finer, ten = add_midside_nodes(nodes, tetrahedra)
    triangles = tetrahedra[:2, :3]
    parts = split_triangles(triangles, ten)
    assert parts.shape == (8, 3)

    def areas(points, faces):
        corners = points[faces]
        return 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    np.testing.assert_allclose(
        areas(finer, parts).reshape(2, 4, 3), np.repeat(areas(nodes, triangles)[:, None] / 4, 4, axis=1), atol=1e-15
    )


def test_quadratic_elements_hold_a_quadratic_field(box, rng):
    """Embedded points follow a quadratic map exactly, with weights that add up to one."""
    nodes, tetrahedra = box((1, 1, 1), (2, 2, 2), 0.2)
    finer, ten = add_midside_nodes(nodes, tetrahedra)
    block = QuadraticTetrahedra(finer, ten)
    points = rng.uniform(0.0, 1.0, (40, 3))
    embedded = block.embed(points, finer)
    assert embedded.weights.shape == (40, 10)
    np.testing.assert_allclose(embedded.weights.sum(axis=1), 1.0, atol=1e-13)
    np.testing.assert_allclose(embedded.points, points, atol=1e-13)
    A, B = rng.standard_normal((3, 3)), rng.standard_normal((3, 3, 3))

    def field(x):
        return x @ A.T + np.einsum("ijk,pj,pk->pi", B, x, x)

    np.testing.assert_allclose(embedded.positions(field(finer)), field(points), atol=1e-12)
    # The Gauss points see the exact gradient of the field, too.
    block.add(field(finer), np.zeros_like(finer), None, None)
    places = np.einsum("qa,mad->mqd", quadratic._GAUSS, finer[block.corners]).reshape(-1, 3)
    expected = A + np.einsum("ijk,pk->pij", B + np.swapaxes(B, 1, 2), places)
    np.testing.assert_allclose(block._F.reshape(-1, 3, 3), expected, atol=1e-12)


def test_model_embeds_in_the_chosen_block(make_solid):
    model = make_solid("quadratic", "corotational")
    assert model.embed(np.array([0.01, 0.01, 0.02])).node_ids.shape == (1, 10)
    effector = model.add_effector("tip", np.array([0.01, 0.012, 0.03]))
    np.testing.assert_allclose(effector.value(model.nodes), [0.01, 0.012, 0.03], atol=1e-15)


def test_negatively_oriented_quadratic_elements_are_reoriented(box, rng):
    nodes, tetrahedra = box((1, 1, 1), (2, 2, 2), 0.2)
    mirrored = tetrahedra.copy()
    mirrored[::3] = mirrored[::3][:, [1, 0, 2, 3]]
    x = None
    energies = []
    for t in (tetrahedra, mirrored):
        finer, ten = add_midside_nodes(nodes, t)
        block = QuadraticTetrahedra(finer, ten, material="stable_neo_hookean")
        x = finer + 0.05 * np.sin(3.0 * finer[:, ::-1])
        energies.append(block.add(x, np.zeros_like(x), None, None)[0])
    assert energies[1] == pytest.approx(energies[0], rel=1e-12)


def test_curved_edges_change_the_volume(box):
    """A quarter of a sphere's octant: with midside nodes on the sphere, the volume is far more accurate."""
    nodes = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    finer, ten = add_midside_nodes(nodes, np.array([[0, 1, 2, 3]]))
    straight = QuadraticTetrahedra(finer, ten).volume
    on_sphere = ~np.isclose(np.linalg.norm(finer, axis=1), 1.0) & (ten[0, [5, 8, 9], None] == np.arange(10)).any(axis=0)
    finer[on_sphere] /= np.linalg.norm(finer[on_sphere], axis=1)[:, None]
    curved = QuadraticTetrahedra(finer, ten).volume
    assert straight == pytest.approx(1 / 6, rel=1e-12)
    assert abs(curved - np.pi / 6) < 0.25 * abs(straight - np.pi / 6)


def test_malformed_quadratic_elements_are_rejected(box):
    nodes, tetrahedra = box((1, 1, 1), (1, 1, 1))
    finer, ten = add_midside_nodes(nodes, tetrahedra)
    with pytest.raises(ValueError, match=r"shape \(m, 10\)"):
        QuadraticTetrahedra(nodes, tetrahedra)
    with pytest.raises(ValueError, match="the mesh has"):
        QuadraticTetrahedra(finer, np.where(ten == ten.max(), 99, ten))
    bent = finer.copy()
    bent[ten[2, 4]] = 3.0 * (finer.mean(axis=0) - finer[ten[2, 4]]) + finer.mean(axis=0)
    with pytest.raises(ValueError, match="inverted by its curved edges"):
        QuadraticTetrahedra(bent, ten)


# -- averaged -------------------------------------------------------------------------------------------------------


def test_averaging_has_no_effect_without_lame_or_in_uniform_strain(box, rng):
    nodes, tetrahedra = box((1, 1, 1), (2, 2, 2), 0.2)
    x = nodes + 0.1 * np.sin(3.0 * nodes[:, ::-1])
    for material in MATERIALS:
        plain, mean = (
            kind(nodes, tetrahedra, material=material, poisson_ratio=0.0) for kind in (Tetrahedra, AveragedTetrahedra)
        )
        for positions in (x, nodes @ (np.eye(3) + 0.1 * rng.standard_normal((3, 3))).T):
            a, b = (block.add(positions, np.zeros_like(nodes), None, None)[0] for block in (plain, mean))
            assert a == pytest.approx(b, rel=1e-12)
        plain.set_elasticity(3e6, 0.45)
        mean.set_elasticity(3e6, 0.45)
        # The mean of squares is more than the square of the mean.
        a, b = (block.add(x, np.zeros_like(nodes), None, None)[0] for block in (plain, mean))
        assert b < 0.999 * a


def test_inverted_elements_are_counted(body, rng):
    if any(isinstance(block, Beam | Superelement) for block in body.blocks):
        x = body.nodes.copy()
        x[0] = np.nan
    else:
        x = body.nodes * [1.0, 1.0, -1.0]
    energy, inverted = body.blocks[0].add(x, np.zeros_like(x), None, None)
    assert energy == np.inf and inverted > 0
