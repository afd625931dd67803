"""Backends: one interface, several physics. A new backend needs its file and one row in `BACKENDS`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from softgym_envs.registry import Registry

if TYPE_CHECKING:
    from softgym_envs.backends.backend import Backend
    from softgym_envs.robots.base import Robot

__all__ = ["BACKENDS", "make_backend"]

BACKENDS = Registry(
    "backend",
    {
        "fem": "softgym_envs.backends.fem:FEMBackend",
        "surrogate": "softgym_envs.backends.surrogate:SurrogateBackend",
        "hybrid": "softgym_envs.backends.hybrid:HybridBackend",
    },
    base="softgym_envs.backends.backend:Backend",
)
"""Backends by name."""


def make_backend(name: str, robot: Robot, **options: object) -> Backend:
    """Return a backend for a robot by its registry name.

    Raises:
        ValueError: for an unknown name or a wrong option.
    """
    return BACKENDS.make(name, robot, **options)
