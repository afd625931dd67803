"""Design spaces: named, bounded, dimensioned variables of a robot's body.

A design is a mapping ``{name: value}`` in SI units. Functions accept plain mappings, partial ones included; `Design` is
complete and checked.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from softgym_envs.arguments import explained
from softgym_envs.errors import DesignError, unknown_name
from softgym_envs.quantities import check_by_unit, check_unit
from softgym_envs.wording import brief


def _is_number(value: object) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


@explained
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
        log: whether to sample and normalise on a logarithmic scale.
        choices: names of what the whole part of the value chooses, from 0; the bounds are then 0 and their number, and
            the upper one chooses the last. A choice is given by its name or its value; a design holds the middle value.
            Samplers of studies treat such a variable as categorical, and observations show one number for each choice.
    """

    name: str
    low: float
    high: float
    baseline: float
    unit: str
    description: str
    log: bool = False
    choices: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for label in ("low", "high", "baseline"):
            if not _is_number(value := getattr(self, label)):
                raise DesignError(f"design variable '{self.name}': {label} = {brief(value)} must be a number")
        if not (math.isfinite(self.low) and math.isfinite(self.high)):
            raise DesignError(f"design variable '{self.name}': low {self.low} and high {self.high} must be finite")
        try:
            check_unit(self.unit, f"design variable '{self.name}'")
            furthest = max(self.low, self.high, key=abs)
            check_by_unit(self.unit, furthest, f"design variable '{self.name}': {'low' if furthest < 0.0 else 'high'}")
        except ValueError as error:
            raise DesignError(str(error)) from None
        if not self.low < self.high:
            raise DesignError(f"design variable '{self.name}': low {self.low} must be below high {self.high}")
        if not self.low <= self.baseline <= self.high:
            raise DesignError(
                f"design variable '{self.name}': baseline {self.baseline} is outside [{self.low}, {self.high}]"
            )
        if self.log and self.low <= 0:
            raise DesignError(f"design variable '{self.name}': a logarithmic scale needs low > 0, got {self.low}")
        if self.choices and (self.low != 0 or self.high != len(self.choices) or self.log):
            raise DesignError(
                f"design variable '{self.name}': {len(self.choices)} choices need a linear scale from 0 to "
                f"{len(self.choices)}, got {self.low} to {self.high}"
            )

    def check(self, value: object) -> float:
        """Return ``value`` as a float inside the bounds, or raise `DesignError`."""
        unit = "" if self.unit == "1" else f" {self.unit}"
        allowed = f"allowed: {self.low:g} to {self.high:g}{unit}"
        if self.choices and isinstance(value, str):
            if value not in self.choices:
                raise DesignError(f"design variable '{self.name}': {unknown_name('choice', value, self.choices)}")
            return self.choices.index(value) + 0.5
        try:
            if isinstance(value, str | bytes | bool):
                raise TypeError
            number = float(value)  # type: ignore[arg-type]
        except (TypeError, ValueError, OverflowError):
            raise DesignError(f"design variable '{self.name}' = {brief(value)} is not a number; {allowed}") from None
        if not math.isfinite(number):
            raise DesignError(f"design variable '{self.name}' = {number} is not finite; {allowed}")
        # Tolerate only the rounding of a bound to text or float32.
        slack = 1e-6 * (self.high - self.low)
        if not self.low - slack <= number <= self.high + slack:
            raise DesignError(f"design variable '{self.name}' = {number:g}{unit} is out of bounds; {allowed}")
        return float(self._nearest(min(max(number, self.low), self.high)))

    def _nearest(self, value: float | np.ndarray) -> float | np.ndarray:
        """Return values inside the bounds, of a choice the middle values."""
        return np.minimum(np.floor(value), len(self.choices) - 1.0) + 0.5 if self.choices else value

    def to_unit(self, value: float | np.ndarray) -> np.ndarray:
        """Map [low, high] to [-1, 1]."""
        if self.log:
            low, high, value = math.log(self.low), math.log(self.high), np.log(value)
        else:
            low, high, value = self.low, self.high, np.asarray(value)
        return 2.0 * (value - low) / (high - low) - 1.0

    def choice(self, value: float) -> str:
        """Return the name of what a value chooses."""
        return self.choices[int(self._nearest(value))]

    @property
    def observed_size(self) -> int:
        """How many numbers of an observation show the variable."""
        return len(self.choices) or 1

    def observe(self, value: float | np.ndarray) -> np.ndarray:
        """Return what observations show of values (...): shape (..., observed_size), in [-1, 1].

        A number is shown by its place between the bounds, a choice by 1 among zeros.
        """
        if not self.choices:
            return self.to_unit(value)[..., None]
        middles = np.arange(len(self.choices)) + 0.5
        return (np.asarray(self._nearest(value))[..., None] == middles).astype(float)

    def from_unit(self, unit_value: float | np.ndarray) -> np.ndarray:
        """Map [-1, 1] to [low, high]; values outside are clipped."""
        fraction = 0.5 * (np.clip(unit_value, -1.0, 1.0) + 1.0)
        if self.log:
            value = np.exp(math.log(self.low) + fraction * math.log(self.high / self.low))
        else:
            value = self.low + fraction * (self.high - self.low)
        return np.asarray(self._nearest(np.clip(value, self.low, self.high)))


