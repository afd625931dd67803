"""A training that begins with random postures."""

import numpy as np

from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.agents.vec_env import SB3VecEnv
from softgym_envs.agents.warm_up import PostureSAC


def test_each_episode_goes_straight_to_one_posture_and_stays():
    environment = EnvironmentConfig(id="SoftGym/FingerReach-v0", max_episode_steps=30)
    envs = environment.make_vec(2)
    model = PostureSAC(
        "MlpPolicy", SB3VecEnv(envs), spaces=envs.spaces, learning_starts=200, buffer_size=200, seed=0, device="cpu"
    )
    model.learn(120)  # two episodes of each environment
    buffer, spaces = model.replay_buffer, envs.spaces
    commands = spaces.middle + spaces.half_range * buffer.next_observations[:60, :, spaces.slices["command"]]
    ends = commands.reshape(2, 30, 2, -1)[:, -1]
    assert len(np.unique(ends.round(6).reshape(4, -1), axis=0)) == 4  # every episode has its own posture
    for episode in commands.reshape(2, 30, 2, -1):
        left = np.abs(episode[-1] - episode)
        assert (np.diff(left, axis=0) <= 1e-6).all()  # straight there
        rests = left < 1e-6
        assert rests[-1].all() and (np.abs(np.diff(episode, axis=0)) <= spaces.rates + 1e-6).all()
    assert (np.abs(buffer.actions[:60]) <= 1.0).all()
