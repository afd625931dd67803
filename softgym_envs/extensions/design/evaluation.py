"""Evaluations of designs: a typed record, and many of them on several processes."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from softgym_envs.codesign.records import Record
from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.executors import parallel_map
from softgym_envs.extensions.design.bodies import Evaluator


@dataclass(frozen=True)
class Evaluation(Record):
    """Metrics of one design, or the reason why it has none."""

    metrics: dict[str, float] = field(default_factory=dict)  # by name [SI]
    infeasible: str | None = None  # why the design has no metrics
    seconds: float = 0.0
    repeated: bool = False  # the sampler had proposed the same design before, and nothing was computed again

    @property
    def feasible(self) -> bool:
        """Whether the design has metrics."""
        return self.infeasible is None


def evaluate(evaluator: Evaluator, design: Mapping[str, float]) -> Evaluation:
    """Evaluate one design. A geometry that cannot exist or has no equilibrium is infeasible."""
    began = time.perf_counter()
    metrics: dict[str, float] = {}
    reason = None
    try:
        metrics = evaluator(design)
    except (InfeasibleDesign, ConvergenceError) as error:
        reason = f"{type(error).__name__}: {error}"
    if not np.isfinite(list(metrics.values())).all():
        reason, metrics = f"metrics are not finite: {metrics}", {}
    return Evaluation(metrics, reason, time.perf_counter() - began)


def evaluate_each(
    evaluator: Evaluator, designs: Iterable[tuple[int, Mapping[str, float]]], workers: int
) -> Iterator[tuple[int, Evaluation]]:
    """Evaluate numbered designs on several processes; yields each number with its evaluation, in any order."""
    yield from parallel_map(_evaluate_one, [(number, evaluator, design) for number, design in designs], workers)


def _evaluate_one(number: int, evaluator: Evaluator, design: Mapping[str, float]) -> tuple[int, Evaluation]:
    return number, evaluate(evaluator, design)
