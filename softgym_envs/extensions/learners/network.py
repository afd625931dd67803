"""A network in training by its own loop: weights, optimiser and what a resumed training needs of both."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field, field_validator

from softgym_envs.agents.learners.base import Learner, Tensors, check_layers, check_weights
from softgym_envs.config import Config

if TYPE_CHECKING:
    import torch

LARGEST_GRADIENT = 1.0
"""Largest norm of the gradient of all weights."""


class RateConfig(Config):
    """Learning rates of Adam."""

    learning_rate: float = Field(default=2e-3, gt=0)
    final_learning_rate: float = Field(default=4e-5, gt=0, description="reached linearly at the last step")


class GradientConfig(RateConfig):
    """Hyperparameters of the learners that know the model."""

    net_arch: list[int] = [128, 128]
    members: int | None = Field(
        default=1, ge=1, description="of the surrogate's ensemble, in training; evaluations use all"
    )

    @field_validator("net_arch")
    @classmethod
    def _layers(cls, value: list[int]) -> list[int]:
        return check_layers(value)


class NetworkLearner(Learner):
    """A learner whose weights Adam changes.

    The learning rate falls linearly with the steps to that given as final; without that, success oscillates.
    """

    def _begin(self, parameters: Mapping[str, torch.nn.Parameter], options: RateConfig) -> None:
        """Begin with weights, under the names of `weights`, at the first step."""
        import torch

        self.step, self._parameters, self._options = 0, dict(parameters), options
        self._optimiser = torch.optim.Adam(self._parameters.values(), lr=options.learning_rate, fused=True)

    def _set_learning_rate(self) -> None:
        """Set the learning rate of the present step."""
        options, share = self._options, min(self.step / self.config.steps, 1.0)
        for group in self._optimiser.param_groups:
            group["lr"] = options.learning_rate + share * (options.final_learning_rate - options.learning_rate)

    def descend(self, loss: torch.Tensor) -> None:
        """Change the weights by one step that reduces a loss."""
        import torch

        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self._parameters.values(), LARGEST_GRADIENT)
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
