"""One actuator of a robot, as a user declares it."""

from __future__ import annotations

import numbers
from dataclasses import dataclass

import numpy as np

from softgym_envs.arguments import explained
from softgym_envs.quantities import check_by_unit, check_unit
from softgym_envs.units import effort_unit
from softgym_envs.wording import brief


@explained
@dataclass(frozen=True)
class Actuator:
    """One actuator of a robot, commanded in displacement or, with an ``effort_rate``, in effort.

    Args:
        name: identifier.
        low: smallest commanded displacement [unit].
        high: largest commanded displacement [unit].
        rate: largest change of the command per control step [unit].
        unit: SI unit of displacement.
        unilateral: whether it cannot push.
        max_effort: largest effort either way; beyond it a commanded displacement is not reached.
        effort_rate: largest change of a commanded effort per control step [Pa for a volume, N for a length]. Given, the
            command is the effort, up to ``max_effort``, as that of a pressure valve or of a weight on a cable; ``low``
            and ``high`` then say which displacements occur, which models learn and observations are scaled by.

    Raises:
        ValueError: for a unit that is not SI, an empty, infinite or implausible range, one without zero, which is the
            command at rest, a rate or largest effort that is not positive, a rate beyond the range, or an effort rate
            without a largest effort.
    """

    name: str
    low: float
    high: float
    rate: float
    unit: str = "m"
    unilateral: bool = True
    max_effort: float = np.inf
    effort_rate: float | None = None

    def __post_init__(self) -> None:
        """Check the numbers."""
        for label in ("low", "high", "rate", "max_effort", "effort_rate"):
            value = getattr(self, label)
            if label == "effort_rate" and value is None:
                continue
            if not isinstance(value, numbers.Real) or isinstance(value, bool):
                raise ValueError(f"actuator '{self.name}': {label} = {brief(value)} must be a number")
        check_unit(self.unit, f"actuator '{self.name}'")
        if not (np.isfinite([self.low, self.high]).all() and self.low < self.high):
            raise ValueError(f"actuator '{self.name}': low {self.low:g} must be below high {self.high:g}, both finite")
        if not self.low <= 0.0 <= self.high:
            raise ValueError(
                f"actuator '{self.name}': the range {self.low:g} to {self.high:g} {self.unit} must contain 0, which is "
                "its command at rest"
            )
        for label, value in (("rate", self.rate), ("max_effort", self.max_effort)):
            if not value > 0.0:
                raise ValueError(f"actuator '{self.name}': {label} = {value:g} must be positive")
        furthest = max(self.low, self.high, key=abs)
        check_by_unit(self.unit, furthest, f"actuator '{self.name}': {'high' if furthest > 0.0 else 'low'}")
        span = self.high - self.low
        if span < self.rate < np.inf:
            raise ValueError(
                f"actuator '{self.name}': rate = {self.rate:g} {self.unit} in a control step exceeds its range of "
                f"{span:g} {self.unit}; check its unit, or pass inf for no limit"
            )
        if self.effort_rate is not None and not 0.0 < self.effort_rate <= self.max_effort < np.inf:
            raise ValueError(
                f"actuator '{self.name}': effort_rate = {self.effort_rate:g} needs a finite max_effort, the largest "
                f"command, and must be positive and not beyond it, got max_effort = {self.max_effort:g}"
            )

    @property
    def by_effort(self) -> bool:
        """Whether its command is its effort, not its displacement."""
        return self.effort_rate is not None

    @property
    def command_unit(self) -> str:
        """SI unit of its command."""
        return effort_unit(self.unit) if self.by_effort else self.unit

    @property
    def command_range(self) -> tuple[float, float]:
        """Smallest and largest command [command_unit]."""
        if not self.by_effort:
            return self.low, self.high
        return 0.0 if self.unilateral else -self.max_effort, self.max_effort

    @property
    def command_rate(self) -> float:
        """Largest change of the command per control step [command_unit]."""
        return self.rate if self.effort_rate is None else self.effort_rate
