"""What metrics are computed from: each source is one argument that all functions of metrics of this source take."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softgym_envs.agents.evaluation import Evaluation
    from softgym_envs.mechanics.model import MechanicalModel
    from softgym_envs.robots.base import Robot


@dataclass(frozen=True)
class Source:
    """What metrics are computed from.

    Args:
        name: identifier.
        read: returns the argument of the functions for a body: an `Outcome` where a
            controller is evaluated, else what an extension evaluates.
        refuse: returns what a robot or a backend lacks for it, as in "metric 'x' needs ..."; empty if it lacks nothing.
        settings: makes and checks the settings of the source, which a configuration gives as plain data in ``sources``;
            called with None for the default ones. None for a source without settings.
    """

    name: str
    read: Callable[[Any], Any]
    refuse: Callable[[Robot, str], str] = lambda robot, backend: ""
    settings: Callable[[Any], Any] | None = None


def needs_fem(robot: Robot, backend: str) -> str:
    """Refuse all backends but finite elements."""
    return "" if backend == "fem" else f"backend 'fem', got '{backend}'"


@dataclass(frozen=True)
class Outcome:
    """One body and the evaluation of its controller.

    Attributes:
        evaluation: one episode per goal.
        design: complete design [SI].
        robot: the family of the body.
    """

    evaluation: Evaluation
    design: Mapping[str, float]
    robot: Robot

    @cached_property
    def model(self) -> MechanicalModel:
        """Mechanical model of the body; built when it is first used (seconds)."""
        return self.robot.build(self.design)


EPISODES = Source(
    "episodes", lambda outcome: outcome, lambda robot, backend: "episodes of a controller, which only a study has"
)
"""A body and the evaluation of its controller, an `Outcome`."""
STATES = Source("states", lambda body: body.course)
"""States of a batch of bodies from rest to the full command, with gradients on a surrogate."""
BODY = Source("body", lambda body: body.model)
"""The mechanical model of a body, a `softgym_envs.mechanics.model.MechanicalModel`."""
DESIGN = Source("design", lambda body: dict(body.design))
"""The values of the variables of a body [SI], ``{name: value}``."""

SOURCES = {source.name: source for source in (EPISODES, STATES, BODY, DESIGN)}
"""Sources that a metric may name."""
