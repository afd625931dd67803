"""Configurations of the design tools. All quantities are SI."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from softgym_envs.codesign.metrics.metric import Direction, Metric, find_metric, metric_name
from softgym_envs.codesign.sampling import SamplerConfig
from softgym_envs.codesign.variables import OptionRange, change_options
from softgym_envs.config import BesideConfig, Config
from softgym_envs.extensions.design.bodies import (
    LearnedBodies,
    StateEvaluator,
    check_derivatives,
    check_metrics,
    full_command,
)
from softgym_envs.extensions.design.box import Box
from softgym_envs.extensions.design.nuisance import AnyNuisance, check_nuisances
from softgym_envs.robots.base import Robot
from softgym_envs.robots.registry import make_robot


def _metric_name(value: Any) -> Any:
    """Return the name or path of a metric that may be given as an object."""
    if isinstance(value, Metric):
        return metric_name(value)
    if isinstance(value, str):
        find_metric(value)
    return value


MetricName = Annotated[str, BeforeValidator(_metric_name)]
"""Name in `softgym_envs.codesign.metrics.metric.METRICS`, or place of a metric of your own, ``my_module:my_metric``."""

FolderName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]


class RobotConfig(Config):
    """A robot, the designs under consideration, and the backend.

    The reference design has the values of ``design``, and the robot's baseline for other variables.
    """

    robot: str = Field(description="registered name, or path my_module:MyRobot")
    robot_options: Annotated[dict[str, Any], BesideConfig()] = Field(default_factory=dict)
    ranges: dict[str, OptionRange] = Field(default_factory=dict, description="bounds of free robot.<option>s")
    bounds: dict[str, tuple[float, float]] = Field(
        default_factory=dict, description="narrower bounds of free design variables, {name: [low, high]}"
    )
    design: dict[str, float] = Field(default_factory=dict)
    backend: Literal["fem", "surrogate"] = "surrogate"
    weights: Annotated[str | None, BesideConfig()] = Field(
        default=None, description="folder of the surrogate's weights; default pretrained ones"
    )

    @model_validator(mode="after")
    def _makes_a_robot(self) -> RobotConfig:
        self.make_robot({name: option.baseline for name, option in self.ranges.items() if name.startswith("robot.")})
        return self

    def make_robot(self, options: Mapping[str, float] | None = None) -> Robot:
        """Return the robot, with other values of options ``{"robot.<option>": value}``."""
        return make_robot(self.robot, **change_options({"robot": self.robot_options}, options or {})["robot"])


class BodiesConfig(RobotConfig):
    """The bodies of a search or a sensitivity study, and how they are actuated; see also `RobotConfig`."""

    variables: tuple[str, ...] | None = Field(
        default=None, min_length=1, description="free variables, also robot.<option>; default all design variables"
    )
    actuation: tuple[float, ...] | None = Field(
        default=None, description="full command: a displacement per actuator; default half of their upper limits"
    )
    steps: int = Field(default=1, ge=1, description="states beyond rest along the actuation")
    sources: dict[str, Any] = Field(
        default_factory=dict, description="settings of what metrics are computed from, such as the grasps"
    )

    @model_validator(mode="after")
    def _consistent(self) -> BodiesConfig:
        full_command(self.make_robot(), self.actuation)
        self.box()
        return self

    def box(self) -> Box:
        """Return the designs under consideration."""
        return Box(self.make_robot().design_space, self.variables, self.bounds, self.design, self.ranges)

    def evaluator(self, metrics: tuple[str, ...], backend: str | None = None) -> StateEvaluator:
        """Return the evaluator of single designs, on the configured backend or another one."""
        backend = self.backend if backend is None else backend
        return StateEvaluator(
            self.make_robot(),
            metrics,
            backend=backend,
            actuation=self.actuation,
            steps=self.steps,
            weights=self.weights if backend == "surrogate" else None,
            make_robot=self.make_robot,
            sources=self.sources,
        )

    def learned(self, metrics: tuple[str, ...]) -> LearnedBodies:
        """Return the evaluator of batches, with gradients."""
        return LearnedBodies(
            self.make_robot(), metrics, actuation=self.actuation, steps=self.steps, weights=self.weights
        )


class ObjectiveConfig(Config):
    """One objective. In a file, the metric alone is enough."""

    metric: MetricName
    goal: Literal["maximize", "minimize"] | float | None = Field(
        default=None, description="or a target value [SI]; default the direction of the metric"
    )
    weight: float = Field(default=1.0, gt=0.0, description="gamma of eq. 4.18 of the thesis, for solver 'gradient'")

    @model_validator(mode="before")
    @classmethod
    def _metric_alone(cls, data: Any) -> Any:
        return {"metric": data} if isinstance(data, str | Metric) else data

    def find(self) -> Metric:
        """Return the metric."""
        return find_metric(self.metric)

    @property
    def direction(self) -> Direction:
        """Direction of `value`."""
        goal = self.find().direction if self.goal is None else self.goal
        return "minimize" if isinstance(goal, float) else goal

    @property
    def title(self) -> str:
        """Name of `value`, with its unit."""
        return f"{self.find().stored_name}{' off its target' if isinstance(self.goal, float) else ''}"

    def value(self, value: Any) -> Any:
        """Return a value of the metric [SI], or its distance to the target (a number, an array or a tensor)."""
        return abs(value - self.goal) if isinstance(self.goal, float) else value

    def cost(self, value: Any) -> Any:
        """Return the cost to minimise for a value of the metric [SI] (a number, an array or a tensor)."""
        return -self.value(value) if self.direction == "maximize" else self.value(value)


class SearchConfig(Config):
    """Search without gradients (Optuna). Several objectives give a Pareto front.

    The result depends on the size of a batch, but not on the number of workers. Variables that ``starts`` do not name
    take the reference, moved into the bounds.
    """

    method: Literal["search"]
    sampler: SamplerConfig = Field(default_factory=SamplerConfig)
    trials: int = Field(default=100, ge=1, description="designs to evaluate, infeasible ones included")
    batch: int = Field(default=1, ge=1, description="designs proposed together; for NSGA-II, the population")
    starts: tuple[dict[str, float], ...] = Field(default=(), description="designs to evaluate first, {name: value}")

    @model_validator(mode="after")
    def _whole_generations(self) -> SearchConfig:
        if self.sampler.name == "nsgaii" and self.batch != self.sampler.options.get("population_size", 50):
            raise ValueError(
                f"batch = {self.batch} must equal the population of NSGA-II, "
                f"population_size = {self.sampler.options.get('population_size', 50)}"
            )
        return self


class GradientConfig(Config):
    """Descent along gradients of the surrogate, within the box, from several starts.

    It starts from the ``"corners"`` of the box, the ``"reference"`` design, or the best designs of a ``"grid"``. The
    same grid normalises the objectives.
    """

    method: Literal["gradient"]
    starts: Literal["corners", "grid", "reference"] = "corners"
    count: int = Field(default=4, ge=1, description="number of starts from the grid")
    grid: int = Field(default=600, ge=2, description="number of designs on the grid")
    iterations: int = Field(default=100, ge=1, description="largest number of iterations of a descent")
    tolerance: float = Field(
        default=1e-6, gt=0.0, description="largest component of the projected gradient at the end of a descent"
    )
    check: bool = Field(default=True, description="also evaluate the best design on FEM")


class OptimiseConfig(Config):
    """A search for the best bodies.

    Attributes:
        name: name of the results' folder.
        bodies: the bodies and how they are evaluated.
        objectives: one or several.
        solver: search or gradient.
        workers: number of processes, for a search.
    """

    name: FolderName
    bodies: BodiesConfig
    objectives: tuple[ObjectiveConfig, ...]
    solver: Annotated[SearchConfig | GradientConfig, Field(discriminator="method")]
    workers: int = Field(default=1, ge=1)

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names or paths of the objectives' metrics."""
        return tuple(objective.metric for objective in self.objectives)

    @model_validator(mode="after")
    def _consistent(self) -> OptimiseConfig:
        metrics = check_metrics(self.bodies.make_robot(), self.metrics, self.bodies.backend, self.bodies.sources)
        box = self.bodies.box()
        if isinstance(self.solver, SearchConfig):
            for start in self.solver.starts:
                box.check_start(start)
            return self
        if self.bodies.backend != "surrogate":
            raise ValueError("solver 'gradient' needs bodies.backend = 'surrogate': FEM has no such derivatives")
        if box.options:
            raise ValueError(f"solver 'gradient' cannot vary the option '{box.options[0]}'; use solver 'search'")
        check_derivatives(metrics)
        return self


