"""The task Follow: headings that are drawn, what the robot sees of them, and that only a robot that turns wins."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from pydantic import ValidationError

import softgym_envs  # noqa: F401 - registers the IDs
from softgym_envs import make_robot
from softgym_envs.agents.baselines import BASELINES, make_baseline
from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.agents.policy import Policy
from softgym_envs.envs.tasks.registry import make_task
from softgym_envs.errors import WeightsError

ID = "SoftGym/QuadrupedFollow-v0"
LEFT, RIGHT, BACK = [0.0, 0.04, 0.0], [0.0, -0.04, 0.0], [-0.04, 0.0, 0.0]
BEARING = slice(8 + 4, 8 + 6)
"""Of observations: after the commands, the height and the vertical."""


def episode(act, *, steps, seed=0, goal=None, **options):
    """Rewards, places of the trunk and infos of an episode."""
    env = gymnasium.make(ID, **options)
    observation, info = env.reset(seed=seed, options={"goal": goal})
    rewards, places, infos = [], [info["effector"]], [info]
    for _ in range(steps):
        observation, reward, *_, info = env.step(act(observation, env.unwrapped))
        assert env.observation_space.contains(observation)
        rewards.append(reward)
        places.append(info["effector"])
        infos.append(info)
    return np.array(rewards), np.array(places), infos


@pytest.fixture(scope="module")
def steered():
    return episode(make_baseline("steer"), steps=200, goal=[LEFT, BACK])


def test_each_episode_draws_its_headings():
    env = gymnasium.make(ID).unwrapped
    angles = []
    for seed in range(20):
        env.reset(seed=seed)
        assert env.path.shape == (2, 3) and np.linalg.norm(env.path, axis=1) == pytest.approx(0.04)
        first, second = np.arctan2(env.path[:, 1], env.path[:, 0])
        angles += [first, (second - first + np.pi) % (2.0 * np.pi) - np.pi]
    assert np.abs(angles).max() <= 0.5 * np.pi
    assert np.ptp(angles) > 2.0


def test_the_robot_sees_its_heading_from_its_own_frame(steered):
    env = gymnasium.make(ID).unwrapped
    observation, _ = env.reset(seed=0, options={"goal": [LEFT, BACK]})
    assert observation[BEARING] == pytest.approx([0.0, 0.5], abs=1e-6)  # ahead 0 and left 1, over 1 + abs
    act = make_baseline("steer")
    for _ in range(98):
        observation = env.step(act(observation, env))[0]
    assert observation[BEARING] == pytest.approx([0.5, 0.0], abs=0.05)
    observation = env.step(act(observation, env))[0]  # shown one step before it is rated
    assert observation[BEARING] == pytest.approx([0.0, 0.5], abs=0.05)
    assert env.goal == pytest.approx(LEFT) and env.observed_goal == pytest.approx(BACK)


def test_a_steered_gait_follows_and_the_same_gait_without_does_not(steered):
    rewards, places, infos = steered
    for k, along in ((99, [0.0, 1.0, 0.0]), (200, [-1.0, 0.0, 0.0])):
        # Means over the second half of the time since the heading was given, 2.5 s.
        mean = (places[k] - places[k - 50]) / 2.5
        assert infos[k]["speed"] == pytest.approx(mean @ along, abs=2e-3)
        assert infos[k]["speed"] > 0.025 and infos[k]["drift"] < 0.005
    straight, _, other = episode(make_baseline("gait"), steps=60, goal=[LEFT, BACK])
    assert abs(other[-1]["speed"]) < 0.005 and other[-1]["drift"] > 0.02
    assert straight.sum() < 0.3 * rewards[:60].sum()
    assert (
        np.abs(rewards - [sum(v for n, v in i.items() if n.startswith("reward_")) for i in infos[1:]]) < 1e-12
    ).all()


def test_a_trained_gait_can_be_steered_too():
    env, walk = gymnasium.make(ID).unwrapped, make_baseline("steer@quadruped_walk_gait")
    observation, _ = env.reset(seed=0, options={"goal": [0.04, 0.0, 0.0]})
    gait = Policy("quadruped_walk_gait").begin()  # reads the commands alone, which come first in both tasks
    assert walk(observation, env) == pytest.approx(gait(observation), abs=1e-3)  # straight ahead
    rewards, _, _ = episode(walk, steps=80, goal=LEFT)
    straight, _, _ = episode(make_baseline("steer"), steps=80, goal=LEFT)
    assert rewards.sum() > 1.2 * straight.sum()


def test_agents_with_the_gait_of_a_policy_need_one():
    assert "steer@quadruped_walk_gait" in BASELINES and "steer@" not in BASELINES and "octopus@x" not in BASELINES
    with pytest.raises(ValueError, match="agent 'qp' takes no policy, got 'x'; allowed: qp"):
        make_baseline("qp@x")
    with pytest.raises(WeightsError, match="policy 'tetrapod_carry' has no gait"):
        make_baseline("steer@tetrapod_carry")
    env = gymnasium.make("SoftGym/FingerReach-v0").unwrapped
    with pytest.raises(WeightsError, match="'quadruped_walk_gait' drives 8 actuators; 'finger' has 2"):
        make_baseline("gait@quadruped_walk_gait")(env.reset(seed=0)[0], env)
    with pytest.raises(WeightsError, match="unknown policy 'nothing'"):
        make_baseline("steer@nothing")


def test_a_residual_corrects_the_agent_it_is_told():
    given = {"id": ID, "residual_scale": 0.5, "residual_on": "steer@quadruped_walk_gait"}
    env = EnvironmentConfig(**given).make()
    observation, _ = env.reset(seed=0)
    expected = np.clip(make_baseline(given["residual_on"])(observation, env.unwrapped) + 0.25, -1.0, 1.0)
    assert env.action(np.full(8, 0.5)) == pytest.approx(expected)
    with pytest.raises(ValidationError, match="needs residual_scale > 0"):
        EnvironmentConfig(id=ID, residual_on="gait")
    with pytest.raises(ValidationError, match="not batched"):
        EnvironmentConfig(id="SoftGym/FingerReach-v0", residual_scale=0.5, residual_on="qp")


def test_rewards_never_exceed_the_way_along_the_headings(steered):
    rewards, places, _ = steered
    ways = np.diff(places, axis=0) / 0.1
    along = np.where(np.arange(1, 201)[:, None] < 100, [[0.0, 1.0, 0.0]], [[-1.0, 0.0, 0.0]])
    assert (0.05 * rewards <= (ways * along).sum(axis=1) + 1e-12).all()


def test_turning_on_the_spot_wins_nothing():
    gait = make_robot("quadruped").steered_gait(1.0)
    rewards, places, infos = episode(
        lambda o, env: env.spaces.action(gait[(env.steps + 1) % 10], env.command), steps=100, goal=LEFT
    )
    assert np.linalg.norm(places[-1] - places[0]) < 0.02
    assert 0.05 * rewards.sum() < 0.15 and not infos[-1]["is_success"]


def test_a_moment_of_the_second_heading_can_be_restored():
    env = gymnasium.make(ID, max_episode_steps=200).unwrapped
    observation, _ = env.reset(seed=3)
    act = make_baseline("steer")
    for _ in range(103):
        observation = env.step(act(observation, env))[0]
    moment = env.get_state()
    following = [env.step(act(None, env)) for _ in range(4)]
    env.reset(seed=4)
    env.set_state(moment)
    for one in following:
        two = env.step(act(None, env))
        assert (one[0] == two[0]).all() and one[1] == two[1] and one[4]["speed"] == two[4]["speed"]


@pytest.mark.parametrize("goal", [[0.0, 0.0, 0.0], [0.04, 0.0, 0.01], [np.inf, 0.0, 0.0], [[0.04, 0.0]], []])
def test_wrong_goals(goal):
    env = gymnasium.make(ID)
    with pytest.raises(ValueError, match=r"goal must be velocities \(vx, vy, 0\)"):
        env.reset(options={"goal": goal})


def test_wrong_options():
    for turn in (-0.1, 4.0, np.nan):
        with pytest.raises(ValueError, match="turn = .* rad is out of bounds; allowed: 0 to pi"):
            make_task("follow", make_robot("quadruped"), turn=turn)
    with pytest.raises(ValueError, match="'swimmer' does not"):
        make_task("follow", make_robot("swimmer"))
    with pytest.raises(ValueError, match="robot 'swimmer' has no gait that turns"):
        make_robot("swimmer").steered_gait(0.5)
