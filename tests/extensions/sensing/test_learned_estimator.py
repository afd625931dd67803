"""The estimator on the learned model: derivatives, recovery on the model and on finite elements, and messages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.backend import PointForce
from softgym_envs.backends.surrogate import SurrogateBackend
from softgym_envs.extensions.fitting.row_errors import KNOTS, RowErrors
from softgym_envs.extensions.sensing import Noise, Payload, Readings, Touch, finger_grid
from softgym_envs.extensions.sensing.learned import LearnedEstimator
from softgym_envs.extensions.sensing.model_errors import measured_errors
from softgym_envs.extensions.sensing.readings import LARGEST_RESIDUAL
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.surrogate.domain import OUTSIDE, UNEXPLAINED

GRID = finger_grid()
POINT = np.array([0.001, 0.0, -0.093])
COMMAND = np.array([0.006])
NOISE = Noise(displacement=1e-4, volume=6e-10)


@pytest.fixture(scope="module")
def robot():
    return make_robot("sensorized_finger")


def touched(robot, exact=True, noise=NOISE):
    return LearnedEstimator(robot, load=Touch(GRID, GRID.cell(POINT), 1.0), noise=noise, exact=exact)


def test_slopes_by_actuators_are_derivatives_of_the_model(robot):
    estimator = touched(robot)
    at = np.tile([0.0, 0.6], (16, 1))
    response = estimator.respond(COMMAND, at)
    ends = [estimator.respond(COMMAND, at + [step, 0.0]) for step in (1e-4, -1e-4)]
    for name in ("sensors", "effectors"):
        slope = getattr(response, f"{name.removesuffix('s')}_slopes")[:, :, 0]
        difference = (getattr(ends[0], name) - getattr(ends[1], name)) / 2e-4
        np.testing.assert_allclose(slope, difference, rtol=0, atol=1e-2 * np.abs(slope).max())


def test_slopes_by_force_agree_with_differences_of_the_model(robot):
    estimator = touched(robot)
    at = np.tile([0.0, 0.6], (16, 1))
    response = estimator.respond(COMMAND, at)
    ends = [estimator.respond(COMMAND, at + [0.0, step]) for step in (0.1, -0.1)]
    slope, difference = response.effector_slopes[:, 1, 1], (ends[0].effectors - ends[1].effectors)[:, 1] / 0.2
    np.testing.assert_allclose(slope, difference, rtol=0.02)


def test_slopes_by_force_let_slack_cables_follow(robot):
    """A strong push near the tip slackens the cable at all places; differences are of equilibria, found anew."""
    point = np.array([0.005, 0.0, -0.112])
    estimator = LearnedEstimator(robot, load=Touch(GRID, GRID.cell(point), 1.0), noise=NOISE, exact=True)
    at, command = np.tile([0.0, 1.7], (16, 1)), np.array([0.002])
    response = estimator.respond(command, at)
    ends = [estimator.respond(command, at + [0.0, step]) for step in (0.1, -0.1)]
    assert response.slack.all() and ends[0].slack.all() and ends[1].slack.all()
    for name in ("sensors", "effectors"):
        slope = getattr(response, f"{name.removesuffix('s')}_slopes")[:, :, 1]
        difference = (getattr(ends[0], name) - getattr(ends[1], name)) / 0.2
        np.testing.assert_allclose(slope, difference, rtol=0, atol=2e-2 * np.abs(slope).max())


@pytest.mark.parametrize("cavities", [2, 4])
def test_force_and_tip_are_found_on_the_model(cavities):
    robot = make_robot("sensorized_finger", cavities=cavities)
    plant = SurrogateBackend(robot)
    plant.touch(PointForce(POINT, np.array([0.0, 0.8, 0.0])))
    state = plant.step(COMMAND)
    estimator = touched(robot, noise=Noise(displacement=1e-5, volume=1e-10))
    volumes = estimator.rest_volumes + state.condensed.delta.s
    for _ in range(3):
        found = estimator.update(Readings(COMMAND, volumes))
    assert found.load[0] == pytest.approx(0.8, abs=0.15)
    assert np.abs(found.effector - state.effector[0]).max() < 1e-3
    assert found.condensed.roles == (("a", 1), ("e", 3), ("s", cavities))
    estimator.touch(None)
    plant.touch(None)
    state = plant.step(COMMAND)
    found = estimator.update(Readings(COMMAND, estimator.rest_volumes + state.condensed.delta.s))
    assert not len(found.load)
    assert np.abs(found.effector - state.effector[0]).max() < 1e-3


def test_a_push_that_slackens_the_cable_is_found_from_small_forces(robot):
    """Volumes change less with the force where the cable pulls, so Gauss-Newton alone ends at half of the force."""
    grid, command, force = finger_grid(), np.array([0.0023]), np.array([0.0, 1.9, 0.0])
    point = np.array([0.005, 0.0, -0.112])
    plant = SurrogateBackend(robot)
    plant.touch(PointForce(point, force))
    state = plant.step(command)
    assert state.slack[0]
    estimator = LearnedEstimator(robot, load=Touch(grid, grid.cell(point), 1.0), noise=Noise(volume=6e-10), exact=True)
    for _ in range(3):
        found = estimator.update(Readings(command, estimator.rest_volumes + state.condensed.delta.s))
    assert found.slack[0] and found.load[0] == pytest.approx(1.9, abs=0.1)
    assert np.abs(found.effector - state.effector[0]).max() < 2e-3


def test_errors_of_the_model_keep_the_truth_of_finite_elements_likely(robot):
    touch = robot.learning.touch
    load = touch.design(robot.design_space.baseline, POINT, np.array([0.0, 0.8, 0.0]))
    state = Statics(touch.variant().build(load)).solve(COMMAND)
    estimator = touched(robot, exact=False)
    assert (estimator.errors.deviation > 0.0).all()
    found = estimator.update(Readings(COMMAND, estimator.rest_volumes + state.condensed.delta.s))
    assert abs(found.load[0] - 0.8) < 4.0 * np.sqrt(found.load_covariance[0, 0])
    assert np.abs(found.effector - state.condensed.delta.e[:3]).max() < 5e-3


def test_a_constant_error_of_the_model_on_one_body_is_measured_and_taken_back(robot):
    """The plant is the model with wrong volumes and tips; measured on it, the errors leave no trace."""
    wrong = np.array([0.0, 3e-4, -2e-4]), np.array([2e-9, -1.5e-9])

    class Plant(SurrogateBackend):
        def step(self, command, mode="displacement", *, force=None):
            state = super().step(command, mode, force=force)
            shift = np.concatenate([[0.0], *wrong])
            return replace(
                state, condensed=replace(state.condensed, free=state.condensed.free + shift), slack=state.slack
            )

    errors = measured_errors(SurrogateBackend(robot), Plant(robot), GRID, states=20)
    np.testing.assert_allclose(errors.mean, np.tile(-np.concatenate(wrong), (KNOTS, 1)), rtol=1e-6, atol=1e-12)
    assert np.abs(errors.deviation).max() < 1e-9
    plant = SurrogateBackend(robot)
    plant.touch(PointForce(POINT, np.array([0.0, 0.8, 0.0])))
    state = plant.step(COMMAND)
    exact = touched(robot)
    corrected = LearnedEstimator(robot, load=exact.load, noise=NOISE, errors=errors)
    volumes = exact.rest_volumes + state.condensed.delta.s
    expected = exact.update(Readings(COMMAND, volumes))
    found = corrected.update(Readings(COMMAND, volumes + wrong[1]))
    np.testing.assert_allclose(found.load, expected.load, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(found.effector, expected.effector + wrong[0], rtol=0, atol=1e-7)


def test_larger_errors_of_the_model_leave_the_force_less_certain(robot):
    load = Touch(GRID, GRID.cell(POINT), 1.0)
    spreads = []
    for size in (0.2e-9, 1e-9):
        rows = np.tile([0.0, 0.0, 0.0, size, size], (KNOTS, 1))
        estimator = LearnedEstimator(robot, load=load, noise=NOISE, errors=RowErrors(0.0 * rows, rows))
        spreads.append(estimator.update(Readings(COMMAND, estimator.rest_volumes - 2e-8)).load_covariance[0, 0])
    assert spreads[1] > 1.5 * spreads[0]


def plant_reading(estimator, force=0.8, command=COMMAND):
    """Return the readings of the learned model itself under a touch."""
    plant = SurrogateBackend(estimator.robot, estimator.design)
    plant.touch(PointForce(POINT, np.array([0.0, force, 0.0])))
    return Readings(command, estimator.rest_volumes + plant.step(command).condensed.delta.s)


def same(found, expected):
    return found.misfit == expected.misfit and (found.effector_covariance == expected.effector_covariance).all()


def test_a_likely_reading_is_trusted(robot):
    estimator = touched(robot)
    found = estimator.update(plant_reading(estimator))
    assert found.trusted and found.distrust == 0


@pytest.mark.parametrize(
    "wrong", [lambda v: 1e9 * v, lambda v: v - 50.0, lambda v: 0.0 * v], ids=["mm3", "change", "0"]
)
def test_impossible_volumes_are_refused_and_forgotten(robot, wrong):
    estimator, other = touched(robot), touched(robot)
    reading = plant_reading(estimator)
    for each in (estimator, other):
        each.update(reading)
    with pytest.raises(ValueError, match=r"readings 'volumes' number 0 = .* m3 is impossible; allowed: above 0, up to"):
        estimator.update(replace(reading, volumes=wrong(reading.volumes)))
    assert same(estimator.update(reading), other.update(reading))


@pytest.mark.parametrize("case", ["command", "readings"])
def test_what_the_model_does_not_know_is_not_trusted_and_not_remembered(robot, case):
    estimator, other = touched(robot), touched(robot)
    reading = plant_reading(estimator)
    for each in (estimator, other):
        each.update(reading)
    if case == "command":
        found, distrust = estimator.update(plant_reading(estimator, command=np.array([0.0155]))), OUTSIDE
    else:
        found, distrust = estimator.update(replace(reading, volumes=0.9 * reading.volumes)), UNEXPLAINED
    assert not found.trusted and found.distrust & distrust
    assert same(estimator.update(reading), other.update(reading))


def test_forces_and_bodies_beyond_the_training_are_not_trusted(robot):
    estimator = touched(robot)
    found = estimator.update(plant_reading(estimator, force=1.15 * estimator.largest_force))
    assert found.load[0] > estimator.largest_force and found.distrust == OUTSIDE
    other = LearnedEstimator(robot, design={"poisson_ratio": 0.4}, noise=NOISE, exact=True)
    assert touched(robot).knows_body and not other.knows_body
    assert other.update(Readings(COMMAND, other.rest_volumes - 5e-8)).distrust & OUTSIDE


def test_a_small_steady_error_does_not_become_unexplained_with_the_number_of_readings(robot):
    estimator = LearnedEstimator(robot, noise=NOISE, exact=True)
    reading = plant_reading(estimator, force=0.0)
    shifted = replace(reading, volumes=reading.volumes + np.array([5.0, -5.0]) * NOISE.volume)
    found = [estimator.update(shifted) for _ in range(40)]
    assert all(each.trusted for each in found) and found[-1].misfit > 2 * LARGEST_RESIDUAL**2


def test_wrong_inputs_are_named(robot):
    with pytest.raises(ValueError, match="no touch of robot 'finger' is learned"):
        LearnedEstimator(make_robot("finger"))
    with pytest.raises(ValueError, match="drift"):
        LearnedEstimator(robot, noise=Noise(drift=0.1))
    with pytest.raises(ValueError, match="volumes"):
        touched(robot).update(Readings(COMMAND, np.array([1.0])))
    with pytest.raises(ValueError, match="does not read efforts; leave them out, or use Estimator"):
        touched(robot).update(Readings(COMMAND, np.ones(2), efforts=np.ones(2)))
    with pytest.raises(ValueError, match="errors must have 5 rows"):
        LearnedEstimator(robot, errors=RowErrors.none(4))


def test_wrong_inputs_name_themselves(robot):
    estimator = LearnedEstimator(robot)
    with pytest.raises(ValueError, match=r"command = 6 m of actuator .* is far beyond its range .* check its unit"):
        estimator.update(estimator.reading(np.array([6.0]), np.zeros(2)))  # millimetres
    with pytest.raises(ValueError, match="readings 'change' must be 2 finite values"):
        estimator.reading(np.array([0.006]), np.zeros(3))
    with pytest.raises(ValueError, match="must be a Touch or None on a learned model; use Estimator"):
        estimator.touch(Payload())
    with pytest.raises(ValueError, match="steps = 0 must be positive"):
        LearnedEstimator(robot, steps=0)
