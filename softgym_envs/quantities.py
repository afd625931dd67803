"""Physical quantities: their plausible ranges in SI units, by which mistakes in units are noticed.

Everything that takes a number with a unit checks it against the one table here: constructors, configuration files,
options of robots, tasks and backends, obstacles, plants and designs. Who means an unusual value says so by the name of
its quantity, with `unchecked` or in the environment variable ``SOFTGYM_UNCHECKED``.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from softgym_envs.errors import unknown_name
from softgym_envs.wording import brief

UNCHECKED = "SOFTGYM_UNCHECKED"
"""Environment variable: names of quantities whose ranges are not checked, separated by commas."""


@dataclass(frozen=True)
class Quantity:
    """A physical quantity.

    Attributes:
        unit: its SI unit.
        low: smallest plausible magnitude besides zero [unit].
        high: largest plausible magnitude [unit].
        example: what has these values, for messages.
        units: other units in use, the likely ones first, with their factors to the SI unit.
        signed: whether negative values have a meaning.
    """

    unit: str
    low: float
    high: float
    example: str
    units: Mapping[str, float] = field(default_factory=dict)
    signed: bool = False


_LENGTHS = {"mm": 1e-3, "um": 1e-6, "cm": 1e-2, "in": 0.0254}
_PRESSURES = {"MPa": 1e6, "kPa": 1e3, "GPa": 1e9, "bar": 1e5}

QUANTITIES: Mapping[str, Quantity] = {
    "size": Quantity(
        "m", 1e-3, 10.0, "bodies of 1 mm to 10 m", {**_LENGTHS, "metres, read as mm": 1e3, "metres, read as um": 1e6}
    ),
    "length": Quantity("m", 0.0, 10.0, "up to 10 m", _LENGTHS, signed=True),
    "angle": Quantity("rad", 0.0, 2.001 * math.pi, "up to one turn", {"deg": math.pi / 180.0}, signed=True),
    "volume": Quantity("m3", 0.0, 1.0, "up to a cubic metre", {"ml": 1e-6, "mm3": 1e-9, "l": 1e-3}, signed=True),
    "density": Quantity(
        "kg/m3",
        10.0,
        2.5e4,
        "foams to platinum",
        {"g/cm3": 1e3, "kg/mm3": 1e9, "t/mm3": 1e12, "g/mm3": 1e6, "mg/mm3": 1e3},
    ),
    "mass": Quantity("kg", 0.0, 1e3, "up to a tonne", {"g": 1e-3, "mg": 1e-6}),
    "modulus": Quantity("Pa", 5e3, 2e12, "soft gels to diamond", {**_PRESSURES, "MPa, converted twice": 1e-6}),
    "pressure": Quantity("Pa", 0.0, 1e8, "up to 1000 bar", {"uPa": 1e-6}, signed=True),
    "stress": Quantity("Pa", 100.0, 2e12, "pressures and moduli", _PRESSURES, signed=True),
    "gravity": Quantity("m/s2", 0.05, 100.0, "of planets", {"mm/s2": 1e-3, "cm/s2": 1e-2, "mm/ms2": 1e3}, signed=True),
    "friction": Quantity("1", 0.0, 4.0, "up to that of soft rubber", {"%": 1e-2}),
    "duration": Quantity("s", 1e-7, 10.0, "steps of up to 10 s", {"ms": 1e-3, "us": 1e-6}),
    "force": Quantity("N", 0.0, 1e5, "up to 100 kN", {"mN": 1e-3, "kN": 1e3}, signed=True),
    "contact_distance": Quantity("m", 0.0, 0.1, "thinner than walls", _LENGTHS),
    "contact_stiffness": Quantity("Pa", 0.0, 1e13, "near a modulus", _PRESSURES),
    "compliance": Quantity("m/N", 0.0, 0.1, "cables that stretch by up to 0.1 m per newton", {"mm/N": 1e-3}),
    "damping_rate": Quantity("1/s", 0.0, 1e5, "up to 1e5 per second"),
}
"""All quantities by name."""

OF_UNIT = {
    "m": "length",
    "rad": "angle",
    "m3": "volume",
    "kg/m3": "density",
    "kg": "mass",
    "Pa": "stress",
    "m/s2": "gravity",
    "s": "duration",
    "N": "force",
}
"""Quantity of the values of actuators and design variables, by their unit."""

_SI = frozenset("m s kg A K mol rad sr Hz N Pa J W C V F ohm S Wb T H step".split())
_OTHER_UNITS = {
    "deg": ("rad", math.pi / 180.0),
    "degree": ("rad", math.pi / 180.0),
    "degrees": ("rad", math.pi / 180.0),
    "°": ("rad", math.pi / 180.0),
    "rpm": ("rad/s", math.pi / 30.0),
    "km": ("m", 1e3),
    "cm": ("m", 1e-2),
    "mm": ("m", 1e-3),
    "um": ("m", 1e-6),
    "µm": ("m", 1e-6),
    "μm": ("m", 1e-6),
    "nm": ("m", 1e-9),
    "in": ("m", 0.0254),
    "inch": ("m", 0.0254),
    "ft": ("m", 0.3048),
    "l": ("m3", 1e-3),
    "L": ("m3", 1e-3),
    "ml": ("m3", 1e-6),
    "mL": ("m3", 1e-6),
    "cc": ("m3", 1e-6),
    "t": ("kg", 1e3),
    "g": ("kg", 1e-3),
    "mg": ("kg", 1e-6),
    "lb": ("kg", 0.45359237),
    "ms": ("s", 1e-3),
    "us": ("s", 1e-6),
    "min": ("s", 60.0),
    "h": ("s", 3600.0),
    "kN": ("N", 1e3),
    "mN": ("N", 1e-3),
    "lbf": ("N", 4.4482216),
    "kgf": ("N", 9.80665),
    "gf": ("N", 9.80665e-3),
    "hPa": ("Pa", 1e2),
    "kPa": ("Pa", 1e3),
    "MPa": ("Pa", 1e6),
    "GPa": ("Pa", 1e9),
    "bar": ("Pa", 1e5),
    "mbar": ("Pa", 1e2),
    "psi": ("Pa", 6894.757),
    "atm": ("Pa", 101325.0),
    "kV": ("V", 1e3),
    "mV": ("V", 1e-3),
    "mA": ("A", 1e-3),
    "mT": ("T", 1e-3),
    "%": ("1", 1e-2),
    "percent": ("1", 1e-2),
}
"""Units that are not SI, or multiples, which the suite does not take: the SI unit of each, and the factor to it."""


def check_quantity(
    name: str,
    value: ArrayLike,
    label: str,
    *,
    high: float | None = None,
    example: str = "",
    hint: str = "",
    factors: Mapping[str, float] | None = None,
) -> None:
    """Refuse values that are not finite, have the wrong sign or are probably in another unit.

    Args:
        name: of the quantity in `QUANTITIES`.
        value: one number or several, in its SI unit. Zero is always plausible.
        label: what the value is, for messages: ``"density"``.
        high: largest plausible magnitude where something narrower is known than in the table.
        example: what it follows from, for messages.
        hint: how to correct the unit, for messages.
        factors: likely mistakes by name and their factors to the right value, instead of other units.

    Raises:
        ValueError: in one line: the value, what is plausible, the likely unit, and how to insist.
    """
    quantity = QUANTITIES[name]
    unit = "" if quantity.unit == "1" else f" {quantity.unit}"
    values = numbers(value, label, quantity.unit)
    if not np.isfinite(values).all():
        raise ValueError(f"{label} = {_shown(value)}{unit} must be finite")
    if not quantity.signed and (values < 0.0).any():
        raise ValueError(f"{label} = {_shown(value)}{unit} must be finite and not negative")
    limit = quantity.high if high is None else min(high, quantity.high)
    sizes = np.abs(values)
    wrong = (sizes > limit) | ((sizes > 0.0) & (sizes < quantity.low))
    if not wrong.any() or name in _insisted():
        return
    first = float(values[int(np.argmax(wrong))])
    likely = (quantity.units if factors is None else factors).items()
    guess = next((each for each in likely if quantity.low <= abs(first) * each[1] <= limit), None)
    meant = ""
    if guess is not None:
        given = guess[0] if " " in guess[0] else f"{first:.4g} {guess[0]}"
        meant = f" did you mean {first * guess[1]:.4g}{unit} ({given})?"
    raise ValueError(
        f"{label} = {first:g}{unit} is implausible, allowed: {quantity.low:g} to {limit:g}{unit} "
        f"({example if high is not None and limit == high else quantity.example});{meant} "
        f"{f'({hint}) ' if hint else ''}if it is meant, set {UNCHECKED}={name}"
    )


def numbers(value: object, label: str, unit: str = "1") -> np.ndarray:
    """Return one number or several as a flat array of floats.

    Raises:
        ValueError: for anything else, such as texts, with the unit that is expected.
    """
    try:
        array = np.ravel(np.asarray(value))
    except ValueError:  # rows of different lengths
        array = np.array(["?"])
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{label} = {brief(value)} must be a number{'' if unit == '1' else f' [{unit}]'}")
    return array.astype(float)


def finite_number(value: object, label: str, unit: str = "1") -> float:
    """Return a finite number.

    Raises:
        ValueError: for anything else, with the unit that is expected.
    """
    array = numbers(value, label, unit)
    if np.ndim(value) or not np.isfinite(array).all():  # type: ignore[arg-type]
        raise ValueError(f"{label} = {brief(value)} must be one finite number{'' if unit == '1' else f' [{unit}]'}")
    return float(array[0])


def check_unit(unit: object, label: str) -> None:
    """Refuse a unit that is not made of SI units, such as ``"deg"`` or ``"mm"``; ``"1"`` stands for a pure number.

    Raises:
        ValueError: with the SI unit and the factor to it where they are known.
    """
    if not isinstance(unit, str) or not unit:
        raise ValueError(f"{label}: unit = {brief(unit)} must be the name of an SI unit, or '1' for a pure number")
    for part in re.split(r"[ /*·^()]+|(?<=[A-Za-z])-?\d+", unit):
        if part in ("", "1", "-") or part in _SI or part.isdigit():
            continue
        if part in _OTHER_UNITS:
            si, factor = _OTHER_UNITS[part]
            raise ValueError(
                f"{label}: unit '{unit}' is not SI; give its values in {si} (1 {part} = {factor:.6g} {si})"
            )
        raise ValueError(f"{label}: {unknown_name('unit', unit, sorted(_SI))}, and powers, products and ratios of them")


def check_by_unit(unit: str, value: ArrayLike, label: str, **options: Any) -> None:
    """Refuse values that are implausible for their unit, as `check_quantity` does; other units are not checked."""
    if unit in OF_UNIT:
        check_quantity(OF_UNIT[unit], value, label, **options)


@contextmanager
def unchecked(*names: str) -> Iterator[None]:
    """Accept any finite value of some quantities while a block runs, in processes that it starts too.

    Args:
        *names: of quantities in `QUANTITIES`: ``"size"``, ``"density"``, ...

    Raises:
        ValueError: for an unknown name.
    """
    for name in names:
        if name not in QUANTITIES:
            raise ValueError(unknown_name("quantity", name, QUANTITIES))
    kept = os.environ.get(UNCHECKED)
    os.environ[UNCHECKED] = ",".join([*_insisted(), *names])
    try:
        yield
    finally:
        if kept is None:
            del os.environ[UNCHECKED]
        else:
            os.environ[UNCHECKED] = kept


def _insisted() -> tuple[str, ...]:
    """Return the names of the quantities that are not checked.

    Raises:
        ValueError: for an unknown name.
    """
    names = tuple(name.strip() for name in os.environ.get(UNCHECKED, "").split(",") if name.strip())
    for name in names:
        if name not in QUANTITIES:
            raise ValueError(f"environment variable {UNCHECKED}: {unknown_name('quantity', name, QUANTITIES)}")
    return names


def _shown(value: ArrayLike) -> str:
    array = np.asarray(value)
    if array.size > 6:
        return f"{array.min():g} to {array.max():g}"
    if array.size == 1:
        return f"{array.item():g}"
    return repr(array.tolist())
