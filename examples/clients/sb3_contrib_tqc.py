"""sb3-contrib: TQC on a batch of environments."""

import gymnasium
from sb3_contrib import TQC

import softgym_envs  # noqa: F401 - registers the environments
from softgym_envs.agents import SB3VecEnv

envs = SB3VecEnv(gymnasium.make_vec("SoftGym/FingerReach-v0", num_envs=8))
model = TQC("MlpPolicy", envs, learning_starts=100, policy_kwargs={"net_arch": [32]}, device="cpu")
model.learn(400)
print(model.predict(envs.reset())[0].shape)
