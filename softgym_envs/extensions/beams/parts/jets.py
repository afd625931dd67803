"""Numbers with first and second derivatives: the arithmetic of a formula gives its derivatives, exactly.

`features` is written once. It is evaluated on `Jet`, of NumPy arrays or of tensors, and in training on tensors alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

Array = Any
"""A NumPy array or a tensor."""

HALF_PI = 0.5 * math.pi


def namespace(values: Array) -> Any:
    """Return NumPy for its arrays, and torch for tensors."""
    if isinstance(values, np.ndarray):
        return np
    import torch

    return torch


def zeros(like: Array, *shape: int) -> Array:
    """Return zeros of a shape, of the kind of an array."""
    return np.zeros(shape) if isinstance(like, np.ndarray) else like.new_zeros(shape)


class Jet:
    """Values of n numbers with their derivatives by m coordinates.

    Attributes:
        value: shape (n,).
        first: shape (n, m).
        second: shape (n, m, m), or None where it is zero.
    """

    __slots__ = ("first", "second", "value")
    __array_priority__ = 100.0  # NumPy arrays leave operations to jets

    def __init__(self, value: Array, first: Array, second: Array | None = None) -> None:
        self.value, self.first, self.second = value, first, second

    @classmethod
    def coordinates(cls, y: Array) -> list[Jet]:
        """Return the coordinates (n, m) themselves, one jet for each of the m."""
        m = y.shape[1]
        firsts = zeros(y, m, *y.shape)
        found = []
        for k in range(m):
            firsts[k, :, k] = 1.0
            found.append(cls(y[:, k], firsts[k]))
        return found

    def __add__(self, other: Any) -> Jet:
        if isinstance(other, Jet):
            return Jet(self.value + other.value, self.first + other.first, _sum(self.second, other.second))
        return Jet(self.value + other, self.first, self.second)

    __radd__ = __add__

    def __neg__(self) -> Jet:
        return Jet(-self.value, -self.first, None if self.second is None else -self.second)

    def __sub__(self, other: Any) -> Jet:
        return self + (-other)

    def __rsub__(self, other: Any) -> Jet:
        return (-self) + other

    def __mul__(self, other: Any) -> Jet:
        if not isinstance(other, Jet):  # a number
            return Jet(self.value * other, self.first * other, None if self.second is None else self.second * other)
        mixed = self.first[:, :, None] * other.first[:, None, :]
        second = mixed + mixed.swapaxes(1, 2)
        if other.second is not None:
            second += self.value[:, None, None] * other.second
        if self.second is not None:
            second += other.value[:, None, None] * self.second
        return Jet(
            self.value * other.value,
            self.value[:, None] * other.first + other.value[:, None] * self.first,
            second,
        )

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Jet:
        if isinstance(other, Jet):
            inverse = 1.0 / other.value
            return self * other.mapped(inverse, -(inverse**2), 2.0 * inverse**3)
        return self * (1.0 / other)

    def mapped(self, value: Array, slope: Array, curvature: Array) -> Jet:
        """Return a function of this number from its values and its first two derivatives, each (n,)."""
        second = curvature[:, None, None] * (self.first[:, :, None] * self.first[:, None, :])
        if self.second is not None:
            second += slope[:, None, None] * self.second
        return Jet(value, slope[:, None] * self.first, second)


def _sum(one: Array | None, other: Array | None) -> Array | None:
    if one is None or other is None:
        return other if one is None else one
    return one + other


class JetFunctions:
    """Functions of jets, by the names that torch has for them."""

    @staticmethod
    def sqrt(x: Jet) -> Jet:
        root = x.value**0.5
        return x.mapped(root, 0.5 / root, -0.25 / (root * x.value))

    @staticmethod
    def log(x: Jet) -> Jet:
        inverse = 1.0 / x.value
        return x.mapped(namespace(x.value).log(x.value), inverse, -(inverse**2))

    @staticmethod
    def cos(x: Jet) -> Jet:
        xp = namespace(x.value)
        c, s = xp.cos(x.value), xp.sin(x.value)
        return x.mapped(c, -s, -c)

    @staticmethod
    def sin(x: Jet) -> Jet:
        xp = namespace(x.value)
        c, s = xp.cos(x.value), xp.sin(x.value)
        return x.mapped(s, c, -s)

    @staticmethod
    def softplus(x: Jet) -> Jet:
        """``log(1 + exp(x))``."""
        xp = namespace(x.value)
        share = 0.5 * (1.0 + xp.tanh(0.5 * x.value))
        value = xp.logaddexp(0.0 * x.value, x.value)
        return x.mapped(value, share, share * (1.0 - share))

    @staticmethod
    def atan2(y: Jet, x: Jet) -> Jet:
        """Angle of the direction (x, y)."""
        square = x.value**2 + y.value**2
        a, b = x.value / square, -y.value / square  # derivatives of the angle by y and x
        first = a[:, None] * y.first + b[:, None] * x.first
        same = 2.0 * a * b
        crossed = (y.value**2 - x.value**2) / square**2
        mixed = y.first[:, :, None] * x.first[:, None, :]
        own = y.first[:, :, None] * y.first[:, None, :] - x.first[:, :, None] * x.first[:, None, :]
        second = same[:, None, None] * own + crossed[:, None, None] * (mixed + mixed.swapaxes(1, 2))
        for scale, part in ((a, y.second), (b, x.second)):
            if part is not None:
                second += scale[:, None, None] * part
        return Jet(namespace(x.value).arctan2(y.value, x.value), first, second)


def columns(parts: Sequence[Any], y: Array) -> tuple[Array, Array]:
    """Return values (n, k) and first derivatives (n, k, m) of k numbers, of which some may be constants.

    Args:
        parts: jets, and numbers or columns (n,) that do not depend on the coordinates.
        y: the coordinates (n, m).
    """
    n, m = y.shape
    values, slopes = zeros(y, n, len(parts)), zeros(y, n, len(parts), m)
    for k, part in enumerate(parts):
        if isinstance(part, Jet):
            values[:, k], slopes[:, k] = part.value, part.first
        else:
            values[:, k] = part
    return values, slopes


def weighted_second(parts: Sequence[Any], weights: Array, y: Array) -> Array:
    """Return the second derivatives (n, m, m) of the sum of k numbers with constant weights (n, k)."""
    n, m = y.shape
    total = zeros(y, n, m, m)
    for k, part in enumerate(parts):
        if isinstance(part, Jet) and part.second is not None:
            total += weights[:, k, None, None] * part.second
    return total
