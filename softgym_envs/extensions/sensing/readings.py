"""Readings of sensors and their noise, and the limits beyond which readings are refused or not believed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgym_envs.backends.backend import check_command
from softgym_envs.robots.base import Robot
from softgym_envs.wording import counted

MAX_GROWTH = 10.0
"""Largest volume of a cavity that a reading may tell, in volumes at rest; also largest pressure of its air over that at
rest. Neither occurs in a soft body, but both do in readings of a wrong unit."""

LARGEST_RESIDUAL = 10.0
"""Residual of one reading, in its standard deviations, up to which the model explains it."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations of sensors, and of changes from one reading to the next.

    Attributes:
        displacement: of the true displacement of an actuator around its command [m].
        volume: of the measured volume of a cavity [m3].
        pressure: of the measured pressure of the air in a sealed cavity [Pa].
        effort: of the measured effort of an actuator [N]; None if it is not measured. Readings with efforts are then
            refused.
        drift: of each parameter of the load from one reading to the next, as a part of its spread before any reading.

    Raises:
        ValueError: for a standard deviation that is not positive and finite, or a negative drift.
    """

    displacement: float = 1e-4
    volume: float = 1e-9
    pressure: float = 10.0
    effort: float | None = None
    drift: float = 0.0

    def __post_init__(self) -> None:
        for name in ("displacement", "volume", "pressure", "effort"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"noise: {name} = {value} must be positive and finite")
        if not (np.isfinite(self.drift) and self.drift >= 0.0):
            raise ValueError(f"noise: drift = {self.drift} must be finite and not negative")


@dataclass(frozen=True)
class Readings:
    """One reading of all sensors.

    Attributes:
        command: commanded displacements of the actuators, shape (n_a,).
        volumes: of the open cavities [m3], shape (open,).
        efforts: of the actuators, shape (n_a,), if they are measured.
        pressures: gauge pressures of the air in the sealed cavities [Pa], shape (sealed,).
    """

    command: np.ndarray
    volumes: np.ndarray | None = None
    efforts: np.ndarray | None = None
    pressures: np.ndarray | None = None


def explains(residuals: np.ndarray) -> bool:
    """Return whether a model explains a reading that leaves residuals (k,), in standard deviations of one reading."""
    return bool(residuals @ residuals <= LARGEST_RESIDUAL**2 * len(residuals))


def check_settings(**settings: float) -> None:
    """Raise ValueError for a setting of an estimator that is not positive and finite."""
    for name, value in settings.items():
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} = {value} must be positive and finite")


def checked_readings(name: str, values: np.ndarray | None, count: int) -> np.ndarray:
    """Return values of one kind of reading as an array (count,), or a ValueError."""
    array = np.asarray([] if values is None else values, dtype=float)
    if array.shape != (count,) or not np.isfinite(array).all():
        raise ValueError(f"readings '{name}' must be {counted(count, 'finite value')}, got {array.tolist()}")
    return array


def checked_command(robot: Robot, values: np.ndarray) -> np.ndarray:
    """Return commanded displacements (n_a,), or a ValueError for malformed ones and those of a wrong unit."""
    return check_command(robot, checked_readings("command", values, len(robot.actuators)), "displacement")


def checked_volumes(values: np.ndarray | None, rest: np.ndarray) -> np.ndarray:
    """Return volumes [m3] of cavities with volumes at rest (k,), or a ValueError for malformed or impossible ones."""
    return _within("volumes", checked_readings("volumes", values, len(rest)), 0.0 * rest, MAX_GROWTH * rest, "m3")


def checked_pressures(values: np.ndarray | None, ambient: np.ndarray) -> np.ndarray:
    """Return gauge pressures [Pa] of air sealed at ambient pressures (k,), or a ValueError, as `checked_volumes`."""
    checked = checked_readings("pressures", values, len(ambient))
    return _within("pressures", checked, -ambient, (MAX_GROWTH - 1.0) * ambient, "Pa")


def _within(name: str, values: np.ndarray, low: np.ndarray, high: np.ndarray, unit: str) -> np.ndarray:
    """Return readings above ``low`` and up to ``high``, or a ValueError that names the first other one."""
    for k in np.flatnonzero(~((low < values) & (values <= high))):
        raise ValueError(
            f"readings '{name}' number {k} = {values[k]:g} {unit} is impossible; allowed: above {low[k]:g}, up to "
            f"{high[k]:g} {unit}"
        )
    return values
