"""Cloning of the inverse QP (model-based): the policy imitates the QP in the states that the policy itself visits.

This is DAgger (Ross, Gordon and Bagnell, A reduction of imitation learning and structured prediction to no-regret
online learning, 2011): at every step the QP tells what it would do, all its answers are kept, and the policy is fitted
to samples of them. At first the QP acts in some of the environments, later only the policy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium.vector import SyncVectorEnv
from pydantic import Field

from softgym_envs.agents.baselines import InverseQPAgent
from softgym_envs.agents.config import TrainConfig
from softgym_envs.agents.learners.base import Tensors
from softgym_envs.agents.residual import BatchQP
from softgym_envs.envs.vector_env import SoftRobotVectorEnv
from softgym_envs.extensions.learners.gradient import GradientLearner
from softgym_envs.extensions.learners.network import GradientConfig


class CloningConfig(GradientConfig):
    """Hyperparameters of the imitation of the inverse QP (`softgym_envs.extensions.learners.cloning`)."""

    batch_size: int = Field(default=256, gt=0)
    gradient_steps: int = Field(default=8, gt=0, description="per step of all environments together")
    lead: float = Field(
        default=0.2, gt=0, le=1, description="share of the steps until the policy acts alone in all environments"
    )


class CloningLearner(GradientLearner):
    """Imitation of the inverse QP, on the batched environment where there is one."""

    Config = CloningConfig
    title = "cloning"

    @classmethod
    def update_seconds(cls, config: TrainConfig) -> float:
        return 1e-4 * config.num_envs + 0.0005 * float(config.settings.gradient_steps)

    needs_batch = False

    def __init__(self, config: TrainConfig) -> None:
        super().__init__(config, config.settings)
        self._expert = self._make_expert()
        size = config.steps + config.num_envs
        self._observations = np.zeros((size, *self.env.single_observation_space.shape), dtype=np.float32)  # type: ignore[misc]
        self._answers = np.zeros((size, *self.env.single_action_space.shape), dtype=np.float32)  # type: ignore[misc]

    def _make_expert(self) -> Callable[[], np.ndarray]:
        """Return a function that returns the answers of the QP in the present states, shape (num_envs, n_a)."""
        if isinstance(self.env, SoftRobotVectorEnv):
            return BatchQP(self.env)
        assert isinstance(self.env, SyncVectorEnv)
        singles, agent = [env.unwrapped for env in self.env.envs], InverseQPAgent()
        return lambda: np.stack([agent(None, env) for env in singles])

    def advance(self, observation: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        import torch

        cloning, env = self.config.settings, self.env
        answer = self._expert()
        rows = slice(self.step, self.step + env.num_envs)
        self._observations[rows], self._answers[rows] = observation, answer
        for _ in range(cloning.gradient_steps):
            sample = rng.integers(0, rows.stop, cloning.batch_size)
            error = self.policy(self._observations[sample]) - torch.from_numpy(self._answers[sample])
            self.descend((error**2).mean())
        with torch.no_grad():
            action = self.policy(observation).numpy()
        led = rng.random(env.num_envs) < 1.0 - self.step / (cloning.lead * self.config.steps)
        return env.step(np.where(led[:, None], answer, action))[0]

    def state(self) -> tuple[Tensors, dict[str, Any]]:
        tensors, meta = super().state()
        kept = {"observations": self._observations[: self.step], "answers": self._answers[: self.step]}
        return tensors | kept, meta

    def restore(self, tensors: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
        super().restore(tensors, meta)
        self._observations[: self.step], self._answers[: self.step] = tensors["observations"], tensors["answers"]
