"""Agents: SAC training, evaluation and baselines (inverse QP, random actions)."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from agents.config import EnvironmentConfig as EnvironmentConfig
    from agents.config import TrainConfig as TrainConfig
    from agents.evaluation import evaluate as evaluate
    from agents.export import export_policy_onnx as export_policy_onnx
    from agents.export_c import export_policy_c as export_policy_c
    from agents.policy import Policy as Policy
    from agents.training import train as train
    from agents.vec_env import SB3VecEnv as SB3VecEnv

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "config": ["EnvironmentConfig", "TrainConfig"],
        "evaluation": ["evaluate"],
        "export": ["export_policy_onnx"],
        "export_c": ["export_policy_c"],
        "policy": ["Policy"],
        "training": ["train"],
        "vec_env": ["SB3VecEnv"],
    },
)
