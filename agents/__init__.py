"""Agents: training, evaluation and export of policies, and agents that need no training, such as the inverse QP."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.agents.config import EnvironmentConfig as EnvironmentConfig
    from softgym_envs.agents.config import TrainConfig as TrainConfig
    from softgym_envs.agents.evaluation import evaluate as evaluate
    from softgym_envs.agents.policy import Policy as Policy
    from softgym_envs.agents.training import train as train
    from softgym_envs.agents.vec_env import SB3VecEnv as SB3VecEnv

if __name__ != "softgym_envs.agents":  # this folder is softgym_envs/agents, by a link
    raise ImportError(f"the package is softgym_envs.agents: import that in place of {__name__}")

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "config": ["EnvironmentConfig", "TrainConfig"],
        "evaluation": ["evaluate"],
        "policy": ["Policy"],
        "training": ["train"],
        "vec_env": ["SB3VecEnv"],
    },
)
