"""The network of the thesis, for comparison (thesis, eq. 4.2, 4.11, 4.12)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from pydantic import Field

from softgym_envs.extensions.fitting.data.states import States
from softgym_envs.extensions.fitting.trainer import History, Trainer, TrainingOptions
from softgym_envs.extensions.networks.direct import DirectModel
from softgym_envs.extensions.networks.perceptron import layers, mean_scale, perceptron, standardise, weights
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.model import Context


class Options(TrainingOptions):
    """Hyper-parameters of the thesis' network."""

    kind: Literal["thesis"] = "thesis"
    width: int = Field(default=450, gt=0)
    depth: int = Field(default=3, gt=0)
    optimiser: Literal["soap", "adam"] = "adam"
    steps: int = Field(default=20000, gt=0)
    batch_size: int = Field(default=512, gt=0)
    learning_rate: float = Field(default=1e-3, gt=0)
    dropout: float = Field(default=0.0, ge=0.0, lt=1.0)


class Model(DirectModel):
    """The thesis' network: two ReLU perceptrons (thesis, eq. 4.2, 4.11, 4.12).

    G maps the design to (W0, free0), F maps (delta, W0, free0) to (W, free).

    Effector rows of free0 and free are absolute positions; standardisation makes them equivalent to the displacements
    from a goal in the thesis. W is symmetric but not always positive definite.
    """

    network = "thesis"

    def __init__(
        self, robot: Robot, tensors: Mapping[str, np.ndarray], card: Mapping[str, Any], members: int | None = None
    ) -> None:
        super().__init__(robot, tensors, card, members)
        self._rest, self._main = layers(tensors, "rest"), layers(tensors, "main")
        self._scales = {k: tensors[k].astype(float) for k in ("rest_mean", "rest_scale", "main_mean", "main_scale")}

    @staticmethod
    def _relu(x: np.ndarray, parts: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        for weight, bias in parts[:-1]:
            x = np.maximum(x @ weight + bias, 0.0)
        weight, bias = parts[-1]
        return x @ weight + bias

    def _prepare(self, design: np.ndarray) -> dict[str, np.ndarray]:
        return {"rest": self._relu(design.astype(np.float32), self._rest)}

    def _entries(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        rest = context.gather()["rest"]
        x = np.concatenate([self.features.actuation(displacement).astype(np.float32), rest], axis=1)
        return self._relu(x, self._main).astype(float) * self._scales["main_scale"] + self._scales["main_mean"]


def train(
    robot: Robot, training: States, validation: States, trainer: Trainer
) -> tuple[dict[str, np.ndarray], dict[str, History]]:
    """Train the thesis' G and F on standardised (W upper triangle, delta_free)."""
    import torch

    options = trainer.options

    def tensor(x):
        return torch.as_tensor(np.ascontiguousarray(x), dtype=torch.float32)

    y = {"train": training.entries, "validation": validation.entries}
    arrays = {"train": training, "validation": validation}
    main_mean, main_scale = mean_scale(y["train"])
    rest_mean, rest_scale = mean_scale(y["train"][training.rest_rows])
    design = {k: tensor(v.design) for k, v in arrays.items()}
    rest = {k: tensor(standardise(y[k][v.rest_of], rest_mean, rest_scale)) for k, v in arrays.items()}
    main_in = {k: torch.cat([tensor(v.actuation), rest[k]], dim=1) for k, v in arrays.items()}
    main_out = {k: tensor(standardise(y[k], main_mean, main_scale)) for k in arrays}
    shape = (options.width, options.depth, "relu", trainer.seed, options.dropout)
    net_rest = perceptron(training.design.shape[1], len(rest_mean), *shape)
    net_main = perceptron(main_in["train"].shape[1], len(main_mean), *shape)

    def loss_of(net, x, target, rows_of=None):
        def loss(rows):
            if rows is None:
                return ((net(x["validation"]) - target["validation"]) ** 2).mean()
            rows = rows if rows_of is None else rows_of[rows]
            return ((net(x["train"][rows]) - target["train"][rows]) ** 2).mean()

        return loss

    rest_rows = torch.as_tensor(training.rest_rows)
    histories = {
        "rest": trainer.optimise("G", net_rest, loss_of(net_rest, design, rest, rest_rows), len(rest_rows)),
        "main": trainer.optimise("F", net_main, loss_of(net_main, main_in, main_out), len(training.design)),
    }
    tensors = weights(net_rest, "rest") | weights(net_main, "main")
    tensors |= {"rest_mean": rest_mean, "rest_scale": rest_scale, "main_mean": main_mean, "main_scale": main_scale}
    return tensors, histories
