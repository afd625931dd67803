"""Learners beside those of stable-baselines3, and what learners of other packages need."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.extensions.learners.goals import GoalObservation as GoalObservation

__getattr__, __dir__, __all__ = lazy_exports(__name__, {"goals": ["GoalObservation"]})
