"""The estimator on finite elements: derivatives, recovery without noise, memory, and messages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.sensing import Estimator, Noise, Payload, Readings, Touch, finger_grid
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.surrogate.domain import UNEXPLAINED

GRID = finger_grid()
TOUCH = np.array([1.3, 0.4, -0.6])  # N, and the place in the cell


def finger_estimator(cavities, **options):
    robot = make_robot("sensorized_finger", cavities=cavities, **options)
    return Estimator(robot, load=Touch(GRID, (0, 14)), noise=Noise(volume=1e-11, pressure=1.3))


def diamond_estimator():
    return Estimator(make_robot("diamond"), load=Payload(), noise=Noise(effort=0.01))


CASES = {
    "finger, 2 cavities": (lambda: finger_estimator(2), np.array([0.006]), TOUCH),
    "finger, 4 cavities": (lambda: finger_estimator(4), np.array([0.006]), TOUCH),
    "finger, slack cable": (lambda: finger_estimator(2), np.array([0.0]), TOUCH),
    "finger, sealed": (lambda: finger_estimator(2, sealed=True), np.array([0.006]), TOUCH),
    "diamond": (diamond_estimator, np.array([0.004, 0.002, 0.006, 0.003]), np.array([0.05])),
}


@pytest.fixture(scope="module", params=CASES.values(), ids=CASES)
def case(request):
    make, command, load = request.param
    return make(), command, load


def test_derivatives_of_readings_are_exact(case):
    estimator, command, load = case
    n_a = len(command)

    def readings(parameters):
        near = estimator.linearise(parameters[:n_a], parameters[n_a:])
        return estimator.predict(near, parameters[:n_a], parameters[n_a:])

    at = np.concatenate([command, load])
    slope = readings(at)[1]
    for k, step in enumerate([1e-5] * n_a + [1e-3] * len(load)):
        change = step * np.eye(len(at))[k]
        difference = (readings(at + change)[0] - readings(at - change)[0]) / (2 * step)
        # A slack cable has no effect at all, so its column is compared with the others.
        largest = 1e-3 * np.abs(slope).max() if k < n_a else np.abs(slope[:, k]).max()
        np.testing.assert_allclose(slope[:, k], difference, rtol=0, atol=2e-3 * largest)


def test_readings_without_noise_lead_to_the_truth(case):
    """The touch lies in the middle of its cell; the prior draws the estimate a little towards no load."""
    estimator, command, load = case
    load = load.copy()
    load[1:] = 0.0  # the middle of the cell, which is the most probable place
    near = estimator.linearise(command, load)
    readings, _ = estimator.predict(near, command, load)
    count = len(estimator.robot.sensing.scale)
    estimator.touch(estimator.load)
    efforts = readings[count:] if len(readings) > count else None
    sealed = estimator.robot.sensing.sealed
    cavities = {"pressures" if sealed else "volumes": readings[:count]}
    found = estimator.update(Readings(command, efforts=efforts, **cavities))
    assert found.converged
    if command.any():
        assert found.load[0] == pytest.approx(load[0], rel=0.03)
        truth = near.state.condensed.delta.e
        assert np.abs(found.effector - truth).max() < 2e-4
    assert found.misfit < 1.0


def test_a_steady_body_needs_no_new_equilibrium_and_becomes_more_certain():
    estimator = finger_estimator(2)
    command, load = np.array([0.006]), TOUCH * [1, 0, 0]
    volumes, _ = estimator.predict(estimator.linearise(command, load), command, load)
    first = estimator.update(Readings(command, volumes))
    second = estimator.update(Readings(command, volumes))
    assert first.equilibria > 0
    assert second.equilibria == 0
    assert (np.diag(second.parameters.covariance) < np.diag(first.parameters.covariance)).all()


def test_readings_under_one_command_count_as_their_mean():
    """The order of their noise does not matter, and force and place are not told apart by it."""
    command, truth = np.array([0.006]), TOUCH
    one_by_one = finger_estimator(2)
    volumes, _ = one_by_one.predict(one_by_one.linearise(command, truth), command, truth)
    noise = one_by_one.noise.volume * np.random.default_rng(3).standard_normal((4, 2))
    for row in noise:
        found = one_by_one.update(Readings(command, volumes + row))
    at_once = finger_estimator(2)
    at_once.noise = replace(at_once.noise, volume=at_once.noise.volume / 2.0)
    expected = at_once.update(Readings(command, volumes + noise.mean(axis=0)))
    spread = np.sqrt(np.diag(expected.parameters.covariance))
    assert (np.abs(found.load - expected.load) < 0.15 * spread[1:]).all()
    np.testing.assert_allclose(np.diag(found.parameters.covariance), spread**2, rtol=0.1)


def test_another_cell_forgets_the_force_and_keeps_the_error_of_the_cable():
    estimator = finger_estimator(2)
    command = np.array([0.006])
    volumes, _ = estimator.predict(estimator.linearise(command + 1e-4, TOUCH), command + 1e-4, TOUCH)
    found = estimator.update(Readings(command, volumes)).parameters
    load = Touch(GRID, (1, 10))
    estimator.touch(load)
    assert estimator.belief.mean[0] == found.mean[0]
    assert estimator.belief.covariance[0, 0] == found.covariance[0, 0]
    np.testing.assert_array_equal(estimator.belief.mean[1:], load.prior.mean)


def test_touched_force_is_that_of_a_point():
    """Nine points of a cell share a force as a point within the cell does: the tip differs by less than 0.3 mm."""
    estimator = finger_estimator(2)
    near = estimator.linearise(np.array([0.006]), TOUCH)
    body = make_robot("sensorized_finger").build()
    body.add_contact("touch", estimator.load.place(TOUCH), radius=estimator.radius)
    state = Statics(body).solve([0.006], contact=TOUCH[0] * np.array(GRID.normal))
    unloaded = Statics(body).solve([0.006])
    moved = np.linalg.norm(state.condensed.delta.e - unloaded.condensed.delta.e)
    assert np.linalg.norm(near.state.condensed.delta.e - state.condensed.delta.e) < min(3e-4, 0.1 * moved)


def test_touches_outside_the_grid_are_told():
    with pytest.raises(ValueError, match=r"touch in cell \(3, 0\) is outside the model: the grid has 3 x 20 cells"):
        GRID.corners((3, 0))
    with pytest.raises(ValueError, match="outside the model"):
        GRID.cell(np.array([0.0, 0.0, -0.005]))
    assert GRID.cell(np.array([0.0, 0.0, -0.016])) == (1, 0)


@pytest.mark.parametrize("volumes", [[1e-7], [np.nan, 1e-7]], ids=["one of two", "not a number"])
def test_lost_sensors_are_told(volumes):
    with pytest.raises(ValueError, match="readings 'volumes' must be 2 finite values"):
        finger_estimator(2).update(Readings(np.array([0.0]), np.array(volumes)))


@pytest.mark.filterwarnings("ignore:outer walls of the body")  # which cross on the way to impossible readings
@pytest.mark.parametrize(
    ("sealed", "message"),
    [
        (False, r"readings 'volumes' number 0 = -50 m3 is impossible; allowed: above 0, up to .* m3"),
        (True, r"readings 'pressures' number 1 = -101325 Pa is impossible; allowed: above -101325, up to 911925 Pa"),
    ],
)
def test_impossible_readings_are_refused_and_forgotten(sealed, message):
    estimators = [finger_estimator(2, sealed=sealed) for _ in range(2)]
    change = np.full(2, 5e3 if sealed else -5e-8)
    reading = estimators[0].reading(np.array([0.006]), change)
    wrong = {"pressures": np.array([5e3, -101325.0])} if sealed else {"volumes": np.full(2, -50.0)}
    for each in estimators:
        each.update(reading)
    with pytest.raises(ValueError, match=message):
        estimators[0].update(replace(reading, **wrong))
    found, expected = (each.update(reading) for each in estimators)
    assert found.misfit == expected.misfit and (found.load_covariance == expected.load_covariance).all()


def test_unexplained_readings_are_not_trusted_and_not_remembered():
    def estimator():
        return Estimator(make_robot("sensorized_finger"), load=Touch(GRID, (0, 14)), noise=Noise(volume=6e-10))

    command = np.array([0.006])
    first, other = estimator(), estimator()
    right = first.reading(command, first.linearise(command, TOUCH).state.condensed.delta.s)
    assert first.update(right).trusted and other.update(right).trusted
    found = first.update(replace(right, volumes=0.9 * right.volumes))
    assert found.converged and found.distrust == UNEXPLAINED and not found.trusted
    after, expected = first.update(right), other.update(right)
    np.testing.assert_allclose(after.load, expected.load, rtol=0, atol=1e-6)
    np.testing.assert_allclose(after.load_covariance, expected.load_covariance, rtol=1e-6, atol=1e-12)


def test_axes_of_a_grid_are_perpendicular():
    from softgym_envs.extensions.sensing import TouchGrid

    with pytest.raises(ValueError, match="perpendicular unit vectors"):
        TouchGrid((0, 0, 0), (1, 0, 0), (1, 0, 0), (0, 0, 1), (2, 2))


def test_a_push_that_slackens_the_cable_is_not_taken_for_a_long_cable():
    """A second explanation of the same volumes, with a tight cable that is 1.7 mm longer, has a far larger cost."""
    robot, noise = make_robot("sensorized_finger", cavities=2), Noise(displacement=1e-4, volume=5.74e-10)
    estimator = Estimator(robot, load=Touch(finger_grid(5e-3), (0, 17), 2.0), noise=noise)
    command, load = np.array([0.00269]), np.array([2.48, 0.2, 0.58])
    truth = estimator.linearise(command - 1.4e-4, load)
    assert truth.state.slack.all()
    volumes = estimator.rest_volumes + truth.state.condensed.delta.s
    estimator = Estimator(robot, load=Touch(finger_grid(5e-3), (0, 17), 2.0), noise=noise)
    for _ in range(3):
        found = estimator.update(Readings(command, volumes))
    assert found.misfit < 1.0 and found.near.state.slack.all()
    assert found.load[0] == pytest.approx(load[0], rel=0.05)
    assert abs(found.displacement[0] - command[0]) < 3e-4


def test_an_estimate_beyond_the_last_equilibrium_is_sought_as_far_as_the_body_stands(monkeypatch):
    estimator = finger_estimator(2)
    command, load = np.array([0.006]), np.array([2.0, 0.0, 0.0])
    readings, _ = estimator.predict(estimator.linearise(command, load), command, load)
    estimator.touch(estimator.load)
    solve = estimator._statics.solve

    def buckling(target, modes="displacement", *, contact=None, **options):
        if np.abs(contact).sum() > 1.0:
            raise ConvergenceError("the finger has buckled")
        return solve(target, modes, contact=contact, **options)

    monkeypatch.setattr(estimator._statics, "solve", buckling)
    found = estimator.update(Readings(command, readings))
    assert not found.converged
    assert 0.2 < np.abs(found.near.forces).sum() <= 1.0
    assert found.load[0] == pytest.approx(2.0, rel=0.3)


@pytest.mark.parametrize("force", [0.84, 0.9], ids=["tight", "slack"])
def test_near_a_slack_cable_the_estimate_is_the_integral_over_both_cases(force):
    """The cell is so small that force and error of the cable are all that is unknown: their integral is a plain sum."""
    grid, command, noise = finger_grid(2e-4), np.array([0.0015]), Noise(displacement=1e-4, volume=3e-10)
    robot = make_robot("sensorized_finger", cavities=2)
    estimator = Estimator(robot, load=Touch(grid, grid.cell(np.array([0.001, 0.0, -0.095])), 1.0), noise=noise)

    def state(error, size):
        return estimator.linearise(command + error, np.array([size, 0.0, 0.0])).state

    truth = state(np.zeros(1), force)
    assert truth.slack[0] == (force > 0.86)
    errors, sizes = np.linspace(-3e-4, 3e-4, 11), np.linspace(force - 0.15, force + 0.15, 21)
    values = np.array([[state(error, size).condensed.delta.array for size in sizes] for error in errors])
    sensors, tips = values[..., -2:], values[..., 1:4]
    exponent = (errors[:, None] / 1e-4) ** 2 + sizes**2 + (((sensors - truth.condensed.delta.s) / 3e-10) ** 2).sum(-1)
    weights = np.exp(-0.5 * (exponent - exponent.min()))
    weights /= weights.sum()
    mean, tip = float((weights * sizes).sum()), np.einsum("ij,ijk->k", weights, tips)
    spread = float(np.sqrt((weights * (sizes - mean) ** 2).sum()))
    deviations = np.sqrt(np.einsum("ij,ijk->k", weights, (tips - tip) ** 2))

    estimator.touch(estimator.load)
    found = estimator.update(estimator.reading(command, truth.condensed.delta.s))
    assert abs(found.load[0] - mean) < 0.05 * spread
    assert np.sqrt(found.load_covariance[0, 0]) == pytest.approx(spread, rel=0.05)
    assert abs(found.effector[1] - tip[1]) < 0.05 * deviations[1]
    assert np.sqrt(found.effector_covariance[1, 1]) == pytest.approx(deviations[1], rel=0.05)


def test_tip_of_an_uncertain_force_lies_on_a_curve(monkeypatch):
    """Near the flange the force is known to 1 N; along the finger the tip is known much better than lines are exact."""
    robot, command = make_robot("sensorized_finger", cavities=4), np.array([0.006])
    touch = Touch(GRID, (1, 1))
    estimator = Estimator(robot, load=touch, noise=Noise(volume=7e-11))
    state = estimator.linearise(command, np.array([2.5, 0.0, 0.0])).state

    def misfit():
        estimator.touch(touch)
        found = estimator.update(estimator.reading(command, state.condensed.delta.s))
        away = found.effector - state.condensed.delta.e
        return float(away @ np.linalg.solve(found.effector_covariance, away))

    curved = misfit()
    monkeypatch.setattr(Estimator, "_bend", lambda *given: None)
    straight = misfit()
    assert curved < 3.0 < straight  # of the mean of three squares


def test_wrong_inputs_name_themselves():
    robot = make_robot("sensorized_finger", cavities=2)
    estimator = Estimator(robot)
    rest = np.zeros(2)
    with pytest.raises(ValueError, match=r"command = 6 m of actuator .* is far beyond its range .* check its unit"):
        estimator.update(estimator.reading(np.array([6.0]), rest))  # millimetres
    with pytest.raises(ValueError, match=r"readings 'change' must be 2 finite values, got \[0.0, 0.0, 0.0\]"):
        estimator.reading(np.array([0.006]), np.zeros(3))
    with pytest.raises(ValueError, match=r"readings have efforts, whose noise is unknown; use Noise\(effort="):
        estimator.update(estimator.reading(np.array([0.006]), rest, efforts=np.ones(1)))
    with pytest.raises(ValueError, match="equilibria = 0 must be positive"):
        Estimator(robot, equilibria=0)
    with pytest.raises(ValueError, match="radius = -1.0 must be positive"):
        Estimator(robot, radius=-1.0)
    with pytest.raises(ValueError, match=r"robot 'finger' has no sensors: no cavities and no Noise\(effort="):
        Estimator(make_robot("finger"))
    with pytest.raises(ValueError, match="0.02 m away from the plane of the grid"):
        GRID.cell(np.array([0.0, 0.02, -0.016]))
    with pytest.raises(ValueError, match=r"touch in cell \(1.5, 2\) is outside the model"):
        estimator.touch(Touch(GRID, (1.5, 2)))
