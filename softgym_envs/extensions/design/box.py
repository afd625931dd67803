"""The designs of a search: free variables within bounds, the others fixed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from softgym_envs.codesign.variables import OptionRange, is_option, make_variables
from softgym_envs.designs import DesignSpace
from softgym_envs.errors import ConfigError


class Box:
    """Free variables within bounds, as a box in unit coordinates [-1, 1]^d.

    Logarithmic variables are uniform in their logarithm. A *design* here also has the values of free robot options, as
    ``robot.<option>``. The arguments after ``space`` are keys of
    `softgym_envs.extensions.design.config.BodiesConfig`.

    Raises:
        DesignError: for an unknown name, or a value or a bound outside the robot's own bounds.
        ConfigError: for a variable that is named twice, options without bounds, or bounds of a variable that is not
            free.

    Attributes:
        names: names of the free variables.
        reference: the complete reference design [SI].
        free: the free variables with their bounds; their baseline is the reference, moved into the bounds.
    """

    def __init__(
        self,
        space: DesignSpace,
        variables: Sequence[str] | None = None,
        bounds: Mapping[str, tuple[float, float]] | None = None,
        design: Mapping[str, float] | None = None,
        ranges: Mapping[str, OptionRange] | None = None,
    ) -> None:
        self.names = tuple(space.names if variables is None else variables)
        bounds = bounds or {}
        for name in bounds:
            if name not in self.names or is_option(name):
                raise ConfigError(f"bounds: '{name}' is not a free design variable; free: {', '.join(self.names)}")
        try:
            chosen = make_variables(self.names, ranges or {}, space)
        except ValueError as error:
            raise ConfigError(str(error)) from None
        if other := [name for name in chosen if is_option(name) and not name.startswith("robot.")]:
            raise ConfigError(f"variable '{other[0]}': design tools have no task; allowed: robot.<option>")
        self.space = space
        self.reference = {
            **space.complete(design),
            **{name: variable.baseline for name, variable in chosen.items() if is_option(name)},
        }
        free = []
        for name, variable in chosen.items():
            low, high = (variable.check(end) for end in bounds.get(name, (variable.low, variable.high)))
            free.append(replace(variable, low=low, high=high, baseline=min(max(self.reference[name], low), high)))
        self.free = DesignSpace(*free)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def options(self) -> tuple[str, ...]:
        """Names of the free variables that are robot options."""
        return tuple(name for name in self.names if is_option(name))

    def design(self, unit: np.ndarray) -> dict[str, float]:
        """Return the complete design of a point in unit coordinates, shape (d,)."""
        return {**self.reference, **self.free.from_unit(unit)}

    def unit(self, design: Mapping[str, float]) -> np.ndarray:
        """Return the unit coordinates of a design, shape (d,)."""
        return self.free.to_unit({name: design[name] for name in self.names})

    def values(self, unit: Tensor) -> Tensor:
        """Return complete designs (B, len(space)) of points (B, d), with gradients. Robot options are left out."""
        columns = {
            name: torch.full((len(unit),), self.reference[name], dtype=torch.float64) for name in self.space.names
        }
        for k, (name, variable) in enumerate(self.free.variables.items()):
            if name in columns:
                ends = np.array([variable.low, variable.high])
                low, high = np.log(ends) if variable.log else ends
                value = low + 0.5 * (unit[:, k] + 1.0) * (high - low)
                columns[name] = torch.exp(value) if variable.log else value
        return torch.stack(list(columns.values()), dim=1)

    def corners(self) -> np.ndarray:
        """Return all corners in unit coordinates, shape (2^d, d)."""
        return self.grid(2 ** len(self))

    def grid(self, count: int) -> np.ndarray:
        """Return a regular grid of about ``count`` points, corners included, shape (m, d) with m >= count."""
        steps = max(2, int(np.ceil(count ** (1.0 / len(self)) - 1e-9)))
        line = np.linspace(-1.0, 1.0, steps)
        return np.stack(np.meshgrid(*[line] * len(self), indexing="ij"), axis=-1).reshape(-1, len(self))

    def check_start(self, start: Mapping[str, float]) -> Mapping[str, float]:
        """Return the free values of a start; missing ones take the reference, moved into the bounds.

        Raises:
            ConfigError: for a variable that is not free.
            DesignError: for a value out of bounds.
        """
        if unknown := sorted(start.keys() - set(self.names)):
            raise ConfigError(f"starts: '{unknown[0]}' is not free; free: {', '.join(self.names)}")
        return self.free.complete(start)
