"""Every material: exact derivatives, objectivity, rest state, small strains, inversions, uniaxial tension."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from softgym_envs.mechanics.elements.tetrahedra import Tetrahedra
from softgym_envs.mechanics.materials import MATERIALS, lame_parameters

MU, LAME = 2.0, 3.0
ELASTICITIES = [(2.0, 3.0), (1.0, 0.0), (1.0, -0.4), (1.0, 400.0)]  # nu = 0.3, 0, -0.33 and 0.49875


def evaluate(material, F, mu=MU, lame=LAME):
    """Energy (m,), stress (m, 3, 3), tangent (m, 9, 9) and the count of inverted gradients."""
    F = np.ascontiguousarray(np.reshape(F, (-1, 9)), dtype=float)
    m = len(F)
    energy, stress, tangent = np.empty(m), np.empty((m, 9)), np.empty((m, 9, 9))
    bad = material.evaluate(F, np.full(m, mu), np.full(m, lame), energy, stress, tangent)
    return energy, stress.reshape(m, 3, 3), tangent, bad


@pytest.fixture(params=sorted(MATERIALS))
def material(request):
    return MATERIALS[request.param]


@pytest.fixture
def gradients(rng):
    """Deformation gradients with det F > 0.2: mild, strongly sheared, and rotated by any angle."""
    F = np.eye(3) + np.concatenate([0.2 * rng.standard_normal((30, 3, 3)), 0.6 * rng.standard_normal((300, 3, 3))])
    F = Rotation.random(len(F), random_state=1).as_matrix() @ F
    F = F[np.linalg.det(F) > 0.2]
    assert len(F) > 60
    return F


def test_registry_names_its_materials():
    assert {"corotational", "stable_neo_hookean"} <= set(MATERIALS)
    assert all(material.name == name for name, material in MATERIALS.items())


@pytest.mark.parametrize(("mu", "lame"), ELASTICITIES)
def test_stress_is_the_derivative_of_the_energy(material, gradients, mu, lame):
    _, stress, _, bad = evaluate(material, gradients, mu, lame)
    assert bad == 0
    h = 1e-5
    for k in range(9):
        step = np.zeros(9)
        step[k] = h
        step = step.reshape(3, 3)
        plus, minus = (evaluate(material, gradients + s * step, mu, lame)[0] for s in (1, -1))
        # Central differences: truncation h^2 = 1e-10 and round-off 1e-16 / h = 1e-11, both times the stiffness.
        np.testing.assert_allclose(stress.reshape(-1, 9)[:, k], (plus - minus) / (2 * h), atol=2e-7 * (mu + abs(lame)))


@pytest.mark.parametrize(("mu", "lame"), ELASTICITIES)
def test_tangent_is_the_symmetric_derivative_of_the_stress(material, gradients, mu, lame):
    tangent = evaluate(material, gradients, mu, lame)[2]
    np.testing.assert_allclose(tangent, np.swapaxes(tangent, 1, 2), rtol=0, atol=1e-12 * np.abs(tangent).max())
    h = 1e-5
    for k in range(9):
        step = np.zeros(9)
        step[k] = h
        step = step.reshape(3, 3)
        plus, minus = (evaluate(material, gradients + s * step, mu, lame)[1].reshape(-1, 9) for s in (1, -1))
        error = np.abs(tangent[:, :, k] - (plus - minus) / (2 * h)).max(axis=1)
        # Truncation grows near singular F, where the polar rotation turns fast: relative to each tangent's size.
        assert (error <= 1e-6 * np.abs(tangent).max(axis=(1, 2))).all()


def test_the_tangent_may_be_left_out(material, gradients):
    energy, stress, _, _ = evaluate(material, gradients)
    F, m = np.reshape(gradients, (-1, 9)), len(gradients)
    alone = np.empty(m), np.empty((m, 9))
    assert material.evaluate(F, np.full(m, MU), np.full(m, LAME), *alone, np.empty((0, 9, 9))) == 0
    np.testing.assert_array_equal(alone[0], energy)
    np.testing.assert_array_equal(alone[1], stress.reshape(-1, 9))


@pytest.mark.parametrize(("mu", "lame"), ELASTICITIES)
def test_rotations_store_no_energy(material, mu, lame):
    turned = np.concatenate([np.eye(3)[None], Rotation.random(50, random_state=3).as_matrix()])
    # Half turns, where the iteration for the polar rotation is far from the identity.
    turned = np.concatenate([turned, [np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, -1.0, 1.0])]])
    energy, stress, _, bad = evaluate(material, turned, mu, lame)
    assert bad == 0
    scale = mu + abs(lame)
    np.testing.assert_allclose(energy, 0.0, atol=1e-14 * scale)
    np.testing.assert_allclose(stress, 0.0, atol=1e-13 * scale)


def test_objectivity_and_isotropy(material, gradients):
    energy, stress, tangent, _ = evaluate(material, gradients)
    for Q in Rotation.random(3, random_state=5).as_matrix():
        turned = evaluate(material, Q @ gradients)
        size = np.abs(stress).max()
        np.testing.assert_allclose(turned[0], energy, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(turned[1], Q @ stress, rtol=0, atol=1e-12 * size)
        full = np.einsum("ai,bk,mijkl->majbl", Q, Q, tangent.reshape(-1, 3, 3, 3, 3)).reshape(-1, 9, 9)
        np.testing.assert_allclose(turned[2], full, rtol=0, atol=1e-10 * np.abs(tangent).max())
        # Isotropy: rotating the reference body instead.
        other = evaluate(material, gradients @ Q)
        np.testing.assert_allclose(other[0], energy, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(other[1], stress @ Q, rtol=0, atol=1e-12 * size)


@pytest.mark.parametrize(("mu", "lame"), ELASTICITIES)
def test_small_strains_are_linear_elastic(material, rng, mu, lame):
    identity = np.eye(3)
    hooke = (
        mu * (np.einsum("ik,jl->ijkl", identity, identity) + np.einsum("il,jk->ijkl", identity, identity))
        + lame * np.einsum("ij,kl->ijkl", identity, identity)
    ).reshape(9, 9)
    np.testing.assert_allclose(evaluate(material, identity, mu, lame)[2][0], hooke, atol=1e-12 * (mu + abs(lame)))
    H = 1e-7 * rng.standard_normal((20, 3, 3))
    strain = 0.5 * (H + np.swapaxes(H, 1, 2))
    linear = 2 * mu * strain + lame * np.trace(strain, axis1=1, axis2=2)[:, None, None] * identity
    # The next term is quadratic in H: 1e-7 relative, times a few.
    np.testing.assert_allclose(evaluate(material, identity + H, mu, lame)[1], linear, atol=5e-6 * np.abs(linear).max())


def dilation(material, F):
    """Dilation (m,), its gradient (m, 9) and hessian (m, 9, 9)."""
    F = np.ascontiguousarray(np.reshape(F, (-1, 9)), dtype=float)
    theta, gradient, hessian = np.empty(len(F)), np.empty((len(F), 9)), np.empty((len(F), 9, 9))
    material.dilation(F, theta, gradient, hessian)
    return theta, gradient, hessian


def test_dilation_has_exact_derivatives(material, gradients):
    _, slope, curvature = dilation(material, gradients)
    np.testing.assert_allclose(curvature, np.swapaxes(curvature, 1, 2), rtol=0, atol=1e-12 * np.abs(curvature).max())
    h = 1e-5
    for k in range(9):
        step = np.zeros(9)
        step[k] = h
        plus, minus = (dilation(material, gradients + s * step.reshape(3, 3)) for s in (1, -1))
        np.testing.assert_allclose(slope[:, k], (plus[0] - minus[0]) / (2 * h), rtol=1e-6, atol=1e-6)
        error = np.abs(curvature[:, :, k] - (plus[1] - minus[1]) / (2 * h)).max(axis=1)
        assert (error <= 2e-6 * np.maximum(1.0, np.abs(curvature).max(axis=(1, 2)))).all()


@pytest.mark.parametrize(("mu", "lame"), ELASTICITIES)
def test_lames_first_parameter_acts_on_the_dilation_alone(material, gradients, mu, lame):
    """psi(mu, lambda) = psi(mu, 0) + lambda / 2 theta^2, with its derivatives: averaged elements depend on this."""
    theta, slope, curvature = dilation(material, gradients)
    whole, shear = evaluate(material, gradients, mu, lame), evaluate(material, gradients, mu, 0.0)
    size = max(1.0, abs(lame))
    np.testing.assert_allclose(whole[0], shear[0] + 0.5 * lame * theta**2, rtol=1e-11, atol=1e-12 * size)
    stress = shear[1].reshape(-1, 9) + lame * theta[:, None] * slope
    np.testing.assert_allclose(whole[1].reshape(-1, 9), stress, rtol=0, atol=1e-11 * np.abs(stress).max())
    tangent = shear[2] + lame * (theta[:, None, None] * curvature + slope[:, :, None] * slope[:, None, :])
    np.testing.assert_allclose(whole[2], tangent, rtol=0, atol=1e-11 * np.abs(tangent).max())


def test_dilation_is_zero_for_rotations_and_small_for_small_strain(material, rng):
    turned = Rotation.random(20, random_state=3).as_matrix()
    np.testing.assert_allclose(dilation(material, turned)[0], 0.0, atol=1e-14)
    H = 1e-6 * rng.standard_normal((20, 3, 3))
    np.testing.assert_allclose(dilation(material, np.eye(3) + H)[0], np.trace(H, axis1=1, axis2=2), atol=2e-11)


def test_energy_grows_away_from_rest(material, rng):
    H = 0.05 * rng.standard_normal((200, 3, 3))
    energy = evaluate(material, np.eye(3) + H)[0]
    strain = np.abs(H + np.swapaxes(H, 1, 2)).max(axis=(1, 2))
    assert (energy[strain > 1e-3] > 0.0).all()


@pytest.mark.parametrize(
    "wrong",
    [
        np.diag([1.0, 1.0, -1.0]),
        -np.eye(3),
        np.diag([1.0, 1.0, 0.0]),
        np.full((3, 3), np.nan),
        np.diag([np.nan, 1.0, 1.0]),
        np.diag([1.0, -np.inf, 1.0]),
    ],
    ids=["mirrored", "inside out", "flat", "all NaN", "one NaN", "minus infinity"],
)
def test_inverted_and_non_finite_gradients_are_counted(material, wrong):
    assert evaluate(material, [np.eye(3), wrong, np.eye(3)])[3] == 1
    assert evaluate(material, [wrong, wrong, wrong])[3] == 3


def test_infinite_gradients_are_counted(material):
    assert evaluate(material, [np.eye(3), np.diag([np.inf, 1.0, 1.0])])[3] == 1


@pytest.mark.parametrize(
    ("young", "poisson"),
    [(0.0, 0.3), (-1.0, 0.3), (np.nan, 0.3), (np.inf, 0.3), (1e6, 0.5), (1e6, -1.0), (1e6, np.nan)],
)
def test_impossible_elasticity_is_rejected(young, poisson):
    with pytest.raises(ValueError, match=r"young_modulus|poisson_ratio"):
        lame_parameters(young, poisson)


def test_lame_parameters_give_back_young_and_poisson():
    mu, lame = lame_parameters(3.0e6, 0.47)
    assert mu * (3 * lame + 2 * mu) / (lame + mu) == pytest.approx(3.0e6, rel=1e-12)
    assert lame / (2 * (lame + mu)) == pytest.approx(0.47, rel=1e-12)


# -- uniaxial tension against a scalar equation ---------------------------------------------------------------------


def neo_hookean_principal_stress(stretch, lateral, mu, lame):
    """Axial and lateral nominal stress for F = diag(stretch, lateral, lateral), from Smith et al. 2018 by hand.

    Psi = m/2 (I - 3) + l/2 (J - a)^2 - m/2 log(I + 1) with I = s^2 + 2 t^2, J = s t^2; P_s = dPsi/ds and
    2 P_t = dPsi/dt.
    """
    m, el = 4.0 / 3.0 * mu, lame + 5.0 / 6.0 * mu
    a = 1.0 + 0.75 * m / el
    invariant, volume = stretch**2 + 2 * lateral**2, stretch * lateral**2
    shear = m * invariant / (invariant + 1.0)
    axial = shear * stretch + el * (volume - a) * lateral**2
    return axial, shear * lateral + el * (volume - a) * stretch * lateral


def corotational_principal_stress(stretch, lateral, mu, lame):
    """The same for Psi = mu ((s - 1)^2 + 2 (t - 1)^2) + lambda/2 (s + 2 t - 3)^2."""
    pressure = lame * (stretch + 2 * lateral - 3.0)
    return 2 * mu * (stretch - 1.0) + pressure, 2 * mu * (lateral - 1.0) + pressure


PRINCIPAL = {"stable_neo_hookean": neo_hookean_principal_stress, "corotational": corotational_principal_stress}


@pytest.mark.parametrize("stretch", [0.6, 0.9, 1.1, 1.5, 2.0])
@pytest.mark.parametrize("name", sorted(PRINCIPAL))
def test_uniaxial_tension_of_a_block(box, name, stretch):
    young, poisson = 5.0e5, 0.4
    mu, lame = lame_parameters(young, poisson)
    principal = PRINCIPAL[name]
    lateral = brentq(lambda t: principal(stretch, t, mu, lame)[1], 0.3, 2.0, xtol=1e-15, rtol=1e-15)
    expected = principal(stretch, lateral, mu, lame)[0]
    if name == "corotational":  # its scalar equation is linear
        assert lateral == pytest.approx(1.0 - poisson * (stretch - 1.0), rel=1e-12)
        assert expected == pytest.approx(young * (stretch - 1.0), rel=1e-12)
    size = np.array([0.03, 0.02, 0.01])
    nodes, tetrahedra = box(size, (3, 3, 2), jitter=0.25)
    block = Tetrahedra(nodes, tetrahedra, material=name, young_modulus=young, poisson_ratio=poisson)
    forces = np.zeros_like(nodes)
    _, inverted = block.add(nodes * [stretch, lateral, lateral], forces, None, None)
    assert inverted == 0
    area = size[1] * size[2]
    pulled = nodes[:, 0] == size[0]
    held = nodes[:, 0] == 0.0
    # Free everywhere but at the two ends, where the nominal stress appears; round-off of stress x area only.
    accuracy = 1e-12 * young * area
    np.testing.assert_allclose(forces[~(pulled | held)], 0.0, atol=accuracy)
    np.testing.assert_allclose(forces[pulled].sum(axis=0), [expected * area, 0, 0], atol=accuracy)
    np.testing.assert_allclose(forces[held].sum(axis=0), [-expected * area, 0, 0], atol=accuracy)
