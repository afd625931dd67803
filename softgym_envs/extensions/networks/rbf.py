"""Radial basis functions, a strong baseline without a network: W and delta_free are interpolated between the states.

`scipy.interpolate.RBFInterpolator` interpolates in the scaled actuation and design, over the nearest states if there
are many. It is exact at the samples and needs no training. W is symmetric but not always positive definite.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_args

import numpy as np
from pydantic import Field

from softgym_envs.config import Config
from softgym_envs.extensions.fitting.data.states import States
from softgym_envs.extensions.fitting.trainer import History, Trainer
from softgym_envs.extensions.networks.direct import DirectModel
from softgym_envs.extensions.networks.perceptron import mean_scale, standardise
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.model import Context

Kernel = Literal["thin_plate_spline", "cubic", "quintic", "linear"]
KERNELS = get_args(Kernel)
"""Weights hold the number of their kernel."""


class Options(Config):
    """Hyper-parameters of the interpolation."""

    kind: Literal["rbf"] = "rbf"
    kernel: Kernel = "cubic"
    neighbors: int = Field(default=200, gt=0)


class Model(DirectModel):
    """Interpolated condensed models (see the module)."""

    network = "rbf"

    def __init__(
        self, robot: Robot, tensors: Mapping[str, np.ndarray], card: Mapping[str, Any], members: int | None = None
    ) -> None:
        from scipy.interpolate import RBFInterpolator

        super().__init__(robot, tensors, card, members)
        points, values = tensors["points"].astype(float), tensors["values"].astype(float)
        self._scales = tensors["mean"].astype(float), tensors["scale"].astype(float)
        kernel, neighbors = KERNELS[int(tensors["kernel"].item())], int(tensors["neighbors"].item())
        self._used = tensors["used"].astype(bool)
        self._interpolate = RBFInterpolator(
            points[:, self._used], values, kernel=kernel, neighbors=neighbors if neighbors < len(points) else None
        )

    def _prepare(self, design: np.ndarray) -> dict[str, np.ndarray]:
        return {"design": design}

    def _entries(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        x = np.concatenate([self.features.actuation(displacement), context.gather()["design"]], axis=1)
        return self._interpolate(x[:, self._used]) * self._scales[1] + self._scales[0]


def train(
    robot: Robot, training: States, validation: States, trainer: Trainer
) -> tuple[dict[str, np.ndarray], dict[str, History]]:
    """Return the states themselves, without duplicates."""
    y = training.entries
    x = np.concatenate([training.actuation, training.design], axis=1)
    x, first = np.unique(np.round(x, 9), axis=0, return_index=True)
    mean, scale = mean_scale(y)
    options: Options = trainer.options
    return {
        "points": x,
        "values": standardise(y[first], mean, scale),
        "mean": mean,
        "scale": scale,
        # Inputs that never change, such as those of a single body, would make the problem singular.
        "used": np.ptp(x, axis=0) > 1e-9,
        "kernel": np.array(KERNELS.index(options.kernel)),
        "neighbors": np.array(options.neighbors),
    }, {}
