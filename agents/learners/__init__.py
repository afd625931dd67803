"""Learning methods; each is a file with a class, its section in `TrainConfig`, and a row here or an entry point."""

from __future__ import annotations

from typing import TYPE_CHECKING

from softgym_envs.agents.config import TrainConfig
from softgym_envs.registry import Registry

if TYPE_CHECKING:
    from softgym_envs.agents.learners.base import Learner

LEARNERS = Registry(
    "learner",
    {
        "sac": "softgym_envs.agents.learners.sac:SACLearner",
        "ppo": "softgym_envs.agents.learners.ppo:PPOLearner",
        "analytic": "softgym_envs.agents.learners.analytic:AnalyticLearner",
        "cloning": "softgym_envs.agents.learners.cloning:CloningLearner",
    },
    base="softgym_envs.agents.learners.base:Learner",
    group="softgym_envs.learners",
)
"""Learners by name: those of the suite and of installed packages."""


def make_learner(config: TrainConfig) -> Learner:
    """Return a new learner of the method that a configuration names.

    Raises:
        ValueError: if the environment cannot be made, or the method cannot learn in it.
    """
    learner: Learner = LEARNERS.find(config.learner)(config)
    return learner
