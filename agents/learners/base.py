"""The Learner base class: what `softgym_envs.agents.training.train` needs of a learning method."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.config import Config
from softgym_envs.errors import WeightsError

Tensors = dict[str, np.ndarray]


def check_weights(shapes: Mapping[str, Sequence[int]], tensors: Mapping[str, np.ndarray], path: Path) -> None:
    """Check that the tensors of a file have the shapes of a learner's weights.

    Raises:
        WeightsError: if one is missing or does not fit.
    """
    for name, shape in shapes.items():
        if name not in tensors:
            raise WeightsError(f"policy '{path}' lacks tensor '{name}'")
        if tensors[name].shape != tuple(shape):
            raise WeightsError(
                f"policy '{path}' does not fit: '{name}' has shape {tensors[name].shape}, needed {tuple(shape)}; "
                "train it with the same net_arch, cables and design_in_observation"
            )


def check_layers(widths: list[int]) -> list[int]:
    """Return the widths of hidden layers.

    Raises:
        ValueError: for a width below 1.
    """
    if any(width < 1 for width in widths):
        raise ValueError("must be positive widths")
    return widths


class Learner(ABC):
    """A policy in training. One file per method, and a row in `softgym_envs.agents.learners` or an entry point.

    `train` makes a learner, restores or loads its weights, calls `learn` for one part of the training after the other,
    evaluates the policy in between and stores `weights` and `state`. A resumed training must give the same policy as
    an uninterrupted one, so each call of `learn` begins with new episodes that depend on seed and step only.

    Args:
        config: configuration of the training.

    Attributes:
        Config: its hyperparameters, `config.settings` of a training.
        title: its name in tables.
        model_based: whether it knows the model of the robot, as the inverse QP does.
        has_memory: whether its policies remember earlier observations.
        config: configuration of the training.
        step: environment steps so far, over all sub-environments.

    Raises:
        ValueError: for an environment in which the method cannot learn.
    """

    Config: ClassVar[type[Config]] = Config
    title: ClassVar[str]
    model_based: ClassVar[bool] = False
    has_memory: ClassVar[bool] = False
    step: int

    @classmethod
    def check(cls, settings: Any, environment: EnvironmentConfig, steps: int | None, *, section: str, end: str) -> None:
        """Raise ValueError for hyperparameters that contradict what `LearnerConfig.check_training` takes."""
        return

    @classmethod
    def update_seconds(cls, config: TrainConfig) -> float:
        """Return the rough CPU time of the updates after a step of all environments together [s]."""
        return 0.0

    @abstractmethod
    def __init__(self, config: TrainConfig) -> None:
        self.config = config

    @abstractmethod
    def learn(self, target: int, progress: Callable[[int], object]) -> None:
        """Train up to at least ``target`` steps; ``progress`` is called with numbers of steps that have been made."""

    @abstractmethod
    def weights(self) -> Tensors:
        """Return copies of all weights; those of the policy are named ``actor.latent_pi.<k>`` and ``actor.mu``."""

    @abstractmethod
    def load_weights(self, tensors: Mapping[str, np.ndarray], path: Path) -> None:
        """Replace the weights by those of a file.

        Raises:
            WeightsError: if one is missing or does not fit.
        """

    @abstractmethod
    def state(self) -> tuple[Tensors, dict[str, Any]]:
        """Return what else a resumed training needs, as tensors and as JSON data: optimiser, buffers, random states."""

    @abstractmethod
    def restore(self, tensors: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
        """Restore what `state` returned."""

    def log_to(self, folder: Path) -> None:  # noqa: B027 - optional
        """Write a log to a folder; by default none."""

    def record(self, values: Mapping[str, float]) -> None:  # noqa: B027 - optional
        """Add values to the log."""

    @abstractmethod
    def close(self) -> None:
        """Close the environments."""
