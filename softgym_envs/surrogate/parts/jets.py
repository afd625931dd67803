"""Numbers with first and second derivatives: the arithmetic of a formula gives its derivatives, exactly.

`features` is written once and evaluated on `Jet` (with NumPy, for elements) or on tensors (in training and on a GPU).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np


class Jet:
    """Values of n numbers with their derivatives by m coordinates.

    Attributes:
        value: shape (n,).
        first: shape (n, m).
        second: shape (n, m, m), or None where it is zero.
    """

    __slots__ = ("first", "second", "value")
    __array_priority__ = 100.0  # NumPy arrays leave operations to jets

    def __init__(self, value: np.ndarray, first: np.ndarray, second: np.ndarray | None = None) -> None:
        self.value, self.first, self.second = value, first, second

    @classmethod
    def coordinates(cls, y: np.ndarray) -> list[Jet]:
        """Return the coordinates (n, m) themselves, one jet for each of the m."""
        n, m = y.shape
        unit = np.eye(m)
        return [cls(y[:, k], np.broadcast_to(unit[k], (n, m))) for k in range(m)]

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
        if not isinstance(other, Jet):
            scale = np.asarray(other)
            second = None if self.second is None else self.second * scale[..., None, None]
            return Jet(self.value * scale, self.first * scale[..., None], second)
        mixed = self.first[:, :, None] * other.first[:, None, :]
        second = mixed + mixed.transpose(0, 2, 1)
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

    def mapped(self, value: np.ndarray, slope: np.ndarray, curvature: np.ndarray) -> Jet:
        """Return a function of this number from its values and its first two derivatives, each (n,)."""
        second = curvature[:, None, None] * (self.first[:, :, None] * self.first[:, None, :])
        if self.second is not None:
            second += slope[:, None, None] * self.second
        return Jet(value, slope[:, None] * self.first, second)


def _sum(one: np.ndarray | None, other: np.ndarray | None) -> np.ndarray | None:
    if one is None or other is None:
        return other if one is None else one
    return one + other


class JetFunctions:
    """Functions of jets, by the names that torch has for them."""

    @staticmethod
    def sqrt(x: Jet) -> Jet:
        root = np.sqrt(x.value)
        return x.mapped(root, 0.5 / root, -0.25 / (root * x.value))

    @staticmethod
    def log(x: Jet) -> Jet:
        inverse = 1.0 / x.value
        return x.mapped(np.log(x.value), inverse, -(inverse**2))

    @staticmethod
    def cos(x: Jet) -> Jet:
        c, s = np.cos(x.value), np.sin(x.value)
        return x.mapped(c, -s, -c)

    @staticmethod
    def sin(x: Jet) -> Jet:
        c, s = np.cos(x.value), np.sin(x.value)
        return x.mapped(s, c, -s)

    @staticmethod
    def softplus(x: Jet) -> Jet:
        """``log(1 + exp(x))``."""
        share = 0.5 * (1.0 + np.tanh(0.5 * x.value))
        return x.mapped(np.logaddexp(0.0, x.value), share, share * (1.0 - share))

    @staticmethod
    def atan2(y: Jet, x: Jet) -> Jet:
        """Angle of the direction (x, y)."""
        square = x.value**2 + y.value**2
        # The derivatives are those of the angle by y and x; only products of first derivatives have curvature.
        a, b = x.value / square, -y.value / square
        first = a[:, None] * y.first + b[:, None] * x.first
        yy = 2.0 * a * b
        xy = (y.value**2 - x.value**2) / square**2
        mixed = y.first[:, :, None] * x.first[:, None, :]
        second = yy[:, None, None] * (
            y.first[:, :, None] * y.first[:, None, :] - x.first[:, :, None] * x.first[:, None, :]
        ) + xy[:, None, None] * (mixed + mixed.transpose(0, 2, 1))
        for scale, part in ((a, y.second), (b, x.second)):
            if part is not None:
                second += scale[:, None, None] * part
        return Jet(np.arctan2(y.value, x.value), first, second)


def columns(parts: Sequence[Jet | float | np.ndarray], n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    """Return values (n, k) and first derivatives (n, k, m) of k numbers, of which some may be constants."""
    values, slopes = np.empty((n, len(parts))), np.zeros((n, len(parts), m))
    for k, part in enumerate(parts):
        if isinstance(part, Jet):
            values[:, k], slopes[:, k] = part.value, part.first
        else:
            values[:, k] = part
    return values, slopes


def weighted_second(parts: Sequence[Any], weights: np.ndarray, m: int) -> np.ndarray:
    """Return the second derivatives (n, m, m) of the sum of k numbers with constant weights (n, k)."""
    total = np.zeros((len(weights), m, m))
    for k, part in enumerate(parts):
        if isinstance(part, Jet) and part.second is not None:
            total += weights[:, k, None, None] * part.second
    return total


HALF_PI = 0.5 * math.pi
