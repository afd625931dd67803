"""Tianshou: a collector on Tianshou's own vector environment."""

import gymnasium
from tianshou.algorithm.algorithm_base import RandomActionPolicy
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.env import DummyVectorEnv

import softgym_envs  # noqa: F401 - registers the environments

envs = DummyVectorEnv([lambda: gymnasium.make("SoftGym/FingerReach-v0") for _ in range(4)])
policy = RandomActionPolicy(action_space=envs.action_space[0])
collector = Collector(policy, envs, VectorReplayBuffer(1000, 4))
collector.reset()
print(collector.collect(n_step=400).returns)
