"""Touches and sensor rows of the learned sensorized finger."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import softgym_envs  # noqa: F401
from softgym_envs import make_robot
from softgym_envs.agents.baselines import make_baseline
from softgym_envs.backends.backend import PointForce
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.backends.surrogate import SurrogateBackend
from softgym_envs.extensions.fitting.data.sampling import SamplingPlan, sample_group
from softgym_envs.mechanics.solvers.statics import Statics

PUSH = PointForce(np.array([0.001, 0.0, -0.093]), np.array([0.0, 0.5, 0.0]))
COMMAND = np.array([0.006])


@pytest.fixture(scope="module")
def robot():
    return make_robot("sensorized_finger")


def test_sensors_and_touch_agree_with_finite_elements(robot):
    states = []
    for backend in (SurrogateBackend(robot), FEMBackend(robot)):
        backend.reset()
        free = backend.step(COMMAND)
        backend.touch(PUSH)
        states.append((free, backend.step(COMMAND)))
    for learned, solved in zip(*states, strict=True):
        assert learned.condensed.roles == solved.condensed.roles
        assert learned.effector.shape == solved.effector.shape
        assert np.abs(learned.effector - solved.effector).max() < 2e-3
        assert np.abs(learned.condensed.delta.s - solved.condensed.delta.s).max() < 0.1 * robot.sensing.scale[0]
        W, truth = learned.condensed.W, solved.condensed.W
        assert W.sa == pytest.approx(truth.sa, rel=0.2)
        assert W.ea[1:] == pytest.approx(truth.ea[1:], rel=0.2)


@pytest.mark.parametrize("cavities", [2, 4])
def test_bodies_of_the_learned_box_are_trusted_and_others_are_not(cavities, rng):
    for box, least, most in (("learned", 0.9, 1.0), ("published", 0.0, 0.1)):
        body = make_robot("sensorized_finger", cavities=cavities, design_box=box)
        backend = SurrogateBackend(body)
        trusted = []
        for _ in range(20):
            backend.reset(body.design_space.sample(rng))
            trusted.append(backend.step(COMMAND).trusted)
        assert least <= np.mean(trusted) <= most


def test_a_touch_ends_and_goes_on_from_a_snapshot(robot):
    backend = SurrogateBackend(robot)
    free = backend.step(COMMAND)
    backend.touch(PUSH)
    touched = backend.step(COMMAND)
    kept = backend.snapshot()
    other = SurrogateBackend(robot)
    other.resume(kept)
    np.testing.assert_allclose(other.step(COMMAND).effector, touched.effector, atol=1e-9)
    backend.touch(None)
    np.testing.assert_allclose(backend.step(COMMAND).effector, free.effector, atol=1e-9)
    backend.touch(PUSH)
    backend.reset()
    np.testing.assert_allclose(backend.step(COMMAND).effector, free.effector, atol=1e-9)


def test_forces_beyond_the_learned_ones_are_doubted_and_others_refused(robot):
    backend = SurrogateBackend(robot)
    backend.touch(PointForce(PUSH.point, np.array([0.0, 5.0, 0.0])))
    assert not backend.step(COMMAND).trusted
    with pytest.raises(ValueError, match="along y on the back"):
        backend.touch(PointForce(PUSH.point, np.array([1.0, 0.0, 0.0])))


def test_stiffness_scales_efforts_of_a_touched_body_alone():
    robot = make_robot("sensorized_finger", touch=True)
    load = {"touch_force": 1.0, "touch_below": 0.09, "touch_beside": 0.002}
    soft, stiff = (Statics(robot.build({**load, "young_modulus": E})).solve(COMMAND).condensed for E in (2e6, 4e6))
    np.testing.assert_allclose(stiff.delta.array, soft.delta.array, rtol=1e-6)
    np.testing.assert_allclose(stiff.lambda_.a, 2.0 * soft.lambda_.a, rtol=1e-6)


def test_groups_share_a_body_under_several_touches():
    robot = make_robot("sensorized_finger", touch=True)
    plan = SamplingPlan(6, 1, sequence="random", loads=3, vary=("outer_radius", *robot.learning.loads))
    designs = plan.designs(robot, 0, 6)
    radii, forces = ([d[name] for d in designs] for name in ("outer_radius", "touch_force"))
    assert radii[0] == radii[1] == radii[2] != radii[3] == radii[4] == radii[5]
    assert len(set(forces)) == 6
    assert plan.designs(robot, 4, 1)[0] == designs[4]
    group, lost = sample_group(robot, plan, 0)
    assert group["effector"].shape == (2 - lost.commands, 8)
    assert group["compliance"].shape == (2 - lost.commands, 45)


def test_the_estimator_reaches_goals_in_the_environment():
    env = gymnasium.make("SoftGym/SensorizedFingerReach-v0", backend="surrogate")
    agent, inner = make_baseline("qp_estimated"), env.unwrapped
    observation, _ = env.reset(seed=3)
    for _ in range(50):
        observation, _, terminated, truncated, info = env.step(agent(observation, inner))
        if terminated or truncated:
            break
    assert info["distance"] < 1e-3
