"""Your own robots and tasks in environments: as objects, classes and paths, registered or not."""

import copy
import pickle
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import softgym_envs
from softgym_envs.envs import registration
from softgym_envs.envs.env import SoftRobotEnv
from softgym_envs.envs.random import RowRandom
from softgym_envs.envs.registration import register_environment
from softgym_envs.envs.tasks.reach import Reach
from softgym_envs.envs.tasks.registry import TASKS, register_task
from softgym_envs.envs.vector_env import SoftRobotVectorEnv
from softgym_envs.errors import ConvergenceError
from softgym_envs.robots.soft_finger import SoftFinger
from tests.helpers import Spike

ROBOT = "tests.helpers:Spike"


class Approach(Reach):
    """Reach whose reward has no bonus close to the goal."""

    name = "approach"
    max_episode_steps = 7

    def reward_terms(self, distance, effort_share):
        return {"distance": 1.0 / (1.0 + distance / self.robot.workspace_scale)}


def walk(env, steps=4):
    observation, _ = env.reset(seed=3)
    env.action_space.seed(3)
    rows = [observation] + [env.step(env.action_space.sample())[0] for _ in range(steps)]
    return np.stack(rows)


@pytest.mark.parametrize("robot", [Spike, ROBOT, "object"])
def test_your_own_robot(robot):
    robot = Spike() if robot == "object" else robot
    env = gymnasium.make("SoftGym/Reach-v0", robot=robot)
    assert type(env.unwrapped.robot) is Spike
    assert env.unwrapped.backend.__class__.__name__ == "FEMBackend"  # no weights ship for it
    assert env.spec.max_episode_steps == 50
    expected = walk(env)
    for twin in (pickle.loads(pickle.dumps(env)), copy.deepcopy(env)):
        assert (walk(twin) == expected).all()
    assert (walk(gymnasium.make(env.spec)) == expected).all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=True)


def test_a_specification_with_a_path_is_text():
    env = gymnasium.make("SoftGym/Reach-v0", robot=ROBOT)
    spec = gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json())
    assert (walk(gymnasium.make(spec)) == walk(env)).all()


def test_a_robot_object_is_used_as_it_is():
    robot = Spike()
    env = SoftRobotEnv(robot, Reach(robot, command_low=0.5))
    assert env.robot is robot and env.task.command_low == 0.5
    with pytest.raises(ValueError, match="task 'reach' was made for another robot"):
        SoftRobotEnv(Spike(), Reach(robot))
    with pytest.raises(ValueError, match=r"already an object: it cannot take gravity"):
        SoftRobotEnv(robot, robot_options={"gravity": (0.0, 0.0, 1.0)})
    with pytest.raises(ValueError, match=r"already an object: it cannot take spread"):
        SoftRobotEnv(robot, Reach(robot), task_options={"spread": 0.01})


def test_your_own_task_in_every_environment():
    from softgym_envs.extensions.gpu.environment import TorchVectorEnv

    single = gymnasium.make("SoftGym/FingerReach-v0", task=Approach)
    batch = gymnasium.make_vec("SoftGym/FingerReach-v0", num_envs=2, task=Approach)
    tensors = TorchVectorEnv("SoftGym/FingerReach-v0", 2, device="cpu", task=Approach)
    goal = [0.005, 0.05, -0.1]
    rewards = []
    for env, action in ((single, np.ones(2)), (batch, np.ones((2, 2))), (tensors, np.ones((2, 2)))):
        env.reset(seed=0, options={"goal": goal})
        _, reward, _, _, info = env.step(action)
        distance = np.ravel(info["distance"])[0]
        assert np.ravel(reward)[0] == pytest.approx(1.0 / (1.0 + distance / single.unwrapped.robot.workspace_scale))
        rewards.append(float(np.ravel(reward)[0]))
    assert rewards == pytest.approx([rewards[0]] * 3, abs=1e-4)


@pytest.mark.parametrize(
    ("drawn", "kind", "message"),
    [
        (np.zeros((1, 3)), ValueError, r"sample of task 'drawn'.* paths of shape \(1, 1, 3\), got \(1, 3\)"),
        (np.full((1, 5, 3), 0.05), ValueError, r"horizon = 1, must return paths of shape \(1, 1, 3\), got \(1, 5, 3\)"),
        (np.full((1, 1, 3), np.inf), ValueError, "sample of task 'drawn' returned a goal that is infinite"),
        (np.full((1, 1, 3), np.nan), ConvergenceError, "50 goals in a row of task 'drawn' are NaN, as kinematics is"),
    ],
)
def test_goals_that_a_task_draws_are_checked(drawn, kind, message):
    class Drawn(Reach):
        name = "drawn"

        def sample(self, rng, count, kinematics):
            return drawn

    single = gymnasium.make("SoftGym/FingerReach-v0", task=Drawn)
    batch = gymnasium.make_vec("SoftGym/FingerReach-v0", num_envs=1, task=Drawn)
    for env in (single, batch):
        with pytest.raises(kind, match=message):
            env.reset(seed=0)


class Redrawn(Reach):
    """Has goals in one half of the workspace only: those in the other are NaN."""

    name = "redrawn"

    def sample(self, rng, count, kinematics):
        goals = super().sample(rng, count, kinematics)
        return np.where(goals[:, :, 1:2] > 0.05, goals, np.nan)


