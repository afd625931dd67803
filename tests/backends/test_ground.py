"""Bodies on other ground: friction and slope are drawn in each episode, without another body."""

from __future__ import annotations

import math

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.backend import Ground
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.envs.env import SoftRobotEnv
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.walkers.tasks.walk import Walk

COMMAND = np.tile([1e-8, -1e-8], 4)


def step(backend, count=8):
    for k in range(count):
        backend.step(COMMAND if k % 4 < 2 else -COMMAND)
    return backend.state


def backend(**options):
    return FEMBackend(make_robot("quadruped", elements=2, **options), dynamics=True)


@pytest.fixture(scope="module")
def own():
    return backend()


def test_friction_is_that_of_a_robot_built_with_it(own):
    model = own.model
    own.stand_on(Ground(friction=0.2))
    state, expected = step(own), step(backend(friction=0.2))
    assert (state.nodes == expected.nodes).all()
    assert (state.condensed.compliance == expected.condensed.compliance).all()
    assert own.model is model
    own.stand_on(Ground())
    assert np.abs(step(own).nodes - state.nodes).max() > 1e-5
    assert (own.state.nodes == step(backend()).nodes).all()


def test_a_slope_is_gravity_that_is_turned(own):
    angle = 0.2
    own.stand_on(Ground(gravity=(-9.81 * math.sin(angle), 0.0, -9.81 * math.cos(angle))))
    state, other = step(own, 4), step(backend(slope=angle), 4)
    c, s = math.cos(angle), math.sin(angle)
    turned = other.nodes @ np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])  # into the axes of the slope
    origins = np.arange(0, len(turned), 4)
    assert np.abs(state.nodes[origins] - turned[origins]).max() < 1e-7
    own.stand_on(Ground())


def test_a_ground_on_which_a_body_cannot_stand_changes_nothing(own):
    own.reset()
    kept = step(own, 2).nodes
    with pytest.raises(ConvergenceError):
        own.stand_on(Ground(friction=0.1, gravity=(-9.0, 0.0, -3.9)))
    assert (step(own, 2).nodes != kept).any()
    own.reset()
    assert (step(own, 2).nodes == kept).all()


def test_ground_stays_for_other_bodies_and_travels_with_a_snapshot(own):
    own.reset()
    own.stand_on(Ground(friction=0.2))
    own.reset({"leg_length": 0.05})
    step(own, 3)
    moment, other = own.snapshot(), backend()
    other.resume(moment)
    assert (step(own, 3).nodes == step(other, 3).nodes).all()
    own.stand_on(Ground())
    own.reset(own.robot.design_space.baseline)


class SlipperyWalk(Walk):
    def draw_ground(self, rng):
        return Ground(friction=rng.uniform(0.2, 0.4))


def test_environments_draw_the_ground_at_each_reset():
    robot = make_robot("quadruped", elements=2)
    env = SoftRobotEnv(robot, SlipperyWalk(robot), backend="fem", backend_options={"dynamics": True})
    grounds = []
    for seed in (1, 2, 1):
        env.reset(seed=seed)
        observations = [env.step(np.tile([1.0, -1.0], 4).astype(np.float32))[0] for _ in range(3)]
        grounds.append(observations[-1])
    assert (grounds[0] == grounds[2]).all()
    assert (grounds[0] != grounds[1]).any()


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"friction": -0.1}, "friction of the ground = -0.1 must not be negative"),
        ({"friction": 80.0}, "friction of the ground"),
        ({"gravity": (0.0, -9.81)}, "gravity must be 3 finite numbers"),
        ({"gravity": (0.0, 0.0, -9810.0)}, "length of gravity"),
    ],
)
def test_wrong_grounds(values, words):
    with pytest.raises(ValueError, match=words):
        Ground(**values)


def test_a_robot_that_touches_nothing_has_no_ground():
    with pytest.raises(ValueError, match="robot 'tetrapod' touches nothing, so it has no ground"):
        FEMBackend(make_robot("tetrapod")).stand_on(Ground(friction=0.2))
