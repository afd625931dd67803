"""Objectives: the numbers by which a study compares bodies.

`OBJECTIVES` has those of the package. A study can also use one of your own by its place, ``my_module:my_objective``: an
`Objective`, or a function of an `Outcome` that is to be minimised.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.errors import unknown_name
from softgym_envs.registry import import_object
from softgym_envs.wording import decimal

if TYPE_CHECKING:
    from softgym_envs.agents.evaluation import Evaluation
    from softgym_envs.envs.tasks.base import Task
    from softgym_envs.mechanics.model import MechanicalModel
    from softgym_envs.robots.base import Robot

EFFORT_UNITS = {"m": ("N", 1.0), "m3": ("kPa", 1e-3), "rad": ("N m", 1.0)}
"""Unit of an actuator's displacement -> unit in which people read its effort, and the factor to it from SI."""


@dataclass(frozen=True)
class Outcome:
    """What an objective can use: one body and the evaluation of its controller.

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


@dataclass(frozen=True)
class Measurement:
    """Value of an objective [SI]."""

    value: float  # mean over the goals
    per_goal: list[float] | None = None  # for each goal, if the objective has such values


@dataclass(frozen=True)
class Objective:
    """A number by which bodies are compared.

    Args:
        name: name in `OBJECTIVES`, or ``module:attribute``.
        function: takes an `Outcome`, returns one number [SI] or one for each goal, whose mean is then the objective.
        label: name in tables and figures.
        unit: unit in tables and figures.
        scale: factor from SI to ``unit``.
        maximize: whether larger is better.
        of_body: whether it depends on the body alone, and not on its controller.
    """

    name: str
    function: Callable[[Outcome], Any]
    label: str
    unit: str = ""
    scale: float = 1.0
    maximize: bool = False
    of_body: bool = False

    @property
    def sign(self) -> int:
        """1 if larger is better, else -1."""
        return 1 if self.maximize else -1

    def measure(self, outcome: Outcome) -> Measurement:
        """Return the value for one body.

        Raises:
            ValueError: if a function of your own returns something else than finite numbers, one or one per goal.
        """
        found = np.asarray(self.function(outcome))
        goals = len(outcome.evaluation.distances)
        if found.dtype.kind not in "bif" or found.shape not in ((), (goals,)):
            raise ValueError(
                f"objective '{self.name}' returned {found!r}; it must return one number, or one for each of {goals} "
                "goals"
            )
        if self.name not in OBJECTIVES and not np.isfinite(found).all():
            raise ValueError(
                f"objective '{self.name}' is not finite for design {dict(outcome.design)}; raise InfeasibleDesign if "
                "the body cannot exist"
            )
        return Measurement(float(found.mean()), found.astype(float).tolist() if found.ndim else None)

    def score(self, value: float) -> float:
        """Score of a value [SI]; larger is better."""
        return self.sign * value

    def shown(self, score: Any) -> Any:
        """Value behind a score, or an array of them, in ``unit``."""
        return self.sign * score * self.scale

    def text(self, value: float | None, sign: str = "") -> str:
        """A value [SI] with its unit, or ``"-"``."""
        if value is None:
            return "-"
        unit = "pp" if sign and self.unit == "%" else self.unit
        return f"{self.number(value, sign)}{' ' + unit if unit else ''}"

    def number(self, value: float, sign: str = "") -> str:
        """A value [SI] in ``unit``, without naming it; two significant digits if it is small."""
        return decimal(value * self.scale, 1 if self.unit == "%" else 2, sign)

    @property
    def axis(self) -> str:
        """Label and unit, for figures: ``"Mean actuator effort [N]"``."""
        return f"{self.label}{f' [{self.unit}]' if self.unit else ''}"

    @property
    def axis_inside(self) -> str:
        """Label and unit inside a sentence: ``"mean actuator effort [N]"``."""
        return self.axis[0].lower() + self.axis[1:]

    def excess(self, value: float, limit: float) -> float:
        """By how much a value violates a constraint [SI]; positive if it does."""
        return self.sign * (limit - value)

    def constraint_text(self, limit: float) -> str:
        """A constraint in words: ``"mean actuator effort at most 8.00 N"``."""
        return f"{self.label.lower()} {'at least' if self.maximize else 'at most'} {self.text(limit)}"

    def violation_text(self, value: float, limit: float) -> str:
        """A violated constraint in words: ``"mean actuator effort 8.31 N exceeds 8.00 N by 0.31 N"``."""
        verb = "is below" if self.maximize else "exceeds"
        return f"{self.label.lower()} {self.text(value)} {verb} {self.text(limit)} by {self.text(abs(value - limit))}"


OBJECTIVES: dict[str, Objective] = {
    objective.name: objective
    for objective in (
        Objective("success_rate", lambda o: o.evaluation.successes, "Success rate", "%", 100.0, maximize=True),
        Objective("mean_distance", lambda o: o.evaluation.distances, "Mean final distance", "mm", 1e3),
        Objective("mean_return", lambda o: o.evaluation.returns, "Mean return", maximize=True),
        Objective(
            "mean_tracking_distance", lambda o: o.evaluation.tracking_distances, "Mean tracking distance", "mm", 1e3
        ),
        Objective("mean_effort", lambda o: o.evaluation.efforts, "Mean actuator effort", "N"),
        Objective("untrusted_share", lambda o: o.evaluation.untrusted, "Share of untrusted states", "%", 100.0),
        Objective("material_volume", lambda o: o.model.volume, "Material volume", "cm3", 1e6, of_body=True),
    )
}
"""Registry: name to objective."""

PATH_OBJECTIVES = ("mean_return", "mean_tracking_distance", "mean_effort", "untrusted_share")
"""Objectives that are means or sums over the steps of an episode."""


def find_objective(name: str, robot: Robot, task: type[Task]) -> Objective:
    """Return an objective, with the units that it has for a robot and a task.

    Args:
        name: name in `OBJECTIVES`, or the place of one of your own, ``module:attribute``.
        robot: decides the unit of efforts.
        task: decides the unit of distances.

    Raises:
        ValueError: if there is no such objective.
    """
    if ":" in name:
        return _import_objective(name)
    if name not in OBJECTIVES:
        raise ValueError(unknown_name("objective", name, OBJECTIVES, other="one of your own as 'module:attribute'"))
    objective = OBJECTIVES[name]
    if name == "mean_effort":
        units = {EFFORT_UNITS.get(actuator.unit, (f"J/{actuator.unit}", 1.0)) for actuator in robot.actuators}
        unit, scale = units.pop() if len(units) == 1 else ("SI units", 1.0)
        objective = replace(objective, unit=unit, scale=scale)
    if name in ("mean_distance", "mean_tracking_distance"):
        shown = task.distance_scale
        label = objective.label.replace("distance", shown.name)
        objective = replace(objective, label=label, unit=shown.unit, scale=shown.factor)
    return objective


def _import_objective(path: str) -> Objective:
    found = import_object("objective", path)
    if isinstance(found, Objective):
        return replace(found, name=path)
    if not callable(found):
        raise ValueError(f"objective '{path}' must be an Objective or a function, got {type(found).__name__}")
    return Objective(path, found, path.partition(":")[2].replace("_", " ").capitalize())


def objective_name(objective: str | Objective | Callable[[Outcome], Any]) -> str:
    """Return the name by which worker processes find an objective: in `OBJECTIVES`, or ``module:attribute``.

    Raises:
        ValueError: if workers cannot import it, such as a lambda or a function inside another one.
    """
    if isinstance(objective, str):
        return objective
    if isinstance(objective, Objective) and OBJECTIVES.get(objective.name) is objective:
        return objective.name
    function = objective.function if isinstance(objective, Objective) else objective
    module = sys.modules.get(getattr(function, "__module__", ""))
    for attribute, value in vars(module).items() if module is not None else ():
        if value is objective:
            name = module.__name__ if module is not None else ""
            if name == "__main__":  # workers import the script by its file name
                name = Path(getattr(module, "__file__", None) or "__main__").stem
            return f"{name}:{attribute}"
    raise ValueError(f"objective {objective!r} cannot be imported by workers: define it at the top level of a module")
