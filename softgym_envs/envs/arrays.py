"""Helpers for code that computes with NumPy arrays as well as torch tensors."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")

#: A NumPy array, or a torch tensor in `TorchVectorEnv`.
Array = Any
#: A tuple, as torch.compile cannot trace the union of types.
_NUMPY_TYPES = (np.ndarray, np.generic)


def namespace(array: Array) -> Any:
    """Return the module whose functions take ``array``: ``numpy`` or ``torch``."""
    if isinstance(array, _NUMPY_TYPES):
        return np
    import torch

    return torch


def with_tensors(original: T, put: Callable[[np.ndarray], Any]) -> T:
    """Return a copy of an object whose arrays are tensors, made by ``put``."""
    twin = copy.copy(original)
    for name, value in vars(original).items():
        if isinstance(value, np.ndarray):
            setattr(twin, name, put(value))
    return twin


def pick_rows(values: Array, index: Array) -> Array:
    """Return ``values[b, index[b]]`` for every row b.

    Args:
        values: shape (B, p, d).
        index: integers, shape (B,).
    """
    if isinstance(values, np.ndarray):
        return values[np.arange(len(values)), index]
    return values.gather(1, index[:, None, None].expand(-1, 1, values.shape[2]))[:, 0]
