"""SBX: SAC in JAX on a batch of environments."""

import gymnasium
from sbx import SAC

import softgym_envs  # noqa: F401 - registers the environments
from softgym_envs.agents import SB3VecEnv

envs = SB3VecEnv(gymnasium.make_vec("SoftGym/FingerReach-v0", num_envs=8))
model = SAC("MlpPolicy", envs, learning_starts=100)
model.learn(400)
print(model.predict(envs.reset())[0].shape)
