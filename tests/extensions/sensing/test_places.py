"""The sum over places of a load against numerical integration."""

import numpy as np
import pytest

from softgym_envs.extensions.sensing import Payload, Touch, finger_grid
from softgym_envs.extensions.sensing.places import Bend, Mixture, Places
from softgym_envs.extensions.sensing.posterior import Gaussian

INFINITE = np.full(1, np.inf)
ACTUATOR = Gaussian(np.array([0.1]), np.array([[0.04]]), -INFINITE, INFINITE)


def mixture(responses: np.ndarray, size: float = 1.0) -> tuple[Mixture, np.ndarray]:
    """A load at places whose readings have the given derivatives (q, k) by its size, and all derivatives."""
    count, readings = responses.shape
    places = Places(np.linspace(-1.0, 1.0, count)[:, None], np.zeros((count, 3)), np.full(count, 1.0 / count))
    by_actuator = np.ones((count, readings, 1))
    return Mixture.before_readings(places, ACTUATOR, size), np.concatenate([by_actuator, responses[:, :, None]], axis=2)


@pytest.mark.parametrize("measured", [(0.9, 1.4), (-0.5, -0.8)], ids=["size away from 0", "size near 0"])
def test_moments_are_those_of_a_numerical_integral(measured):
    responses = np.array([[0.3, 1.0], [0.6, 1.0], [1.5, 2.0]])
    before, slopes = mixture(responses)
    base, spread = np.array([0.05, -0.02]), np.array([0.2, 0.3])
    outputs = np.array([[[0.4, 1.0], [1.0, -0.5]]] * 3)
    found = before.after(np.array(measured), spread, base, slopes).moments(np.array([2.0, 3.0]), outputs)

    errors, sizes = np.meshgrid(np.linspace(-1.5, 1.7, 801), np.linspace(0.0, 6.0, 1501), indexing="ij")
    density, values = [], []
    for place, response in zip((-1.0, 0.0, 1.0), responses, strict=True):
        exponent = (errors - 0.1) ** 2 / 0.04 + sizes**2
        for k in range(2):
            exponent += ((measured[k] - base[k] - errors - response[k] * sizes) / spread[k]) ** 2
        weight = np.exp(-0.5 * exponent)
        weight[:, 0] *= 0.5  # trapezoidal rule at the limit
        density.append(weight.ravel())
        place_values = [
            errors,
            sizes,
            np.full_like(sizes, place),
            2.0 + 0.4 * errors + sizes,
            3.0 + errors - 0.5 * sizes,
        ]
        values.append(np.array([value.ravel() for value in place_values]))
    weights, samples = np.concatenate(density), np.concatenate(values, axis=1)
    mean = samples @ weights / weights.sum()
    covariance = np.cov(samples, aweights=weights, bias=True)
    np.testing.assert_allclose(found.displacement, mean[:1], atol=2e-4)
    np.testing.assert_allclose(found.load, mean[1:3], atol=2e-4)
    np.testing.assert_allclose(found.outputs, mean[3:], atol=2e-4)
    np.testing.assert_allclose(found.load_covariance, covariance[1:3, 1:3], atol=2e-4)
    np.testing.assert_allclose(found.output_covariance, covariance[3:, 3:], atol=2e-4)


def test_two_readings_at_once_and_one_after_the_other_agree():
    before, slopes = mixture(np.array([[0.3, 1.0], [0.9, 1.2]]))
    measured, base, spread = np.array([0.7, 0.9]), np.zeros(2), np.array([0.1, 0.2])
    together = before.after(measured, spread, base, slopes)
    first = before.after(measured[:1], spread[:1], base[:1], slopes[:, :1])
    second = first.after(measured[1:], spread[1:], base[1:], slopes[:, 1:])
    np.testing.assert_allclose(second.means, together.means, rtol=1e-10)
    np.testing.assert_allclose(second.covariances, together.covariances, rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(np.diff(second.logarithms), np.diff(together.logarithms), rtol=1e-10)


def test_places_of_a_cell_are_a_quadrature_over_it():
    load = Touch(finger_grid(), (1, 3))
    places = load.places(effectors=3)
    assert places.shares.sum() == pytest.approx(1.0)
    assert places.shares @ places.coordinates[:, 0] ** 4 == pytest.approx(1.0 / 5.0)
    np.testing.assert_allclose(places.directions[7], load.forces(np.array([1.0, *places.coordinates[7]]), 3))


def test_payload_has_one_place():
    places = Payload().places(effectors=3)
    np.testing.assert_allclose(places.directions, [[0.0, 0.0, -9.81]])
    assert places.coordinates.shape == (1, 0)


def test_a_cut_distribution_has_the_moments_of_its_samples():
    before, _ = mixture(np.array([[0.3], [0.9]]))
    rng, slope, offset = np.random.default_rng(0), np.array([2.0, -1.0]), 0.3
    cut = before.cut(offset, slope)
    samples = rng.multivariate_normal(before.means[0], before.covariances[0], 400_000)
    kept = samples[offset + samples @ slope >= 0.0]
    np.testing.assert_allclose(cut.means[0], kept.mean(axis=0), atol=0.01)
    np.testing.assert_allclose(cut.covariances[0], np.cov(kept.T), atol=0.01)
    share = np.exp(cut.logarithms - before.logarithms)
    np.testing.assert_allclose(share, len(kept) / len(samples), atol=0.005)


def test_both_sides_of_a_cut_make_up_the_whole():
    before, _ = mixture(np.array([[0.3], [0.9]]))
    slope = np.array([2.0, -1.0])
    whole = before.cut(0.3, slope).joined_with(before.cut(-0.3, -slope))
    for name in ("logarithms", "means", "covariances"):
        np.testing.assert_allclose(getattr(whole, name), getattr(before, name), atol=1e-12)


def test_bent_outputs_have_the_moments_of_bent_samples():
    rng = np.random.default_rng(0)
    mean, covariance = np.array([0.2, -0.1, 0.3]), np.diag([0.3, 0.2, 0.1]) ** 2 + 0.01
    bend = Bend(np.array([0.1, 0.1, 0.0]), np.array([0.6, 0.8, 0.0]), np.array([0.5, -0.3, 1.0]))
    samples = rng.multivariate_normal(mean, covariance, 400_000)
    y = (samples - bend.origin) @ bend.axis
    samples = samples + 0.5 * y[:, None] ** 2 * bend.curvature
    (found,), (spread,) = bend.apply(mean[None], covariance[None])
    np.testing.assert_allclose(found, samples.mean(axis=0), atol=2e-3)
    np.testing.assert_allclose(spread, np.cov(samples.T), atol=2e-3)