class SensitivityConfig(Config):
    """A study of which variables matter for which metrics.

    Attributes:
        name: name of the results' folder.
        bodies: the bodies and how they are evaluated.
        metrics: names of metrics, or paths of your own, ``"my_module:my_metric"``.
        method: ``"oat"`` (one variable at a time; thesis, eq. 3.1), ``"morris"`` (elementary effects) or ``"sobol"``
            (shares of the variance).
        levels: values of each variable between its bounds, both included: two as in the thesis (``oat``), an even
            number of grid levels (``morris``).
        samples: trajectories (``morris``), or base samples, a power of two (``sobol``).
        confidence: level of the intervals (``morris``, ``sobol``).
        seed: seed of the samples.
        workers: number of processes.
    """

    name: FolderName
    bodies: BodiesConfig
    metrics: tuple[MetricName, ...]
    method: Literal["oat", "morris", "sobol"] = "oat"
    levels: int = Field(default=2, ge=2)
    samples: int = Field(default=64, ge=2)
    confidence: float = Field(default=0.95, gt=0.0, lt=1.0)
    seed: int = Field(default=0, ge=0)
    workers: int = Field(default=1, ge=1)

    @model_validator(mode="after")
    def _consistent(self) -> SensitivityConfig:
        check_metrics(self.bodies.make_robot(), self.metrics, self.bodies.backend, self.bodies.sources)
        if self.method == "sobol" and self.samples & (self.samples - 1):
            raise ValueError(f"samples = {self.samples} must be a power of two for method 'sobol'")
        if self.method == "morris" and self.levels % 2:
            raise ValueError(f"levels = {self.levels} must be even for method 'morris'")
        return self


