"""Configuration of a co-design study. Lengths and all other quantities are SI."""

from __future__ import annotations

import importlib.util
import inspect
import warnings
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from agents.config import EnvironmentConfig, SACConfig
from softgym_envs.config import Config
from softgym_envs.designs import DesignSpace
from softgym_envs.envs.registration import ENVIRONMENTS
from softgym_envs.robots import make_robot
from softgym_envs.robots.robot import Robot

__all__ = [
    "PRUNERS",
    "SAMPLERS",
    "FinalistsConfig",
    "GoalsConfig",
    "PrunerConfig",
    "SamplerConfig",
    "ScreenConfig",
    "StudyConfig",
    "TrainingConfig",
    "ZoneConfig",
    "construct",
    "robot_of",
]

SAMPLERS: dict[str, str] = {
    "tpe": "TPESampler",
    "cmaes": "CmaEsSampler",
    "gp": "GPSampler",
    "nsgaii": "NSGAIISampler",
    "qmc": "QMCSampler",
    "random": "RandomSampler",
}
"""Registry: name to class of `optuna.samplers`."""

PRUNERS: dict[str, str] = {
    "none": "NopPruner",
    "median": "MedianPruner",
    "percentile": "PercentilePruner",
    "hyperband": "HyperbandPruner",
    "successive_halving": "SuccessiveHalvingPruner",
    "threshold": "ThresholdPruner",
}
"""Registry: name to class of `optuna.pruners`. Their steps are environment steps of training."""


def robot_of(environment: EnvironmentConfig) -> Robot:
    """Return the family of bodies of an environment.

    Raises:
        ValueError: for a wrong option of the robot.
    """
    row = ENVIRONMENTS[environment.id]
    return make_robot(row.robot, **{**row.robot_options, **environment.robot_options})


def construct(cls: type, options: dict[str, Any]) -> Any:
    """Make a sampler or a pruner of Optuna. Naming one in a configuration is consent to its being experimental."""
    from optuna.exceptions import ExperimentalWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        return cls(**options)


def _check_options(kind: str, name: str, cls: type, options: dict[str, Any]) -> None:
    """Raise ValueError for a keyword that the constructor of a sampler or pruner does not take."""
    allowed = [key for key in inspect.signature(cls).parameters if key not in ("seed", "args", "kwargs")]
    for key in options:
        if key not in allowed:
            raise ValueError(f"unknown option '{key}' of {kind} '{name}'; allowed: {', '.join(allowed) or 'none'}")
    try:
        construct(cls, options)
    except TypeError as error:
        raise ValueError(f"{kind} '{name}': {error}") from None


class SamplerConfig(Config):
    """Who proposes bodies: ``name`` of `SAMPLERS`, ``seed``, and further arguments of its class."""

    name: Literal["tpe", "cmaes", "gp", "nsgaii", "qmc", "random"] = "tpe"
    seed: int = Field(default=0, ge=0)
    options: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _known_options(self) -> SamplerConfig:
        import optuna

        if self.name == "cmaes" and importlib.util.find_spec("cmaes") is None:
            others = ", ".join(name for name in SAMPLERS if name != "cmaes")
            raise ValueError(f"sampler 'cmaes' needs the package cmaes (pip install cmaes); allowed without: {others}")
        _check_options("sampler", self.name, getattr(optuna.samplers, SAMPLERS[self.name]), self.options)
        return self


class PrunerConfig(Config):
    """Who stops hopeless trials: ``name`` of `PRUNERS`, and further arguments of its class."""

    name: Literal["none", "median", "percentile", "hyperband", "successive_halving", "threshold"] = "none"
    options: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _known_options(self) -> PrunerConfig:
        import optuna

        _check_options("pruner", self.name, getattr(optuna.pruners, PRUNERS[self.name]), self.options)
        return self


