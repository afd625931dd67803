"""Make an environment with a body of your choice, and step it."""

import gymnasium

import softgym_envs  # noqa: F401 - registers the environments

env = gymnasium.make("SoftGym/FingerReach-v0", design={"length": 0.041}, sample_design=["joint_height"])
env.action_space.seed(0)
observation, info = env.reset(seed=0)
truncated = False
while not truncated:
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
print(f"hinges of {1e3 * env.unwrapped.design['joint_height']:.2f} mm, {1e3 * info['distance']:.1f} mm from the goal")
