"""Registry of backends."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from softgym_envs.registry import Registry, check_options, import_object

if TYPE_CHECKING:
    from softgym_envs.backends.backend import Backend
    from softgym_envs.backends.batch import BatchBackend
    from softgym_envs.robots.base import Robot

BACKENDS = Registry(
    "backend",
    {
        "fem": "softgym_envs.backends.fem:FEMBackend",
        "surrogate": "softgym_envs.backends.surrogate:SurrogateBackend",
    },
    base="softgym_envs.backends.backend:Backend",
    group="softgym_envs.backends",
)
"""Backends of all robots by name; `Robot.backends` replaces them for one robot."""


def backend_class(name: str, robot: Robot) -> type[Backend]:
    """Return the class of a robot's backend with a name.

    Raises:
        ValueError: for an unknown name.
    """
    found: type[Backend] = BACKENDS.resolve(robot.backends.get(name, name))
    return found


def check_backend(name: str, robot: Robot, options: Mapping[str, object]) -> None:
    """Check the options of a backend, besides robot and design, before it is made.

    Raises:
        ValueError: for an unknown name or option, a value of the wrong type, or actuators that the backend does not
            take.
    """
    found = backend_class(name, robot)
    if not found.commands_efforts:
        robot.needs_displacements(f"backend '{name}'")
    check_options(f"backend '{name}'", found, 2, options)


def takes_option(name: str, robot: Robot, option: str) -> bool:
    """Return whether a robot's backend with a name has an option."""
    return option in inspect.signature(backend_class(name, robot)).parameters


def make_backend(name: str, robot: Robot, design: Mapping[str, float] | None = None, **options: object) -> Backend:
    """Return the backend with a name, for a robot.

    Raises:
        ValueError: for an unknown name or option.
    """
    check_backend(name, robot, options)
    made: Backend = backend_class(name, robot)(robot, design, **options)  # type: ignore[call-arg]
    return made


def batch_class(name: str, robot: Robot, options: Mapping[str, object]) -> type[BatchBackend] | None:
    """Return what steps many bodies at once as a robot's backend with a name and options; None for nothing."""
    found: Any = backend_class(name, robot).batch_class(robot, options)
    return import_object("batched backend", found) if isinstance(found, str) else found
