"""Propagation of uncertainties to the measured contact-aided fingers."""

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.zigzag_gap import (
    EFFECTS,
    READ,
    Curve,
    Reading,
    Setup,
    close,
    ends,
    objectives,
    read,
    robot_of,
    run,
    sample,
    shares,
    spread,
)
from softgym_envs.errors import ConvergenceError

LINE = Curve(
    angle=np.linspace(0.0, 0.6, 61).tolist(),
    torque=(0.5 * np.linspace(0.0, 0.6, 61)).tolist(),
    force=(2.0 * np.linspace(0.0, 0.6, 61)).tolist(),
)
"""Torque and force that are proportional to the angle."""


def test_reading_of_a_straight_curve():
    full = math.radians(30.0)
    plain = objectives(LINE, Reading())
    assert plain.force == pytest.approx(2.0 * full)
    assert plain.resistance == pytest.approx(0.25)
    assert plain.energy == pytest.approx(sum(0.5 * (full * k / 40) ** 2 for k in range(1, 41)))
    double = objectives(LINE, Reading(young_modulus=2 * 3.62e6))
    assert (double.force, double.energy) == pytest.approx((2 * plain.force, 2 * plain.energy))
    # The servo reaches x of the command c, where c = x + 0.2 * 0.5 x + 0.01.
    late = read(LINE, Reading(servo_compliance=0.2, servo_error=0.01), 30.0)
    assert objectives(LINE, Reading(torque_offset=0.1)).energy - plain.energy == pytest.approx(0.1 * full * 20.5)
    early = read(Curve([0.0, 0.3, full], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]), Reading(servo_error=-0.01), 30.0)
    assert early.force[-1] == pytest.approx(1.0 + 0.01 / (full - 0.3))  # beyond the end of the curve
    assert late.force == pytest.approx(np.maximum(2.0 * (np.array(late.angle) - 0.01) / 1.1, 0.0))


def test_a_failed_closing_has_no_objectives():
    with pytest.raises(ConvergenceError, match="no equilibrium at 20 deg"):
        objectives(Curve(failure="no equilibrium at 20 deg"), Reading())


def test_shares_of_a_linear_function():
    points = np.random.default_rng(0).random((400, 3))
    weights, explained = shares(points, 3.0 * points[:, 0] - 4.0 * points[:, 1] + 7.0)
    assert explained == pytest.approx(1.0)
    assert weights == pytest.approx([0.6, -0.8, 0.0], abs=0.06)


def test_sample_fills_the_tolerances():
    rows = sample("B", 64)
    for name, effect in EFFECTS.items():
        values = np.array([getattr(reading if name in READ else setup, name) for setup, reading in rows])
        assert effect.low <= values.min() < values.max() <= effect.high
        assert np.ptp(values) > 0.9 * (effect.high - effect.low)
    assert sample("203", 2, 40.0)[0][0].increments == 27


@pytest.mark.parametrize("name", ["A", "B", "203"])
def test_every_setup_is_a_design_that_can_be_drawn(name):
    for setup in ends(name).values():
        robot, design = robot_of(setup)
        corners = robot.outline(design)
        assert corners[:, 0].max() >= robot.width - 1e-12


def test_thicker_walls_leave_the_inner_side_of_the_zigzag():
    (robot, thin), (_, thick) = (robot_of(replace(Setup("B"), wall=wall)) for wall in (0.0, 2e-4))
    n = robot.control_points
    moved = robot.outline(thick) - robot.outline(thin)
    assert moved[4 : 4 + n, 0] == pytest.approx(2e-4)  # outer side
    assert moved[8 + n : 8 + 2 * n, 0] == pytest.approx(0.0, abs=1e-12)


def test_setups_are_evaluated_once(tmp_path, monkeypatch):
    closed = []
    monkeypatch.setattr("benchmarks.zigzag_gap.close", lambda setup: closed.append(setup) or LINE)
    setups = [setup for setup, _ in sample("A", 8)]
    first = run(setups, tmp_path, 1, progress=False)
    assert run(setups, tmp_path, 1, progress=False) == first and len(closed) == 8
    rows = sample("A", 8)
    assert spread(rows, first)["force"]["largest"] == pytest.approx(max(objectives(LINE, r).force for _, r in rows))


def test_a_coarse_finger_closes():
    curve = close(Setup("A", angle=9.0, increments=3, mesh_size=40e-3, gap=4e-3))
    assert curve.failure is None and len(curve.angle) == 4
    assert curve.force[-1] > 0.02 and curve.torque[-1] > curve.torque[1] > 0.0
