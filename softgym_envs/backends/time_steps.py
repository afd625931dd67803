"""Options of motion in time, the same for every backend that computes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from softgym_envs.quantities import check_quantity

MAX_STEPS = 10_000
"""Largest number of time steps in a control step: more would run for minutes, and a unit is probably wrong."""


def shared_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return those options of a backend that mean the same on any other: whether and how bodies move in time."""
    names = {"dynamics", *(field.name for field in fields(TimeSteps))}
    return {name: value for name, value in options.items() if name in names}


@dataclass(frozen=True)
class TimeSteps:
    """How a backend divides a control step, and how bodies are damped.

    Attributes:
        control_step: duration of one command [s].
        time_step: largest physical time step [s]; commands are ramped over those of a control step.
        mass_damping: Rayleigh's alpha [1/s].
        stiffness_damping: Rayleigh's beta [s].

    Raises:
        ValueError: for a step that is not positive, too many time steps in a control step, or a negative damping.
    """

    control_step: float = 0.05
    time_step: float = 0.01
    mass_damping: float = 0.0
    stiffness_damping: float = 0.01

    def __post_init__(self) -> None:
        for name in ("control_step", "time_step"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} = {value} s must be positive and finite")
            check_quantity("duration", value, name)
        if self.control_step > MAX_STEPS * self.time_step:
            raise ValueError(
                f"time_step = {self.time_step:g} s divides control_step = {self.control_step:g} s into more than "
                f"{MAX_STEPS} steps; check their units"
            )
        for name in ("mass_damping", "stiffness_damping"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} = {value} must be finite and not negative")
        check_quantity("damping_rate", self.mass_damping, "mass_damping")
        check_quantity("duration", self.stiffness_damping, "stiffness_damping")

    @property
    def count(self) -> int:
        """Time steps of a control step."""
        return max(1, int(np.ceil(self.control_step / self.time_step - 1e-9)))

    @property
    def step(self) -> float:
        """Duration of a time step [s]."""
        return self.control_step / self.count

    def ramp(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Return the commands at the ends of the time steps, shape (count, ...), from ``start`` to ``end``."""
        share = np.arange(1, self.count + 1).reshape(-1, *(1,) * np.ndim(end)) / self.count
        parts = start + share * (end - start)
        parts[-1] = end  # without round-off
        return parts


def check_still(steps: TimeSteps, **others: tuple[object, object]) -> None:
    """Refuse options of motion on a backend that computes none.

    Args:
        steps: its time steps and damping.
        **others: further options, each with its value and its default.

    Raises:
        ValueError: naming an option that is not at its default.
    """
    options = {field.name: (getattr(steps, field.name), field.default) for field in fields(TimeSteps)} | others
    for name, (value, default) in options.items():
        if value != default:
            raise ValueError(f"{name} = {value!r} has no effect without dynamics=True")
