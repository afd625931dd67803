"""Intervals and correlations of what a study measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softgym_envs.codesign.goals import Stratum, first_goals
from softgym_envs.codesign.records import Record

CONFIDENCE = 0.95
RESAMPLES = 10_000
MIN_GOALS = 5
"""Fewest goals for an interval: from fewer goals it would be meaningless."""

Interval = tuple[float, float] | None
"""Ends of a 95 % interval; None with fewer than `MIN_GOALS` goals."""


def mean_interval(table: np.ndarray, minus: np.ndarray | None = None) -> Interval:
    """Return the interval of a mean, or of the difference of two, over goals and training seeds.

    Both tables have the same goals, but each has its own seeds. The interval is Student's. With several seeds the
    variance over the seeds is added to that over the goals, with Satterthwaite's degrees of freedom (1946). It covers
    95 % for a normal distribution, and 93 to 99 % with two to five seeds. If most goals do not change and a few change
    much it covers less: 75 % over 12 goals, 89 % over 40; a bootstrap is no better.

    Args:
        table: values, shape (seeds, goals).
        minus: values to subtract, shape (other seeds, goals).
    """
    from scipy.stats import t

    tables = [table] if minus is None else [table, minus]
    goals = table.mean(axis=0) - (0.0 if minus is None else minus.mean(axis=0))
    samples = [goals] + [each.mean(axis=1) for each in tables]
    if len(goals) < MIN_GOALS:
        return None
    # Variances of a mean, and their degrees of freedom.
    parts = [(x.var(ddof=1) / len(x), len(x) - 1) for x in samples if len(x) > 1]
    variance = sum(v for v, _ in parts)
    mean = float(goals.mean())
    if variance == 0.0:
        return mean, mean
    freedom = variance**2 / sum(v * v / f for v, f in parts)
    half = float(t.ppf(0.5 + 0.5 * CONFIDENCE, freedom) * np.sqrt(variance))
    return mean - half, mean + half


@dataclass(frozen=True, eq=False)
class MeshPart(Record):
    """What is left of a mesh's error in a change [SI].

    Attributes:
        goals: number of goals on the finer mesh.
        ratio: size of its elements over that of the coarser mesh.
        before: mean change at these goals on the coarser mesh.
        left: mean of what is left, over all goals.
        left_interval: interval of this mean over goals; with few goals it reaches from the smallest to the largest.
        interval: interval of the change on the coarser mesh, widened by `left_interval`.
    """

    goals: int
    ratio: float
    before: float
    left: float
    left_interval: tuple[float, float]
    interval: Interval


def mesh_part(
    coarse: np.ndarray, fine: np.ndarray, ratio: float, interval: Interval, strata: Sequence[Stratum] = ()
) -> MeshPart:
    """Return what is left of a mesh's error in a change, from the same change on a finer mesh.

    The error is taken as linear in the size of the elements, as sharp edges make it: at each goal
    ``(fine - coarse) / (1 - ratio)`` is left. The scatter of its mean over goals comes from bootstrapping them. Goals
    of several kinds are bootstrapped kind by kind, and the mean over all goals is that of the kinds, weighted by their
    shares.

    Args:
        coarse: the change at the goals of the finer mesh, on the coarser one, shape (k,).
        fine: the same on the finer mesh.
        ratio: size of the finer mesh's elements over that of the coarser mesh's, below 1.
        interval: of the change at all goals, on the coarser mesh.
        strata: kinds of goals, in the order of the changes; default: one.
    """
    left = (np.asarray(fine) - np.asarray(coarse)) / (1.0 - ratio)
    rng, start, mean, means = np.random.default_rng(0), 0, 0.0, np.zeros(RESAMPLES)
    for stratum in strata or first_goals(len(left), len(left)):
        part = left[start : start + len(stratum.numbers)]
        start += len(part)
        mean += stratum.share * float(part.mean())
        means += stratum.share * part[rng.integers(len(part), size=(RESAMPLES, len(part)))].mean(axis=1)
    tails = 0.5 * (1.0 - CONFIDENCE)
    low, high = (float(end) for end in np.quantile(means, (tails, 1.0 - tails)))
    whole = None if interval is None else (interval[0] + min(low, 0.0), interval[1] + max(high, 0.0))
    return MeshPart(len(left), ratio, float(np.mean(coarse)), mean, (low, high), whole)


def rate_interval(successes: np.ndarray) -> Interval:
    """Return the interval of a success rate: Wilson's over goals, widened to `mean_interval` with several seeds.

    Wilson's interval counts each goal once, whatever the number of seeds: several policies that reach all goals say
    little more about other goals than one does.

    Args:
        successes: shape (seeds, goals).
    """
    from scipy.stats import binomtest

    goals, reached = successes.shape[1], float(successes.mean(axis=0).sum())
    if goals < MIN_GOALS:
        return None
    # Round fractions of goals in the direction that widens the interval.
    ends = (int(np.floor(reached + 1e-9)), int(np.ceil(reached - 1e-9)))
    low, high = (binomtest(k, goals).proportion_ci(CONFIDENCE, method="wilson") for k in ends)
    found = float(low.low), float(high.high)
    wide = mean_interval(successes) if len(successes) > 1 else None
    return found if wide is None else (max(min(found[0], wide[0]), 0.0), min(max(found[1], wide[1]), 1.0))


def rank_correlation(first: Sequence[float], second: Sequence[float]) -> float | None:
    """Return Spearman's rank correlation; None with fewer than three pairs or without any variation."""
    from scipy.stats import spearmanr

    return None if _alike(first, second) else float(spearmanr(first, second).statistic)


def kendall_tau(first: Sequence[float], second: Sequence[float]) -> float | None:
    """Return Kendall's tau-b: the share of pairs in the same order minus that in opposite order, corrected for ties.

    None with fewer than three pairs or without any variation.
    """
    from scipy.stats import kendalltau

    return None if _alike(first, second) else float(kendalltau(first, second).statistic)


def _alike(first: Sequence[float], second: Sequence[float]) -> bool:
    return len(first) < 3 or np.ptp(first) == 0.0 or np.ptp(second) == 0.0
