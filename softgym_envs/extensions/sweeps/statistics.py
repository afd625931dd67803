"""Interquartile means with bootstrap intervals.

As defined by Agarwal et al., Deep reinforcement learning at the edge of the statistical precipice, 2021, and their
package rliable; computed with `scipy.stats`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats


@dataclass(frozen=True)
class Estimate:
    """A value and the interval of its bootstrap distribution, which is NaN if nothing can be resampled."""

    value: float
    low: float
    high: float


def interquartile_mean(scores: np.ndarray) -> float:
    """Return the mean of the middle half of all scores, of any shape: without a quarter of them at either end."""
    return float(stats.trim_mean(np.ravel(scores), 0.25))


def stratified_estimate(scores: np.ndarray, *, resamples: int = 2000) -> Estimate:
    """Return the interquartile mean over all runs and tasks; the interval resamples the runs of each task separately.

    Args:
        scores: comparable scores, shape (runs, tasks); a run is one training seed.
        resamples: number of resamples of the 95 % bootstrap interval.

    Raises:
        ValueError: for another shape or scores that are not finite.
    """
    scores = _checked(scores)
    if len(scores) < 2:
        return Estimate(interquartile_mean(scores), np.nan, np.nan)

    def statistic(*columns: np.ndarray, axis: int = -1) -> np.ndarray:
        return stats.trim_mean(np.concatenate(columns, axis=-1), 0.25, axis=-1)

    return bootstrap(tuple(scores.T), statistic, resamples)


def crossed_estimate(scores: np.ndarray, *, resamples: int = 2000) -> Estimate:
    """Return the interquartile mean over seeds and goals of one environment; the interval resamples both.

    All goals share the policy of a seed, and all seeds share the goals, so the entries must not be resampled one by
    one. Resampling whole rows and whole columns is Owen's pigeonhole bootstrap (2007). Its intervals are too wide for
    many seeds; for three seeds that differ as much as goals, a 95 % interval covers 78 %.

    Args:
        scores: shape (seeds, goals); an axis of length one is not resampled.
        resamples: number of resamples of the 95 % bootstrap interval.

    Raises:
        ValueError: for another shape or scores that are not finite.
    """
    scores = _checked(scores)
    rows, columns = (np.arange(size) for size in scores.shape)
    drawn = tuple(index for index in (rows, columns) if len(index) > 1)
    if not drawn:
        return Estimate(interquartile_mean(scores), np.nan, np.nan)

    def statistic(*indices: np.ndarray, axis: int = -1) -> np.ndarray:
        chosen = list(indices)
        i = chosen.pop(0) if len(rows) > 1 else rows
        j = chosen.pop(0) if len(columns) > 1 else columns
        table = scores[i[..., :, None], j[..., None, :]]
        return stats.trim_mean(table.reshape(*table.shape[:-2], -1), 0.25, axis=-1)

    return bootstrap(drawn, statistic, resamples)


def _checked(scores: np.ndarray) -> np.ndarray:
    scores = np.asarray(scores, dtype=float)
    if scores.ndim != 2 or scores.size == 0 or not np.isfinite(scores).all():
        raise ValueError(f"scores must be a finite table (seeds, tasks or goals), got shape {scores.shape}")
    return scores


def bootstrap(samples: tuple[np.ndarray, ...], statistic: Callable[..., Any], resamples: int) -> Estimate:
    """Return the statistic of samples, and its percentile interval when each sample is resampled."""
    result = stats.bootstrap(
        samples,
        statistic,
        vectorized=True,
        method="percentile",
        n_resamples=resamples,
        batch=100,
        rng=np.random.default_rng(0),
    )
    low, high = result.confidence_interval
    return Estimate(float(statistic(*samples)), float(low), float(high))
