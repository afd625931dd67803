"""Design spaces: named, bounded, dimensioned variables of a robot's body.

A design is a plain mapping ``{name: value}`` in SI units.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from softgym_envs.errors import DesignError

__all__ = ["DesignSpace", "DesignVariable"]


@dataclass(frozen=True)
class DesignVariable:
    """One scalar of a design.

    Args:
        name: identifier, as written in configuration files.
        low: smallest allowed value [unit].
        high: largest allowed value [unit].
        baseline: value of the reference body [unit].
        unit: SI unit, or ``"1"`` for a pure number.
        description: what the variable means to a designer.
        log: sample and normalise on a logarithmic scale.
    """

    name: str
    low: float
    high: float
    baseline: float
    unit: str
    description: str
    log: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high)):
            raise DesignError(f"design variable '{self.name}': low {self.low} and high {self.high} must be finite")
        if not self.low < self.high:
            raise DesignError(f"design variable '{self.name}': low {self.low} must be below high {self.high}")
        if not self.low <= self.baseline <= self.high:
            raise DesignError(
                f"design variable '{self.name}': baseline {self.baseline} is outside [{self.low}, {self.high}]"
            )
        if self.log and self.low <= 0:
            raise DesignError(f"design variable '{self.name}': a logarithmic scale needs low > 0, got {self.low}")

    def check(self, value: object) -> float:
        """Return ``value`` as a float inside the bounds, or raise `DesignError`."""
        unit = "" if self.unit == "1" else f" {self.unit}"
        allowed = f"allowed: {self.low:g} to {self.high:g}{unit}"
        try:
            number = float(value)  # type: ignore[arg-type]
        except (TypeError, ValueError, OverflowError):
            raise DesignError(f"design variable '{self.name}' = {value!r} is not a number; {allowed}") from None
        if not math.isfinite(number):
            raise DesignError(f"design variable '{self.name}' = {number} is not finite; {allowed}")
        # Bounds survive a trip through text or float32 without a false alarm, but nothing more.
        slack = 1e-6 * (self.high - self.low)
        if not self.low - slack <= number <= self.high + slack:
            raise DesignError(f"design variable '{self.name}' = {number:g}{unit} is out of bounds; {allowed}")
        return min(max(number, self.low), self.high)

    def to_unit(self, value: float | np.ndarray) -> np.ndarray:
        """Map [low, high] to [-1, 1]."""
        if self.log:
            low, high, value = math.log(self.low), math.log(self.high), np.log(value)
        else:
            low, high, value = self.low, self.high, np.asarray(value)
        return 2.0 * (value - low) / (high - low) - 1.0

    def from_unit(self, unit_value: float | np.ndarray) -> np.ndarray:
        """Map [-1, 1] to [low, high]; values outside are clipped."""
        fraction = 0.5 * (np.clip(unit_value, -1.0, 1.0) + 1.0)
        if self.log:
            value = np.exp(math.log(self.low) + fraction * math.log(self.high / self.low))
        else:
            value = self.low + fraction * (self.high - self.low)
        return np.clip(value, self.low, self.high)


class DesignSpace:
    """An ordered set of `DesignVariable`."""

    def __init__(self, *variables: DesignVariable) -> None:
        names = [variable.name for variable in variables]
        if len(set(names)) != len(names):
            raise DesignError(f"design variables must have distinct names, got {names}")
        self.variables = MappingProxyType({variable.name: variable for variable in variables})

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the variables, in order."""
        return tuple(self.variables)

    @property
    def baseline(self) -> dict[str, float]:
        """The reference design."""
        return {name: variable.baseline for name, variable in self.variables.items()}

    def __len__(self) -> int:
        return len(self.variables)

    def __getitem__(self, name: str) -> DesignVariable:
        try:
            return self.variables[name]
        except KeyError:
            raise DesignError(f"unknown design variable '{name}'; allowed: {', '.join(self.names)}") from None

    def __reduce__(self) -> tuple[type[DesignSpace], tuple[DesignVariable, ...]]:
        return DesignSpace, tuple(self.variables.values())

    def __repr__(self) -> str:
        return f"DesignSpace({', '.join(self.names)})"

    def complete(self, design: Mapping[str, float] | None = None) -> dict[str, float]:
        """Validate a partial design and fill the rest from the baseline.

        Raises:
            DesignError: for an unknown name, a non-finite or an out-of-range value.
        """
        if design is None:
            return self.baseline
        if not isinstance(design, Mapping):
            raise DesignError(f"a design is a mapping {{name: value}}, got {type(design).__name__}: {design!r}")
        checked = {name: self[name].check(value) for name, value in design.items()}
        return {**self.baseline, **checked}

    def override(self, base: Mapping[str, float], design: Mapping[str, float]) -> dict[str, float]:
        """Return the complete design ``base`` with the variables of a partial ``design`` put in, validated."""
        complete = self.complete(design)
        return {**base, **{name: complete[name] for name in design}}

    def to_unit(self, design: Mapping[str, float]) -> np.ndarray:
        """Return the design as a vector in [-1, 1], shape (len(self),)."""
        full = self.complete(design)
        return np.array([variable.to_unit(full[name]) for name, variable in self.variables.items()], dtype=float)

    def from_unit(self, vector: np.ndarray) -> dict[str, float]:
        """Return the design of a vector in [-1, 1], shape (len(self),). Values outside are clipped.

        Raises:
            DesignError: for a wrong length or a non-finite entry.
        """
        vector = np.asarray(vector, dtype=float)
        if vector.shape != (len(self),):
            raise DesignError(f"a unit design has shape ({len(self)},), got {vector.shape}")
        if not np.isfinite(vector).all():
            raise DesignError(f"a unit design must be finite, got {vector.tolist()}")
        return {
            name: float(variable.from_unit(u))
            for (name, variable), u in zip(self.variables.items(), vector, strict=True)
        }

    def sample(self, rng: np.random.Generator, names: tuple[str, ...] | None = None) -> dict[str, float]:
        """Draw a uniform design; variables not in ``names`` (default: all) keep their baseline."""
        chosen = self.names if names is None else names
        design = {name: float(self[name].from_unit(rng.uniform(-1.0, 1.0))) for name in chosen}
        return self.complete(design)
