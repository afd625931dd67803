"""Analytic policy gradient (model-based): the policy follows the derivative of each step's own reward.

The policy acts in the batched environment on the surrogate. After each step the environment returns the exact
derivative of the reward in the action (`SoftRobotVectorEnv.step_with_gradient`), and the policy ascends the mean
logarithm of the reward. There is no critic, no exploration noise and no differentiation through time: a quasi-static
robot reaches a goal by improving every step.

The logarithm turns a product of reward terms into a sum, and it keeps a slope near the goal and far from it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from agents.config import TrainConfig
from agents.learners.base import Learner, Tensors, check_weights
from softgym_envs.envs.gradients import StepGradient
from softgym_envs.envs.vector_env import SoftRobotVectorEnv

#: Smallest reward whose logarithm is followed; below, gradients would be without bound.
SMALLEST_REWARD = 1e-6
#: Largest norm of the gradient of the policy's weights.
LARGEST_GRADIENT = 1.0


class AnalyticLearner(Learner):
    """Analytic policy gradient, one step deep.

    The learning rate falls linearly with the steps to that given as final; without that, success oscillates.

    Raises:
        ValueError: for an environment without derivatives: not on the surrogate, or a correction of the QP.
    """

    def __init__(self, config: TrainConfig) -> None:
        import torch

        environment = config.environment
        if environment.backend != "surrogate" or environment.residual_scale:
            raise ValueError(
                f"learner 'analytic' needs environment.backend = surrogate and no residual_scale, got "
                f"{environment.backend} and {environment.residual_scale:g}; allowed: learner 'sac'"
            )
        super().__init__(config)
        self.options, self.step = config.analytic, 0
        members = {"members": self.options.members} if self.options.members else {}
        env = environment.make_vec(config.num_envs, backend_options={**environment.backend_options, **members})
        self.env: SoftRobotVectorEnv = env.unwrapped  # type: ignore[assignment]
        generator = torch.Generator().manual_seed(config.seed)
        sizes = [self.env.single_observation_space.shape[0], *self.options.net_arch]  # type: ignore[index]
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
        self._optimiser = torch.optim.Adam(self._network.parameters(), lr=self.options.learning_rate, fused=True)

    def learn(self, target: int, progress: Callable[[int], object]) -> None:
        import torch

        env, config = self.env, self.config
        rng = np.random.default_rng([config.seed, self.step])
        observation, _ = env.reset(seed=int(rng.integers(2**31)))
        # Episodes end at different times, so that a batch holds states of all ages.
        env.steps = rng.integers(0, env.max_episode_steps, env.num_envs)
        while self.step < target:
            share = min(self.step / config.steps, 1.0)
            rate = self.options.learning_rate + share * (self.options.final_learning_rate - self.options.learning_rate)
            for group in self._optimiser.param_groups:
                group["lr"] = rate
            action = torch.tanh(self._network(torch.from_numpy(observation)))
            observation, *_, gradient = env.step_with_gradient(action.detach().numpy())
            ascent = torch.from_numpy(self._ascent(gradient).astype(np.float32))
            loss = -(action * ascent).sum() / env.num_envs
            self._optimiser.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self._network.parameters(), LARGEST_GRADIENT)
            self._optimiser.step()
            self.step += env.num_envs
            progress(env.num_envs)

    def _ascent(self, gradient: StepGradient) -> np.ndarray:
        """Return the gradient of the log rewards in the actions (B, n_a), one-sided at kinks.

        The exact derivative is zero for commands that are slack or held by a limit; an actor that ended there would
        never come back. So a slack actuator is tightened if that helps, and its command follows what the cable reaches.
        A command held by a limit may move back, but not further out.
        """
        tighten = np.maximum(gradient.held, 0.0)
        command = (
            np.where(gradient.slack, tighten, gradient.command) / np.maximum(gradient.reward, SMALLEST_REWARD)[:, None]
        )
        command += np.where(gradient.slack, self.options.slack_pull * gradient.gap / self._span**2, 0.0)
        outward = gradient.limited * command > 0.0
        return np.where(outward, 0.0, command * gradient.slope)

    @property
    def _span(self) -> np.ndarray:
        return 0.5 * (self.env.robot.upper - self.env.robot.lower)

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
            _, key, part = name.split("/")
            moments.setdefault(int(key), {})[part] = torch.as_tensor(value)
        self._optimiser.load_state_dict({**self._optimiser.state_dict(), "state": moments})
        self.step = int(meta["step"])

    def close(self) -> None:
        self.env.close()
