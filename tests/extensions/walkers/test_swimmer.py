"""The swimmer: bodies over the whole design box swim in compiled code, against their wave and not by chance."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend, _drifts
from softgym_envs.extensions.beams.servo import Servo
from tests.extensions.walkers.driving import bodies_in_motion


@pytest.fixture(scope="module")
def robot():
    return make_robot("swimmer")


def swim(backend, gait, periods):
    """Return the way of the middle of the body over the second half of some periods [m], shape (3,)."""
    states = [backend.step(gait[k % len(gait)]) for k in range(periods * len(gait))]
    return states[-1].effector[0] - states[len(states) // 2 - 1].effector[0]


def test_every_body_exists_at_rest_and_moves_in_compiled_code(robot):
    backend = FEMBackend(robot, dynamics=True)
    for state in bodies_in_motion(backend):
        np.testing.assert_array_equal(state.nodes, backend.model.nodes)
        np.testing.assert_allclose(backend.step(np.zeros(8)).nodes, backend.model.nodes, rtol=0.0, atol=1e-15)


def test_a_wave_that_runs_to_the_tail_drives_the_body_forwards(robot):
    backend, gait = FEMBackend(robot, dynamics=True), robot.reference_gait()
    assert (np.abs(np.diff(gait, axis=0, append=gait[:1])) <= robot.rates).all()
    ahead = swim(backend, gait, 4)
    backend.reset()
    back = swim(backend, gait[::-1], 4)
    assert ahead[0] > 1e-3
    assert back[0] < -1e-3
    assert np.abs([ahead[2], back[2]]).max() < 1e-9  # nothing leaves the plane
    backend.reset()
    standing = np.outer(np.sin(2.0 * np.pi * np.arange(20) / 20), gait[5])
    assert np.abs(swim(backend, standing, 4)[0]) < 0.3 * ahead[0]  # a stroke that retraces itself (Purcell's scallop)


def test_what_a_swimmer_cannot_be(robot):
    with pytest.raises(ValueError, match="nothing holds robot 'swimmer', so it has no equilibrium; pass dynamics=True"):
        FEMBackend(robot)
    with pytest.raises(ValueError, match="viscosity = 0"):
        make_robot("swimmer", viscosity=0.0)
    with pytest.raises(ValueError, match="elements = 0 is out of bounds"):
        make_robot("swimmer", elements=0)


def test_a_body_that_can_shift_but_not_turn_does_not_drift():
    model = make_robot("swimmer").build()
    assert _drifts(model)
    model.add("a", Servo("heading", 0, np.array([0.0, 0.0, 1.0]), model.nodes))
    assert not _drifts(model)
