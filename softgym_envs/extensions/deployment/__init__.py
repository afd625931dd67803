"""Deployment: surrogates, controllers and policies in C and as ONNX graphs, bodies for CAD, moulds."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.extensions.deployment.cad import export_body as export_body
    from softgym_envs.extensions.deployment.controller_c import export_controller_c as export_controller_c
    from softgym_envs.extensions.deployment.embedded import EmbeddedLoop as EmbeddedLoop
    from softgym_envs.extensions.deployment.mjcf import export_mjcf as export_mjcf
    from softgym_envs.extensions.deployment.moulds import export_moulds as export_moulds
    from softgym_envs.extensions.deployment.policy_c import export_policy_c as export_policy_c
    from softgym_envs.extensions.deployment.policy_onnx import export_policy_onnx as export_policy_onnx
    from softgym_envs.extensions.deployment.surrogate_c import export_c as export_c
    from softgym_envs.extensions.deployment.surrogate_onnx import export_onnx as export_onnx

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "cad": ["export_body"],
        "controller_c": ["export_controller_c"],
        "embedded": ["EmbeddedLoop"],
        "mjcf": ["export_mjcf"],
        "moulds": ["export_moulds"],
        "policy_c": ["export_policy_c"],
        "policy_onnx": ["export_policy_onnx"],
        "surrogate_c": ["export_c"],
        "surrogate_onnx": ["export_onnx"],
    },
)
