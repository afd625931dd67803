"""Evolution of the policy's weights (model-free): CMA-ES of the package ``cmaes`` on the returns of whole episodes.

A generation is one episode of the batched environment in which each sub-environment tries weights of its own. The
search needs neither critic nor gradients, so a late reward counts as much as an early one. It suits tasks whose reward
comes after a long detour, such as a swing, and small policies: the covariance has as many rows as there are weights.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, field_validator

from softgym_envs.agents.config import TrainConfig
from softgym_envs.agents.learners.base import Learner, Tensors, check_layers, check_weights
from softgym_envs.config import Config
from softgym_envs.extras import require


class EvolutionConfig(Config):
    """Hyperparameters of the evolution of weights (`softgym_envs.extensions.learners.evolution`)."""

    step_size: float = Field(default=0.2, gt=0, description="first standard deviation of each weight")
    net_arch: list[int] = Field(default=[], description="widths of hidden layers; none for a linear policy")

    @field_validator("net_arch")
    @classmethod
    def _layers(cls, value: list[int]) -> list[int]:
        return check_layers(value)


class EvolutionLearner(Learner):
    """Covariance matrix adaptation (Hansen 2016) of all weights of a network.

    `weights` are those of the largest return since the last evaluation. All sub-environments of a generation have the
    goals and the body of the first one, if they are batched in one process.

    Args:
        config: configuration of the training; ``num_envs`` is the size of a generation.

    Attributes:
        env: the batched environment.

    Raises:
        ValueError: for fewer than four sub-environments.
    """

    Config = EvolutionConfig
    title = "evolution"

    def __init__(self, config: TrainConfig) -> None:
        if config.num_envs < 4:
            raise ValueError(f"num_envs = {config.num_envs} is too small for learner 'evolution'; allowed: 4 or more")
        require("codesign")
        super().__init__(config)
        self.env = config.environment.make_vec(config.num_envs)
        sizes = [self.env.single_observation_space.shape[0], *config.settings.net_arch]  # type: ignore[index]
        layers = [(f"actor.latent_pi.{2 * k}", a, b) for k, (a, b) in enumerate(zip(sizes, sizes[1:], strict=False))]
        layers.append(("actor.mu", sizes[-1], self.env.single_action_space.shape[0]))  # type: ignore[index]
        self._shapes = {f"{name}.{part}": shape for name, a, b in layers for part, shape in _parts(a, b)}
        self._begin(np.zeros(sum(int(np.prod(shape)) for shape in self._shapes.values())))

    def _begin(self, first: np.ndarray) -> None:
        """Start the search at weights (n,)."""
        from cmaes import CMA

        config = self.config
        self.step = 0
        self._first = self._best = first
        self._returns: list[np.ndarray] = []
        self._lengths: list[int] = []
        self._search = CMA(
            mean=first, sigma=config.settings.step_size, population_size=config.num_envs, seed=config.seed
        )

    def learn(self, target: int, progress: Callable[[int], object]) -> None:
        largest = -np.inf
        while self.step < target:
            candidates = self._candidates()
            returns, steps = self._episode(self._unpacked(candidates.astype(np.float32)), progress)
            if returns.max() > largest:
                largest, self._best = float(returns.max()), candidates[int(returns.argmax())]
            self._learn_from(candidates, returns, steps)

    def _candidates(self) -> np.ndarray:
        """Return the weights of the next generation, shape (num_envs, n)."""
        return np.array([self._search.ask() for _ in range(self.config.num_envs)])

    def _learn_from(self, candidates: np.ndarray, returns: np.ndarray, steps: int) -> None:
        self._search.tell([(weights, -value) for weights, value in zip(candidates, returns.tolist(), strict=True)])
        self._returns.append(returns)
        self._lengths.append(steps)
        self.step += steps * self.config.num_envs

    def _episode(self, tensors: Tensors, progress: Callable[[int], object]) -> tuple[np.ndarray, int]:
        """Return the returns (num_envs,) of one episode with weights for each sub-environment, and its length."""
        env, count = self.env, self.config.num_envs
        observation = self._reset()
        returns, running, steps = np.zeros(count), np.ones(count, dtype=bool), 0
        while running.any():
            x = observation[:, :, None]
            for name in list(self._shapes)[:-2:2]:
                x = np.maximum(tensors[name] @ x + tensors[name.replace("weight", "bias")][:, :, None], 0.0)
            x = tensors["actor.mu.weight"] @ x + tensors["actor.mu.bias"][:, :, None]
            observation, reward, terminated, truncated, _ = env.step(np.tanh(x[:, :, 0]))
            returns += np.where(running, reward, 0.0)
            running &= ~(terminated | truncated)
            steps += 1
            progress(count)
        return returns, steps

    def _reset(self) -> np.ndarray:
        """Begin an episode, the same for all sub-environments, that depends on seed and step only."""
        env, count = self.env, self.config.num_envs
        seed = int(np.random.default_rng([self.config.seed, self.step]).integers(2**31))
        observation, _ = env.reset(seed=[seed] * count)  # type: ignore[arg-type]
        return observation

    def _unpacked(self, weights: np.ndarray) -> Tensors:
        """Return the tensors (..., *shape) of weights (..., n)."""
        found, start = {}, 0
        for name, shape in self._shapes.items():
            end = start + int(np.prod(shape))
            found[name] = weights[..., start:end].reshape(*weights.shape[:-1], *shape)
            start = end
        return found

    def weights(self) -> Tensors:
        return {name: value.copy() for name, value in self._unpacked(self._best.astype(np.float32)).items()}

    def load_weights(self, tensors: Mapping[str, np.ndarray], path: Path) -> None:
        check_weights(self._shapes, tensors, path)
        self._begin(np.concatenate([tensors[name].ravel() for name in self._shapes]).astype(float))

    def state(self) -> tuple[Tensors, dict[str, Any]]:
        # The search follows from its start, its seed and these returns.
        return {"first": self._first, "returns": np.array(self._returns)}, {"lengths": self._lengths}

    def restore(self, tensors: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
        best = self._best
        self._begin(tensors["first"])
        for returns, steps in zip(tensors["returns"], meta["lengths"], strict=True):
            self._learn_from(self._candidates(), returns, steps)
        self._best = best

    def close(self) -> None:
        self.env.close()


def _parts(inputs: int, outputs: int) -> tuple[tuple[str, tuple[int, ...]], ...]:
    return ("weight", (outputs, inputs)), ("bias", (outputs,))
