"""One actuator of a robot, as a user declares it."""

from __future__ import annotations

import numbers
from dataclasses import dataclass

import numpy as np

from softgym_envs.arguments import explained
from softgym_envs.quantities import check_by_unit, check_unit
from softgym_envs.wording import brief


@explained
@dataclass(frozen=True)
class Actuator:
    """One actuator of a robot.

    Args:
        name: identifier.
        low: smallest commanded displacement [unit].
        high: largest commanded displacement [unit].
        rate: largest change of the command per control step [unit].
        unit: SI unit of displacement.
        unilateral: whether it cannot push.
        max_effort: largest effort either way; beyond it a commanded displacement is not reached.

    Raises:
        ValueError: for a unit that is not SI, an empty, infinite or implausible range, one without zero, which is the
            command at rest, a rate or largest effort that is not positive, or a rate beyond the range.
    """

    name: str
    low: float
    high: float
    rate: float
    unit: str = "m"
    unilateral: bool = True
    max_effort: float = np.inf

    def __post_init__(self) -> None:
        """Check the numbers."""
        for label in ("low", "high", "rate", "max_effort"):
            value = getattr(self, label)
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
