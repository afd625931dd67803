"""Orthotropic material: exact derivatives, objectivity, its axes, the isotropic limit, patches and invalid input."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softgym_envs.extensions.modules.orthotropic import PAIRS, Orthotropic, orthotropic_stiffness, turned_stiffness
from softgym_envs.mechanics.elements.quadratic import QuadraticTetrahedra, add_midside_nodes
from softgym_envs.mechanics.elements.tetrahedra import Tetrahedra
from softgym_envs.mechanics.materials import lame_parameters
from softgym_envs.mechanics.model import MechanicalModel

WOOD = orthotropic_stiffness((1.0, 0.3, 0.1), (0.2, 0.35, 0.25), (0.05, 0.08, 0.12))
AXES = Rotation.random(random_state=4).as_matrix()


def evaluate(material, F, young=2.0):
    F = np.ascontiguousarray(np.reshape(F, (-1, 9)), dtype=float)
    m = len(F)
    mu, lame = lame_parameters(young, 0.3)
    energy, stress, tangent = np.empty(m), np.empty((m, 9)), np.empty((m, 9, 9))
    bad = material.evaluate(F, np.full(m, mu), np.full(m, lame), energy, stress, tangent)
    return energy, stress, tangent, bad


@pytest.fixture
def gradients(rng):
    F = np.eye(3) + 0.2 * rng.standard_normal((40, 3, 3))
    return Rotation.random(40, random_state=1).as_matrix() @ F[np.linalg.det(F) > 0.1][:40]


def test_derivatives(gradients):
    material, h = Orthotropic(WOOD, AXES), 1e-5
    _, stress, tangent, bad = evaluate(material, gradients)
    assert bad == 0
    np.testing.assert_allclose(tangent, tangent.swapaxes(1, 2), atol=1e-12)
    for k in range(9):
        step = h * np.eye(9)[k].reshape(3, 3)
        plus, minus = (evaluate(material, gradients + s * step) for s in (1, -1))
        np.testing.assert_allclose(stress[:, k], (plus[0] - minus[0]) / (2 * h), atol=1e-8)
        np.testing.assert_allclose(tangent[:, :, k], (plus[1] - minus[1]) / (2 * h), atol=1e-8)


def test_the_tangent_may_be_left_out(gradients):
    material, m = Orthotropic(WOOD, AXES), len(gradients)
    energy, stress, _, _ = evaluate(material, gradients)
    alone, (mu, lame) = (np.empty(m), np.empty((m, 9))), lame_parameters(2.0, 0.3)
    F = np.reshape(gradients, (-1, 9))
    assert material.evaluate(F, np.full(m, mu), np.full(m, lame), *alone, np.empty((0, 9, 9))) == 0
    np.testing.assert_array_equal(alone[0], energy)
    np.testing.assert_array_equal(alone[1], stress)


def test_rotations_of_space_and_of_the_material(gradients):
    """Rotating space changes nothing; a body cut out of the material in other directions has the turned axes."""
    material, turn = Orthotropic(WOOD), Rotation.random(random_state=2).as_matrix()
    energy = evaluate(material, gradients)[0]
    np.testing.assert_allclose(evaluate(material, turn @ gradients)[0], energy, rtol=1e-12)
    np.testing.assert_allclose(evaluate(Orthotropic(WOOD, turn), gradients @ turn.T)[0], energy, rtol=1e-12)
    still = evaluate(material, Rotation.random(20, random_state=3).as_matrix())
    np.testing.assert_allclose(still[0], 0.0, atol=1e-15)
    np.testing.assert_allclose(still[1], 0.0, atol=1e-15)


def test_small_strains_see_the_moduli_along_the_axes():
    """Pulled along an axis of the material, it has that Young's modulus and those Poisson's ratios."""
    young, poisson = (1.0, 0.3, 0.1), {(1, 2): 0.2, (0, 2): 0.35, (0, 1): 0.25}
    compliance = np.linalg.inv(2.0 * turned_stiffness(WOOD, AXES))
    for k in range(3):
        axis = AXES[:, k]
        stress = np.array([axis[i] * axis[j] for i, j in PAIRS])
        strains = compliance @ stress
        tensor = np.zeros((3, 3))
        for value, (i, j) in zip(strains, PAIRS, strict=True):
            tensor[i, j] = tensor[j, i] = value if i == j else 0.5 * value
        own = AXES.T @ tensor @ AXES
        assert own[k, k] == pytest.approx(1.0 / (2.0 * young[k]))
        for (i, j), ratio in poisson.items():
            if i == k:
                assert -own[j, j] / own[i, i] == pytest.approx(ratio)
    # The stress of a small strain is C e.
    e = 1e-7 * np.array([[1.0, 0.3, -0.2], [0.3, -0.5, 0.1], [-0.2, 0.1, 0.4]])
    stress = evaluate(Orthotropic(WOOD, AXES), np.eye(3) + e)[1].reshape(3, 3)
    strain = np.array([e[i, j] if i == j else 2.0 * e[i, j] for i, j in PAIRS])
    expected = 2.0 * turned_stiffness(WOOD, AXES) @ strain
    np.testing.assert_allclose([stress[i, j] for i, j in PAIRS], expected, atol=1e-5 * np.abs(expected).max())


def test_isotropic_limit():
    mu, lame = lame_parameters(1.0, 0.3)
    stiffness = orthotropic_stiffness((1.0,) * 3, (0.3,) * 3, (mu,) * 3)
    expected = np.diag([2.0 * mu] * 3 + [mu] * 3)
    expected[:3, :3] += lame
    np.testing.assert_allclose(stiffness, expected, atol=1e-12)
    np.testing.assert_allclose(turned_stiffness(stiffness, AXES), expected, atol=1e-12)


def _cube(rng):
    """A cube of 2 x 2 x 2 boxes of six tetrahedra, with the inner node moved."""
    from softgym_envs.extensions.modules.homogenisation import Cell

    nodes, tetrahedra = Cell((np.linspace(0, 1, 3),) * 3, np.ones((2, 2, 2), dtype=bool)).mesh()
    nodes[np.abs(nodes - 0.5).max(axis=1) < 0.1] += 0.1 * rng.standard_normal(3)
    return nodes, tetrahedra


@pytest.mark.parametrize("element", ["linear", "quadratic"])
def test_patch(element, rng):
    """An affine motion of a body's surface is an equilibrium of its inside, and stores the energy of one gradient."""
    nodes, tetrahedra = _cube(rng)
    if element == "quadratic":
        nodes, tetrahedra = add_midside_nodes(nodes, tetrahedra)
    block = {"linear": Tetrahedra, "quadratic": QuadraticTetrahedra}[element](
        nodes, tetrahedra, material=Orthotropic(WOOD, AXES), young_modulus=2.0, poisson_ratio=0.3
    )
    F = Rotation.random(random_state=5).as_matrix() @ (np.eye(3) + 0.1 * rng.standard_normal((3, 3)))
    forces = np.zeros_like(nodes)
    energy, inverted = block.add(nodes @ F.T, forces, None, None)
    inside = (nodes.min(axis=1) > 1e-9) & (nodes.max(axis=1) < 1.0 - 1e-9)
    assert inverted == 0 and inside.any()
    np.testing.assert_allclose(forces[inside], 0.0, atol=1e-13)
    assert energy == pytest.approx(evaluate(Orthotropic(WOOD, AXES), F)[0][0])


