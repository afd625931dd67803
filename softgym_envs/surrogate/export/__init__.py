"""Trained condensed models outside Python: a C header for microcontrollers, an ONNX graph for everything else."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.surrogate.export.c import export_c as export_c
    from softgym_envs.surrogate.export.common import FORMATS as FORMATS
    from softgym_envs.surrogate.export.onnx import export_onnx as export_onnx

__getattr__, __dir__, __all__ = lazy_exports(
    __name__, {"c": ["export_c"], "common": ["FORMATS"], "onnx": ["export_onnx"]}
)
