"""Exceptions of the suite. Every message names the thing, its value and what is allowed."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from os.path import commonprefix


class SoftGymError(Exception):
    """Base class of all errors that softgym-envs raises for its users."""


class DesignError(SoftGymError, ValueError):
    """A design has an unknown, missing, out-of-range or non-finite variable."""


class InfeasibleDesign(SoftGymError):
    """A design within its bounds whose geometry cannot exist or cannot be meshed in time.

    An optimiser treats it as a result and continues.
    """


class MeshingError(SoftGymError):
    """The mesh generator is missing or a drawing function fails; the design is never the cause."""


class ConvergenceError(SoftGymError):
    """No equilibrium was found.

    Attributes:
        fraction: reached share of the requested load increment, in [0, 1).
    """

    def __init__(self, message: str, *, fraction: float = 0.0) -> None:
        super().__init__(message)
        self.fraction = fraction


class ImpossibleState(ConvergenceError, InfeasibleDesign):
    """An equilibrium of the equations that no body has: walls passed through each other, or cells turned inside out."""


class DataError(SoftGymError):
    """A dataset, mesh or result file is missing, truncated, corrupted or of the wrong version."""


class WeightsError(DataError):
    """Network weights are missing, truncated, corrupted or of the wrong version."""


class MissingLibrary(SoftGymError, ImportError):
    """An optional library is not installed, or a system library that it loads is missing."""


class ConfigError(SoftGymError, ValueError):
    """A configuration file or command-line override is malformed."""


MAX_NAMES = 17
"""Largest number of allowed names that a message lists besides the nearest one."""


def unknown_name(kind: str, name: str, allowed: Iterable[str], *, other: str = "") -> str:
    """Return the message for a name that does not exist: the nearest name, if there is one, and the allowed names.

    A long list of allowed names is omitted if there is a near one.

    Args:
        kind: what the name should be: ``"robot"``, ``"option"``, ...
        name: the name given.
        allowed: the names that exist.
        other: what may be given instead of a name: ``"a policy file"``.
    """
    allowed = list(allowed)
    # Ignore a prefix or suffix that all names share, as in environment IDs.
    start = commonprefix(allowed) if len(allowed) > 1 else ""
    end = commonprefix([each[::-1] for each in allowed])[::-1] if len(allowed) > 1 else ""

    def core(text: str) -> str:
        return text.removeprefix(start).removesuffix(end).lower()

    cores = {core(each): each for each in allowed}
    near = get_close_matches(core(str(name)), cores, n=1)
    hint = f"did you mean '{cores[near[0]]}'? " if near else ""
    if near and len(allowed) > MAX_NAMES:
        return f"unknown {kind} '{name}'; {hint}{f'allowed too: {other}' if other else ''}".rstrip()
    names = [*allowed, f"or {other}"] if other else allowed
    return f"unknown {kind} '{name}'; {hint}allowed: {', '.join(names) or 'none'}"


def no_equilibrium(
    target: Iterable[float], modes: Iterable[str], done: float, reached: Iterable[float]
) -> ConvergenceError:
    """Return the error for commands of actuators that have no equilibrium.

    Args:
        target: commands.
        modes: what they command, ``"displacement"`` or ``"effort"``.
        done: reached share of the load increment, in [0, 1).
        reached: commands of the last equilibrium.
    """
    wanted, last = (", ".join(f"{value:.6g}" for value in values) for values in (target, reached))
    return ConvergenceError(
        f"no equilibrium for actuators [{wanted}] ({'/'.join(sorted(set(modes)))}): "
        f"stopped at {100 * done:.1f} % of the increment, actuators [{last}]",
        fraction=done,
    )
