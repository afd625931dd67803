"""Learned condensed models: inference, trust and shipped weights."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.surrogate.model import SurrogateModel as SurrogateModel
    from softgym_envs.surrogate.pretrained import pretrained_model as pretrained_model

__getattr__, __dir__, __all__ = lazy_exports(
    __name__, {"model": ["SurrogateModel"], "pretrained": ["pretrained_model"]}
)
