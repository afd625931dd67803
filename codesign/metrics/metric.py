"""Metrics: the numbers by which bodies are compared, with a controller or without.

`METRICS` has those of the suite and of installed packages (entry points of the group ``softgym_envs.metrics``). One of
your own is a function that `metric` decorates; name it by its place, ``my_module:my_metric``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from softgym_envs.codesign.metrics.sources import EPISODES, SOURCES, Source
from softgym_envs.errors import unknown_name
from softgym_envs.registry import Table, import_place
from softgym_envs.units import Display, display, effort_unit
from softgym_envs.wording import decimal

if TYPE_CHECKING:
    from softgym_envs.codesign.metrics.sources import Outcome
    from softgym_envs.envs.tasks.base import Task
    from softgym_envs.robots.base import Robot

Direction = Literal["maximize", "minimize"]


@dataclass(frozen=True)
class Measurement:
    """Value of a metric of episodes [SI]."""

    value: float  # mean over the goals, or that of the worst one (`Metric.worst`)
    per_goal: list[float] | None = None  # for each goal, if the metric has such values


@dataclass(frozen=True)
class Metric:
    """A number by which bodies are compared.

    Args:
        name: identifier, as in configurations and tables.
        function: takes what its source provides, see `softgym_envs.codesign.metrics.sources`, and returns a number
            [SI]; of episodes also one number per goal, whose mean (or worst) is the metric; of states one per body.
        unit: SI unit, ``"1"`` for a plain number. ``"effort"`` and ``"distance"`` stand for the unit of the efforts of
            the robot and of the distances of the task.
        direction: what a designer usually wants: ``"maximize"`` or ``"minimize"``.
        source: what the function takes: ``"episodes"``, ``"states"``, ``"body"``, ``"design"`` or a `Source`.
        label: name in tables and figures; default the name in words.
        shown: how people read it; default by the unit.
        over_path: whether it is a mean or sum over the steps of an episode, and so not known from where episodes end.
        worst: whether the worst goal counts, as for limits of a drive, and not the mean over the goals. Tests of ends
            know the worst of the ends.
        description: one line for tables; default the first line of the function's documentation.

    Raises:
        ValueError: for an unknown direction or source.
    """

    name: str
    function: Callable[[Any], Any]
    unit: str = "1"
    direction: Direction = "minimize"
    source: Source = EPISODES
    label: str = ""
    shown: Display | None = None
    over_path: bool = False
    worst: bool = False
    description: str = ""

    def __post_init__(self) -> None:
        if self.direction not in get_args(Direction):
            raise ValueError(f"metric '{self.name}': direction = {self.direction!r}; allowed: maximize, minimize")
        if isinstance(self.source, str):
            if self.source not in SOURCES:
                raise ValueError(f"metric '{self.name}': {unknown_name('source', self.source, SOURCES)}")
            object.__setattr__(self, "source", SOURCES[self.source])
        if not self.label:
            words = self.name.rpartition(":")[2].replace("_", " ")
            object.__setattr__(self, "label", words[:1].upper() + words[1:])
        if not self.description:
            lines = (self.function.__doc__ or self.name).strip().splitlines()
            object.__setattr__(self, "description", lines[0])

    def __call__(self, argument: Any) -> Any:
        """Return what the function returns."""
        return self.function(argument)

    def measure(self, outcome: Outcome) -> Measurement:
        """Return the value for one body and the episodes of its controller.

        Raises:
            ValueError: if the function returns something else than finite numbers, one or one per goal.
        """
        found = np.asarray(self.function(self.source.read(outcome)))
        goals = len(outcome.evaluation.distances)
        if found.dtype.kind not in "bif" or found.shape not in ((), (goals,)):
            raise ValueError(
                f"metric '{self.name}' returned {found!r}; it must return one number, or one for each of {goals} goals"
            )
        if self.name not in METRICS and not np.isfinite(found).all():
            raise ValueError(
                f"metric '{self.name}' is not finite for design {dict(outcome.design)}; raise InfeasibleDesign if the "
                "body cannot exist"
            )
        value = (found.min() if self.maximize else found.max()) if self.worst else found.mean()
        return Measurement(float(value), found.astype(float).tolist() if found.ndim else None)

    # -- comparison -------------------------------------------------------------------------------------------------

    @property
    def maximize(self) -> bool:
        """Whether larger is better."""
        return self.direction == "maximize"

    @property
    def sign(self) -> int:
        """1 if larger is better, else -1."""
        return 1 if self.maximize else -1

    @property
    def of_body(self) -> bool:
        """Whether it depends on the body alone, and not on its controller."""
        return self.source is not EPISODES

    def score(self, value: float) -> float:
        """Score of a value [SI]; larger is better."""
        return self.sign * value

    def excess(self, value: float, limit: float) -> float:
        """By how much a value violates a constraint [SI]; positive if it does."""
        return self.sign * (limit - value)

    # -- text -------------------------------------------------------------------------------------------------------

    @property
    def display(self) -> Display:
        """How people read it."""
        return display(self.unit) if self.shown is None else self.shown

    @property
    def scale(self) -> float:
        """Factor from SI to the unit that people read."""
        return self.display.factor

    def value_of(self, score: Any) -> Any:
        """Value behind a score, or an array of them, in the unit that people read."""
        return self.sign * score * self.scale

    def text(self, value: float | None, sign: str = "") -> str:
        """A value [SI] with its unit, or ``"-"``."""
        if value is None:
            return "-"
        unit = "pp" if sign and self.display.unit == "%" else self.display.unit
        return f"{self.number(value, sign)}{' ' + unit if unit else ''}"

    def number(self, value: float, sign: str = "") -> str:
        """A value [SI] in the unit that people read, without naming it; two significant digits if it is small."""
        return decimal(value * self.scale, 1 if self.display.unit == "%" else 2, sign)

    @property
    def stored_name(self) -> str:
        """Name and SI unit, for columns of values [SI]: ``"mean_distance [m]"``."""
        return self.name if self.unit == "1" else f"{self.name} [{self.unit}]"

    @property
    def axis(self) -> str:
        """Label and unit, for figures: ``"Mean actuator effort [N]"``."""
        return f"{self.label}{f' [{self.display.unit}]' if self.display.unit else ''}"

    @property
    def axis_inside(self) -> str:
        """Label and unit inside a sentence: ``"mean actuator effort [N]"``."""
        return self.axis[0].lower() + self.axis[1:]

    def constraint_text(self, limit: float) -> str:
        """A constraint in words: ``"mean actuator effort at most 8.00 N"``."""
        return f"{self.label.lower()} {'at least' if self.maximize else 'at most'} {self.text(limit)}"

    def violation_text(self, value: float, limit: float) -> str:
        """A violated constraint in words: ``"mean actuator effort 8.31 N exceeds 8.00 N by 0.31 N"``."""
        verb = "is below" if self.maximize else "exceeds"
        return f"{self.label.lower()} {self.text(value)} {verb} {self.text(limit)} by {self.text(abs(value - limit))}"


def metric(
    unit: str = "1", direction: Direction = "minimize", source: str | Source = EPISODES, **options: Any
) -> Callable[[Callable[[Any], Any]], Metric]:
    """Return a decorator that makes a `Metric` of a function, with the function's name.

    Examples:
        >>> @metric(unit="kg", direction="minimize", source="design")
        ... def mass(design):
        ...     return 1.1e3 * design["length"] * design["height"] ** 2
    """
    return lambda function: Metric(function.__name__, function, unit, direction, source, **options)  # type: ignore[arg-type]


class _Metrics(Table):
    def _checked(self, found: Any) -> Metric:
        if not isinstance(found, Metric):
            raise ValueError(f"a metric must be a Metric, got {found!r}")
        return found


TYPICAL = Display("% of the typical effort", 100.0, 0)
"""How efforts of several units are shown: as shares of `Robot.effort_scale`."""

_NAMES = (
    *("success_rate", "mean_distance", "mean_return", "mean_tracking_distance", "mean_effort"),
    "mean_settled_distance",
    *("largest_effort", "largest_strain", "self_force", "untrusted_share", "material_volume"),
    *("forward_speed", "relative_drift", "relative_slip", "cost_of_transport", "throw_range"),
)
METRICS: Mapping[str, Metric] = _Metrics(
    "metric",
    {name: f"softgym_envs.codesign.metrics.episodes:{name}" for name in _NAMES},
    group="softgym_envs.metrics",
)
"""Registry: name to metric."""


def find_metric(name: str | Metric, robot: Robot | None = None, task: type[Task] | None = None) -> Metric:
    """Return a metric, read in the units of a robot and a task.

    Args:
        name: name in `METRICS`, the place of one of your own, ``module:attribute``, or the metric itself. A plain
            function becomes a metric of episodes that is minimised.
        robot: decides how efforts are read.
        task: decides how distances are read.

    Raises:
        ValueError: if there is no such metric.
    """
    if isinstance(name, Metric):
        found: Any = name
    elif name in METRICS:
        found = METRICS[name]
    elif ":" in name:
        found = import_place("metric", name)
        if not isinstance(found, Metric):
            if not callable(found):
                raise ValueError(f"metric '{name}' must be a Metric or a function, got {type(found).__name__}")
            found = Metric(name.partition(":")[2], found)
    else:
        raise ValueError(unknown_name("metric", name, METRICS, other="one of your own as 'module:attribute'"))
    if found.unit == "effort" and robot is not None:
        units = {effort_unit(actuator.unit) for actuator in robot.actuators}
        found = replace(found, unit=units.pop()) if len(units) == 1 else replace(found, unit="1", shown=TYPICAL)
    if found.unit == "distance" and task is not None:
        scale = task.distance_scale
        label = found.label.replace("distance", scale.name)
        shown = Display(scale.unit, scale.factor, 1 if scale.unit == "%" else 2)
        found = replace(found, label=label, shown=shown, unit="1" if scale.unit == "%" else "m")
    return found


def metric_name(metric: str | Metric | Callable[[Any], Any]) -> str:
    """Return the name by which worker processes find a metric: in `METRICS`, or ``module:attribute``.

    Raises:
        ValueError: if workers cannot import it, such as a lambda or a function inside another one.
    """
    if isinstance(metric, str):
        return metric
    if isinstance(metric, Metric) and METRICS.get(metric.name) is metric:
        return metric.name
    function = metric.function if isinstance(metric, Metric) else metric
    module = sys.modules.get(getattr(function, "__module__", ""))
    for attribute, value in vars(module).items() if module is not None else ():
        if value is metric:
            name = module.__name__ if module is not None else ""
            if name == "__main__":  # workers import the script by its file name
                name = Path(getattr(module, "__file__", None) or "__main__").stem
            return f"{name}:{attribute}"
    raise ValueError(f"metric {metric!r} cannot be imported by workers: define it at the top level of a module")
