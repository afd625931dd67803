"""MechanicalModel: assembled derivatives, loads, patch test and malformed meshes."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs.mechanics.elements.tetrahedra import Tetrahedra
from softgym_envs.mechanics.materials import MATERIALS
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.registry import make_robot
from tests.helpers import dense_tangent

ONE_TETRAHEDRON = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])


def evaluate(model, x, effort):
    """The equilibrium equations of a model under its current loads."""
    return model.assembly.evaluate(x, effort, model.loads)


@pytest.fixture
def bent(beam, rng):
    """Positions of the beam in large bending with noise, fixed nodes at rest."""
    x = beam.nodes.copy()
    s = x[:, 0] / 0.1
    x[:, 2] += 0.03 * s**2
    x[:, 1] -= 0.01 * s**2
    x += 4e-4 * rng.standard_normal(x.shape)
    x[beam.fixed] = beam.nodes[beam.fixed]
    return x


# -- assembly -------------------------------------------------------------------------------------------------------


def test_residual_is_the_derivative_of_the_energy_less_the_work_of_the_efforts(beam, bent):
    beam.set_gravity((1.0, -2.0, -9.81))
    beam.nodal_loads[-1] = [0.1, 0.2, -0.3]
    effort = np.array([2.0, 1.5, 0.2, -0.1, 0.3])

    def potential(x):
        return beam.energy(x) - effort @ evaluate(beam, x, effort)[3]

    residual = evaluate(beam, bent, effort)[0].copy()
    h = 1e-7
    expected = np.empty_like(residual)
    for k, dof in enumerate(beam.kinematics.free_dofs):
        plus, minus = bent.copy(), bent.copy()
        plus.ravel()[dof] += h
        minus.ravel()[dof] -= h
        expected[k] = (potential(plus) - potential(minus)) / (2 * h)
    # Potential of about 0.2 J: round-off 0.2 * 1e-16 / 1e-7 = 2e-10 N, against residuals of the order of 1 N.
    assert np.abs(residual).max() > 1.0
    np.testing.assert_allclose(residual, expected, atol=5e-8)


def test_tangent_is_the_derivative_of_the_residual_with_cable_tension(beam, bent):
    effort = np.array([20.0, 15.0, 0.0, 0.0, 0.0])
    tangent = dense_tangent(beam, evaluate(beam, bent, effort)[1])
    without = dense_tangent(beam, evaluate(beam, bent, np.zeros(5))[1])
    h = 1e-8
    expected = np.empty_like(tangent)
    for k, dof in enumerate(beam.kinematics.free_dofs):
        plus, minus = bent.copy(), bent.copy()
        plus.ravel()[dof] += h
        minus.ravel()[dof] -= h
        expected[:, k] = (evaluate(beam, plus, effort)[0] - evaluate(beam, minus, effort)[0]) / (2 * h)
    size = np.abs(expected).max()
    np.testing.assert_allclose(tangent, expected, atol=1e-6 * size)
    # The tension's own term is far above that tolerance.
    assert np.abs(tangent - without).max() > 1e-3 * size


def test_constraint_gradients_and_values_of_the_assembly(beam, bent):
    assembled = evaluate(beam, bent, np.zeros(5))
    H, delta = assembled.gradients, assembled.delta
    h = 1e-7
    for k, dof in enumerate(beam.kinematics.free_dofs):
        plus, minus = bent.copy(), bent.copy()
        plus.ravel()[dof] += h
        minus.ravel()[dof] -= h
        difference = (evaluate(beam, plus, np.zeros(5)).delta - evaluate(beam, minus, np.zeros(5)).delta) / (2 * h)
        np.testing.assert_allclose(H[k], difference, atol=1e-7)
    assert [letter for letter, _ in beam.roles] == ["a", "e"]
    assert dict(beam.roles) == {"a": 2, "e": 3}
    np.testing.assert_allclose(delta[:2], [c.value(bent)[0] for c in beam.constraints["a"]], atol=1e-16)
    np.testing.assert_allclose(delta[2:], beam.constraints["e"][0].value(bent), atol=1e-16)


def test_inverted_elements_are_reported_not_assembled(beam, bent):
    bent[-1, 0] -= 0.2
    assert evaluate(beam, bent, np.zeros(5)) is None
    assert beam.energy(bent) == np.inf
    bent[-1, 0] = np.nan
    assert evaluate(beam, bent, np.zeros(5)) is None


def test_warping_a_step_equals_it_to_first_order_and_keeps_fixed_nodes(beam, bent, rng):
    step = 1e-6 * rng.standard_normal(len(beam.kinematics.free_dofs))
    warped = beam.warping.displacement(bent, step)
    np.testing.assert_array_equal(warped[beam.fixed], 0.0)
    # Second order: (1e-6 / element size 1e-2)^2 times the beam's length.
    np.testing.assert_allclose(warped.ravel()[beam.kinematics.free_dofs], step, atol=1e-9)


def test_two_blocks_of_one_material_equal_one(box):
    nodes, tetrahedra = box((1, 1, 1), (2, 2, 2), 0.2)
    options = {"young_modulus": 1e5, "poisson_ratio": 0.4}
    fixed = nodes[:, 2] == 0.0
    one = MechanicalModel.from_mesh(nodes, tetrahedra, fixed=fixed, element="linear", **options)
    parts = [Tetrahedra(nodes, part, **options) for part in (tetrahedra[::2], tetrahedra[1::2])]
    two = MechanicalModel(nodes, parts, fixed=fixed)
    x = nodes + 0.1 * np.sin(5.0 * nodes) * nodes[:, 2:]
    for a, b in zip(evaluate(one, x, np.zeros(0)), evaluate(two, x, np.zeros(0)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9 * max(1.0, np.abs(a).max(initial=0.0)))
    assert one.volume == pytest.approx(two.volume, rel=1e-12)


def test_elasticity_may_differ_per_element_and_change(box):
    nodes, tetrahedra = box((1, 1, 1), (2, 2, 2), 0.2)
    x = nodes * [1.1, 1.0, 0.9]
    young = np.where(np.arange(len(tetrahedra)) % 2, 1e5, 3e5)
    mixed = Tetrahedra(nodes, tetrahedra, young_modulus=young, poisson_ratio=0.3)
    parts = [
        Tetrahedra(nodes, tetrahedra[k::2], young_modulus=value, poisson_ratio=0.3) for k, value in ((0, 3e5), (1, 1e5))
    ]
    energy = [block.add(x, np.zeros_like(x), None, None)[0] for block in (mixed, *parts)]
    assert energy[0] == pytest.approx(energy[1] + energy[2], rel=1e-12)
    mixed.set_elasticity(2e5, 0.3)
    whole = Tetrahedra(nodes, tetrahedra, young_modulus=2e5, poisson_ratio=0.3)
    assert mixed.add(x, np.zeros_like(x), None, None)[0] == whole.add(x, np.zeros_like(x), None, None)[0]


# -- loads ----------------------------------------------------------------------------------------------------------


def test_weight_is_density_times_volume_times_gravity(box):
    nodes, tetrahedra = box((0.3, 0.2, 0.1), (3, 2, 2), 0.2)
    gravity = np.array([1.0, 2.0, -9.81])
    model = MechanicalModel.from_mesh(
        nodes, tetrahedra, fixed=nodes[:, 0] < 1e-9, density=1234.0, gravity=gravity, element="linear"
    )
    assert model.volume == pytest.approx(0.3 * 0.2 * 0.1, rel=1e-12)
    assert model.mass == pytest.approx(1234.0 * 0.006, rel=1e-12)
    np.testing.assert_allclose(model.loads.sum(axis=0), 1234.0 * 0.006 * gravity, rtol=1e-12)
    # Its moment too: the weight acts at the centre of mass.
    moment = np.cross(model.nodes, model.loads).sum(axis=0)
    np.testing.assert_allclose(moment, np.cross([0.15, 0.1, 0.05], 1234.0 * 0.006 * gravity), rtol=1e-9)
    model.nodal_loads[5] = [1.0, 0.0, 0.0]
    np.testing.assert_allclose(model.loads.sum(axis=0), 1234.0 * 0.006 * gravity + [1, 0, 0], rtol=1e-12)
    model.set_gravity((0.0, 0.0, 0.0))
    np.testing.assert_allclose(model.loads.sum(axis=0), [1, 0, 0])


@pytest.mark.parametrize("gravity", [(0.0, 0.0), (0.0, 0.0, np.nan), 9.81])
def test_malformed_gravity_is_rejected(beam, gravity):
    with pytest.raises(ValueError, match="three finite numbers"):
        beam.set_gravity(gravity)


def test_reactions_balance_the_weight(beam):
    """At equilibrium the internal forces of the clamped nodes carry all of the dead loads."""
    beam.set_gravity((0.0, 0.0, -9.81))
    x = Statics(beam, tolerance=1e-12).solve([0.0, 0.0], "effort").x
    forces = np.zeros_like(x)
    beam.blocks[0].add(x, forces, None, None)
    np.testing.assert_allclose(forces[~beam.fixed] - beam.loads[~beam.fixed], 0.0, atol=1e-8)
    np.testing.assert_allclose(forces.sum(axis=0), 0.0, atol=1e-9)  # internal forces balance themselves
    np.testing.assert_allclose(forces[beam.fixed].sum(axis=0) + beam.loads[~beam.fixed].sum(axis=0), 0.0, atol=1e-7)
    assert x[:, 2].min() < beam.nodes[:, 2].min() - 0.005  # and it sags


# -- patch test -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(MATERIALS))
def test_patch_of_irregular_elements_reproduces_a_linear_field(box, rng, name):
    size = np.array([0.04, 0.03, 0.03])
    nodes, tetrahedra = box(size, (4, 3, 3), jitter=0.3)
    boundary = ((nodes == 0.0) | (nodes == size)).any(axis=1)
    assert (~boundary).sum() == 12
    F = np.array([[1.2, 0.3, -0.1], [0.05, 0.9, 0.2], [-0.15, 0.1, 1.1]])
    exact = nodes @ F.T + [0.01, -0.02, 0.03]
    model = MechanicalModel.from_mesh(
        nodes, tetrahedra, fixed=boundary, material=name, poisson_ratio=0.4, element="linear"
    )
    statics = Statics(model, tolerance=1e-14)
    start = exact.copy()
    start[~boundary] += 1e-3 * rng.standard_normal((12, 3))
    statics.restore(start, np.zeros(0))
    solved = statics.solve(np.zeros(0)).x
    np.testing.assert_array_equal(solved[boundary], exact[boundary])
    np.testing.assert_allclose(solved, exact, rtol=0, atol=1e-12)  # 1e-10 of the largest displacement and less


# -- meshes ---------------------------------------------------------------------------------------------------------


def test_negatively_oriented_elements_are_reoriented(box):
    nodes, tetrahedra = box((1, 1, 1), (2, 2, 2))
    mirrored = tetrahedra.copy()
    mirrored[::3] = mirrored[::3][:, [1, 0, 2, 3]]
    plain, turned = (
        MechanicalModel.from_mesh(nodes, t, fixed=nodes[:, 0] < 1e-9, element="linear") for t in (tetrahedra, mirrored)
    )
    assert turned.volume == pytest.approx(1.0, rel=1e-12)
    corners = nodes[turned.blocks[0].connectivity]
    assert (np.linalg.det(corners[:, 1:] - corners[:, :1]) > 0.0).all()
    x = nodes * [1.1, 1.0, 0.95]
    assert turned.energy(x) == pytest.approx(plain.energy(x), rel=1e-12)


def test_isolated_nodes_are_held_and_have_no_effect(box):
    nodes, tetrahedra = box((0.1, 0.02, 0.02), (4, 1, 1))
    extra = np.vstack([[[9.0, 9.0, 9.0]], nodes, [[5.0, 5.0, 5.0]]])
    fixed = np.flatnonzero(nodes[:, 0] == 0.0)
    states = []
    for points, connectivity, clamp in ((nodes, tetrahedra, fixed), (extra, tetrahedra + 1, fixed + 1)):
        model = MechanicalModel.from_mesh(
            points, connectivity, fixed=clamp, young_modulus=1e6, gravity=(0, 0, -9.81), element="linear"
        )
        states.append(Statics(model).solve(np.zeros(0)).x)
    np.testing.assert_allclose(states[1][1:-1], states[0], atol=1e-12)
    np.testing.assert_array_equal(states[1][[0, -1]], extra[[0, -1]])


def test_mask_and_indices_of_fixed_nodes_are_the_same(box):
    nodes, tetrahedra = box()
    mask = nodes[:, 0] == 0.0
    by_mask, by_index = (
        MechanicalModel.from_mesh(nodes, tetrahedra, fixed=f, element="linear")
        for f in (mask, np.flatnonzero(mask).tolist())
    )
    np.testing.assert_array_equal(by_mask.kinematics.free_dofs, by_index.kinematics.free_dofs)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"nodes": np.zeros((4, 2))}, "nodes must be finite|shape"),
        ({"nodes": np.full((4, 3), np.nan)}, "finite"),
        ({"tetrahedra": np.array([[0, 1, 2]])}, "shape"),
        ({"tetrahedra": np.zeros((0, 4), dtype=int)}, "m > 0"),
        ({"tetrahedra": np.array([[0, 1, 2, 4]])}, "the mesh has 4"),
        ({"tetrahedra": np.array([[0, 1, 2, -1]])}, "refer to nodes"),
        ({"tetrahedra": np.array([[0, 1, 2, 2]])}, "degenerate"),
        ({"nodes": ONE_TETRAHEDRON * [1, 1, 1e-12]}, "degenerate"),
        ({"material": "jelly"}, "unknown material 'jelly'.*corotational"),
        ({"poisson_ratio": 0.5}, "poisson_ratio = 0.5"),
        ({"young_modulus": -1.0}, "young_modulus = -1"),
        ({"gravity": (0.0, np.inf, 0.0)}, "gravity"),
        ({"fixed": np.zeros(4, dtype=bool)}, "no node is fixed"),
        ({"fixed": []}, "no node is fixed"),
    ],
    ids=[
        "plane nodes",
        "NaN nodes",
        "triangles",
        "no elements",
        "index too large",
        "negative index",
        "node twice",
        "flat element",
        "unknown material",
        "incompressible",
        "negative stiffness",
        "infinite gravity",
        "empty mask",
        "empty list",
    ],
)
def test_malformed_meshes_are_rejected(change, message):
    arguments = {"nodes": ONE_TETRAHEDRON, "tetrahedra": np.array([[0, 1, 2, 3]]), "fixed": [0, 1, 2], **change}
    nodes, tetrahedra = arguments.pop("nodes"), arguments.pop("tetrahedra")
    with pytest.raises(ValueError, match=message):
        MechanicalModel.from_mesh(nodes, tetrahedra, **arguments)


@pytest.mark.parametrize("fixed", [[7], [True, False], [0.5]], ids=["out of range", "short mask", "not an index"])
def test_malformed_fixed_nodes_are_rejected(fixed):
    with pytest.raises((ValueError, IndexError)):
        MechanicalModel.from_mesh(ONE_TETRAHEDRON, np.array([[0, 1, 2, 3]]), fixed=fixed, element="linear")


def test_unknown_role_is_rejected(beam):
    with pytest.raises(ValueError, match="unknown role 'x'"):
        beam.add("x", beam.constraints["a"][0])
    with pytest.raises(ValueError, match="role 'a' takes a constraint, got 'cable'"):
        beam.add("a", "cable")


def test_rows_of_a_role_have_different_names(beam):
    actuator = beam.constraints["a"][0]
    with pytest.raises(
        ValueError, match=f"the model already has an actuator named '{actuator.name}'; give each its own"
    ):
        beam.add("a", actuator)
    beam.add("s", actuator)  # measured too


@pytest.mark.parametrize(
    "name", ["finger", "two_finger_gripper", "tetrapod", "trunk"]
)  # cables, bonds, frames, chambers
def test_equations_without_the_tangent_are_the_same(name):
    model = make_robot(name).build()
    effort = np.linspace(0.1, 1.0, model.assembly.size)
    whole = evaluate(model, model.nodes, effort)
    expected = [np.array(part) for part in (whole.residual, whole.gradients, whole.delta, whole.energy)]
    found = model.assembly.evaluate(model.nodes, effort, model.loads, tangent=False)
    assert found.tangent is None
    for part, known in zip((found.residual, found.gradients, found.delta, found.energy), expected, strict=True):
        np.testing.assert_array_equal(part, known)
