"""Backends: one interface, several physics. A new backend needs its file and one row in `BACKENDS`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from softgym_envs.registry import make_registered

if TYPE_CHECKING:
    from softgym_envs.backends.backend import Backend
    from softgym_envs.robots.base import Robot

__all__ = ["BACKENDS", "make_backend"]

BACKENDS: dict[str, str] = {
    "fem": "softgym_envs.backends.fem:FEMBackend",
    "surrogate": "softgym_envs.backends.surrogate:SurrogateBackend",
    "hybrid": "softgym_envs.backends.hybrid:HybridBackend",
}
"""Registry: name to ``module:class``, imported when used."""


def make_backend(name: str, robot: Robot, **options: object) -> Backend:
    """Return a backend for a robot by its registry name.

    Raises:
        ValueError: for an unknown name or a wrong option.
    """
    return make_registered("backend", BACKENDS, name, robot, **options)
