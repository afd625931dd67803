"""RLlib: PPO; the environment is registered where it is made."""

import gymnasium
import ray
from ray.rllib.algorithms.ppo import PPOConfig
from ray.tune.registry import register_env


def make(config):
    """Return the environment, in whichever process runs it."""
    import softgym_envs  # noqa: F401 - registers the environments

    return gymnasium.make("SoftGym/FingerReach-v0", **config)


register_env("finger_reach", make)
config = (
    PPOConfig()
    .environment("finger_reach", env_config={"sample_design": True, "design_in_observation": True})
    .env_runners(num_env_runners=0, num_envs_per_env_runner=2)
    .training(train_batch_size_per_learner=200, minibatch_size=100, num_epochs=1)
)
algorithm = config.build_algo()
print(algorithm.train()["env_runners"]["num_env_steps_sampled"])
algorithm.stop()
ray.shutdown()