class ZoneConfig(Config):
    """A box of space [m] in which goals are spread evenly."""

    center: tuple[float, float, float]
    half_size: tuple[float, float, float]

    @field_validator("half_size")
    @classmethod
    def _positive(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if not all(size >= 0.0 for size in value):
            raise ValueError("must be three lengths of at least 0 m")
        return value


class GoalsConfig(Config):
    """Three disjoint sets of goals: to train on, to choose bodies by, and unseen ones to test the choice.

    Attributes:
        source: ``"family"``: effector positions that random bodies reach under random commands, the same for every
            body; ``"zone"``: points of a box in space, the work zone a designer has in mind, whether any body reaches
            them or not; ``"task"``: as the task draws them for the baseline body (for tasks whose goals are paths).
        zone: the box, for ``"zone"``.
        vary: design variables in which those random bodies differ; default: those that are optimised.
        count: goals every trial is scored on.
        unseen_count: goals only the finalists are tested on.
        training_count: goals that training episodes draw from (not for ``"task"``).
        seed: seed of all three.
        command_low: smallest random command, as a part of the range of its actuator, in [0, 1) (``"family"`` only).
    """

    source: Literal["family", "zone", "task"] = "family"
    zone: ZoneConfig | None = None
    vary: tuple[str, ...] | None = Field(default=None, min_length=1)
    count: int = Field(default=40, ge=1)
    unseen_count: int = Field(default=30, ge=2)
    training_count: int = Field(default=300, ge=1)
    seed: int = Field(default=0, ge=0)
    command_low: float = Field(default=0.0, ge=0.0, lt=1.0)

    @model_validator(mode="after")
    def _zone_where_needed(self) -> GoalsConfig:
        if (self.source == "zone") != (self.zone is not None):
            raise ValueError("'zone' (center, half_size) belongs to source 'zone', and to it alone")
        return self


class TrainingConfig(Config):
    """Training inside one trial; see `agents.config.TrainConfig`. Not used by the strategy ``"qp"``.

    Attributes:
        steps: environment steps of one trial.
        report_every: environment steps between two reports to the pruner.
        evaluation_episodes: episodes behind each report.
        num_envs: environments in parallel in one trial.
        seed: the same in all trials, so that they differ by their bodies.
        sac: hyper-parameters.
    """

    steps: int = Field(default=2_500, ge=1)
    report_every: int = Field(default=500, ge=1)
    evaluation_episodes: int = Field(default=32, ge=1)
    num_envs: int = Field(default=16, ge=1)
    seed: int = Field(default=0, ge=0)
    sac: SACConfig = Field(default_factory=SACConfig)


class ScreenConfig(Config):
    """A cheap first look: many bodies scored by the inverse QP, the best of them become trials.

    Attributes:
        enabled: whether there is one.
        candidates: bodies to score, spread evenly over the box.
        keep: fraction of the candidates that becomes trials.
        goals: goals per candidate, the first ones of those that bodies are chosen by.
    """

    enabled: bool = False
    candidates: int = Field(default=32, ge=2)
    keep: float = Field(default=0.15, gt=0.0, le=1.0)
    goals: int = Field(default=10, ge=1)

    @property
    def kept(self) -> int:
        """Number of candidates that become trials."""
        return max(1, round(self.keep * self.candidates)) if self.enabled else 0


class FinalistsConfig(Config):
    """The check on FEM.

    Attributes:
        count: best bodies to test beside the baseline; 0 for no check.
        choose: who names the winner: the ``"surrogate"`` score of the trials, or the ``"fem"`` score of the finalists
            on the same goals. Never the unseen goals.
        fem_options: options of the FEM backend.
    """

    count: int = Field(default=3, ge=0)
    choose: Literal["surrogate", "fem"] = "surrogate"
    fem_options: dict[str, Any] = Field(default_factory=dict)


class StudyConfig(Config):
    """A co-design study.

    Attributes:
        name: of the study, and of its folder.
        title: of the report; default: the name.
        environment: robot, task and backend of the trials. Its ``design`` (default: the robot's baseline) is the
            baseline body of the study and gives the variables that are not optimised.
        variables: names of the design variables to optimise.
        objective: what is optimised: success rate and return upwards, mean final distance downwards.
        strategy: ``"warm_start"`` fine-tunes a design-conditioned policy in each trial, ``"scratch"`` trains a new one,
            ``"qp"`` trains none and scores a body by the inverse QP.
        policy: design-conditioned policy to start from, for ``"warm_start"``: a file or the name of a shipped one.
        trials: number of bodies, the baseline and those of the screen included.
        workers: processes, one thread each.
        sampler: who proposes bodies.
        pruner: who stops hopeless trials.
        goals: what the body has to reach.
        training: training inside one trial.
        screen: cheap first look by the inverse QP.
        finalists: check on FEM.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
    title: str = ""
    environment: EnvironmentConfig
    variables: tuple[str, ...] = Field(min_length=1)
    objective: Literal["success_rate", "mean_distance", "mean_return"] = "mean_distance"
    strategy: Literal["warm_start", "scratch", "qp"] = "warm_start"
    policy: str | None = None
    trials: int = Field(ge=1)
    workers: int = Field(default=1, ge=1)
    sampler: SamplerConfig = Field(default_factory=SamplerConfig)
    pruner: PrunerConfig = Field(default_factory=PrunerConfig)
    goals: GoalsConfig = Field(default_factory=GoalsConfig)
    training: TrainingConfig = Field(default_factory=TrainingConfig)
    screen: ScreenConfig = Field(default_factory=ScreenConfig)
    finalists: FinalistsConfig = Field(default_factory=FinalistsConfig)

    @field_validator("environment")
    @classmethod
    def _comparable(cls, environment: EnvironmentConfig) -> EnvironmentConfig:
        if environment.sample_design:
            raise ValueError("sample_design must be false: a trial has one body; 'variables' names what is optimised")
        robot_of(environment).design_space.complete(environment.design)
        return environment

    @model_validator(mode="after")
    def _consistent(self) -> StudyConfig:
        space = self.space
        repeated = [name for name in self.variables if self.variables.count(name) > 1]
        if repeated:
            raise ValueError(f"variables: '{repeated[0]}' is named twice")
        for name in (*self.variables, *(self.goals.vary or ())):
            space[name]
        if self.strategy == "warm_start" and not self.policy:
            raise ValueError("strategy 'warm_start' needs 'policy', the file of a trained design-conditioned policy")
        if self.strategy != "warm_start" and self.policy:
            raise ValueError(f"policy = '{self.policy}' is of no use to strategy '{self.strategy}'; remove it")
        if self.strategy != "qp" and self.environment.backend != "surrogate":
            raise ValueError(
                f"environment.backend = '{self.environment.backend}' is for strategy 'qp' only; allowed: surrogate"
            )
        if self.strategy == "qp" and self.pruner.name != "none":
            raise ValueError(f"pruner '{self.pruner.name}' has nothing to stop in strategy 'qp'; allowed: none")
        if self.strategy != "qp" and self.training.report_every > self.training.steps:
            raise ValueError(
                f"training.report_every = {self.training.report_every} exceeds training.steps = {self.training.steps}"
            )
        if self.screen.enabled and self.screen.goals > self.goals.count:
            raise ValueError(f"screen.goals = {self.screen.goals} exceeds goals.count = {self.goals.count}")
        if 1 + self.screen.kept > self.trials:
            raise ValueError(
                f"trials = {self.trials} is too few for the baseline and {self.screen.kept} bodies kept by the screen"
            )
        if self.finalists.count >= self.trials and self.trials > 1:
            raise ValueError(f"finalists.count = {self.finalists.count} must be below trials = {self.trials}")
        return self

    @property
    def robot(self) -> Robot:
        """The family of bodies."""
        return robot_of(self.environment)

    @property
    def space(self) -> DesignSpace:
        """All design variables of the robot."""
        return self.robot.design_space

    @property
    def baseline(self) -> dict[str, float]:
        """The complete baseline design [SI]."""
        return self.space.complete(self.environment.design)
