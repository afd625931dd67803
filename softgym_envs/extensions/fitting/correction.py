"""Fit of the correction of efforts for the error of a mesh, from states on finer and coarser ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from softgym_envs.errors import DataError
from softgym_envs.surrogate.correction import EffortCorrection

LOWEST_ORDER, HIGHEST_ORDER = 0.5, 4.0
"""Bounds of observed orders: orders of meshes that are not nested scatter."""


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
