"""Random numbers of many episodes, each from a generator of its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


class RowRandom:
    """Draws for B episodes, row k from generator k; the `Random` of tasks outside of tensors.

    A row gets the numbers that its generator would give alone, whatever the other rows are.

    Args:
        generators: one for each row.
    """

    def __init__(self, generators: Sequence[np.random.Generator]) -> None:
        self._generators = generators

    def uniform(self, low: Any, high: Any, size: Any) -> np.ndarray:
        """Draw uniformly between ``low`` and ``high``, shape ``size`` = (B, ...)."""
        return low + (np.asarray(high) - low) * self.random(size)

    def random(self, size: Any) -> np.ndarray:
        """Draw uniformly between 0 and 1, shape ``size`` = (B, ...)."""
        return self._filled(size, "random")

    def normal(self, size: Any) -> np.ndarray:
        """Draw from the standard normal distribution, shape ``size`` = (B, ...)."""
        return self._filled(size, "standard_normal")

    def integers(self, low: int, *, size: Any) -> np.ndarray:
        """Draw integers from 0 to ``low - 1``, shape ``size`` = (B, ...)."""
        shape = self._row_shape(size)
        return np.stack([generator.integers(low, size=shape) for generator in self._generators])

    def _filled(self, size: Any, method: str) -> np.ndarray:
        found = np.empty((len(self._generators), *self._row_shape(size)))
        for row, generator in zip(found.reshape(len(found), -1), self._generators, strict=True):
            getattr(generator, method)(out=row)
        return found

    def _row_shape(self, size: Any) -> tuple[int, ...]:
        shape = (size,) if isinstance(size, int | np.integer) else tuple(size)
        if not shape or shape[0] != len(self._generators):
            raise ValueError(
                f"size = {size!r} of random numbers must begin with the number of episodes, {len(self._generators)}"
            )
        return shape[1:]

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"random numbers of episodes have no '{name}'; allowed: uniform, random, normal, integers")
