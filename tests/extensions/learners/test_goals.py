"""The goal-conditioned interface, with stable-baselines3's hindsight replay."""

import gymnasium
import numpy as np
import pytest
from stable_baselines3.common.env_checker import check_env

from softgym_envs.extensions.learners import GoalObservation


@pytest.mark.parametrize("effort", [False, True])
def test_relabelled_rewards_are_those_of_the_environment(effort):
    plain = gymnasium.make("SoftGym/FingerReach-v0", design_in_observation=True)
    env = GoalObservation(gymnasium.make("SoftGym/FingerReach-v0", design_in_observation=True), effort=effort)
    first, _ = env.reset(seed=0)
    assert env.observation_space.contains(first) and first["observation"].shape == (
        plain.observation_space.shape[0] - 6,
    )
    other = env.reset(seed=1)[0]["desired_goal"]
    env.reset(seed=0)
    goal = other.astype(float) * env.unwrapped.spaces.position_scale
    plain.reset(seed=0, options={"goal": goal})
    achieved, infos, rewards, expected = [], [], [], []
    for action in np.random.default_rng(0).uniform(-0.2, 1.0, (20, 2)).astype(np.float32):
        observation, reward, _, _, info = env.step(action)
        assert env.compute_reward(observation["achieved_goal"], observation["desired_goal"], info) == reward
        achieved.append(observation["achieved_goal"])
        infos.append(info)
        rewards.append(reward)
        _, want, _, _, relabelled = plain.step(action)
        expected.append(want if effort else relabelled["reward_distance"])
    batch = env.compute_reward(np.array(achieved), np.tile(other, (20, 1)), infos if effort else [{}] * 20)
    np.testing.assert_allclose(batch, expected, rtol=1e-4)
    assert np.abs(batch - rewards).max() > 1e-3


def test_stable_baselines_checks_it():
    check_env(GoalObservation(gymnasium.make("SoftGym/FingerReach-v0")), warn=True)


def test_hindsight_replay_of_stable_baselines():
    from stable_baselines3 import SAC, HerReplayBuffer

    env = GoalObservation(gymnasium.make("SoftGym/FingerReach-v0", max_episode_steps=10))
    model = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4},
        policy_kwargs={"net_arch": [8]},
        learning_starts=20,
        batch_size=16,
        seed=0,
        device="cpu",
    )
    model.learn(30)
    batch = model.replay_buffer.sample(200)
    parts = {name: value.numpy() for name, value in batch.next_observations.items()}
    expected = env.compute_reward(parts["achieved_goal"], parts["desired_goal"], [{}] * 200)
    np.testing.assert_allclose(batch.rewards[:, 0], expected, rtol=1e-5)
    reached = (parts["achieved_goal"] == parts["desired_goal"]).all(axis=1)
    assert 0 < reached.sum() < 200  # goals that the same transition reached are among the new ones


@pytest.mark.parametrize("task", ["Track", "Grasp"])
def test_other_tasks_are_refused(task):
    with pytest.raises(ValueError, match=f"task '{task.lower()}' has no goal-conditioned interface"):
        GoalObservation(gymnasium.make(f"SoftGym/Finger{task}-v0", backend="surrogate"))
