"""Units: how people read SI quantities, and what is conjugate to what. The only table of either."""

from __future__ import annotations

import math
from typing import NamedTuple

from softgym_envs.wording import decimal


class Display(NamedTuple):
    """How people read a quantity.

    Attributes:
        unit: unit that people read; empty for a plain number.
        factor: factor to it from SI.
        decimals: decimals of a number that is not small.
    """

    unit: str
    factor: float = 1.0
    decimals: int = 3


PERCENT = Display("%", 100.0, 1)

DISPLAYS = {
    "m": Display("mm", 1e3, 2),
    "m3": Display("cm3", 1e6, 2),
    "m/s": Display("mm/s", 1e3, 1),
    "rad": Display("deg", 180.0 / math.pi, 1),
    "Pa": Display("kPa", 1e-3, 0),
    "J": Display("mJ", 1e3, 2),
    "N": Display("N", 1.0, 2),
    "N m": Display("N m", 1.0, 3),
    "1": Display("", 1.0, 3),
}
"""SI unit -> how people read it. Other units are read as they are."""

EFFORTS = {"m": "N", "m3": "Pa", "rad": "N m", "1": "N m", "Pa": "m3"}
"""Unit of a displacement -> unit of the effort conjugate to it, if that has a name of its own."""


def display(unit: str) -> Display:
    """Return how people read quantities in an SI unit."""
    return DISPLAYS.get(unit, Display(unit))


def present(value: float, unit: str) -> str:
    """Return a quantity [unit] as people read it: ``"41.50 mm"``."""
    shown = display(unit)
    return f"{decimal(value * shown.factor, shown.decimals)}{' ' + shown.unit if shown.unit else ''}"


def effort_unit(unit: str) -> str:
    """Return the unit of the effort conjugate to a displacement in ``unit``: N for m, J/unit for an unknown one."""
    return EFFORTS.get(unit, f"J/{unit}")
