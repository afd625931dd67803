"""What model-based learners have in common: a network that is trained on the batched environment by its own loop."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

from softgym_envs.agents.config import TrainConfig
from softgym_envs.envs.vector_env import SoftRobotVectorEnv
from softgym_envs.extensions.learners.network import GradientConfig, NetworkLearner

if TYPE_CHECKING:
    import torch


class GradientLearner(NetworkLearner):
    """A network that learns, without critic and exploration noise, in the batched environment.

    Args:
        config: configuration of the training.
        options: learning rates, widths and members.

    Attributes:
        needs_batch: whether the method needs the batched environment; else it takes others too, which this process
            steps one after the other.
        env: the environments.

    Raises:
        ValueError: for an environment that is not batched if the method needs it, or a correction of the QP.
    """

    model_based = True

    needs_batch: ClassVar[bool] = True
    env: VectorEnv

    def __init__(self, config: TrainConfig, options: GradientConfig) -> None:
        import torch

        environment = config.environment
        if (self.needs_batch and not environment.batched) or environment.residual_scale:
            raise ValueError(
                f"learner '{config.learner}' needs environment.backend = surrogate, or fem for robots of beams, and no "
                f"residual_scale, got backend {environment.backend} and residual_scale {environment.residual_scale:g}; "
                "allowed here: a model-free learner, such as 'sac' or 'ppo'"
            )
        super().__init__(config)
        if environment.batched:
            members = {"members": options.members} if options.members and environment.backend == "surrogate" else {}
            env = environment.make_vec(config.num_envs, backend_options={**environment.backend_options, **members})
        else:
            env = SyncVectorEnv([environment.make] * config.num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
        self.env = env.unwrapped
        generator = torch.Generator().manual_seed(config.seed)
        sizes = [self.env.single_observation_space.shape[0], *options.net_arch]  # type: ignore[index]
        actions = self.env.single_action_space.shape[0]  # type: ignore[index]
        layers = [torch.nn.Linear(a, b) for a, b in zip(sizes, sizes[1:], strict=False)]
        for layer in layers:
            torch.nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)
            torch.nn.init.zeros_(layer.bias)
        mean = torch.nn.Linear(sizes[-1], actions)
        torch.nn.init.zeros_(mean.weight)  # the untrained policy keeps still
        torch.nn.init.zeros_(mean.bias)
        self._network = torch.nn.Sequential(*(part for layer in layers for part in (layer, torch.nn.ReLU())), mean)
        names = [f"actor.latent_pi.{2 * k}" for k in range(len(layers))] + ["actor.mu"]
        modules = zip(names, [*layers, mean], strict=True)
        parameters = {f"{name}.{kind}": getattr(m, kind) for name, m in modules for kind in ("weight", "bias")}
        self._begin(parameters, options)

    def learn(self, target: int, progress: Callable[[int], object]) -> None:
        env, config = self.env, self.config
        rng = np.random.default_rng([config.seed, self.step])
        observation, _ = env.reset(seed=int(rng.integers(2**31)))
        # Episodes end at different times, so that a batch holds states of all ages.
        if isinstance(env, SoftRobotVectorEnv):
            env.steps = rng.integers(0, env.max_episode_steps, env.num_envs)
        while self.step < target:
            self._set_learning_rate()
            observation = self.advance(observation, rng)
            self.step += env.num_envs
            progress(env.num_envs)

    @abstractmethod
    def advance(self, observation: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Make one step of all environments and improve the policy.

        Args:
            observation: the present observations, shape (num_envs, d).
            rng: random numbers of this part of the training.

        Returns:
            The next observations.
        """

    def policy(self, observation: np.ndarray) -> torch.Tensor:
        """Return actions (B, n_a) for observations (B, d), with their derivatives in the weights."""
        import torch

        return torch.tanh(self._network(torch.from_numpy(observation)))

    def close(self) -> None:
        self.env.close()
