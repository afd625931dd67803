"""Kinds of networks that weights may be of."""

from __future__ import annotations

from softgym_envs.registry import Table

NETWORKS = Table("network", {"potential": "softgym_envs.surrogate.potential.model"}, group="softgym_envs.networks")
"""Kind to module. Each module has ``Model``, a `SurrogateModel`; to be fitted, it needs more."""
