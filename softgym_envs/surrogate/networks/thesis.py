"""The network of the thesis (eq. 4.2, 4.11, 4.12), for comparison."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from pydantic import Field

from softgym_envs.config import Config
from softgym_envs.robots.robot import Robot
from softgym_envs.surrogate.model import Context, SurrogateModel
from softgym_envs.surrogate.networks.perceptron import layers, mean_scale, perceptron, standardise, weights
from softgym_envs.surrogate.states import States

__all__ = ["Model", "Options", "train"]


class Options(Config):
    """Hyper-parameters."""

    kind: Literal["thesis"] = "thesis"
    width: int = Field(default=450, gt=0)
    depth: int = Field(default=3, gt=0)
    steps: int = Field(default=20000, gt=0)
    batch_size: int = Field(default=512, gt=0)
    learning_rate: float = Field(default=1e-3, gt=0)


class Model(SurrogateModel):
    """The thesis' network (eq. 4.2, 4.11, 4.12): two ReLU perceptrons.

    G maps the design to (W0, free0), F maps (delta, W0, free0) to (W, free).

    Effector rows of free0 and free are absolute positions, which standardisation makes equivalent to the thesis'
    displacements from a goal. W is symmetric but not kept positive definite.
    """

    network = "thesis"

    def __init__(
        self, robot: Robot, tensors: Mapping[str, np.ndarray], card: Mapping[str, Any], members: int | None = None
    ) -> None:
        super().__init__(robot, tensors, card, members)
        self._rest, self._main = layers(tensors, "rest"), layers(tensors, "main")
        self._scales = {k: tensors[k].astype(float) for k in ("rest_mean", "rest_scale", "main_mean", "main_scale")}
        self._upper = np.triu_indices(self.size)

    @staticmethod
    def _relu(x: np.ndarray, parts: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        for weight, bias in parts[:-1]:
            x = np.maximum(x @ weight + bias, 0.0)
        weight, bias = parts[-1]
        return x @ weight + bias

    def _prepare(self, design: np.ndarray) -> dict[str, np.ndarray]:
        return {"rest": self._relu(design.astype(np.float32), self._rest)}

    def _outputs(self, context: Context, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        arrays = context.gather()
        x = np.concatenate([self.features.actuation(displacement).astype(np.float32), arrays["rest"]], axis=1)
        y = self._relu(x, self._main).astype(float) * self._scales["main_scale"] + self._scales["main_mean"]
        W = np.empty((len(y), self.size, self.size))
        entries = len(self._upper[0])
        W[:, self._upper[0], self._upper[1]] = y[:, :entries]
        W[:, self._upper[1], self._upper[0]] = y[:, :entries]
        return W, y[:, entries:]

    def _state(self, context: Context, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        W, free = self._outputs(context, displacement)
        a, e = slice(0, self.count), slice(self.count, self.size)
        effort = np.linalg.solve(W[:, a, a], (displacement - free[:, a])[:, :, None])
        return effort[:, :, 0], (W[:, e, a] @ effort)[:, :, 0] + free[:, e], np.full(len(effort), np.inf)

    def _compliance(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        return self._outputs(context, displacement)[0]


def train(
    robot: Robot, training: States, validation: States, trainer: Any
) -> tuple[dict[str, np.ndarray], dict[str, list[dict[str, float]]]]:
    """Train the thesis' G and F on standardised (W upper triangle, delta_free)."""
    import torch

    options = trainer.options

    def tensor(x):
        return torch.as_tensor(np.ascontiguousarray(x), dtype=torch.float32)

    def outputs(arrays: States) -> np.ndarray:
        n = arrays.W.shape[1]
        upper = np.triu_indices(n)
        effort = np.concatenate([arrays.effort, np.zeros_like(arrays.effector)], axis=1)
        delta = np.concatenate([arrays.displacement, arrays.effector], axis=1)
        free = delta - np.einsum("bij,bj->bi", arrays.W, effort)
        return np.concatenate([arrays.W[:, upper[0], upper[1]], free], axis=1)

    y = {"train": outputs(training), "validation": outputs(validation)}
    arrays = {"train": training, "validation": validation}
    main_mean, main_scale = mean_scale(y["train"])
    rest_mean, rest_scale = mean_scale(y["train"][training.rest_rows])
    design = {k: tensor(v.design) for k, v in arrays.items()}
    rest = {k: tensor(standardise(y[k][v.rest_of], rest_mean, rest_scale)) for k, v in arrays.items()}
    main_in = {k: torch.cat([tensor(v.actuation), rest[k]], dim=1) for k, v in arrays.items()}
    main_out = {k: tensor(standardise(y[k], main_mean, main_scale)) for k in arrays}
    net_rest = perceptron(training.design.shape[1], len(rest_mean), options.width, options.depth, "relu", trainer.seed)
    net_main = perceptron(main_in["train"].shape[1], len(main_mean), options.width, options.depth, "relu", trainer.seed)

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