class CalibrationConfig(RobotConfig):
    """Fit of design variables, robot options and nuisance parameters to measurements; see also `RobotConfig`.

    Attributes:
        name: name of the results' folder.
        fit: design variables to fit, and robot options as ``robot.<option>``.
        nuisances: unknowns of the measurement that are fitted too, by name: what the drives do (gain, offset, backlash,
            compliance, friction), the sensor's frame, offsets of columns and the distance of an object.
        data: CSV or JSON file of measurements, with a column for each actuator and effector coordinate.
        method: ``"gradient"`` (least squares) or ``"tpe"`` (Optuna).
        starts: first values ``{name: value}`` of variables and nuisance parameters, one fit from each; default: the
            reference design.
        trials: number of evaluations (``tpe``).
        refine: fit once more on FEM, from the best fit on the surrogate.
        held_out: names of trials that are not fitted but predicted, from a column ``trial`` of the data.
        level: confidence level of the intervals; None for no intervals.
        intervals: ``"profile"`` (of the fitted variables, by their profile likelihood) or ``"linear"`` (of all
            parameters, from the derivatives at the optimum, which costs nothing more).
        seed: seed of ``tpe``.
    """

    name: FolderName
    fit: tuple[str, ...] = Field(min_length=1)
    nuisances: dict[str, Annotated[AnyNuisance, Field(discriminator="kind")]] = Field(default_factory=dict)
    data: Annotated[str, BesideConfig()]
    method: Literal["gradient", "tpe"] = "gradient"
    starts: tuple[dict[str, float], ...] = Field(default=({},), min_length=1)
    trials: int = Field(default=250, ge=1)
    refine: bool = False
    held_out: tuple[str, ...] = ()
    level: float | None = Field(default=0.95, gt=0.0, lt=1.0)
    intervals: Literal["profile", "linear"] = "profile"
    seed: int = Field(default=0, ge=0)

    @model_validator(mode="after")
    def _consistent(self) -> CalibrationConfig:
        box = self.box()
        check_nuisances(self.nuisances, self.make_robot(), self.fit, self.backend)
        if box.options and self.backend != "fem":
            raise ValueError(f"fit: the option '{box.options[0]}' needs backend 'fem', got '{self.backend}'")
        for start in self.starts:
            for name, value in start.items():
                if name in self.nuisances:
                    self.nuisances[name].check(name, value)
            box.check_start({name: value for name, value in start.items() if name not in self.nuisances})
        return self

    def box(self) -> Box:
        """Return the fitted variables within their bounds."""
        return Box(self.make_robot().design_space, self.fit, self.bounds, self.design, self.ranges)