def test_each_element_may_have_its_own_axes(rng):
    nodes, tetrahedra = _cube(rng)
    axes = Rotation.random(len(tetrahedra), random_state=6).as_matrix()
    block = Tetrahedra(nodes, tetrahedra, material=Orthotropic(WOOD, axes), young_modulus=2.0, poisson_ratio=0.3)
    F = np.eye(3) + 0.05 * rng.standard_normal((3, 3))
    energy, _ = block.add(nodes @ F.T, np.zeros_like(nodes), None, None)
    alone = [evaluate(Orthotropic(WOOD, turn), F)[0][0] for turn in axes]
    assert energy == pytest.approx(alone @ block.volumes)
    with pytest.raises(ValueError, match="47 elements"):
        wrong = Tetrahedra(nodes, tetrahedra, material=Orthotropic(WOOD, axes[:-1]), young_modulus=2.0)
        wrong.add(nodes, np.zeros_like(nodes), None, None)


def test_what_is_refused(rng):
    with pytest.raises(ValueError, match="energy is not positive"):
        orthotropic_stiffness((1.0, 1.0, 1.0), (0.0, 0.0, 1.2), (1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="moduli positive"):
        orthotropic_stiffness((1.0, -1.0, 1.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="positive definite"):
        Orthotropic(np.diag([1.0] * 5 + [-1.0]))
    with pytest.raises(ValueError, match="orthonormal"):
        Orthotropic(WOOD, 2.0 * np.eye(3))
    with pytest.raises(ValueError, match="shapes"):
        Orthotropic(np.eye(3))
    nodes, tetrahedra = _cube(rng)
    with pytest.raises(ValueError, match="averaged elements take isotropic materials"):
        MechanicalModel.from_mesh(
            nodes, tetrahedra, fixed=lambda x: x[:, 2] < 1e-9, element="averaged", material=Orthotropic(WOOD)
        ).assembly.evaluate(nodes, np.zeros(0), np.zeros_like(nodes))
