"""skrl: PPO on a batch of environments."""

import gymnasium
import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.trainers.torch import SequentialTrainer

import softgym_envs  # noqa: F401 - registers the environments

env = wrap_env(gymnasium.make_vec("SoftGym/FingerReach-v0", num_envs=16), wrapper="gymnasium")
shape = {"observation_space": env.observation_space, "action_space": env.action_space, "device": env.device}


class Actor(GaussianMixin, Model):
    """Mean and standard deviation of the actions."""

    def __init__(self):
        Model.__init__(self, **shape)
        GaussianMixin.__init__(self)
        self.net = torch.nn.Sequential(
            torch.nn.Linear(self.num_observations, 32), torch.nn.Tanh(), torch.nn.Linear(32, self.num_actions)
        )
        self.log_std = torch.nn.Parameter(torch.zeros(self.num_actions))

    def compute(self, inputs, role=""):
        """Return the mean and the logarithm of the standard deviation."""
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Critic(DeterministicMixin, Model):
    """Value of a state."""

    def __init__(self):
        Model.__init__(self, **shape)
        DeterministicMixin.__init__(self)
        self.net = torch.nn.Sequential(
            torch.nn.Linear(self.num_observations, 32), torch.nn.Tanh(), torch.nn.Linear(32, 1)
        )

    def compute(self, inputs, role=""):
        """Return the value."""
        return self.net(inputs["observations"]), {}


agent = PPO(
    models={"policy": Actor(), "value": Critic()},
    memory=RandomMemory(memory_size=50, num_envs=env.num_envs, device=env.device),
    cfg=PPO_CFG(rollouts=50, learning_epochs=2, mini_batches=4),
    observation_space=env.observation_space,
    action_space=env.action_space,
    device=env.device,
)
SequentialTrainer(cfg={"timesteps": 100, "headless": True}, env=env, agents=agent).train()
