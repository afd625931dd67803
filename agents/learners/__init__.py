"""Learning methods. A new one is a file with a class derived from `Learner`, and a row here or an entry point."""

from softgym_envs.registry import Registry

LEARNERS = Registry(
    "learner",
    {
        "sac": "softgym_envs.agents.learners.sac:SACLearner",
        "ppo": "softgym_envs.agents.learners.ppo:PPOLearner",
    },
    base="softgym_envs.agents.learners.base:Learner",
    group="softgym_envs.learners",
)
"""Learners by name: those of the suite and of installed packages."""
