"""Kinds of networks; each is a module with its model, its hyper-parameters and its training."""

from __future__ import annotations

from types import ModuleType

from softgym_envs.registry import Table

NETWORKS = Table("network", {"potential": "softgym_envs.surrogate.potential"}, group="softgym_envs.networks")
"""Kind to module. Each module has ``Model`` (a `SurrogateModel`), ``Options`` (its hyper-parameters, a `Config` whose
``kind`` is its key) and ``train(robot, training, validation, trainer) -> (tensors, histories)``."""


def network_module(kind: str) -> ModuleType:
    """Return the module of a network kind.

    Raises:
        ValueError: for an unknown kind.
    """
    module: ModuleType = NETWORKS.find(kind)
    return module
