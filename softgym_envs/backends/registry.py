"""Registry of backends."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from softgym_envs.registry import Registry, check_options

if TYPE_CHECKING:
    from softgym_envs.backends.backend import Backend
    from softgym_envs.backends.batch import BatchBackend
    from softgym_envs.robots.base import Robot

BACKENDS = Registry(
    "backend",
    {
        "fem": "softgym_envs.backends.fem:FEMBackend",
        "surrogate": "softgym_envs.backends.surrogate:SurrogateBackend",
        "hybrid": "softgym_envs.backends.hybrid:HybridBackend",
    },
    base="softgym_envs.backends.backend:Backend",
    group="softgym_envs.backends",
)
"""Backends by name: those of the suite and of installed packages."""

BATCHES = Registry(
    "batched backend",
    {
        "fem": "softgym_envs.backends.fem_batch:FEMBatch",
        "surrogate": "softgym_envs.backends.surrogate:SurrogateBatch",
    },
    base="softgym_envs.backends.batch:BatchBackend",
)
"""Backends that step many bodies at once, by the same names."""


def backend_class(name: str, robot: Robot) -> type[Backend]:
    """Return the class of the backend with a name, for a robot that may have one of its own (`Robot.backends`).

    Raises:
        ValueError: for an unknown name.
    """
    found: type[Backend] = BACKENDS.resolve(robot.backends.get(name, name))
    return found


def check_backend(name: str, robot: Robot, options: Mapping[str, object]) -> None:
    """Check the options of a backend, besides robot and design, before it is made.

    Raises:
        ValueError: for an unknown name or option, or a value of the wrong type.
    """
    check_options(f"backend '{name}'", backend_class(name, robot), 2, options)


def make_backend(name: str, robot: Robot, **options: object) -> Backend:
    """Return the backend with a name, for a robot.

    Raises:
        ValueError: for an unknown name or option.
    """
    cls: Any = backend_class(name, robot)
    check_options(f"backend '{name}'", cls, 1, options)
    made: Backend = cls(robot, **options)
    return made


def is_batched(name: str, robot: Robot, options: Mapping[str, object]) -> bool:
    """Whether a backend with options steps many bodies of a robot at once (`BATCHES`)."""
    if name == "fem":
        return robot.made_of_beams and not robot.touches and options.get("scheme", "euler") == "euler"
    return name == "surrogate"


def make_batch_backend(name: str, robot: Robot, **options: object) -> BatchBackend:
    """Return the batched backend with a name, for a robot for which `is_batched` holds."""
    made: BatchBackend = BATCHES.resolve(name)(robot, **options)  # `check_backend` checks the options
    return made
