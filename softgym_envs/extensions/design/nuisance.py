"""Nuisance parameters: unknowns of a measurement that are fitted together with the body.

They are not of interest themselves, but a fit without them is biased: the zero of a force sensor, the position of a
cable at the start, the distance of the object that a finger pushes against (thesis, sec. 3.4.5).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from softgym_envs.config import Config
from softgym_envs.errors import unknown_name
from softgym_envs.extensions.design.instrument import Instrument
from softgym_envs.extensions.design.measurements import columns_of
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


class GainConfig(NuisanceConfig):
    """Drives that do a multiple of what was recorded: ``gain * recorded - offset``, before their play."""

    kind: Literal["gain"]
    columns: tuple[str, ...] = Field(min_length=1, description="imposed columns of the measurements")


class BacklashConfig(NuisanceConfig):
    """Drives with play: they stay while their command is within half its width."""

    kind: Literal["backlash"]
    columns: tuple[str, ...] = Field(min_length=1, description="imposed columns of the measurements")


class ComplianceConfig(NuisanceConfig):
    """Cables that stretch under tension, which then lacks at the body."""

    kind: Literal["compliance"]
    columns: tuple[str, ...] = Field(min_length=1, description="imposed columns of displacements")


class FrictionConfig(NuisanceConfig):
    """Coefficient of friction of all cables on their guides."""

    kind: Literal["friction"]


class FrameConfig(NuisanceConfig):
    """The sensor's frame: turned about the axes x, y and z of the body in this order, then shifted."""

    kind: Literal["frame"]
    part: Literal["turn_x", "turn_y", "turn_z", "shift_x", "shift_y", "shift_z"]


AnyNuisance = (
    OffsetConfig | ContactConfig | GainConfig | BacklashConfig | ComplianceConfig | FrictionConfig | FrameConfig
)
Nuisances = Mapping[str, AnyNuisance]


def make_instrument(values: Mapping[str, float], nuisances: Nuisances, robot: Robot, driven: str) -> Instrument:
    """Return the drives and the sensor's frame for values of the nuisance parameters.

    Args:
        values: by name.
        nuisances: by name.
        robot: the measured robot.
        driven: ``"displacement"`` or ``"effort"``, what was imposed.
    """
    names = columns_of(robot)[0 if driven == "displacement" else 1]
    n = len(names)
    gain, offset, backlash, compliance = np.ones(n), np.zeros(n), np.zeros(n), np.zeros(n)
    turn, shift, friction = np.zeros(3), np.zeros(3), 0.0
    for name, nuisance in nuisances.items():
        value = values[name]
        if isinstance(nuisance, OffsetConfig):
            if nuisance.column in names:
                offset[names.index(nuisance.column)] += value
        elif isinstance(nuisance, GainConfig | BacklashConfig | ComplianceConfig):
            array = {"gain": gain, "backlash": backlash, "compliance": compliance}[nuisance.kind]
            array[[names.index(column) for column in nuisance.columns]] = value
        elif isinstance(nuisance, FrictionConfig):
            friction = value
        elif isinstance(nuisance, FrameConfig):
            kind, axis = nuisance.part.split("_")
            (turn if kind == "turn" else shift)["xyz".index(axis)] = value
    return Instrument(gain, offset, backlash, compliance, friction, turn, shift)


def check_nuisances(nuisances: Nuisances, robot: Robot, fitted: Sequence[str], backend: str = "fem") -> None:
    """Check the names, columns and units of nuisance parameters, and that a backend has them.

    Raises:
        ValueError: for a name that a fitted variable has, an unknown column, a wrong unit, a part that two parameters
            describe, or one that needs finite elements on another backend.
    """
    displacement, effort, effector = columns_of(robot)
    units = {
        **{name: actuator.unit for name, actuator in zip(displacement, robot.actuators, strict=True)},
        **{name: effort_unit(a.unit) for name, a in zip(effort, robot.actuators, strict=True)},
        **dict.fromkeys(effector, "m"),
    }
    taken: dict[str, str] = {}
    for name, nuisance in nuisances.items():
        if name in robot.design_space.names or name in fitted:
            raise ValueError(f"nuisances: '{name}' is a variable of the body; use another name")
        if not isinstance(nuisance, OffsetConfig | ContactConfig) and backend != "fem":
            raise ValueError(f"nuisances: '{name}' is a {nuisance.kind}, which needs backend 'fem', got '{backend}'")
        columns, unit = _columns_and_unit(name, nuisance, units, [*displacement, *effort])
        if nuisance.unit != unit:
            raise ValueError(f"nuisances: '{name}': unit = '{nuisance.unit}' must be '{unit}'")
        for part in columns:
            kind = nuisance.kind if part == nuisance.kind else f"{nuisance.kind} of {part}"
            if not isinstance(nuisance, OffsetConfig) and (other := taken.setdefault(kind, name)) != name:
                raise ValueError(f"nuisances: '{other}' and '{name}' both describe {kind}; allowed: one")


def _columns_and_unit(
    name: str, nuisance: AnyNuisance, units: Mapping[str, str], imposed: Sequence[str]
) -> tuple[Sequence[str], str]:
    """Return what a nuisance parameter describes, and its unit; raises ValueError for an unknown column."""
    if isinstance(nuisance, OffsetConfig):
        if nuisance.column not in units:
            raise ValueError(f"nuisances: '{name}': {unknown_name('column', nuisance.column, units)}")
        return [nuisance.column], units[nuisance.column]
    if isinstance(nuisance, FrameConfig):
        return [nuisance.part], "rad" if nuisance.part.startswith("turn") else "m"
    if isinstance(nuisance, ContactConfig | FrictionConfig):
        return [nuisance.kind], "m" if nuisance.kind == "contact" else "1"
    allowed = [c for c in imposed if c.endswith("_displacement")] if nuisance.kind == "compliance" else imposed
    for column in nuisance.columns:
        if column not in allowed:
            raise ValueError(f"nuisances: '{name}': {unknown_name('column', column, allowed)}")
    unit = units[nuisance.columns[0]]
    return nuisance.columns, {"gain": "1", "backlash": unit, "compliance": f"{unit}/N"}[nuisance.kind]
