"""Units that people read: lengths in mm, pressures in kPa, times in seconds or minutes."""

from __future__ import annotations

from softgym_envs.wording import decimal

SHOWN = {"m": ("mm", 1e3, 2), "Pa": ("kPa", 1e-3, 0), "1": ("", 1.0, 3)}


def shown_unit(unit: str) -> tuple[str, float, int]:
    """Return the unit that people read, the factor to it from SI, and the number of decimals."""
    return SHOWN.get(unit, (unit, 1.0, 3))


def present(value: float, unit: str) -> str:
    """Return a quantity [unit] as people read it: ``"41.50 mm"``."""
    name, factor, decimals = shown_unit(unit)
    return f"{decimal(value * factor, decimals)}{' ' + name if name else ''}"


def time_text(seconds: float) -> str:
    """Return a time: ``"2.4 s"``, or ``"10.1 min"`` from a minute on."""
    return f"{seconds:.1f} s" if seconds < 60.0 else f"{seconds / 60.0:.1f} min"
