"""An environment that hides the effector: what it shows, what touches the body, and that the estimator solves it."""

from __future__ import annotations

import copy

import gymnasium
import numpy as np
import pytest

import softgym_envs  # noqa: F401
from softgym_envs import make_robot
from softgym_envs.agents.baselines import make_baseline
from softgym_envs.backends.backend import PointForce
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.envs.tasks.registry import make_task
from softgym_envs.extensions.learners.goals import GoalObservation
from softgym_envs.mechanics.solvers.statics import Statics

ID = "SoftGym/SensorizedFingerReach-v0"


def final_distances(agent, env, seeds=2):
    """Distances to the goal at the ends of episodes [m]."""
    found = []
    for seed in range(seeds):
        observation, _ = env.reset(seed=seed)
        ended = False
        while not ended:
            observation, *_, ended, info = env.step(agent(observation, env.unwrapped))
        found.append(float(info["distance"]))
    return np.array(found)


@pytest.mark.parametrize("options", [{"cavities": 2}, {"cavities": 4}, {"cavities": 2, "sealed": True}])
def test_the_estimator_reaches_goals_that_the_model_alone_misses(options):
    env = gymnasium.make(ID, robot_options=options, task_options={"force": 1.5})
    estimated = final_distances(make_baseline("qp_estimated"), env)
    blind = final_distances(make_baseline("qp_model"), env)
    assert (estimated < env.unwrapped.task.success_distance).all()
    assert blind.max() > 2.0 * env.unwrapped.task.success_distance


def test_observations_hold_sensors_and_no_effector():
    env = gymnasium.make(ID, plant={}, task_options={"window": 1})
    observation, _ = env.reset(seed=0)
    spaces, task = env.unwrapped.spaces, env.unwrapped.task
    np.testing.assert_allclose(observation[spaces.slices["sensors"]], [0.0, 0.0, -1.0, 0.0, 0.0], atol=1e-12)
    observation, *_ = env.step(np.ones(1))
    first, second, felt, across, along = observation[spaces.slices["sensors"]]
    change = env.unwrapped.state.condensed.delta.s / env.unwrapped.robot.sensing.scale
    np.testing.assert_allclose([first, second], change / (1.0 + np.abs(change)), rtol=1e-6)
    assert felt == 1.0
    centres = task.touch.grid.corners(task.touch.cell).mean(axis=0)
    width, length = task.touch.grid.pitch * np.array(task.touch.grid.cells)
    np.testing.assert_allclose([across, along], [2 * centres[0] / width, 2 * (-0.015 - centres[2]) / length - 1])
    np.testing.assert_allclose(env.unwrapped.sensed.sensors, change)
    with pytest.raises(ValueError, match="sensors in place of its effector"):
        spaces.observed_effector(observation)


def test_observations_hold_earlier_readings_with_their_commands():
    single = gymnasium.make(ID, task_options={"window": 1})
    stacked = gymnasium.make(ID, task_options={"window": 1, "history": 3})
    blocks = []
    for step in range(4):
        action = np.array([0.3 * step])
        (one, *_), (several, *_) = (env.step(action) if step else env.reset(seed=0) for env in (single, stacked))
        parts = single.unwrapped.spaces.slices
        now = one[parts["sensors"]]
        blocks.insert(0, np.concatenate([one[parts["command"]], now[:2]]))
        known = (blocks + 2 * blocks[-1:])[1:3]
        shown = several[stacked.unwrapped.spaces.slices["sensors"]]
        np.testing.assert_array_equal(shown, np.concatenate([now, *known]))
    moment = stacked.unwrapped.get_state()
    np.testing.assert_array_equal(stacked.unwrapped.set_state(moment)[0], several)


def test_noise_reaches_the_volumes():
    env = gymnasium.make(ID, task_options={"force": 0.0})
    env.reset(seed=0)
    errors = []
    for _ in range(100):
        env.step(np.zeros(1))
        true = env.unwrapped.task.sensors.readings(env.unwrapped.state)
        errors.append(env.unwrapped.sensed.sensors - true)
    assert 0.008 < np.std(errors) < 0.012


def test_touches_begin_within_the_window_and_copies_go_on_with_them():
    env = gymnasium.make(ID).unwrapped
    begins = set()
    for seed in range(4):
        env.reset(seed=seed)
        felt = []
        for _ in range(env.task.touch.window + 1):
            env.step(np.array([0.5]))
            felt.append(env.task.touch.cell is not None)
        assert felt[-1] and felt == sorted(felt)
        begins.add(felt.index(True))
    assert len(begins) > 1
    twin = copy.deepcopy(env)
    for action in (0.3, -0.4):
        mine, theirs = env.step(np.array([action])), twin.step(np.array([action]))
        np.testing.assert_array_equal(mine[0], theirs[0])
    assert env.reset(seed=0)[0][3] == -1.0


def test_a_touch_of_the_backend_is_a_contact_of_the_model():
    robot = make_robot("sensorized_finger")
    point, force = np.array([0.002, 0.0, -0.08]), np.array([0.0, 0.7, 0.0])
    backend = FEMBackend(robot)
    backend.touch(PointForce(point, force))
    touched = backend.step(np.array([0.004]))
    model = robot.build()
    model.add_contact("touch", point, radius=2.5e-3)
    expected = Statics(model).solve([0.004], contact=force)
    np.testing.assert_allclose(touched.effector[0], expected.condensed.delta.e, atol=1e-9)
    assert np.linalg.norm(touched.effector[0] - backend.probe(np.array([0.003])).effector[0]) > 1e-3
    backend.reset()
    free = backend.step(np.array([0.004]))
    np.testing.assert_allclose(free.effector[0], FEMBackend(robot).step(np.array([0.004])).effector[0], atol=1e-9)
    assert np.linalg.norm(free.effector[0] - touched.effector[0]) > 1e-3


def test_refusals():
    finger, sensorized = make_robot("finger"), make_robot("sensorized_finger")
    with pytest.raises(ValueError, match="needs a robot with sensors"):
        make_task("sensed_reach", finger)
    with pytest.raises(ValueError, match="force = -1"):
        make_task("sensed_reach", sensorized, force=-1.0)
    with pytest.raises(ValueError, match="window = 0"):
        make_task("sensed_reach", sensorized, window=0)
    with pytest.raises(ValueError, match="history = 0"):
        make_task("sensed_reach", sensorized, history=0)
    env = gymnasium.make(ID)
    with pytest.raises(ValueError, match="goal-conditioned"):
        GoalObservation(env)
    observation, _ = env.reset(seed=0)
    with pytest.raises(ValueError, match="measures the effector"):
        make_baseline("qp_pi")(observation, env.unwrapped)
    reach = gymnasium.make("SoftGym/FingerReach-v0")
    observation, _ = reach.reset(seed=0)
    with pytest.raises(ValueError, match="needs a task that shows sensors"):
        make_baseline("qp_estimated")(observation, reach.unwrapped)
    assert env.unwrapped.task.agents == ("qp_model", "qp_estimated", "random")
