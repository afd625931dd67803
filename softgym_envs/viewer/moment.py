"""One state of a rollout, as it is drawn or written, and what takes such states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from softgym_envs.registry import Table

if TYPE_CHECKING:
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


@dataclass(frozen=True)
class EpisodeWriter:
    """An option of ``softgym rollout`` that writes the episode to a file or folder.

    Attributes:
        place: ``"module:class"`` of a `Watcher` and context manager that takes the robot and the path.
        help: of the option.
        suffix: with which files end; none for a folder.
        hint: what to do with what was written.
    """

    place: str
    help: str
    suffix: str = ""
    hint: str = ""


WRITERS = Table("writer of episodes", {}, group="softgym_envs.writers")
"""`EpisodeWriter` of installed packages, by the name of the option."""


class Watcher(Protocol):
    """Takes the states of a rollout, one after the other."""

    def log(self, moment: Moment, /) -> None:
        """Draw or write one state."""
