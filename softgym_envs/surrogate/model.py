"""Trained condensed models, evaluated by a compiled kernel or NumPy, whichever is faster: no torch in the hot path.

Every model maps the reached actuator displacement and the design to efforts, effector positions and the compliance.
What depends on the design alone is computed once per body (`context`). All arrays carry a leading batch dimension.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numba import njit

from softgym_envs.designs import DesignSpace
from softgym_envs.errors import WeightsError
from softgym_envs.mechanics.condensation import CondensedModel, Roles
from softgym_envs.robots.robot import Robot
from softgym_envs.surrogate.sampling import learned_variables

__all__ = ["NETWORKS", "Context", "Features", "SurrogateModel", "load_model"]

FORMAT = 1


class Features:
    """Inputs of the networks, all about [-1, 1].

    Args:
        space: design space of the robot.
        learned: design variables that are inputs, in order.
        lower: smallest actuator displacements, shape (n_a,).
        upper: largest actuator displacements, shape (n_a,).
    """

    def __init__(self, space: DesignSpace, learned: tuple[str, ...], lower: np.ndarray, upper: np.ndarray) -> None:
        self.space, self.learned = space, learned
        self.lower, self.upper = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        self.design_size = len(learned) + ("poisson_ratio" in learned)

    def design(self, values: np.ndarray) -> np.ndarray:
        """Scale design values (B, len(space)) in the order of the space; returns (B, design_size)."""
        columns = []
        for name in self.learned:
            variable = self.space[name]
            value = values[:, self.space.names.index(name)]
            columns.append(variable.to_unit(value))
            if name == "poisson_ratio":
                # Near 0.5 everything depends on 1 - 2 nu, over orders of magnitude.
                low, high = np.log(1.0 - 2.0 * variable.low), np.log(1.0 - 2.0 * variable.high)
                columns.append(2.0 * (np.log(1.0 - 2.0 * value) - low) / (high - low) - 1.0)
        return np.stack(columns, axis=-1) if columns else np.zeros((len(values), 0))

    def actuation(self, displacement: np.ndarray) -> np.ndarray:
        """Scale displacements (B, n_a)."""
        return 2.0 * (displacement - self.lower) / (self.upper - self.lower) - 1.0


@dataclass
class Context:
    """What a model knows of B bodies before they are actuated.

    Attributes:
        stiffness: factor of all efforts relative to the baseline stiffness, shape (B, 1).
        arrays: arrays of the model with leading dimension B.
    """

    stiffness: np.ndarray
    arrays: dict[str, np.ndarray]

    def rows(self, index: np.ndarray) -> Context:
        """The context of some of the bodies."""
        return Context(self.stiffness[index], {name: array[index] for name, array in self.arrays.items()})

    def put(self, index: np.ndarray, other: Context) -> None:
        """Overwrite the context of some of the bodies."""
        self.stiffness[index] = other.stiffness
        for name, array in self.arrays.items():
            array[index] = other.arrays[name]


class SurrogateModel(ABC):
    """A learned condensed model of one robot.

    Args:
        robot: the robot the weights are for.
        tensors: weights by name.
        card: the JSON beside the weights.
    """

    network: ClassVar[str]

    def __init__(self, robot: Robot, tensors: Mapping[str, np.ndarray], card: Mapping[str, Any]) -> None:
        self.robot = robot
        self.card = dict(card)
        self.features = Features(robot.design_space, learned_variables(robot), robot.lower, robot.upper)
        self.count = len(robot.actuators)
        self.effectors = 3 * len(robot.effectors)
        self.size = self.count + self.effectors
        self.roles: Roles = (("a", self.count), ("e", self.effectors))

    def context(self, designs: np.ndarray) -> Context:
        """Prepare bodies: designs (B, len(space)) in the order of the space."""
        variable = self.robot.stiffness_variable
        names = self.robot.design_space.names
        if variable is None:
            stiffness = np.ones((len(designs), 1))
        else:
            stiffness = designs[:, [names.index(variable)]] / self.robot.design_space[variable].baseline
        return Context(stiffness, self._prepare(self.features.design(designs)))

    def state(self, context: Context, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return efforts [N, ...] (B, n_a) and effector positions [m] (B, n_e) at displacements (B, n_a)."""
        effort, effector = self._state(context.arrays, displacement)
        return effort * context.stiffness, effector

    def compliance(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        """Return W, shape (B, n, n), at displacements (B, n_a)."""
        return self._compliance(context.arrays, displacement) / context.stiffness[:, :, None]

    def condensed(self, context: Context, displacement: np.ndarray) -> CondensedModel:
        """Return the condensed models at displacements (B, n_a)."""
        effort, effector = self.state(context, displacement)
        W = self.compliance(context, displacement)
        full = np.concatenate([effort, np.zeros_like(effector)], axis=-1)
        delta = np.concatenate([displacement, effector], axis=-1)
        return CondensedModel(W, delta - np.einsum("bij,bj->bi", W, full), full, self.roles)

    @abstractmethod
    def _prepare(self, design: np.ndarray) -> dict[str, np.ndarray]:
        """Arrays of the context from design features (B, design_size)."""

    @abstractmethod
    def _state(self, arrays: dict[str, np.ndarray], displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Efforts at baseline stiffness and effector positions."""

    @abstractmethod
    def _compliance(self, arrays: dict[str, np.ndarray], displacement: np.ndarray) -> np.ndarray:
        """W at baseline stiffness."""


def _layers(tensors: Mapping[str, np.ndarray], prefix: str) -> list[tuple[np.ndarray, np.ndarray]]:
    layers: list[tuple[np.ndarray, np.ndarray]] = []
    while f"{prefix}.{len(layers)}.weight" in tensors:
        k = len(layers)
        # Stored as (out, in); used from the right, so transposed and contiguous.
        weight = np.ascontiguousarray(tensors[f"{prefix}.{k}.weight"].T, dtype=np.float32)
        layers.append((weight, tensors[f"{prefix}.{k}.bias"].astype(np.float32)))
    if not layers:
        raise WeightsError(f"the weights hold no layers named '{prefix}.*'")
    return layers


def _activate(x: np.ndarray) -> np.ndarray:
    """The algebraic sigmoid ``x / sqrt(1 + x^2)``: smooth like tanh, and a few instructions on any machine."""
    return x / np.sqrt(1.0 + x * x)


def _forward(x: np.ndarray, layers: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    for weight, bias in layers[:-1]:
        x = _activate(x @ weight + bias)
    weight, bias = layers[-1]
    return x @ weight + bias


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _rows_forward(x, first, prepared, hidden, hidden_bias, last, last_bias, out):
    """Perceptron of every row: ``prepared`` (B, w) holds the design's share of the first layer."""
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


#: From this many rows on, matrix products of NumPy beat the compiled loop over rows (``softgym bench inference``).
_BATCH = 32


class _ActuatedNet:
    """A perceptron of (actuation, design) whose design part is prepared once per body."""

    def __init__(self, layers: list[tuple[np.ndarray, np.ndarray]], count: int) -> None:
        (first, self._bias), *hidden, (self._last, self._last_bias) = layers
        self._first = np.ascontiguousarray(first[:count])
        self._design = np.ascontiguousarray(first[count:])
        width = first.shape[1]
        self._hidden = np.stack([w for w, _ in hidden]) if hidden else np.zeros((0, width, width), dtype=np.float32)
        self._hidden_bias = np.stack([b for _, b in hidden]) if hidden else np.zeros((0, width), dtype=np.float32)

    def prepare(self, design: np.ndarray) -> np.ndarray:
        """Share of the design features (B, d) in the first layer, shape (B, width)."""
        return design @ self._design + self._bias

    def __call__(self, actuation: np.ndarray, prepared: np.ndarray) -> np.ndarray:
        """Outputs (B, k) at scaled actuation (B, n_a) of bodies prepared as (B, width)."""
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


class ResidualModel(SurrogateModel):
    """Structured network: equal to its rest pair at rest, W always symmetric positive definite.

    A rest network G gives, for a design, the Cholesky factor ``C0`` of the rest compliance and the effector at rest.
    A state network N and a compliance network M act as residuals that vanish at rest by construction:

        effort = (K0 + N_K(delta, p) - N_K(0, p)) delta,            K0 = W0_aa^-1
        effector = effector_0 + (W0_ea K0 + N_J(delta, p) - N_J(0, p)) delta
        W = C C^T,  C = C0 T,  T = lower triangular with diagonal exp(d) from  d = M(delta, p) - M(0, p)

    (Thesis eq. 4.2 and 4.12 give the inputs and outputs; the structure is ours.)
    """

    network = "residual"

    def __init__(self, robot: Robot, tensors: Mapping[str, np.ndarray], card: Mapping[str, Any]) -> None:
        super().__init__(robot, tensors, card)
        self._rest = _layers(tensors, "rest")
        self._rest_scale = tensors["rest_scale"].astype(float)
        self._rest_mean = tensors["rest_mean"].astype(float)
        # Each first layer splits into an actuation part and a design part that is known in advance.
        self._nets = {name: _ActuatedNet(_layers(tensors, name), self.count) for name in ("state", "compliance")}
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
        """Lower triangular matrices (B, n, n) with the exponential of the given diagonal."""
        result = np.zeros((len(entries), self.size, self.size))
        entries = entries.copy()
        entries[:, self._diagonal] = np.exp(entries[:, self._diagonal])
        result[:, self._lower[0], self._lower[1]] = entries
        return result

    def _state(self, arrays: dict[str, np.ndarray], displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        correction = self._nets["state"](self.features.actuation(displacement), arrays["state_in"]) * self._state_scale
        slope = arrays["slope"] + correction.reshape(arrays["slope"].shape)
        both = (slope @ displacement[:, :, None])[:, :, 0]
        return both[:, : self.count], arrays["effector"] + both[:, self.count :]

    def _compliance(self, arrays: dict[str, np.ndarray], displacement: np.ndarray) -> np.ndarray:
        d = self._nets["compliance"](self.features.actuation(displacement), arrays["compliance_in"])
        d = (d - arrays["compliance_zero"]) * self._compliance_scale
        C = arrays["C0"] @ self._triangular(d.astype(float))
        return C @ np.swapaxes(C, 1, 2)


class ThesisModel(SurrogateModel):
    """The thesis' network (eq. 4.2, 4.11, 4.12): two ReLU perceptrons.

    G maps the design to (W0, free0), F maps (delta, W0, free0) to (W, free).

    Effector rows of free0 and free are absolute positions, which standardisation makes equivalent to the thesis'
    displacements from a goal. W is symmetric but not kept positive definite.
    """

    network = "thesis"

    def __init__(self, robot: Robot, tensors: Mapping[str, np.ndarray], card: Mapping[str, Any]) -> None:
        super().__init__(robot, tensors, card)
        self._rest, self._main = _layers(tensors, "rest"), _layers(tensors, "main")
        self._tensors = {k: tensors[k].astype(float) for k in ("rest_mean", "rest_scale", "main_mean", "main_scale")}
        self._upper = np.triu_indices(self.size)

    @staticmethod
    def _relu(x: np.ndarray, layers: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        for weight, bias in layers[:-1]:
            x = np.maximum(x @ weight + bias, 0.0)
        weight, bias = layers[-1]
        return x @ weight + bias

    def _prepare(self, design: np.ndarray) -> dict[str, np.ndarray]:
        return {"rest": self._relu(design.astype(np.float32), self._rest)}

    def _outputs(self, arrays: dict[str, np.ndarray], displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = np.concatenate([self.features.actuation(displacement).astype(np.float32), arrays["rest"]], axis=1)
        y = self._relu(x, self._main).astype(float) * self._tensors["main_scale"] + self._tensors["main_mean"]
        W = np.empty((len(y), self.size, self.size))
        entries = len(self._upper[0])
        W[:, self._upper[0], self._upper[1]] = y[:, :entries]
        W[:, self._upper[1], self._upper[0]] = y[:, :entries]
        return W, y[:, entries:]

    def _state(self, arrays: dict[str, np.ndarray], displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        W, free = self._outputs(arrays, displacement)
        a, e = slice(0, self.count), slice(self.count, self.size)
        effort = np.linalg.solve(W[:, a, a], (displacement - free[:, a])[:, :, None])
        return effort[:, :, 0], (W[:, e, a] @ effort)[:, :, 0] + free[:, e]

    def _compliance(self, arrays: dict[str, np.ndarray], displacement: np.ndarray) -> np.ndarray:
        return self._outputs(arrays, displacement)[0]


NETWORKS: dict[str, type[SurrogateModel]] = {model.network: model for model in (ResidualModel, ThesisModel)}
"""Registry of network kinds."""


def load_model(folder: str | Path, robot: Robot) -> SurrogateModel:
    """Load weights (``model.safetensors``) and their card (``model.json``) for a robot.

    Raises:
        WeightsError: if a file is missing, truncated, of another version or for another robot; the message names the
            file and what was expected.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    folder = Path(folder)
    card_path, weights_path = folder / "model.json", folder / "model.safetensors"
    for path in (card_path, weights_path):
        if not path.is_file():
            raise WeightsError(f"weights file '{path}' does not exist; train it with 'softgym fit'")
    try:
        card = json.loads(card_path.read_text())
    except ValueError as error:
        raise WeightsError(f"weights card '{card_path}' is not valid JSON: {error}") from None
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise WeightsError(f"weights card '{card_path}' is not of format {FORMAT}")
    if card.get("network") not in NETWORKS:
        raise WeightsError(f"'{card_path}': unknown network {card.get('network')!r}; allowed: {', '.join(NETWORKS)}")
    if card.get("robot") != robot.name or card.get("signature") != robot.signature:
        wanted = {"robot": robot.name, **robot.signature}
        found = {"robot": card.get("robot"), **card.get("signature", {})}
        different = sorted(k for k in wanted if wanted[k] != found.get(k))
        raise WeightsError(
            f"weights '{folder.name}' were trained for another robot: "
            + ", ".join(f"{k} = {found.get(k)!r}, asked {wanted[k]!r}" for k in different)
            + "; use backend='fem' or train weights with 'softgym fit'"
        )
    bounds = {n: [v.low, v.high, v.unit] for n, v in robot.design_space.variables.items()}
    ranges = [[actuator.low, actuator.high] for actuator in robot.actuators]
    for name, asked in (("design_variables", bounds), ("actuators", ranges)):
        if card.get(name) != asked:
            raise WeightsError(f"weights '{folder.name}' are for other {name}: {card.get(name)}, asked {asked}")
    try:
        tensors = load_file(weights_path)
    except (SafetensorError, OSError, ValueError) as error:
        raise WeightsError(f"weights '{weights_path}' are damaged or truncated: {error}") from None
    try:
        return NETWORKS[card["network"]](robot, tensors, card)
    except (KeyError, ValueError, IndexError) as error:
        raise WeightsError(f"weights '{weights_path}' do not fit network '{card['network']}': {error}") from None
