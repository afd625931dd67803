"""Imitation of an inverse QP that sees everything, by a policy with a memory that sees the observations only.

The QP knows the condensed model of the plant's present state, hidden effector and touches included. The policy, a gated
recurrent unit, gets the observations of an episode one after the other and learns what the QP would do (Chen et al.,
Learning by cheating, 2019). As in `softgym_envs.extensions.learners.cloning`, answers are collected in the states that
the policy itself visits (DAgger); an update follows whole episodes of them through time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from pydantic import Field

from softgym_envs.agents.baselines import make_baseline
from softgym_envs.agents.config import TrainConfig
from softgym_envs.agents.learners.base import Tensors
from softgym_envs.agents.policy import memory_layers, remember
from softgym_envs.extensions.learners.network import GradientConfig, NetworkLearner


class RecurrentConfig(GradientConfig):
    """Hyperparameters of the imitation by a network with memory (`softgym_envs.extensions.learners.recurrent`)."""

    net_arch: list[int] = Field(default=[64], min_length=1, max_length=1, description="width of the memory")
    batch_size: int = Field(default=32, gt=0, description="episodes of each update")
    gradient_steps: int = Field(default=8, gt=0, description="updates after each episode")
    lead: float = Field(
        default=0.2, gt=0, le=1, description="share of the steps until the policy acts alone in all episodes"
    )


class RecurrentLearner(NetworkLearner):
    """A policy with a memory that imitates the inverse QP, in one environment of any backend.

    Args:
        config: configuration of the training.

    Attributes:
        env: the environment.

    Raises:
        ValueError: for several sub-environments, a correction of the QP, or a task whose states the QP needs.
    """

    Config = RecurrentConfig
    title = "recurrent"
    model_based = True
    has_memory = True

    @classmethod
    def update_seconds(cls, config: TrainConfig) -> float:
        return 0.005

    def __init__(self, config: TrainConfig) -> None:
        import torch

        environment, options = config.environment, config.settings
        if config.num_envs != 1 or environment.residual_scale or environment.task_class.needs_state:
            raise ValueError(
                f"learner 'recurrent' needs num_envs = 1, no residual_scale and goals in space, got {config.num_envs}, "
                f"{environment.residual_scale:g} and task '{environment.task_class.name}'"
            )
        super().__init__(config)
        self.env = environment.make()
        self._teacher = make_baseline("qp")
        inputs, outputs = (int(space.shape[0]) for space in (self.env.observation_space, self.env.action_space))  # type: ignore[index]
        (width,) = options.net_arch
        torch.manual_seed(config.seed)
        self._unit, self._mean = torch.nn.GRU(inputs, width, batch_first=True), torch.nn.Linear(width, outputs)
        torch.nn.init.zeros_(self._mean.weight)  # the untrained policy keeps still
        torch.nn.init.zeros_(self._mean.bias)
        named = {f"actor.memory.{n.removesuffix('_l0')}": value for n, value in self._unit.named_parameters()}
        self._begin(named | dict(self._mean.named_parameters("actor.mu")), options)
        steps = environment.row.max_episode_steps
        # An episode begins before the last step and may end after it.
        self._observations = np.zeros((config.steps, steps, inputs), dtype=np.float32)
        self._answers = np.zeros((config.steps, steps, outputs), dtype=np.float32)
        self._lengths = np.zeros(config.steps, dtype=np.int64)
        self._episodes = 0

    def learn(self, target: int, progress: Callable[[int], object]) -> None:
        options = self.config.settings
        rng = np.random.default_rng([self.config.seed, self.step])
        while self.step < target:
            self._set_learning_rate()
            led = bool(rng.random() < 1.0 - self.step / (options.lead * self.config.steps))
            made = self._episode(int(rng.integers(2**31)), led)
            for _ in range(options.gradient_steps):
                self._imitate(rng.integers(0, self._episodes, options.batch_size))
            self.step += made
            progress(made)

    def _episode(self, seed: int, led: bool) -> int:
        """Keep an episode in which the QP or the policy acts, with the answers of the QP; return its length."""
        env, row = self.env, self._episodes
        w = self.weights()
        read, recall = memory_layers(w)
        memory = np.zeros(len(recall[0]), dtype=np.float32)
        observation, _ = env.reset(seed=seed)
        length, ended = 0, False
        while not ended:
            answer = self._teacher(observation, env.unwrapped)
            self._observations[row, length], self._answers[row, length] = observation, answer
            length += 1
            memory = remember(memory, observation, read, recall)
            own = np.tanh(w["actor.mu.weight"] @ memory + w["actor.mu.bias"])
            observation, _, terminated, truncated, _ = env.step(answer if led else own)
            ended = terminated or truncated
        self._lengths[row] = length
        self._episodes += 1
        return length

    def _imitate(self, rows: np.ndarray) -> None:
        """Change the weights so that the actions in some episodes come nearer to the answers of the QP."""
        import torch

        seen, answers = (torch.from_numpy(kept[rows]) for kept in (self._observations, self._answers))
        actions = torch.tanh(self._mean(self._unit(seen)[0]))
        lasts = torch.from_numpy(np.arange(seen.shape[1]) < self._lengths[rows, None])
        self.descend(((actions - answers)[lasts] ** 2).mean())

    def state(self) -> tuple[Tensors, dict[str, Any]]:
        tensors, meta = super().state()
        kept = slice(0, self._episodes)
        episodes = {"observations": self._observations[kept], "answers": self._answers[kept]}
        return tensors | episodes | {"lengths": self._lengths[kept]}, meta

    def restore(self, tensors: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
        super().restore(tensors, meta)
        self._episodes = len(tensors["lengths"])
        kept = slice(0, self._episodes)
        self._observations[kept], self._answers[kept] = tensors["observations"], tensors["answers"]
        self._lengths[kept] = tensors["lengths"]

    def close(self) -> None:
        self.env.close()
