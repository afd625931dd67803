"""The most probable parameters, where the answer is known by hand."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs.extensions.sensing.information import sensor_information
from softgym_envs.extensions.sensing.posterior import Gaussian, most_probable

UNLIMITED = np.full(3, np.inf)


@pytest.fixture
def linear():
    """Five readings that are linear in three parameters, their noise, and a prior with correlations."""
    rng = np.random.default_rng(0)
    root = rng.standard_normal((3, 3))
    prior = Gaussian(rng.standard_normal(3), root @ root.T + np.eye(3), -UNLIMITED, UNLIMITED)
    return rng.standard_normal((5, 3)), rng.standard_normal(5), rng.uniform(0.1, 2.0, 5), prior


def test_linear_readings_give_the_kalman_update(linear):
    matrix, readings, noise, prior = linear
    found = most_probable(lambda p: (matrix @ p, matrix), readings, noise, prior)
    gain = prior.covariance @ matrix.T @ np.linalg.inv(matrix @ prior.covariance @ matrix.T + np.diag(noise**2))
    expected = prior.mean + gain @ (readings - matrix @ prior.mean)
    np.testing.assert_allclose(found.parameters.mean, expected, rtol=1e-10)
    np.testing.assert_allclose(
        found.parameters.covariance, prior.covariance - gain @ matrix @ prior.covariance, atol=1e-12
    )
    assert found.converged


def test_readings_one_by_one_give_the_same_as_all_at_once(linear):
    matrix, readings, noise, prior = linear
    whole = most_probable(lambda p: (matrix @ p, matrix), readings, noise, prior).parameters
    belief = prior
    for k in range(5):
        row = matrix[k : k + 1]
        belief = most_probable(
            lambda p, row=row: (row @ p, row), readings[k : k + 1], noise[k : k + 1], belief
        ).parameters
    np.testing.assert_allclose(belief.mean, whole.mean, rtol=1e-9)
    np.testing.assert_allclose(belief.covariance, whole.covariance, atol=1e-12)


def test_information_is_half_the_logarithm_of_the_lost_volume(linear):
    matrix, readings, noise, prior = linear
    found = most_probable(lambda p: (matrix @ p, matrix), readings, noise, prior).parameters
    before, after = (np.linalg.slogdet(each.covariance)[1] for each in (prior, found))
    assert sensor_information(matrix, noise, prior) == pytest.approx(0.5 * (before - after))


def test_limits_hold_and_the_others_adapt():
    """A reading of -1 of the sum of both: the first stays at zero, the second takes the whole reading."""
    prior = Gaussian(np.zeros(2), np.eye(2), np.array([0.0, -np.inf]), np.full(2, np.inf))
    matrix = np.array([[1.0, 1.0]])
    found = most_probable(lambda p: (matrix @ p, matrix), np.array([-1.0]), np.array([0.1]), prior)
    assert found.mode[0] == 0.0
    assert found.mode[1] == pytest.approx(-1.0 / 1.01)
    np.testing.assert_allclose(found.parameters.mean, np.full(2, -1.0 / 2.01))  # as if there were no limits


def test_readings_one_by_one_give_the_same_as_all_at_once_at_a_limit(linear):
    matrix, readings, noise, free = linear
    unlimited = most_probable(lambda p: (matrix @ p, matrix), readings, noise, free).mode
    low = unlimited + np.array([0.5, -np.inf, -np.inf])
    prior = Gaussian(free.mean, free.covariance, low, UNLIMITED)
    whole = most_probable(lambda p: (matrix @ p, matrix), readings, noise, prior)
    assert whole.mode[0] == pytest.approx(low[0])
    belief = prior
    for k in range(5):
        row = matrix[k : k + 1]
        found = most_probable(lambda p, row=row: (row @ p, row), readings[k : k + 1], noise[k : k + 1], belief)
        belief = found.parameters
    np.testing.assert_allclose(found.mode, whole.mode, rtol=1e-8)


def test_noise_and_prior_must_be_positive():
    prior = Gaussian(np.zeros(1), np.eye(1), np.full(1, -np.inf), np.full(1, np.inf))
    with pytest.raises(ValueError, match="readings must be positive"):
        most_probable(lambda p: (p, np.eye(1)), np.ones(1), np.zeros(1), prior)
    flat = Gaussian(prior.mean, np.zeros((1, 1)), prior.low, prior.high)
    with pytest.raises(ValueError, match="not positive definite"):
        most_probable(lambda p: (p, np.eye(1)), np.ones(1), np.ones(1), flat)
