"""TorchRL: a collector whose batches hold the environment's information too."""

import gymnasium
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper

import softgym_envs  # noqa: F401 - registers the environments

env = GymWrapper(gymnasium.make("SoftGym/FingerReach-v0")).auto_register_info_dict()
for batch in Collector(env, None, frames_per_batch=100, total_frames=200):
    print(batch["next", "reward"].mean(), batch["next", "distance"].min(), batch["next", "reward_effort"].mean())
