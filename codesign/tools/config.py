"""Configuration of the design tools. Everything is SI."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from codesign.sampling import SamplerConfig
from codesign.tools.bodies import Box, Evaluator, LearnedBodies, check_metrics, full_command
from codesign.tools.metrics import METRICS
from softgym_envs.config import Config
from softgym_envs.robots import make_robot
from softgym_envs.robots.base import Robot

__all__ = [
    "BodiesConfig",
    "CalibrationConfig",
    "GradientConfig",
    "ObjectiveConfig",
    "OptimiseConfig",
    "SearchConfig",
    "SensitivityConfig",
]


class BodiesConfig(Config):
    """Which bodies, and how they are evaluated.

    Attributes:
        robot: registry name.
        robot_options: options of the robot.
        variables: free design variables; default all.
        bounds: narrower bounds of some of them, ``{name: [low, high]}``.
        design: values of the others, and the reference of the free ones; the rest is the robot's baseline.
        backend: ``"fem"`` or ``"surrogate"``.
        weights: folder of the surrogate's weights; default the shipped ones.
        actuation: full command, a displacement for each actuator; default half of their upper limits.
        steps: states beyond rest along the actuation.
    """

    robot: str
    robot_options: dict[str, Any] = Field(default_factory=dict)
    variables: tuple[str, ...] | None = Field(default=None, min_length=1)
    bounds: dict[str, tuple[float, float]] = Field(default_factory=dict)
    design: dict[str, float] = Field(default_factory=dict)
    backend: Literal["fem", "surrogate"] = "surrogate"
    weights: str | None = None
    actuation: tuple[float, ...] | None = None
    steps: int = Field(default=1, ge=1)

    @model_validator(mode="after")
    def _exists(self) -> BodiesConfig:
        full_command(self.make_robot(), self.actuation)
        self.box()
        return self

    def make_robot(self) -> Robot:
        """Return the family of bodies."""
        return make_robot(self.robot, **self.robot_options)

    def box(self) -> Box:
        """Return the designs under consideration."""
        return Box(self.make_robot().design_space, self.variables, self.bounds, self.design)

    def evaluator(self, metrics: tuple[str, ...], backend: str | None = None) -> Evaluator:
        """Return what evaluates one design at a time, on this backend or another."""
        backend = self.backend if backend is None else backend
        weights = self.weights if backend == "surrogate" else None
        return Evaluator(
            self.make_robot(), metrics, backend=backend, actuation=self.actuation, steps=self.steps, weights=weights
        )

    def learned(self, metrics: tuple[str, ...]) -> LearnedBodies:
        """Return what evaluates batches with gradients."""
        return LearnedBodies(
            self.make_robot(), metrics, actuation=self.actuation, steps=self.steps, weights=self.weights
        )


class ObjectiveConfig(Config):
    """One objective.

    Attributes:
        metric: name in `codesign.tools.metrics.METRICS`.
        goal: ``"maximize"``, ``"minimize"``, or a value [SI] to come near to; default: what the metric is good for.
        weight: gamma of eq. 4.18, used where objectives are added up.
    """

    metric: str
    goal: Literal["maximize", "minimize"] | float | None = None
    weight: float = Field(default=1.0, gt=0.0)

    @model_validator(mode="after")
    def _known(self) -> ObjectiveConfig:
        if self.metric not in METRICS:
            raise ValueError(f"unknown metric '{self.metric}'; allowed: {', '.join(METRICS)}")
        return self

    def cost(self, value: Any) -> Any:
        """Return what is minimised, of a value of the metric [SI] (a number, an array or a tensor)."""
        goal = self.goal
        if goal is None:
            goal = "maximize" if METRICS[self.metric].better == "larger" else "minimize"
        if isinstance(goal, float):
            return abs(value - goal)
        return -value if goal == "maximize" else value


class SearchConfig(Config):
    """Search without gradients (Optuna); several objectives give a Pareto front.

    Attributes:
        method: ``"search"``.
        sampler: who proposes designs.
        trials: designs to evaluate, infeasible ones included.
        batch: designs that are proposed together, for NSGA-II the population. The result depends on it and not on the
            number of workers.
        starts: designs to evaluate first, ``{name: value}`` each; missing variables take the reference, within bounds.
    """

    method: Literal["search"]
    sampler: SamplerConfig = Field(default_factory=SamplerConfig)
    trials: int = Field(default=100, ge=1)
    batch: int = Field(default=1, ge=1)
    starts: tuple[dict[str, float], ...] = ()

    @model_validator(mode="after")
    def _generations(self) -> SearchConfig:
        if self.sampler.name == "nsgaii" and self.batch != self.sampler.options.get("population_size", 50):
            raise ValueError(
                f"batch = {self.batch} must be the population of NSGA-II, "
                f"population_size = {self.sampler.options.get('population_size', 50)}"
            )
        return self


class GradientConfig(Config):
    """Descent along gradients of the surrogate, within the box, from several starts.

    Attributes:
        method: ``"gradient"``.
        starts: ``"corners"`` of the box, the ``"reference"`` design, or ``"grid"``: the best designs of a grid.
        count: number of starts, for ``"grid"``.
        grid: designs of the grid that the objectives are normalised on and that starts are chosen from.
        iterations: most iterations of a descent.
        tolerance: a descent ends when no component of the projected gradient of the normalised cost is larger.
        check: evaluate the best design also on FEM.
    """

    method: Literal["gradient"]
    starts: Literal["corners", "grid", "reference"] = "corners"
    count: int = Field(default=4, ge=1)
    grid: int = Field(default=600, ge=2)
    iterations: int = Field(default=100, ge=1)
    tolerance: float = Field(default=1e-6, gt=0.0)
    check: bool = True


def check_starts(starts: Sequence[Mapping[str, float]], box: Box) -> None:
    """Check that starts are of free variables, within their bounds.

    Raises:
        ValueError: for a variable that is not free.
        DesignError: for a value out of bounds.
    """
    for start in starts:
        if unknown := sorted(start.keys() - set(box.names)):
            raise ValueError(f"starts: '{unknown[0]}' is not free; free: {', '.join(box.names)}")
        box.free.complete(start)


class OptimiseConfig(Config):
    """A search for the best bodies.

    Attributes:
        name: of the results' folder.
        bodies: which bodies, and how they are evaluated.
        objectives: one or several.
        solver: search or gradient.
        workers: processes, for a search.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
    bodies: BodiesConfig
    objectives: tuple[ObjectiveConfig, ...] = Field(min_length=1)
    solver: Annotated[SearchConfig | GradientConfig, Field(discriminator="method")]
    workers: int = Field(default=1, ge=1)

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names of the objectives' metrics."""
        return tuple(objective.metric for objective in self.objectives)

    @model_validator(mode="after")
    def _consistent(self) -> OptimiseConfig:
        if len(set(self.metrics)) != len(self.metrics):
            raise ValueError(f"objectives: a metric is named twice in {', '.join(self.metrics)}")
        check_metrics(self.bodies.make_robot(), self.metrics, self.bodies.backend)
        if isinstance(self.solver, SearchConfig):
            check_starts(self.solver.starts, self.bodies.box())
        if isinstance(self.solver, GradientConfig) and self.bodies.backend != "surrogate":
            raise ValueError("solver 'gradient' needs bodies.backend = 'surrogate': meshes have no derivative")
        return self


