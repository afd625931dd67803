"""Fitting of surrogates: states on finite elements, training, calibration of trust; `softgym dataset`, `fit`, ...

The core uses fitted weights (`softgym_envs.surrogate`); this package makes them.
"""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.extensions.fitting.torch_potential import TorchModel as TorchModel
    from softgym_envs.extensions.fitting.training import FitConfig as FitConfig
    from softgym_envs.extensions.fitting.training import fit as fit

__getattr__, __dir__, __all__ = lazy_exports(
    __name__, {"torch_potential": ["TorchModel"], "training": ["FitConfig", "fit"]}
)