def test_goals_that_are_nan_are_drawn_again_row_by_row():
    batch = gymnasium.make_vec("SoftGym/FingerReach-v0", num_envs=8, task=Redrawn)
    single = gymnasium.make("SoftGym/FingerReach-v0", task=Redrawn)
    plain = gymnasium.make_vec("SoftGym/FingerReach-v0", num_envs=8)
    goals, others = (env.reset(seed=0)[1]["goal"] for env in (batch, plain))
    assert 0 < (others[:, 1] <= 0.05).sum() < 8 and (goals[:, 1] > 0.05).all()
    for k in range(8):
        np.testing.assert_allclose(single.reset(seed=k)[1]["goal"], goals[k], atol=1e-7)


def test_random_numbers_of_a_task_have_an_axis_of_episodes():
    rng = RowRandom([np.random.default_rng(k) for k in (3, 4)])
    drawn = [rng.uniform([0.0, 1.0], [2.0, 4.0], (2, 2)), rng.integers(9, size=2), rng.normal((2, 3))]
    for k in range(2):
        alone = np.random.default_rng(3 + k)
        assert (drawn[0][k] == alone.uniform([0.0, 1.0], [2.0, 4.0])).all() and drawn[1][k] == alone.integers(9)
        assert (drawn[2][k] == alone.standard_normal(3)).all()
    with pytest.raises(ValueError, match=r"size = \(3, 2\) .* must begin with the number of episodes, 2"):
        rng.uniform(0.0, 1.0, (3, 2))
    with pytest.raises(AttributeError, match="have no 'choice'; allowed: uniform"):
        rng.choice(3)


def test_what_make_vec_makes():
    env = gymnasium.make_vec("SoftGym/Reach-v0", num_envs=2, robot=Spike, vectorization_mode="sync")
    assert env.reset(seed=0)[0].shape[0] == 2
    env.close()
    env = gymnasium.make_vec("SoftGym/Reach-v0", num_envs=2, robot=SoftFinger)  # weights ship for it
    assert isinstance(env, SoftRobotVectorEnv)


def test_own_identifiers(monkeypatch):
    monkeypatch.setattr(registration, "ENVIRONMENTS", dict(softgym_envs.ENVIRONMENTS))
    monkeypatch.setattr(gymnasium.envs.registration, "registry", dict(gymnasium.registry))
    monkeypatch.setattr(gymnasium, "registry", gymnasium.envs.registration.registry)
    register_environment("Lab/SpikeApproach-v0", robot=Spike, task=Approach, task_options={"spread": 1e-3})
    env = gymnasium.make("Lab/SpikeApproach-v0")
    assert env.spec.max_episode_steps == 7 and env.unwrapped.task.spread == 1e-3
    assert gymnasium.make("Lab/SpikeApproach-v0", task_options={"spread": 0.0}).unwrapped.task.spread == 0.0
    with pytest.raises(ValueError, match="'Lab/SpikeApproach-v0' is already registered"):
        register_environment("Lab/SpikeApproach-v0", robot=Spike, task=Approach)
    with pytest.raises(ValueError, match="unknown robot 'fingr'; did you mean 'finger'"):
        register_environment("Lab/Fingr-v0", robot="fingr", task="reach")
    with pytest.raises(ValueError, match="unknown task 'reech'; did you mean 'reach'"):
        register_environment("Lab/Reech-v0", robot="finger", task="reech", max_episode_steps=5)
    with pytest.raises(gymnasium.error.Error, match="Malformed environment ID"):
        register_environment("Lab/Finger Reach", robot="finger", task="reach")
    assert not {"Lab/Reech-v0", "Lab/Finger Reach"} & registration.ENVIRONMENTS.keys()


def test_own_tasks_have_names(monkeypatch):
    monkeypatch.setattr(TASKS, "_entries", dict(TASKS._entries))
    register_task(Approach)
    assert type(gymnasium.make("SoftGym/FingerReach-v0", task="approach").unwrapped.task) is Approach


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "robot is missing; allowed: a registered name, 'module:class', a class or an object"),
        ({"robot": "fingr"}, "unknown robot 'fingr'; did you mean 'finger'"),
        ({"robot": "nowhere:Arm"}, "there is no module 'nowhere'"),
        ({"robot": dict}, "a robot must be a subclass of"),
        ({"robot": "finger", "task": "reech"}, "unknown task 'reech'; did you mean 'reach'"),
        ({"robot": "finger", "desing": {}}, "unknown environment option 'desing'; did you mean 'design'"),
    ],
)
def test_wrong_parts(options, message):
    with pytest.raises(ValueError, match=message):
        gymnasium.make("SoftGym/Reach-v0", **options)


MILLIMETRES = [0.0, 66.0, -72.0]


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"goals": [MILLIMETRES]}, "goals"),
        ({"goals": [[0.0, 0.066, -0.072], MILLIMETRES]}, "goals"),
        ({"spread": 5.0}, "spread"),
        ({"path": [MILLIMETRES]}, "path"),
        ({"jitter": 5.0}, "jitter"),
    ],
)
def test_goals_in_millimetres_are_refused(options, name):
    task = "track" if name in ("path", "jitter") else "reach"
    with pytest.raises(ValueError, match=rf"^{name} = .*did you mean metres\?$"):
        gymnasium.make("SoftGym/FingerReach-v0", task=task, task_options=options)


def test_goals_in_millimetres_are_refused_at_reset():
    from softgym_envs.extensions.gpu.environment import TorchVectorEnv

    id = "SoftGym/FingerReach-v0"
    for env in (gymnasium.make(id), gymnasium.make_vec(id, num_envs=2), TorchVectorEnv(id, 2, device="cpu")):
        with pytest.raises(ValueError, match=r"^goal = \[0\.0, 66\.0, -72\.0\] m .*did you mean metres\?$"):
            env.reset(options={"goal": MILLIMETRES})
        env.reset(options={"goal": np.array(MILLIMETRES) / 1e3})