class SensitivityConfig(Config):
    """Which variables matter for which metrics.

    Attributes:
        name: of the results' folder.
        bodies: which bodies, and how they are evaluated.
        metrics: names in `codesign.tools.metrics.METRICS`.
        method: ``"oat"`` (one at a time, eq. 3.1), ``"morris"`` (elementary effects) or ``"sobol"`` (variances).
        levels: values of each variable between its bounds, both included: two for the thesis' study (``oat``), an even
            number of grid levels (``morris``).
        samples: trajectories (``morris``), or base samples, a power of two (``sobol``).
        confidence: level of the intervals (``morris``, ``sobol``).
        seed: of the samples.
        workers: processes.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
    bodies: BodiesConfig
    metrics: tuple[str, ...] = Field(min_length=1)
    method: Literal["oat", "morris", "sobol"] = "oat"
    levels: int = Field(default=2, ge=2)
    samples: int = Field(default=64, ge=2)
    confidence: float = Field(default=0.95, gt=0.0, lt=1.0)
    seed: int = Field(default=0, ge=0)
    workers: int = Field(default=1, ge=1)

    @model_validator(mode="after")
    def _consistent(self) -> SensitivityConfig:
        check_metrics(self.bodies.make_robot(), self.metrics, self.bodies.backend)
        if self.method == "sobol" and self.samples & (self.samples - 1):
            raise ValueError(f"samples = {self.samples} must be a power of two for method 'sobol'")
        if self.method == "morris" and self.levels % 2:
            raise ValueError(f"levels = {self.levels} must be even for method 'morris'")
        return self


class CalibrationConfig(Config):
    """Fit of design variables to measurements.

    Attributes:
        name: of the results' folder.
        robot: registry name.
        robot_options: options of the robot.
        design: values of the variables that are not fitted; the rest is the robot's baseline.
        fit: variables to fit.
        bounds: narrower bounds of some of them.
        data: CSV or JSON file of measurements, see `codesign.tools.calibration.read_measurements`.
        backend: ``"surrogate"`` or ``"fem"``.
        weights: folder of the surrogate's weights; default the shipped ones.
        method: ``"gradient"`` (least squares) or ``"tpe"`` (Optuna).
        starts: first values ``{name: value}``, one fit from each; default the reference design (``gradient``).
        trials: evaluations (``tpe``).
        refine: fit once more on FEM, from the best fit on the surrogate.
        level: of the interval; None for no interval.
        seed: of ``tpe``.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
    robot: str
    robot_options: dict[str, Any] = Field(default_factory=dict)
    design: dict[str, float] = Field(default_factory=dict)
    fit: tuple[str, ...] = Field(min_length=1)
    bounds: dict[str, tuple[float, float]] = Field(default_factory=dict)
    data: str
    backend: Literal["fem", "surrogate"] = "surrogate"
    weights: str | None = None
    method: Literal["gradient", "tpe"] = "gradient"
    starts: tuple[dict[str, float], ...] = ()
    trials: int = Field(default=250, ge=1)
    refine: bool = False
    level: float | None = Field(default=0.95, gt=0.0, lt=1.0)
    seed: int = Field(default=0, ge=0)

    @model_validator(mode="after")
    def _exists(self) -> CalibrationConfig:
        check_starts(self.starts, self.box())
        return self

    def make_robot(self) -> Robot:
        """Return the family of bodies."""
        return make_robot(self.robot, **self.robot_options)

    def box(self) -> Box:
        """Return the fitted variables within their bounds."""
        return Box(self.make_robot().design_space, self.fit, self.bounds, self.design)
