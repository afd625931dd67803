"""Scoring of a body: its metrics and what they cost, or the reason why it has none."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

import numpy as np

from softgym_envs.codesign.metrics.metric import Metric
from softgym_envs.codesign.records import Score
from softgym_envs.envs.parallel import cpu_seconds
from softgym_envs.errors import ConvergenceError, InfeasibleDesign


@contextmanager
def scoring(score: Score, clock: Callable[[], float] = cpu_seconds) -> Iterator[None]:
    """Add the time of a block to a score; a body that cannot exist or be simulated gets a reason instead of scores.

    Only `InfeasibleDesign`, `ConvergenceError` and scores that are not finite make a body infeasible; other exceptions
    are bugs.

    Args:
        score: what the block fills.
        clock: returns CPU seconds [s].
    """
    began, cpu = time.perf_counter(), clock()
    try:
        yield
    except (InfeasibleDesign, ConvergenceError) as error:
        score.reason, score.scores = str(error), []
    if not np.isfinite(score.scores).all():
        score.reason, score.scores = f"the scores are not finite: {score.scores}", []
    score.seconds += time.perf_counter() - began
    score.cpu_seconds += clock() - cpu


class Evaluator(ABC):
    """Scores bodies by metrics; a subclass says what it reads them from.

    Args:
        metrics: the metrics.
    """

    def __init__(self, metrics: tuple[Metric, ...]) -> None:
        self.metrics = metrics

    @abstractmethod
    def measure(self, design: Mapping[str, float]) -> dict[str, float]:
        """Return the metrics of a complete design by name [SI].

        Raises:
            InfeasibleDesign: if the body cannot exist.
            ConvergenceError: if it cannot be simulated.
        """

    def __call__(self, design: Mapping[str, float]) -> Score:
        """Score a complete design [SI]."""
        score = Score(design=dict(design))
        with scoring(score):
            score.values = self.measure(design)
            score.scores = [metric.score(score.values[metric.name]) for metric in self.metrics]
        return score
