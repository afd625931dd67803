"""Correction of the efforts of a learned model for the error of the mesh it was learned on.

The tip of a body converges quickly with its mesh. The efforts converge slowly if strains are singular at sharp edges,
but their ratio on two meshes hardly depends on the state, only a little on the body. A few states on finer and coarser
meshes therefore give a factor, a function of the design alone, by which the learned efforts are multiplied and the
compliances divided, as by a change of Young's modulus. So ``W`` remains the exact, positive definite derivative.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

    Array = TypeVar("Array", np.ndarray, Tensor)


@dataclass(frozen=True)
class EffortCorrection:
    """Factor of the efforts, ``exp(constant + slopes . features)`` for the scaled features of a design.

    Attributes:
        constant: logarithm of the factor in the middle of the design box.
        slopes: its change from the middle to the end of each feature, shape (d,); empty for a constant factor.
        order: observed order of convergence of the efforts.
        scatter: root mean square deviation of the logarithm for bodies that are left out of the fit.
        states: number of states behind it.
    """

    constant: float = 0.0
    slopes: tuple[float, ...] = ()
    order: float = 1.0
    scatter: float = 0.0
    states: int = 0

    def factor(self, features: Array) -> Array:
        """Return the factor of each row of features (B, d), shape (B, 1)."""
        exponent = 0.0 * features[:, :1].sum(1) + self.constant
        for k, slope in enumerate(self.slopes):
            exponent = exponent + slope * features[:, k]
        power = np.exp(exponent) if isinstance(exponent, np.ndarray) else sys.modules["torch"].exp(exponent)
        return power[:, None]

    @classmethod
    def of_card(cls, card: Mapping[str, Any], features: int) -> EffortCorrection:
        """Read the correction from a model's card; without one the factor is 1.

        Raises:
            ValueError: if it does not fit the number of features.
        """
        given = dict(card.get("correction") or {})
        try:
            found = cls(**{**given, "slopes": tuple(given.get("slopes", ()))})
        except TypeError as error:
            raise ValueError(f"the correction of the card is malformed: {error}") from None
        if len(found.slopes) not in (0, features):
            raise ValueError(f"the card's correction has {len(found.slopes)} slopes for {features} features")
        return found
