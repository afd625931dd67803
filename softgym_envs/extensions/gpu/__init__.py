"""Environments on tensors: thousands of bodies on a learned model, on a GPU or a CPU."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.extensions.gpu.environment import TorchVectorEnv as TorchVectorEnv

__getattr__, __dir__, __all__ = lazy_exports(__name__, {"environment": ["TorchVectorEnv"]})
