"""Nuisance parameters: unknowns of a measurement that are fitted together with the body.

They are not of interest themselves, but a fit without them is biased: the zero of a force sensor, the position of a
cable at the start, the distance of the object that a finger pushes against (thesis, sec. 3.4.5).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from softgym_envs.codesign.tools.measurements import columns_of
from softgym_envs.config import Config
from softgym_envs.errors import unknown_name
from softgym_envs.robots.base import Robot
from softgym_envs.units import effort_unit


class NuisanceConfig(Config):
    """A nuisance parameter; its values are in its own ``unit``, an SI unit."""

    bounds: tuple[float, float]
    start: float | None = Field(default=None, description="first value; default the middle of the bounds")
    unit: str

    @model_validator(mode="after")
    def _start_within_bounds(self) -> NuisanceConfig:
        if not self.bounds[0] < self.bounds[1]:
            raise ValueError(f"bounds = {list(self.bounds)} must be [low, high] with low < high")
        if self.start is not None:
            self.check("start", self.start)
        return self

    def check(self, name: str, value: float) -> None:
        """Raise ValueError for a value out of bounds."""
        low, high = self.bounds
        if not low <= value <= high:
            raise ValueError(
                f"{name} = {value:g} {self.unit} is out of bounds; allowed: {low:g} to {high:g} {self.unit}"
            )

    @property
    def first(self) -> float:
        """The first value [unit]."""
        return 0.5 * (self.bounds[0] + self.bounds[1]) if self.start is None else self.start


class OffsetConfig(NuisanceConfig):
    """A sensor whose reading is the true value plus an offset."""

    kind: Literal["offset"]
    column: str = Field(description="column of the measurements: imposed or measured")


class ContactConfig(NuisanceConfig):
    """Distance at which the first effector touches a rigid, frictionless plane.

    On FEM the contact force is exact. On a surrogate it comes from the compliance of the free state (thesis, eq. 4.16),
    so ``refine`` the fit on FEM.
    """

    kind: Literal["contact"]
    normal: tuple[float, float, float] = Field(description="direction towards the plane, of any length")

    @field_validator("normal")
    @classmethod
    def _not_zero(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if not np.linalg.norm(value) > 0.0:
            raise ValueError("must be a direction: three numbers that are not all zero")
        return value

    @property
    def direction(self) -> np.ndarray:
        """The normal with length 1, shape (3,)."""
        return np.array(self.normal) / np.linalg.norm(self.normal)


Nuisances = Mapping[str, OffsetConfig | ContactConfig]


def check_nuisances(nuisances: Nuisances, robot: Robot, fitted: Sequence[str]) -> None:
    """Check the names, columns and units of nuisance parameters.

    Raises:
        ValueError: for a name that a fitted variable has, an unknown column, a wrong unit, or a second contact.
    """
    displacement, effort, effector = columns_of(robot)
    units = {
        **{name: actuator.unit for name, actuator in zip(displacement, robot.actuators, strict=True)},
        **{name: effort_unit(a.unit) for name, a in zip(effort, robot.actuators, strict=True)},
        **dict.fromkeys(effector, "m"),
    }
    contacts = [name for name, nuisance in nuisances.items() if isinstance(nuisance, ContactConfig)]
    if len(contacts) > 1:
        raise ValueError(f"nuisances: '{contacts[0]}' and '{contacts[1]}' are both contacts; allowed: one")
    for name, nuisance in nuisances.items():
        if name in robot.design_space.names or name in fitted:
            raise ValueError(f"nuisances: '{name}' is a variable of the body; use another name")
        unit = "m"
        if isinstance(nuisance, OffsetConfig):
            if nuisance.column not in units:
                raise ValueError(f"nuisances: '{name}': {unknown_name('column', nuisance.column, units)}")
            unit = units[nuisance.column]
        if nuisance.unit != unit:
            raise ValueError(f"nuisances: '{name}': unit = '{nuisance.unit}' must be '{unit}'")
