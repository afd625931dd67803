"""Registry of network kinds; each module holds the model, its hyper-parameters and its training."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

NETWORKS: dict[str, str] = {
    "potential": "softgym_envs.surrogate.potential",
    "residual": "softgym_envs.surrogate.baselines.residual",
    "thesis": "softgym_envs.surrogate.baselines.thesis",
    "rbf": "softgym_envs.surrogate.baselines.rbf",
}
"""Kind to module. Each module has ``Model`` (a `SurrogateModel`), ``Options`` (its hyper-parameters, a `Config` whose
``kind`` is its key) and ``train(robot, training, validation, trainer) -> (tensors, histories)``."""


def network_module(kind: str) -> ModuleType:
    """Return the module of a network kind.

    Raises:
        ValueError: for an unknown kind.
    """
    if kind not in NETWORKS:
        raise ValueError(f"unknown network {kind!r}; allowed: {', '.join(NETWORKS)}")
    return import_module(NETWORKS[kind])
