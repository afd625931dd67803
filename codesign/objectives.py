"""What a body is judged by. A score is larger for a better body, whatever the objective."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

__all__ = ["OBJECTIVES", "Objective", "rank_key", "violations"]


@dataclass(frozen=True)
class Objective:
    """One way to judge an evaluation.

    Args:
        key: field of a trial's evaluation, see `codesign.phases.trial.assess`.
        label: for people.
        unit: unit that people read.
        scale: from SI to ``unit``.
        sign: 1 if more is better, -1 if less is.
        per_goal: field that has its value for each goal, where there is one.
        of_body: whether it is a property of the body alone.
    """

    key: str
    label: str
    unit: str
    scale: float
    sign: int
    per_goal: str = ""
    of_body: bool = False

    def score(self, record: Mapping[str, Any]) -> float:
        """Score of a stored evaluation, larger is better [SI]."""
        return self.sign * float(record[self.key])

    def shown(self, score: Any) -> Any:
        """The value of the objective behind a score, or an array of them, in ``unit``."""
        return self.sign * score * self.scale

    def text(self, score: float | None) -> str:
        """The value of the objective behind a score, with its unit."""
        if score is None:
            return "-"
        return f"{self.shown(score):.{1 if self.unit == '%' else 2}f}{' ' + self.unit if self.unit else ''}"


OBJECTIVES: dict[str, Objective] = {
    objective.key: objective
    for objective in (
        Objective("success_rate", "Success rate", "%", 100.0, 1, "successes"),
        Objective("mean_distance", "Mean final distance", "mm", 1e3, -1, "distances"),
        Objective("mean_return", "Mean return", "", 1.0, 1, "returns"),
        Objective("mean_tracking_distance", "Mean tracking distance", "mm", 1e3, -1, "mean_distances"),
        Objective("mean_effort", "Mean actuator effort", "", 1.0, -1, "efforts"),
        Objective("material_volume", "Material volume", "cm3", 1e6, -1, of_body=True),
    )
}
"""Registry: name to objective."""


def violations(limits: Mapping[str, float], record: Mapping[str, Any]) -> list[float]:
    """By how much an evaluation breaks each limit [SI]; not positive where it keeps it."""
    return [-(OBJECTIVES[name].sign) * (float(record[name]) - limit) for name, limit in limits.items()]


def rank_key(score: float, record: Mapping[str, Any]) -> tuple[float, float]:
    """Sort key of an evaluation, larger is better; equal scores are told apart by the mean distance."""
    return (score, -float(record["mean_distance"]))
