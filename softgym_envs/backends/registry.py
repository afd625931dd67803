"""Registry of backends."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

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


HANDS = Registry(
    "backend",
    {
        "fem": "softgym_envs.backends.fem:FEMBackend",
        "surrogate": "softgym_envs.backends.chain_hand:ChainHandBackend",
        "hybrid": "softgym_envs.backends.hybrid_chain:HybridHandBackend",
    },
    base="softgym_envs.backends.backend:Backend",
)
"""Backends of hands of fingers that are learned as chains, by the same names."""

BATCHES = Registry(
    "batched backend",
    {
        "fem": "softgym_envs.backends.fem_batch:FEMBatch",
        "surrogate": "softgym_envs.backends.surrogate:SurrogateBatch",
    },
    base="softgym_envs.backends.batch:BatchBackend",
)
"""Backends that step many bodies at once, by the same names."""

LEARNED = {"potential": BACKENDS, "chain": CHAINS, "hand": HANDS}
"""Backends by what is learned of a robot."""


def check_backend(name: str, robot: Robot, options: Mapping[str, object]) -> None:
    """Check the options of a backend, besides robot and design, before it is made.

    Raises:
        ValueError: for an unknown name or option, or a value of the wrong type.
    """
    check_options(f"backend '{name}'", LEARNED[robot.learned].resolve(name), 2, options)


def make_backend(name: str, robot: Robot, **options: object) -> Backend:
    """Return the backend with a name, for a robot.

    Raises:
        ValueError: for an unknown name or option.
    """
    return LEARNED[robot.learned].make(name, robot, **options)


def is_batched(name: str, robot: Robot, options: Mapping[str, object]) -> bool:
    """Whether a backend with options steps many bodies of a robot at once (`BATCHES`)."""
    if name == "fem":
        return robot.made_of_beams and not robot.touches and options.get("scheme", "euler") == "euler"
    return name == "surrogate"


def make_batch_backend(name: str, robot: Robot, **options: object) -> BatchBackend:
    """Return the batched backend with a name, for a robot for which `is_batched` holds."""
    made: BatchBackend = BATCHES.resolve(name)(robot, **options)  # `check_backend` checks the options
    return made
