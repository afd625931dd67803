"""What model-based learners have in common: a network that is trained on the batched environment by its own loop."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

from softgym_envs.agents.config import GradientConfig, TrainConfig
from softgym_envs.agents.learners.base import Learner, Tensors, check_weights
from softgym_envs.envs.vector_env import SoftRobotVectorEnv

if TYPE_CHECKING:
    import torch

#: Largest norm of the gradient of the policy's weights.
LARGEST_GRADIENT = 1.0


class GradientLearner(Learner):
    """A network that learns, without critic and exploration noise, in the batched environment.

    The learning rate falls linearly with the steps to that given as final; without that, success oscillates.

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

    needs_batch: ClassVar[bool] = True
    env: VectorEnv

    def __init__(self, config: TrainConfig, options: GradientConfig) -> None:
        import torch

        environment = config.environment
        if (self.needs_batch and not environment.batched) or environment.residual_scale:
            raise ValueError(
                f"learner '{config.learner}' needs environment.backend = surrogate, or fem for robots of beams, and no "
                f"residual_scale, got {environment.backend} and {environment.residual_scale:g}; allowed: learner 'sac' "
                "or 'ppo'"
            )
        super().__init__(config)
        self._options, self.step = options, 0
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
        self._parameters = {f"{name}.{kind}": getattr(m, kind) for name, m in modules for kind in ("weight", "bias")}
        self._optimiser = torch.optim.Adam(self._network.parameters(), lr=options.learning_rate, fused=True)

    def learn(self, target: int, progress: Callable[[int], object]) -> None:
        env, config, options = self.env, self.config, self._options
        rng = np.random.default_rng([config.seed, self.step])
        observation, _ = env.reset(seed=int(rng.integers(2**31)))
        # Episodes end at different times, so that a batch holds states of all ages.
        if isinstance(env, SoftRobotVectorEnv):
            env.steps = rng.integers(0, env.max_episode_steps, env.num_envs)
        while self.step < target:
            share = min(self.step / config.steps, 1.0)
            for group in self._optimiser.param_groups:
                group["lr"] = options.learning_rate + share * (options.final_learning_rate - options.learning_rate)
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

    def descend(self, loss: torch.Tensor) -> None:
        """Change the weights by one step that reduces a loss."""
        import torch

        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self._network.parameters(), LARGEST_GRADIENT)
        self._optimiser.step()

    def weights(self) -> Tensors:
        return {name: value.detach().numpy().copy() for name, value in self._parameters.items()}

    def load_weights(self, tensors: Mapping[str, np.ndarray], path: Path) -> None:
        import torch

        check_weights({name: value.shape for name, value in self._parameters.items()}, tensors, path)
        with torch.no_grad():
            for name, value in self._parameters.items():
                value.copy_(torch.as_tensor(tensors[name]))

    def state(self) -> tuple[Tensors, dict[str, Any]]:
        stored = self._optimiser.state_dict()["state"]
        tensors = {
            f"optimiser/{key}/{part}": value.numpy().copy()
            for key, moments in stored.items()
            for part, value in moments.items()
        }
        return tensors, {"step": self.step}

    def restore(self, tensors: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
        import torch

        moments: dict[int, dict[str, Any]] = {}
        for name, value in tensors.items():
            if name.startswith("optimiser/"):
                _, key, part = name.split("/")
                moments.setdefault(int(key), {})[part] = torch.as_tensor(value)
        self._optimiser.load_state_dict({**self._optimiser.state_dict(), "state": moments})
        self.step = int(meta["step"])

    def close(self) -> None:
        self.env.close()
