"""Plain perceptrons, the parts of the residual network and of the thesis' network."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from softgym_envs.errors import WeightsError


def layers(tensors: Mapping[str, np.ndarray], prefix: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return weights (in, out) and biases of the perceptron with a prefix, in single precision."""
    found: list[tuple[np.ndarray, np.ndarray]] = []
    while f"{prefix}.{len(found)}.weight" in tensors:
        k = len(found)
        # Stored as (out, in) but multiplied from the right, hence transposed and made contiguous.
        weight = np.ascontiguousarray(tensors[f"{prefix}.{k}.weight"].T, dtype=np.float32)
        found.append((weight, tensors[f"{prefix}.{k}.bias"].astype(np.float32)))
    if not found:
        raise WeightsError(f"the weights have no layers named '{prefix}.*'")
    return found


def perceptron(
    inputs: int, outputs: int, width: int, depth: int, activation: str, seed: int, dropout: float = 0.0
) -> Any:
    """Return a torch perceptron with seeded weights.

    Args:
        inputs: number of inputs.
        outputs: number of outputs.
        width: units of each hidden layer.
        depth: number of hidden layers.
        activation: ``"algebraic"`` or ``"relu"``.
        seed: seed of the weights.
        dropout: share of the units of each hidden layer that is left out at a training step.
    """
    import torch
    from torch import nn

    class AlgebraicSigmoid(nn.Module):
        def forward(self, x):
            return x * torch.rsqrt(1.0 + x * x)

    torch.manual_seed(seed)
    sizes = [inputs, *([width] * depth)]
    parts: list[nn.Module] = []
    for a, b in zip(sizes[:-1], sizes[1:], strict=True):
        parts += [nn.Linear(a, b), AlgebraicSigmoid() if activation == "algebraic" else nn.ReLU()]
        if dropout:
            parts.append(nn.Dropout(dropout))
    parts.append(nn.Linear(width, outputs))
    return nn.Sequential(*parts)


def weights(net, prefix: str) -> dict[str, np.ndarray]:
    """Return the tensors of a perceptron under the names that `layers` expects."""
    from torch import nn

    linear = [layer for layer in net if isinstance(layer, nn.Linear)]
    tensors = {}
    for k, layer in enumerate(linear):
        tensors[f"{prefix}.{k}.weight"] = layer.weight.detach().numpy().copy()
        tensors[f"{prefix}.{k}.bias"] = layer.bias.detach().numpy().copy()
    return tensors


def mean_scale(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and scale of columns. A constant column has scale 0, so its prediction is its mean."""
    scale = values.std(axis=0)
    return values.mean(axis=0), np.where(scale > 1e-12 * np.abs(values).max(), scale, 0.0)


def standardise(values: np.ndarray, mean: np.ndarray | float, scale: np.ndarray) -> np.ndarray:
    """Return values in units of their scale; constant columns become 0."""
    return np.where(scale > 0.0, (values - mean) / np.where(scale > 0.0, scale, 1.0), 0.0)
