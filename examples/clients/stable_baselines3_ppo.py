"""stable-baselines3: PPO on 64 environments that step together."""

import gymnasium
from stable_baselines3 import PPO

import softgym_envs  # noqa: F401 - registers the environments
from softgym_envs.agents import SB3VecEnv

envs = SB3VecEnv(gymnasium.make_vec("SoftGym/FingerReach-v0", num_envs=64))
model = PPO("MlpPolicy", envs, n_steps=50, batch_size=800, n_epochs=2, device="cpu")
model.learn(6400)
print(model.predict(envs.reset())[0].shape)