class Design(Mapping[str, float]):
    """A value for every variable of a design space, checked once and immutable.

    A mapping ``{name: value}``, created by `DesignSpace.complete` and accepted wherever a design is.

    Attributes:
        space: the variables.
        array: values in their order [units of the variables], read-only, shape (len(space),).
    """

    __slots__ = ("_values", "array", "space")

    def __init__(self, space: DesignSpace, values: Mapping[str, float]) -> None:
        self.space = space
        self._values = {variable.name: variable.check(values[variable.name]) for variable in space}
        self.array = np.array(list(self._values.values()))
        self.array.flags.writeable = False

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __hash__(self) -> int:
        return hash(tuple(self._values.items()))

    def __reduce__(self) -> tuple[type[Design], tuple[DesignSpace, dict[str, float]]]:
        return Design, (self.space, self._values)

    def __repr__(self) -> str:
        return f"Design({', '.join(f'{name}={value:g}' for name, value in self._values.items())})"


@explained
class DesignSpace:
    """An ordered set of design variables; iteration yields them in order."""

    def __init__(self, *variables: DesignVariable) -> None:
        names = [variable.name for variable in variables]
        if len(set(names)) != len(names):
            raise DesignError(f"design variables must have distinct names, got {names}")
        self.variables = MappingProxyType({variable.name: variable for variable in variables})
        self.names: tuple[str, ...] = tuple(names)
        self.baseline = Design(self, {variable.name: variable.baseline for variable in variables})

    def __len__(self) -> int:
        return len(self.variables)

    def __iter__(self) -> Iterator[DesignVariable]:
        return iter(self.variables.values())

    def __getitem__(self, name: str) -> DesignVariable:
        try:
            return self.variables[name]
        except KeyError:
            raise DesignError(unknown_name("design variable", name, self.names)) from None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, DesignSpace) and tuple(self) == tuple(other)

    def __hash__(self) -> int:
        return hash(tuple(self))

    def __reduce__(self) -> tuple[type[DesignSpace], tuple[DesignVariable, ...]]:
        return DesignSpace, tuple(self)

    def __repr__(self) -> str:
        return f"DesignSpace({', '.join(self.names)})"

    def complete(self, design: Mapping[str, float] | None = None, base: Mapping[str, float] | None = None) -> Design:
        """Return a complete, checked design.

        Args:
            design: values of some or all variables. A `Design` of this space is returned unchanged.
            base: values of the other variables; default: the baseline.

        Raises:
            DesignError: for an unknown name, or a value that is not finite or out of bounds.
        """
        if isinstance(design, Design) and (design.space is self or design.space == self):
            return design
        start = self.baseline if base is None else self.complete(base)
        if design is None:
            return start
        if not isinstance(design, Mapping):
            raise DesignError(f"a design is a mapping {{name: value}}, got {type(design).__name__}: {brief(design)}")
        for name in design:
            self[name]  # raises for an unknown name
        return Design(self, {**start, **design})

    def within(self, bounds: Mapping[str, tuple[float, float]]) -> DesignSpace:
        """Return a space in which some variables have other bounds.

        Args:
            bounds: smallest and largest value of these variables [their units].

        Raises:
            DesignError: for an unknown name, or bounds that do not contain the baseline.
        """
        changed = {name: replace(self[name], low=low, high=high) for name, (low, high) in bounds.items()}
        return DesignSpace(*(changed.get(variable.name, variable) for variable in self))

    def to_unit(self, design: Mapping[str, float]) -> np.ndarray:
        """Return the design as a vector in [-1, 1], shape (len(self),)."""
        full = self.complete(design)
        return np.array([variable.to_unit(full[variable.name]) for variable in self], dtype=float)

    def from_unit(self, vector: np.ndarray) -> Design:
        """Return the design of a vector in [-1, 1], shape (len(self),). Values outside are clipped.

        Raises:
            DesignError: for a wrong length or an entry that is not finite.
        """
        vector = np.asarray(vector, dtype=float)
        if vector.shape != (len(self),):
            raise DesignError(f"a unit design has shape ({len(self)},), got {vector.shape}")
        if not np.isfinite(vector).all():
            raise DesignError(f"a unit design must be finite, got {vector.tolist()}")
        values = (float(variable.from_unit(u)) for variable, u in zip(self, vector, strict=True))
        return Design(self, dict(zip(self.names, values, strict=True)))

    def observe(self, designs: np.ndarray, names: Sequence[str]) -> np.ndarray:
        """Return what observations show of designs (..., len(self)): the variables in ``names``, shape (..., k)."""
        shown = [self[name].observe(designs[..., self.names.index(name)]) for name in names]
        return np.concatenate(shown, axis=-1) if shown else np.empty((*designs.shape[:-1], 0))

    def sample(self, rng: np.random.Generator, names: Sequence[str] | None = None) -> Design:
        """Draw a uniform design; variables not in ``names`` (default: all) keep their baseline."""
        chosen = self.names if names is None else names
        return self.complete({name: float(self[name].from_unit(rng.uniform(-1.0, 1.0))) for name in chosen})
