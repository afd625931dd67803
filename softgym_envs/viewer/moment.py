"""One state of a rollout, as it is drawn or written, and what takes such states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from softgym_envs.backends.backend import State


@dataclass(frozen=True)
class Moment:
    """One state of a rollout.

    Attributes:
        step: control step.
        design: the body.
        state: its state; a state without nodes is drawn in the shape of a finite-element model.
        goal: the current goal [m], shape (3,).
        path: all goals of the episode [m], shape (p, 3).
        reward: reward of the step to this state; None after a reset.
        distance: distance to the goal as the task measures it [m]; default: Euclidean.
    """

    step: int
    design: Mapping[str, float]
    state: State
    goal: np.ndarray
    path: np.ndarray | None = None
    reward: float | None = None
    distance: float | None = None


class Watcher(Protocol):
    """Takes the states of a rollout, one after the other."""

    def log(self, moment: Moment, /) -> None:
        """Draw or write one state."""
