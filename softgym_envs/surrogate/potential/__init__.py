"""The potential network: its model, hyper-parameters and training, as the registry of networks expects them."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.surrogate.potential.model import Model as Model
    from softgym_envs.surrogate.potential.training import Options as Options
    from softgym_envs.surrogate.potential.training import train as train

__getattr__, __dir__, __all__ = lazy_exports(__name__, {"model": ["Model"], "training": ["Options", "train"]})
