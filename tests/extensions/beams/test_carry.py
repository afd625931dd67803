"""Carry: its distance, its pushes and refused options."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import softgym_envs  # noqa: F401  (registers the environments)
from softgym_envs import make_robot
from softgym_envs.envs.tasks.registry import make_task


@pytest.fixture(scope="module")
def robot():
    return make_robot("tetrapod")


def no_kinematics(commands):
    raise AssertionError("the goal must not depend on where commands lead")


def test_only_the_distance_to_the_right_counts(robot):
    task = make_task("carry", robot, distance=0.1)
    goal = task.sample(np.random.default_rng(0), 2, no_kinematics)
    assert goal.shape == (2, 1, 3)
    np.testing.assert_allclose(goal[:, 0], robot.effector_rest + [[0.1, 0.0, 0.0]] * 2)
    effectors = robot.effector_rest + np.array([[0.0, 0.0, 0.0], [0.06, 0.05, -0.1], [0.1, 0, 0], [0.3, 0.2, 0.0]])
    np.testing.assert_allclose(task.distance(effectors, goal[0, 0]), [0.1, 0.04, 0.0, 0.0], atol=1e-15)
    np.testing.assert_array_equal(task.axes, [1.0, 0.0, 0.0])


def test_the_reward_grows_to_the_right_also_beyond_the_goal(robot):
    task = make_task("carry", robot, distance=0.1)
    goal = task.sample(np.random.default_rng(0), 1, no_kinematics)[:, 0]
    effectors = robot.effector_rest + np.linspace(-0.1, 0.3, 41)[:, None] * [1.0, 0.0, 0.0]
    distance, terms, reward = task.rate(effectors, goal, np.full(41, 0.5))
    assert (np.diff(reward) > 0.0).all()
    assert terms["distance"][20] == pytest.approx(0.5)  # at the goal
    np.testing.assert_allclose(reward, terms["distance"] * 0.975)
    assert (terms["distance"] > 0.0).all() and (terms["distance"] < 1.0).all()
    np.testing.assert_allclose(distance, np.linspace(0.2, -0.2, 41).clip(min=0.0), atol=1e-15)


def test_pushes(robot):
    """Each episode draws its own push, within the window and the largest force."""
    task = make_task("carry", robot, push=0.5, push_steps=3, push_window=10)
    rng = np.random.default_rng(0)
    firsts, forces = set(), []
    for _ in range(200):
        task.load.begin(rng)
        steps = [k for k in range(20) if task.load.at(k) is not None]
        assert steps == list(range(steps[0], steps[0] + 3))
        firsts.add(steps[0])
        forces.append(task.load.at(steps[0]))
        assert (task.load.at(steps[2]) == forces[-1]).all()
    assert firsts == set(range(10))
    sizes = np.linalg.norm(forces, axis=1)
    assert sizes.max() <= 0.5 and sizes.max() > 0.45 and sizes.min() < 0.05
    assert (np.abs(np.mean(forces, axis=0)) < 0.06).all()  # in all directions


def test_no_push_by_default(robot):
    task = make_task("carry", robot)
    assert task.load is None


def test_pushes_move_the_robot_and_depend_on_the_seed():
    def run(seed, **task_options):
        env = gymnasium.make("SoftGym/TetrapodCarry-v0", task_options=task_options)
        env.reset(seed=seed)
        path = [env.step(np.zeros(4, dtype=np.float32))[4]["effector"] for _ in range(12)]
        env.close()
        return np.array(path)

    still = run(3)
    np.testing.assert_allclose(still, still[:1].repeat(12, axis=0), atol=1e-6)
    pushed = run(3, push=0.5, push_window=4)
    assert np.abs(pushed - still).max() > 1e-4
    assert (run(3, push=0.5, push_window=4) == pushed).all()
    assert (run(4, push=0.5, push_window=4) != pushed).any()


def test_an_episode_succeeds_beyond_the_goal():
    env = gymnasium.make("SoftGym/TetrapodCarry-v0", task_options={"distance": 0.02})
    env.reset(seed=0)
    right = np.array([1.0, 1.0, -1.0, 1.0], dtype=np.float32)
    rewards, places = [], []
    for _ in range(10):
        _, reward, _, _, info = env.step(right)
        rewards.append(reward)
        places.append(info["effector"][0])
    assert places[-1] > 0.02 and info["distance"] == 0.0 and info["is_success"]
    assert reward > 0.5
    beyond = np.array(places) > 0.02
    assert beyond.sum() > 1 and (np.diff(np.array(rewards)[beyond]) * np.diff(np.array(places)[beyond]) > 0.0).all()
    env.close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"distance": -0.1}, "distance = -0.1 m must be non-negative and finite"),
        ({"distance": np.nan}, "distance = nan m must be non-negative and finite"),
        ({"push": -1.0}, "push = -1.0 N must be non-negative and finite"),
        ({"push": np.inf}, "push = inf N must be non-negative and finite"),
        ({"push_steps": 0}, "push_steps = 0 and push_window = 40 must be at least 1"),
        ({"push_window": 0}, "push_steps = 4 and push_window = 0 must be at least 1"),
        ({"mass": 1.0}, "mass"),
    ],
)
def test_bad_options(robot, options, message):
    with pytest.raises(ValueError, match=message):
        make_task("carry", robot, **options)
