"""Registry of backends."""

from __future__ import annotations

from typing import TYPE_CHECKING

from softgym_envs.registry import Registry

if TYPE_CHECKING:
    from softgym_envs.backends.backend import Backend
    from softgym_envs.robots.base import Robot

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

CHAINS = Registry(
    "backend",
    {
        "fem": "softgym_envs.backends.fem:FEMBackend",
        "surrogate": "softgym_envs.backends.chain:ChainBackend",
        "hybrid": "softgym_envs.backends.hybrid_chain:HybridChainBackend",
    },
    base="softgym_envs.backends.backend:Backend",
)
"""Backends of robots that are learned as chains, by the same names."""


def make_backend(name: str, robot: Robot, **options: object) -> Backend:
    """Return the backend with a name, for a robot.

    Raises:
        ValueError: for an unknown name or option.
    """
    return (CHAINS if robot.learned == "chain" else BACKENDS).make(name, robot, **options)
