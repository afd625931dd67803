"""The exception tree of the suite: every error names the thing, its value and what is allowed."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

__all__ = [
    "ConfigError",
    "ConvergenceError",
    "DataError",
    "DesignError",
    "InfeasibleDesign",
    "MeshingError",
    "SoftGymError",
    "WeightsError",
]


class SoftGymError(Exception):
    """Base of all errors raised on purpose by softgym-envs."""


class DesignError(SoftGymError, ValueError):
    """A design has an unknown, missing, out-of-range or non-finite variable."""


class InfeasibleDesign(SoftGymError):
    """A design inside its box whose geometry cannot exist or cannot be meshed in time.

    This is a result for an optimiser, never a crash.
    """


class MeshingError(SoftGymError):
    """The mesh generator is missing, or a drawing function fails: this is never the fault of a design."""


class ConvergenceError(SoftGymError):
    """No equilibrium was found.

    Attributes:
        fraction: part of the requested load increment that was reached, in [0, 1).
    """

    def __init__(self, message: str, *, fraction: float = 0.0) -> None:
        super().__init__(message)
        self.fraction = fraction


class DataError(SoftGymError):
    """A dataset, mesh or result file is missing, truncated, corrupted or of the wrong version."""


class WeightsError(DataError):
    """Network weights are missing, truncated, corrupted or of the wrong version."""


class ConfigError(SoftGymError, ValueError):
    """A configuration file or command-line override is malformed."""


def unknown_name(kind: str, name: str, allowed: Iterable[str]) -> str:
    """Return the message for a name that does not exist: the nearest one, if any is near, and all that are allowed.

    Args:
        kind: what the name should be: ``"robot"``, ``"option"``, ...
        name: the name given.
        allowed: the names that exist.
    """
    allowed = list(allowed)
    near = get_close_matches(str(name), allowed, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    return f"unknown {kind} '{name}'; {hint}allowed: {', '.join(allowed) or 'none'}"
