"""A structured network: exact at rest, with a symmetric positive definite W by construction."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from pydantic import Field

from softgym_envs.errors import DataError
from softgym_envs.extensions.fitting.data.states import States
from softgym_envs.extensions.fitting.trainer import History, Trainer, TrainingOptions
from softgym_envs.extensions.networks.perceptron import layers, mean_scale, perceptron, standardise, weights
from softgym_envs.mechanics.compilation import njit
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.model import Context, SurrogateModel


class Options(TrainingOptions):
    """Hyper-parameters of the residual network."""

    kind: Literal["residual"] = "residual"
    width: int = Field(default=128, gt=0)
    depth: int = Field(default=3, gt=0)
    learning_rate: float = Field(default=3e-3, gt=0)


def _activate(x: np.ndarray) -> np.ndarray:
    """Return the algebraic sigmoid ``x / sqrt(1 + x^2)``, which is smooth like tanh but cheaper."""
    return x / np.sqrt(1.0 + x * x)


def _forward(x: np.ndarray, parts: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    for weight, bias in parts[:-1]:
        x = _activate(x @ weight + bias)
    weight, bias = parts[-1]
    return x @ weight + bias


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _rows_forward(x, first, prepared, hidden, hidden_bias, last, last_bias, out):
    """Evaluate a perceptron row by row; ``prepared`` (B, w) is the contribution of the design to the first layer."""
    width = first.shape[1]
    h = np.empty(width, dtype=np.float32)
    g = np.empty(width, dtype=np.float32)
    one = np.float32(1.0)
    for b in range(x.shape[0]):
        for j in range(width):
            h[j] = prepared[b, j]
        for i in range(x.shape[1]):
            value = x[b, i]
            for j in range(width):
                h[j] += value * first[i, j]
        for j in range(width):
            h[j] = h[j] / np.sqrt(one + h[j] * h[j])
        for layer in range(hidden.shape[0]):
            for j in range(width):
                g[j] = hidden_bias[layer, j]
            for i in range(width):
                value = h[i]
                for j in range(width):
                    g[j] += value * hidden[layer, i, j]
            for j in range(width):
                h[j] = g[j] / np.sqrt(one + g[j] * g[j])
        for k in range(last.shape[1]):
            out[b, k] = last_bias[k]
        for i in range(width):
            value = h[i]
            for k in range(last.shape[1]):
                out[b, k] += value * last[i, k]


#: For this many rows or more, NumPy's matrix products are faster than the compiled loop over rows.
_BATCH = 32


class _ActuatedNet:
    """A perceptron of (actuation, design); the contribution of the design is computed once per body."""

    def __init__(self, parts: list[tuple[np.ndarray, np.ndarray]], count: int) -> None:
        (first, self._bias), *hidden, (self._last, self._last_bias) = parts
        self._first = np.ascontiguousarray(first[:count])
        self._design = np.ascontiguousarray(first[count:])
        width = first.shape[1]
        self._hidden = np.stack([w for w, _ in hidden]) if hidden else np.zeros((0, width, width), dtype=np.float32)
        self._hidden_bias = np.stack([b for _, b in hidden]) if hidden else np.zeros((0, width), dtype=np.float32)

    def prepare(self, design: np.ndarray) -> np.ndarray:
        """Return the contribution of design features (B, d) to the first layer, shape (B, width)."""
        return design @ self._design + self._bias

    def __call__(self, actuation: np.ndarray, prepared: np.ndarray) -> np.ndarray:
        """Return outputs (B, k) at scaled actuation (B, n_a) for prepared bodies (B, width)."""
        x = actuation.astype(np.float32)
        if len(x) >= _BATCH:
            h = _activate(x @ self._first + prepared)
            for weight, bias in zip(self._hidden, self._hidden_bias, strict=True):
                h = _activate(h @ weight + bias)
            return h @ self._last + self._last_bias
        out = np.empty((len(x), self._last.shape[1]), dtype=np.float32)
        _rows_forward(
            x,
            self._first,
            prepared,
            self._hidden,
            self._hidden_bias,
            self._last,
            self._last_bias,
            out,
        )
        return out


class Model(SurrogateModel):
    """A structured network: exact at rest, with a symmetric positive definite W by construction.

    A network G maps the design to the effector at rest and the Cholesky factor ``C0`` of the compliance at rest.
    A state network N and a compliance network M are residuals that vanish at rest by construction:

        effort = (K0 + N_K(delta, p) - N_K(0, p)) delta,            K0 = W0_aa^-1
        effector = effector_0 + (W0_ea K0 + N_J(delta, p) - N_J(0, p)) delta
        W = C C^T,  C = C0 T,  T = lower triangular with diagonal exp(d) from  d = M(delta, p) - M(0, p)

    Inputs and outputs are those of the thesis (eq. 4.2, 4.12); the structure is our own.
    """

    network = "residual"

    def __init__(
        self, robot: Robot, tensors: Mapping[str, np.ndarray], card: Mapping[str, Any], members: int | None = None
    ) -> None:
        super().__init__(robot, tensors, card, members)
        self._rest = layers(tensors, "rest")
        self._rest_scale = tensors["rest_scale"].astype(float)
        self._rest_mean = tensors["rest_mean"].astype(float)
        # The first layer of each network is split into an actuation part and a design part.
        self._nets = {name: _ActuatedNet(layers(tensors, name), self.count) for name in ("state", "compliance")}
        self._state_scale = tensors["state_scale"].astype(np.float32)
        self._compliance_scale = tensors["compliance_scale"].astype(np.float32)
        self._lower = np.tril_indices(self.size)
        self._diagonal = np.flatnonzero(self._lower[0] == self._lower[1])
        self._zero = self.features.actuation(np.zeros((1, self.count))).astype(np.float32)

    def _prepare(self, design: np.ndarray) -> dict[str, np.ndarray]:
        x = design.astype(np.float32)
        rest = _forward(x, self._rest).astype(float) * self._rest_scale + self._rest_mean
        entries = len(self._lower[0])
        C0 = self._triangular(rest[:, :entries])
        W0 = C0 @ np.swapaxes(C0, 1, 2)
        a, e = slice(0, self.count), slice(self.count, self.size)
        K0 = np.linalg.inv(W0[:, a, a])
        slope = np.concatenate([K0, W0[:, e, a] @ K0], axis=1)
        arrays = {"C0": C0, "effector": rest[:, entries:], "slope": slope}
        zero = np.repeat(self._zero, len(x), axis=0)
        for name, net in self._nets.items():
            arrays[f"{name}_in"] = net.prepare(x)
            arrays[f"{name}_zero"] = net(zero, arrays[f"{name}_in"])
        arrays["slope"] = slope - (arrays["state_zero"] * self._state_scale).reshape(slope.shape)
        return arrays

    def _triangular(self, entries: np.ndarray) -> np.ndarray:
        """Return lower triangular matrices (B, n, n) from entries whose diagonal is logarithmic."""
        result = np.zeros((len(entries), self.size, self.size))
        entries = entries.copy()
        entries[:, self._diagonal] = np.exp(entries[:, self._diagonal])
        result[:, self._lower[0], self._lower[1]] = entries
        return result

    def _state(self, context: Context, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        arrays = context.gather()
        correction = self._nets["state"](self.features.actuation(displacement), arrays["state_in"]) * self._state_scale
        slope = arrays["slope"] + correction.reshape(arrays["slope"].shape)
        both = (slope @ displacement[:, :, None])[:, :, 0]
        return both[:, : self.count], arrays["effector"] + both[:, self.count :], np.full(len(both), np.inf)

    def _compliance(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        arrays = context.gather()
        d = self._nets["compliance"](self.features.actuation(displacement), arrays["compliance_in"])
        d = (d - arrays["compliance_zero"]) * self._compliance_scale
        C = arrays["C0"] @ self._triangular(d.astype(float))
        return C @ np.swapaxes(C, 1, 2)


def _log_cholesky(C: np.ndarray) -> np.ndarray:
    """Return the entries (B, n (n + 1) / 2) of lower triangular C (B, n, n), with the logarithm of the diagonal."""
    C = C.copy()
    diagonal = np.arange(C.shape[1])
    C[:, diagonal, diagonal] = np.log(C[:, diagonal, diagonal])
    rows, columns = np.tril_indices(C.shape[1])
    return C[:, rows, columns]


def train(
    robot: Robot, training: States, validation: States, trainer: Trainer
) -> tuple[dict[str, np.ndarray], dict[str, History]]:
    """Train the three networks of the model."""
    import torch

    if not training.unloaded:
        raise DataError("some bodies have efforts or displacements at rest; use network.kind = 'potential'")
    options = trainer.options
    count = len(robot.actuators)
    a, e = slice(0, count), slice(count, None)

    def tensor(x):
        return torch.as_tensor(np.ascontiguousarray(x), dtype=torch.float32)

    tensors: dict[str, np.ndarray] = {}
    histories: dict[str, History] = {}
    # 1. Effector and compliance at rest, from the design.
    rest = {}
    for key, arrays in (("train", training), ("validation", validation)):
        rows = arrays.rest_rows
        y = np.concatenate([_log_cholesky(np.linalg.cholesky(arrays.W[rows])), arrays.effector[rows]], axis=1)
        rest[key] = (arrays.design[rows], y)
    mean, scale = mean_scale(rest["train"][1])
    inputs = {k: tensor(v[0]) for k, v in rest.items()}
    targets = {k: tensor(standardise(v[1], mean, scale)) for k, v in rest.items()}
    net = perceptron(training.design.shape[1], len(mean), 64, 2, "algebraic", trainer.seed)

    def rest_loss(rows):
        key = "validation" if rows is None else "train"
        x, y = (inputs[key], targets[key]) if rows is None else (inputs[key][rows], targets[key][rows])
        return ((net(x) - y) ** 2).mean()

    histories["rest"] = trainer.optimise("rest", net, rest_loss, len(rest["train"][0]))
    tensors |= weights(net, "rest") | {"rest_mean": mean, "rest_scale": scale}

    # 2. Efforts and effectors, as a residual of the rest slopes.
    zero = tensor(2.0 * (0.0 - robot.lower) / (robot.upper - robot.lower) - 1.0)
    parts = {}
    slopes = []
    for key, arrays in (("train", training), ("validation", validation)):
        W0 = arrays.W[arrays.rest_of]
        K0 = np.linalg.inv(W0[:, a, a])
        slope = np.concatenate([K0, W0[:, e, a] @ K0], axis=1)
        y = np.concatenate([arrays.effort, arrays.effector - arrays.effector[arrays.rest_of]], axis=1)
        parts[key] = [tensor(v) for v in (arrays.actuation, arrays.design, arrays.displacement, slope, y)]
        slopes.append(slope)
    y_scale = parts["train"][4].std(dim=0)
    state_scale = np.abs(slopes[0]).mean(axis=0).reshape(-1)
    state_scale_t = tensor(state_scale)
    net_state = perceptron(
        count + training.design.shape[1], len(state_scale), options.width, options.depth, "algebraic", trainer.seed
    )

    def state_loss(rows):
        actuation, design, displacement, slope, y = (
            parts["validation"] if rows is None else [v[rows] for v in parts["train"]]
        )
        at_rest = torch.cat([zero.expand(len(design), -1), design], dim=1)
        both = net_state(torch.cat([torch.cat([actuation, design], dim=1), at_rest]))
        residual = (both[: len(design)] - both[len(design) :]) * state_scale_t
        predicted = ((slope + residual.reshape(slope.shape)) @ displacement[:, :, None])[:, :, 0]
        return (((predicted - y) / y_scale) ** 2).mean()

    histories["state"] = trainer.optimise("state", net_state, state_loss, len(training.design))
    tensors |= weights(net_state, "state") | {"state_scale": state_scale}

    # 3. The compliance, whitened by its rest value.
    whitened = {}
    for key, arrays in (("train", training), ("validation", validation)):
        C0 = np.linalg.cholesky(arrays.W[arrays.rest_of])
        half = np.linalg.solve(C0, arrays.W)
        T = np.linalg.cholesky(np.linalg.solve(C0, np.swapaxes(half, 1, 2)))
        whitened[key] = _log_cholesky(T)
    compliance_scale = mean_scale(whitened["train"])[1]
    wanted = {k: tensor(standardise(v, 0.0, compliance_scale)) for k, v in whitened.items()}
    net_compliance = perceptron(
        count + training.design.shape[1], len(compliance_scale), options.width, options.depth, "algebraic", trainer.seed
    )

    def compliance_loss(rows):
        key = "validation" if rows is None else "train"
        actuation, design = parts[key][0], parts[key][1]
        y = wanted[key]
        if rows is not None:
            actuation, design, y = actuation[rows], design[rows], y[rows]
        at_rest = torch.cat([zero.expand(len(design), -1), design], dim=1)
        both = net_compliance(torch.cat([torch.cat([actuation, design], dim=1), at_rest]))
        return ((both[: len(design)] - both[len(design) :] - y) ** 2).mean()

    histories["compliance"] = trainer.optimise("compliance", net_compliance, compliance_loss, len(training.design))
    tensors |= weights(net_compliance, "compliance") | {"compliance_scale": compliance_scale}
    return tensors, histories
