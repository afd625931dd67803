"""Learning methods. A new one needs its own file, its section in `TrainConfig` and one row here."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from softgym_envs.agents.config import TrainConfig

if TYPE_CHECKING:
    from softgym_envs.agents.learners.base import Learner

LEARNERS = {
    "sac": "softgym_envs.agents.learners.sac:SACLearner",
    "ppo": "softgym_envs.agents.learners.ppo:PPOLearner",
    "analytic": "softgym_envs.agents.learners.analytic:AnalyticLearner",
    "cloning": "softgym_envs.agents.learners.cloning:CloningLearner",
    "recurrent": "softgym_envs.agents.learners.recurrent:RecurrentLearner",
    "evolution": "softgym_envs.agents.learners.evolution:EvolutionLearner",
}


def make_learner(config: TrainConfig) -> Learner:
    """Return a new learner of the method that a configuration names.

    Raises:
        ValueError: if the environment cannot be made, or the method cannot learn in it.
    """
    module, _, name = LEARNERS[config.learner].partition(":")
    return getattr(import_module(module), name)(config)
