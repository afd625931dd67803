"""Correction of the efforts of a learned model for the error of the mesh it was learned on.

The tip of a body converges quickly with its mesh. The efforts converge slowly if strains are singular at sharp edges,
but their ratio on two meshes hardly depends on the state, only a little on the body. A few states on finer and coarser
meshes therefore give a factor, a function of the design alone, by which the learned efforts are multiplied and the
compliances divided, as by a change of Young's modulus. So ``W`` remains the exact, positive definite derivative.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from softgym_envs.errors import DataError

if TYPE_CHECKING:
    from torch import Tensor

    Array = TypeVar("Array", np.ndarray, Tensor)

LOWEST_ORDER, HIGHEST_ORDER = 0.5, 4.0
"""Bounds of observed orders: orders of meshes that are not nested scatter."""


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


def order_of(ratio: float, sizes: Sequence[float]) -> float:
    """Return the order ``p`` of ``f(h) = f(0) + c h^p`` on three meshes, within its bounds.

    Args:
        ratio: difference between the coarse and the middle value over that between the middle and the fine one.
        sizes: of the elements, from coarse to fine.
    """
    coarse, middle, fine = sizes

    def ratio_of(order: float) -> float:
        return (coarse**order - middle**order) / (middle**order - fine**order)

    low, high = LOWEST_ORDER, HIGHEST_ORDER
    if ratio >= ratio_of(high):
        return high
    if ratio <= ratio_of(low):
        return low
    for _ in range(60):
        order = 0.5 * (low + high)
        low, high = (order, high) if ratio_of(order) < ratio else (low, order)
    return order


def fit_correction(
    levels: Sequence[Mapping[str, np.ndarray]], sizes: Sequence[float], features: np.ndarray
) -> EffortCorrection:
    """Fit the factor from the middle mesh to the converged efforts.

    A body's effort on a mesh is the work of its efforts over their displacements at equal commands, ``effort . delta``
    summed over its states. One order is observed for all bodies, from the medians of their differences. The logarithm
    of the factor is linear in some features of the design: they are added one at a time, while that improves the
    prediction for bodies that are left out of the fit.

    Args:
        levels: datasets of the same commands on the coarse, middle and fine mesh.
        sizes: of their elements, from coarse to fine, in any unit.
        features: scaled designs of the rows of the middle level, shape (N, d).

    Raises:
        DataError: if fewer than three bodies have all their states on every mesh, or efforts do not converge.
    """
    works = [_works(level) for level in levels]
    kept = [body for body in works[1] if all(body in work and work[body][1] == works[1][body][1] for work in works)]
    if len(kept) < 3:
        raise DataError(f"only {len(kept)} bodies have all their states on every mesh; a correction needs 3")
    coarse, middle, fine = (np.array([work[body][0] for body in kept]) for work in works)
    order = order_of(float(np.median((coarse - middle) / (middle - fine))), sizes)
    converged = fine + (fine - middle) / ((sizes[1] / sizes[2]) ** order - 1.0)
    factor = converged / middle
    if not (factor > 0.0).all():
        raise DataError(
            f"the efforts of {int((factor <= 0.0).sum())} of {len(kept)} bodies do not converge on meshes of sizes "
            f"{list(sizes)} (observed order {order:.2g}); use finer ones"
        )
    log_factor = np.log(factor)
    rows = {tuple(design): row for row, design in enumerate(levels[1]["design"])}
    x = features[[rows[body] for body in kept]]
    chosen: list[int] = []
    scatter = _left_out(x[:, chosen], log_factor)
    while left := [k for k in range(x.shape[1]) if k not in chosen]:
        errors = [_left_out(x[:, [*chosen, k]], log_factor) for k in left]
        if not min(errors) < scatter:
            break
        scatter = min(errors)
        chosen.append(left[int(np.argmin(errors))])
    coefficients = np.linalg.lstsq(_with_ones(x[:, chosen]), log_factor, rcond=None)[0]
    slopes = np.zeros(x.shape[1])
    slopes[chosen] = coefficients[1:]
    states = sum(works[1][body][1] for body in kept)
    return EffortCorrection(float(coefficients[0]), tuple(map(float, slopes)), float(order), scatter, states)


def _works(data: Mapping[str, np.ndarray]) -> dict[tuple[float, ...], tuple[float, int]]:
    """Return the sum of ``effort . delta`` over the states of each body, and the number of states without rest."""
    found: dict[tuple[float, ...], tuple[float, int]] = {}
    for design, effort, delta, rest in zip(
        *(data[k] for k in ("design", "effort", "displacement", "rest")), strict=True
    ):
        work, count = found.get(tuple(design), (0.0, 0))
        found[tuple(design)] = (work, count) if rest else (work + float(effort @ delta), count + 1)
    return {body: (work, count) for body, (work, count) in found.items() if count}


def _with_ones(x: np.ndarray) -> np.ndarray:
    return np.column_stack([np.ones(len(x)), x])


def _left_out(x: np.ndarray, values: np.ndarray) -> float:
    """Return the root mean square error of a linear fit of values (B,) for rows of x (B, k) that are left out of it."""
    matrix = _with_ones(x)
    if len(matrix) <= matrix.shape[1]:
        return float("inf")
    hat = matrix @ np.linalg.pinv(matrix)
    leverage = np.minimum(np.diag(hat), 1.0 - 1e-9)
    return float(np.sqrt((((values - hat @ values) / (1.0 - leverage)) ** 2).mean()))
