"""Proximal policy optimisation of stable-baselines3 (model-free), on many environments at once."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import Field, field_validator
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from torch.optim import Optimizer

from softgym_envs.agents.config import TrainConfig
from softgym_envs.agents.learners.base import Tensors, check_layers, check_weights
from softgym_envs.agents.learners.sb3 import SB3Learner
from softgym_envs.agents.vec_env import SB3VecEnv
from softgym_envs.config import Config
from softgym_envs.envs.vector_env import SoftRobotVectorEnv

#: Parts of the model of stable-baselines3, and their names in a policy file.
_NAMES = {
    "mlp_extractor.policy_net.": "actor.latent_pi.",
    "action_net.0.": "actor.mu.",
    "mlp_extractor.value_net.": "critic.latent_vf.",
    "value_net.": "critic.value.",
    "log_std": "actor.log_std",
}


class TanhPolicy(ActorCriticPolicy):
    """Actor and critic; the mean action is the hyperbolic tangent of the actor's output, as with the other learners."""

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        self.action_net = torch.nn.Sequential(self.action_net, torch.nn.Tanh())


class PPOConfig(Config):
    """Hyperparameters of proximal policy optimisation, named as in stable-baselines3."""

    learning_rate: float = Field(default=1e-3, gt=0)
    final_learning_rate: float = Field(default=1e-4, gt=0, description="reached linearly at the last step")
    n_steps: int = Field(default=25, gt=0, description="of each environment between updates")
    batch_size: int = Field(default=400, gt=1, description="at most all steps between updates")
    n_epochs: int = Field(default=6, gt=0)
    gamma: float = Field(default=0.9, gt=0, le=1)
    gae_lambda: float = Field(default=0.9, gt=0, le=1)
    clip_range: float = Field(default=0.2, gt=0)
    ent_coef: float = Field(default=0.0, ge=0)
    log_std_init: float = -0.5
    net_arch: list[int] = [64, 64]

    @field_validator("net_arch")
    @classmethod
    def _layers(cls, value: list[int]) -> list[int]:
        return check_layers(value)


class PPOLearner(SB3Learner):
    """Proximal policy optimisation on batched environments.

    Attributes:
        model: that of stable-baselines3.
    """

    Config = PPOConfig
    title = "PPO"

    @classmethod
    def update_seconds(cls, config: TrainConfig) -> float:
        return 3e-5 * config.num_envs

    model: PPO

    def __init__(self, config: TrainConfig) -> None:
        super().__init__(config)
        ppo = config.settings
        self.model = PPO(
            TanhPolicy,
            SB3VecEnv(config.environment.make_vec(config.num_envs)),
            learning_rate=ppo.learning_rate,
            n_steps=ppo.n_steps,
            batch_size=min(ppo.batch_size, ppo.n_steps * config.num_envs),
            n_epochs=ppo.n_epochs,
            gamma=ppo.gamma,
            gae_lambda=ppo.gae_lambda,
            clip_range=ppo.clip_range,
            ent_coef=ppo.ent_coef,
            policy_kwargs={
                "net_arch": list(ppo.net_arch),
                "activation_fn": torch.nn.ReLU,
                "log_std_init": ppo.log_std_init,
                "optimizer_kwargs": {"eps": 1e-5, "fused": True},  # eps: default of stable-baselines3
            },
            seed=config.seed,
            device="cpu",
        )
        self.schedule_learning_rate(ppo.learning_rate, ppo.final_learning_rate)

    def begin(self) -> None:
        """Start episodes that end at different times, so that a batch holds states of all ages."""
        model, env = self.model, self.model.get_env()
        assert isinstance(env, SB3VecEnv)
        model._last_obs = env.reset()
        model._last_episode_starts = np.ones(env.num_envs, dtype=bool)
        batch = env.env.unwrapped
        if isinstance(batch, SoftRobotVectorEnv):
            rng = np.random.default_rng([self.config.seed, self.step])
            batch.steps = rng.integers(0, batch.max_episode_steps, env.num_envs)

    def optimisers(self) -> dict[str, Optimizer]:
        """Return the only one."""
        return {"policy": self.model.policy.optimizer}

    def weights(self) -> Tensors:
        return {
            new + name.removeprefix(old): value.detach().numpy().copy()
            for name, value in self.model.policy.state_dict().items()
            for old, new in _NAMES.items()
            if name.startswith(old)
        }

    def load_weights(self, tensors: Mapping[str, np.ndarray], path: Path) -> None:
        own = self.weights()
        check_weights({name: value.shape for name, value in own.items()}, tensors, path)
        model = self.model.policy
        names = {new: old for old, new in _NAMES.items()}
        state = {
            names[new] + name.removeprefix(new): torch.as_tensor(tensors[name])
            for name in own
            for new in names
            if name.startswith(new)
        }
        model.load_state_dict(state)
