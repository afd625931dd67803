"""The quadruped: bodies over the whole design box stand and move in compiled code; weight, slopes, determinism."""

from __future__ import annotations

import math

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from tests.extensions.walkers.driving import bodies_in_motion


@pytest.fixture(scope="module")
def robot():
    return make_robot("quadruped")


def test_every_body_stands_and_moves_in_compiled_code(robot):
    backend = FEMBackend(robot, dynamics=True)
    for _ in bodies_in_motion(backend):
        for _ in range(10):
            state = backend.step(np.zeros(8))
        weight = 9.81 * backend.model.mass
        assert state.contacts.total[0] == pytest.approx([0.0, 0.0, weight], abs=1e-6 * weight)
        assert np.abs(state.velocity).max() < 1e-9


def test_mass_of_the_baseline(robot):
    model = robot.build()
    leg = math.pi * 0.008**2 * 0.055 * 1070.0
    assert model.mass == pytest.approx(0.05 + 4 * leg, rel=1e-9)


@pytest.mark.parametrize(("design", "height"), [({"leg_length": 0.08}, 0.088), ({"lean": 0.2}, 0.0635)])
def test_the_feet_begin_on_the_ground(robot, design, height):
    backend = FEMBackend(robot, design)
    assert backend.state.effector[0] == pytest.approx([0.0, 0.0, height], abs=2e-3)


def test_equal_pairs_walk_nowhere_and_opposite_ones_bend(robot):
    """Volumes before the axis bend a leg backwards, and so the trunk comes forward; a stretched leg is longer."""
    backend = FEMBackend(robot, dynamics=True)
    rest = backend.state.effector[0]
    bend = np.tile([-1.0, 1.0], 4) * 1.5e-8
    for k in range(8):
        state = backend.step(min(1.0, 0.25 * (k + 1)) * bend)
    assert abs(state.effector[0, 0] - rest[0]) > 2e-3
    assert state.effector[0, 1] == pytest.approx(0.0, abs=1e-9)
    backend.reset()
    for _ in range(8):
        state = backend.step(np.full(8, 3e-8))
    assert state.effector[0, 2] > rest[2] + 1e-3
    assert state.effector[0, :2] == pytest.approx([0.0, 0.0], abs=1e-6)


def test_it_stands_on_a_slope():
    slope = 0.18
    backend = FEMBackend(make_robot("quadruped", friction=0.2, slope=slope), dynamics=True)
    for _ in range(20):
        state = backend.step(np.zeros(8))
    assert np.abs(state.velocity).max() < 1e-6
    assert state.contacts.total[0] == pytest.approx([0.0, 0.0, 9.81 * backend.model.mass], rel=1e-5, abs=1e-5)


def test_the_same_motion_bit_for_bit(robot):
    ends = []
    for _ in range(2):
        backend = FEMBackend(robot, dynamics=True)
        for k in range(6):
            state = backend.step((k + 1) * robot.rates * np.array([1, -0.5, -0.5, 1, -0.5, 1, 1, -0.5]))
        ends.append(state.nodes)
    assert (ends[0] == ends[1]).all()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"friction": -0.1}, "friction = -0.1"),
        ({"elements": 1}, "elements = 1 is out of bounds"),
        ({"friction": 0.0}, "friction = 0.0 must be finite and positive"),
        ({"slope": 45.0}, "slope = 45.0 rad is out of bounds"),
        ({"friction": 0.2, "slope": 0.2}, "allowed: below 0.197 rad"),
    ],
)
def test_wrong_options(options, words):
    with pytest.raises(ValueError, match=words):
        make_robot("quadruped", **options)
