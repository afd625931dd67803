"""The Cramer-Rao limit of a force: against a linear body whose errors are drawn, and how other sensors change it."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.force_limits import (
    FORCE,
    HALF_NORMAL,
    SENSORS,
    Sensors,
    TouchedBody,
    limiting_band,
    measured_band,
)
from softgym_envs.estimation import Noise

NOISE = Noise(displacement=1e-4, volume=6e-10)
TENSION = 0.16  # [N]


@pytest.fixture
def touch():
    slope = np.array([[4e-6, 2e-9, 1e-10, 3e-10], [5e-6, 6e-9, -2e-10, 5e-10], [1e3, -0.4, 0.02, 0.05]])
    return TouchedBody((0, 0), np.zeros(2), 0.7, np.array([5e-3]), np.zeros((10, 2)), np.zeros(2), 0.07, slope)


def test_the_limit_is_the_error_of_the_best_estimate_of_a_linear_body(touch):
    rng, count, slope = np.random.default_rng(0), 200_000, touch.slope[:2]
    spread = np.array([1e-4, FORCE * HALF_NORMAL**0.5, 3.0**-0.5, 3.0**-0.5])
    parameters = spread * rng.standard_normal((count, 4))
    means = parameters @ slope.T + 6e-10 / 10**0.5 * rng.standard_normal((count, 2))  # of ten readings
    read = slope @ np.diag(spread**2) @ slope.T + 6e-10**2 / 10 * np.eye(2)
    gain = np.diag(spread**2) @ slope.T @ np.linalg.inv(read)
    errors = (means @ gain.T - parameters)[:, 1]
    size, forces = np.sqrt(np.mean(errors**2)), np.ones(count)
    assert touch.limit(NOISE, TENSION) == pytest.approx(size, rel=1e-2)
    expected, found = limiting_band(np.full(count, size), forces), measured_band(errors, forces)
    assert found.rms == pytest.approx(expected.rms)
    for quantity in ("mean", "median", "within", "of_range"):
        assert getattr(found, quantity) == pytest.approx(getattr(expected, quantity), rel=1e-2)


def test_without_readings_the_force_is_known_as_before(touch):
    blind = replace(touch, slope=np.zeros((3, 4)))
    assert blind.limit(NOISE, TENSION) == pytest.approx(FORCE * np.sqrt(1.0 - 2.0 / np.pi))


def test_what_is_known_exactly_is_no_unknown(touch):
    exact = touch.limit(NOISE, TENSION, Sensors(pitch=0.0, cable=0.0))
    information = 10 * ((touch.slope[:2, 1] / 6e-10) ** 2).sum() + 1.0 / HALF_NORMAL
    assert exact == pytest.approx(information**-0.5)
    assert exact == pytest.approx(touch.limit(NOISE, TENSION, Sensors(pitch=1e-6, cable=1e-6)))


def test_better_sensors_lower_the_limit(touch):
    usual, *others = (touch.limit(NOISE, TENSION, sensors) for sensors in SENSORS.values())
    assert all(other < usual for other in others)
    assert others[-1] == min(others)
