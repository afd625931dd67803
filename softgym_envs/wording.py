"""Numbers in text: decimals that do not hide a small value, counts with their noun, times."""

from __future__ import annotations

import math

ROUND_OFF = 1e-12
"""Below this, in the unit that people read, a number is the round-off of a difference."""
MAX_DECIMALS = 6
"""A number that needs more decimals is written with an exponent."""


def decimal(value: float, decimals: int, sign: str = "") -> str:
    """Return a number with ``decimals`` decimals, or with two significant digits if it is too small for them.

    With two decimals: ``"12.35"``, ``"0.12"``, ``"0.028"``, ``"0.00"`` for zero.

    Args:
        value: number, in the unit that people read.
        decimals: decimals of a number that is not small.
        sign: as in a format: ``"+"`` also writes the sign of positive numbers.
    """
    if abs(value) < ROUND_OFF:
        value = 0.0  # no negative zero
    elif abs(round(value, decimals)) < 10.0 ** (1 - decimals):
        decimals = 1 - math.floor(math.log10(abs(value)))
        if decimals > MAX_DECIMALS:
            return f"{value:{sign}.1e}"
    return f"{round(value, decimals) + 0.0:{sign}.{decimals}f}"


def counted(count: int, noun: str) -> str:
    """Return a count with its noun: ``"1 test goal"``, ``"2 test goals"``, ``"3 bodies"``."""
    if count == 1:
        return f"{count} {noun}"
    plural = f"{noun[:-1]}ies" if noun.endswith("y") else f"{noun}es" if noun.endswith("s") else f"{noun}s"
    return f"{count} {plural}"


def time_text(seconds: float) -> str:
    """Return a time: ``"2.4 s"``, or ``"10.1 min"`` from a minute on."""
    return f"{seconds:.1f} s" if seconds < 60.0 else f"{seconds / 60.0:.1f} min"


def brief(value: object, most: int = 100) -> str:
    """Return a value as people write it, in one line of at most ``most`` characters."""
    text = " ".join(repr(value).split())
    return text if len(text) <= most else f"{text[: most - 4]} ..."
