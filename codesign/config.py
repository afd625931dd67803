"""Configuration of a co-design study; all quantities are in SI units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from agents.config import EnvironmentConfig, SACConfig, check_hindsight, check_start
from agents.joint import PROPOSERS
from codesign.objectives import OBJECTIVES, Objective, find_objective, objective_name
from codesign.sampling import SamplerConfig, check_options
from codesign.variables import OptionRange, is_option, make_variables, split_values, with_options
from softgym_envs.config import Config
from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.envs.tasks.reach import Reach
from softgym_envs.envs.tasks.registry import make_task
from softgym_envs.robots.base import Robot

JOURNAL = "journal"
"""``storage`` of a study whose folder keeps the trials."""


@dataclass(frozen=True)
class Strategy:
    """How a body gets its score.

    Args:
        trains: whether each trial trains a policy of its own.
        policy: whether the study needs a design-conditioned policy: as the start of trainings, else as shared policy.
        proposer: name in `agents.joint.PROPOSERS` if bodies and a shared policy are trained together first.
    """

    trains: bool = False
    policy: bool = False
    proposer: str | None = None

    @property
    def shares_policy(self) -> bool:
        """Whether one policy scores all bodies: the given one, or that of the joint training."""
        return not self.trains and (self.policy or bool(self.proposer))


STRATEGIES: dict[str, Strategy] = {
    "scratch": Strategy(trains=True),
    "warm_start": Strategy(trains=True, policy=True),
    "policy": Strategy(policy=True),
    "critic": Strategy(proposer="critic"),
    "distribution": Strategy(proposer="distribution"),
    "qp": Strategy(),
}
"""Registry: name to strategy."""

PRUNERS: dict[str, str] = {
    "none": "NopPruner",
    "median": "MedianPruner",
    "percentile": "PercentilePruner",
    "hyperband": "HyperbandPruner",
    "successive_halving": "SuccessiveHalvingPruner",
    "threshold": "ThresholdPruner",
    "wilcoxon": "WilcoxonPruner",
}
"""Registry: name to class of `optuna.pruners`. They count environment steps of training; ``"wilcoxon"``, for strategies
without training in a trial, counts goals and compares each with the same goal of the best body.
"""


class PrunerConfig(Config):
    """Algorithm that stops hopeless trials.

    Attributes:
        name: key of `PRUNERS`.
        options: further arguments of its class.
    """

    name: Literal["none", "median", "percentile", "hyperband", "successive_halving", "threshold", "wilcoxon"] = "none"
    options: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _known_options(self) -> PrunerConfig:
        import optuna

        check_options("pruner", self.name, getattr(optuna.pruners, PRUNERS[self.name]), self.options)
        return self


class ZoneConfig(Config):
    """A box [m] over which goals are spread evenly."""

    center: tuple[float, float, float]
    half_size: tuple[float, float, float]

    @field_validator("half_size")
    @classmethod
    def _positive(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if not all(size >= 0.0 for size in value):
            raise ValueError("must be three lengths of 0 m or more")
        return value


class GoalsConfig(Config):
    """Three disjoint sets of goals: for training, for scoring bodies, and unseen ones for the final test.

    Attributes:
        source: where goals come from. ``"family"``: effector positions that random bodies reach under random commands,
            the same for every body. ``"zone"``: points in a box, the work zone of the designer, reachable or not.
            ``"task"``: as the task draws them for the baseline body; for tasks whose goals are paths.
        zone: the box, for ``"zone"``.
        vary: design variables in which the random bodies differ; default: the optimised ones.
        count: number of goals that every trial is scored on.
        unseen_count: number of goals that only finalists are tested on.
        training_count: number of goals that training episodes draw from (not for ``"task"``).
        seed: seed of all three sets.
        command_low: smallest random command as a fraction of its actuator's range, in [0, 1) (``"family"`` only).
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
            raise ValueError("'zone' (center, half_size) must be given with source 'zone', and only with it")
        return self


class TrainingConfig(Config):
    """Training for one body, in a trial or as a finalist; see `agents.config.TrainConfig`.

    Attributes:
        steps: environment steps of one trial.
        report_every: environment steps between two reports to the pruner.
        evaluation_episodes: number of episodes for each report.
        num_envs: number of parallel environments in one trial.
        seed: seed, the same in all trials so that they differ by their bodies only.
        sac: hyper-parameters.
    """

    steps: int = Field(default=2_500, ge=1)
    report_every: int = Field(default=500, ge=1)
    evaluation_episodes: int = Field(default=32, ge=1)
    num_envs: int = Field(default=16, ge=1)
    seed: int = Field(default=0, ge=0)
    sac: SACConfig = Field(default_factory=SACConfig)


class JointConfig(TrainingConfig):
    """Training of bodies and policy together, before the trials; for the strategies ``"critic"``, ``"distribution"``.

    Attributes:
        steps: environment steps.
        report_every: environment steps between two checkpoints; the critic proposes bodies at each.
        keep: number of the most promising bodies that become trials.
        options: arguments of the proposer, see `agents.joint`.
    """

    steps: int = Field(default=40_000, ge=1)
    report_every: int = Field(default=4_000, ge=1)
    keep: int = Field(default=4, ge=1, le=32)
    options: dict[str, int | float] = Field(default_factory=dict)


class ScreenConfig(Config):
    """Screen before the trials: the inverse QP scores many bodies, and the best become trials.

    Attributes:
        enabled: whether there is a screen.
        candidates: number of bodies to score, spread evenly over the design box.
        keep: fraction of the candidates that becomes trials.
        goals: number of goals per candidate: the first of the selection goals.
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
        count: number of best bodies to test besides the baseline; 0 for no check.
        choose: what decides who wins: the ``"surrogate"`` score of the trials, or the ``"fem"`` score of the finalists
            on the same goals. The unseen goals never do.
        fem_options: options of the FEM backend.
        seeds: number of policies to train anew for each finalist, with seeds 1, 2, ... added to that of the trial; 0 to
            test the policy of the trial.
        steps: environment steps of each of these trainings; default: those of a trial.
    """

    count: int = Field(default=3, ge=0)
    choose: Literal["surrogate", "fem"] = "surrogate"
    fem_options: dict[str, Any] = Field(default_factory=dict)
    seeds: int = Field(default=0, ge=0)
    steps: int | None = Field(default=None, ge=1)


class StudyConfig(Config):
    """A co-design study.

    Attributes:
        name: name of the study and of its folder.
        title: title of the report; default: the name.
        environment: robot, task and backend of the trials. Its ``design`` (default: the robot's baseline) is the
            baseline body of the study and gives the design variables that are not optimised.
        variables: names of what is optimised: design variables, and options of robot or task as ``robot.<option>`` and
            ``task.<option>``.
        ranges: bounds of those options.
        objective: what is optimised: the name of an objective, or one of your own as ``module:attribute``; in
            Python also the function or `Objective` itself.
        secondary_objectives: further objectives; the study then looks for the Pareto front of all of them.
        constraints: largest allowed values of objectives that are minimised, smallest of those that are maximised [SI];
            a body that violates one cannot win.
        strategy: how bodies are scored. ``"policy"``: by one design-conditioned policy. ``"warm_start"``: each trial
            fine-tunes that policy. ``"scratch"``: each trial trains a policy (plain nesting). ``"critic"`` and
            ``"distribution"``: bodies and a policy are trained together, then that policy scores every body. ``"qp"``:
            by the inverse QP, without training.
        policy: design-conditioned policy, for ``"policy"`` and ``"warm_start"``: a file or the name of a shipped one.
        joint: training of bodies and policy together, for ``"critic"`` and ``"distribution"``.
        trials: number of bodies, the baseline and those of the screen included.
        workers: number of workers with one thread each.
        executor: what workers are: ``"processes"`` of this machine, or tasks of a ``"ray"`` cluster.
        storage: where trials are kept: the ``"journal"`` of the folder, for one machine, or a PostgreSQL database for
            many machines, ``postgresql://user@host:port/database``.
        heartbeat: time without a heartbeat after which a worker of a database counts as dead; another worker then runs
            its trial again [s].
        patience: how long to wait for a database that does not answer [s].
        attempts: number of workers that a body may crash without any progress of its training; the next one gives the
            body up as infeasible.
        sampler: algorithm that proposes bodies. Gaussian processes need the fewest, but ignore pruned trials.
        pruner: algorithm that stops hopeless trials.
        goals: what the effector has to reach.
        training: training inside one trial.
        screen: screen by the inverse QP before the trials.
        finalists: check on FEM.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
    title: str = ""
    environment: EnvironmentConfig
    variables: tuple[str, ...] = Field(min_length=1)
    ranges: dict[str, OptionRange] = Field(default_factory=dict)
    objective: str = "mean_distance"
    secondary_objectives: tuple[str, ...] = ()
    constraints: dict[str, float] = Field(default_factory=dict)
    strategy: Literal["policy", "warm_start", "scratch", "critic", "distribution", "qp"] = "policy"
    policy: str | None = None
    joint: JointConfig = Field(default_factory=JointConfig)
    trials: int = Field(ge=1)
    workers: int = Field(default=1, ge=1)
    executor: Literal["processes", "ray"] = "processes"
    storage: str = JOURNAL
    heartbeat: float = Field(default=60.0, ge=1.0)
    patience: float = Field(default=600.0, ge=0.0)
    attempts: int = Field(default=5, ge=1)
    sampler: SamplerConfig = Field(default_factory=lambda: SamplerConfig(name="gp"))
    pruner: PrunerConfig = Field(default_factory=PrunerConfig)
    goals: GoalsConfig = Field(default_factory=GoalsConfig)
    training: TrainingConfig = Field(default_factory=TrainingConfig)
    screen: ScreenConfig = Field(default_factory=ScreenConfig)
    finalists: FinalistsConfig = Field(default_factory=FinalistsConfig)

    @field_validator("storage")
    @classmethod
    def _known_storage(cls, storage: str) -> str:
        if storage == JOURNAL:
            return storage
        from sqlalchemy.engine import make_url
        from sqlalchemy.exc import ArgumentError

        try:
            url = make_url(storage)
        except ArgumentError:
            raise ValueError(f"allowed: {JOURNAL}, postgresql://user@host:port/database") from None
        if url.password is not None or "password" in url.query:
            raise ValueError("remove the password: the address is written to files; use ~/.pgpass or PGPASSWORD")
        if url.get_backend_name() != "postgresql" or not url.database:
            raise ValueError(f"allowed: {JOURNAL}, postgresql://user@host:port/database")
        return storage

    @field_validator("environment")
    @classmethod
    def _comparable(cls, environment: EnvironmentConfig) -> EnvironmentConfig:
        if environment.sample_design:
            raise ValueError("sample_design must be false: a trial has one body, and 'variables' names what varies")
        environment.make_robot().design_space.complete(environment.design)
        return environment

    @field_validator("objective", mode="before")
    @classmethod
    def _importable(cls, objective: Any) -> str:
        return objective_name(objective)

    @field_validator("secondary_objectives", mode="before")
    @classmethod
    def _all_importable(cls, objectives: Any) -> Any:
        return [objective_name(o) for o in objectives] if isinstance(objectives, list | tuple) else objectives

    @model_validator(mode="after")
    def _consistent(self) -> StudyConfig:
        make_variables(self.variables, self.ranges, self.space)
        for name in self.goals.vary or ():
            self.space[name]
        self._check_objectives()
        self._check_strategy()
        self._check_options()
        if self.goals.zone is not None:
            self._check_zone(self.goals.zone)
        if self.screen.enabled and self.screen.goals > self.goals.count:
            raise ValueError(f"screen.goals = {self.screen.goals} exceeds goals.count = {self.goals.count}")
        first = self.screen.kept + (self.joint.keep if self.plan.proposer else 0)
        if 1 + first > self.trials:
            raise ValueError(
                f"trials = {self.trials} is too few for the baseline and {first} bodies found before the trials"
            )
        if self.finalists.count >= self.trials and self.trials > 1:
            raise ValueError(f"finalists.count = {self.finalists.count} must be below trials = {self.trials}")
        return self

    def _check_objectives(self) -> None:
        objectives = (self.objective, *self.secondary_objectives)
        repeated = [name for name in objectives if objectives.count(name) > 1]
        if repeated:
            raise ValueError(f"objective '{repeated[0]}' is named twice")
        if self.primary.of_body:  # looking it up also refuses unknown names
            allowed = ", ".join(name for name, objective in OBJECTIVES.items() if not objective.of_body)
            raise ValueError(
                f"objective '{self.objective}' does not depend on the controller; use it in 'secondary_objectives' or "
                f"'constraints', or run a design search; allowed: {allowed}"
            )
        if self.secondary_objectives and self.pruner.name != "none":
            raise ValueError(f"pruner '{self.pruner.name}' supports one objective only; allowed: none")
        if (self.secondary_objectives or self.constraints) and self.sampler.name == "cmaes":
            raise ValueError(
                "sampler 'cmaes' supports neither secondary objectives nor constraints; allowed: tpe, gp, nsgaii"
            )

    def _check_options(self) -> None:
        options = [name for name in self.variables if is_option(name)]
        if options and (self.plan.policy or self.plan.proposer):
            raise ValueError(
                f"strategy '{self.strategy}' uses a policy that was trained with fixed options, so '{options[0]}' "
                "cannot vary; allowed: qp, scratch"
            )
        if options and self.goals.source == "task":
            task = [name for name in options if name.startswith("task.")]
            if task:
                raise ValueError(f"goals.source = 'task' depends on '{task[0]}', so bodies would have different goals")

    def _check_zone(self, zone: ZoneConfig) -> None:
        corners = np.asarray(zone.center) + np.array(list(product((-1.0, 1.0), repeat=3))) * zone.half_size
        self.robot.check_point("goals.zone.center", zone.center)
        self.robot.check_point("a corner of goals.zone", corners)

    def _check_strategy(self) -> None:
        plan = self.plan
        if plan.policy and not self.policy:
            raise ValueError(f"strategy '{self.strategy}' needs 'policy': a trained design-conditioned policy")
        if not plan.policy and self.policy:
            raise ValueError(f"strategy '{self.strategy}' does not use policy = '{self.policy}'; remove it")
        if self.strategy != "qp" and self.environment.backend != "surrogate" and plan.proposer:
            raise ValueError(
                f"joint training does not run on environment.backend = '{self.environment.backend}'; allowed: surrogate"
            )
        row = self.environment.row
        if self.goals.source == "family" and not self.environment.has_surrogate:
            raise ValueError(
                f"goals.source = 'family' needs a surrogate, and robot '{row.robot}' has none; allowed: task, zone"
            )
        trains = plan.trains or plan.proposer or self.finalists.seeds
        if self.goals.source != "task" and trains and not issubclass(self.environment.task_class, Reach):
            raise ValueError(
                f"goals.source = '{self.goals.source}' makes points, but task '{row.task}' trains on paths; "
                "allowed: task"
            )
        if self.finalists.seeds and self.strategy == "qp":
            raise ValueError(
                f"finalists.seeds = {self.finalists.seeds} trains policies, but strategy 'qp' has none; allowed: 0"
            )
        shown = self.environment.design_in_observation
        if plan.shares_policy and shown is not True and not set(self.variables) <= set(shown or ()):
            raise ValueError(
                f"strategy '{self.strategy}' needs a policy that observes the body: add {', '.join(self.variables)} to "
                "environment.design_in_observation"
            )
        if plan.proposer:
            try:
                PROPOSERS[plan.proposer](**self.joint.options)
            except TypeError as error:
                raise ValueError(f"joint.options: {error}") from None
            if self.joint.report_every > self.joint.steps:
                raise ValueError(
                    f"joint.report_every = {self.joint.report_every} exceeds joint.steps = {self.joint.steps}"
                )
        pruner = self.pruner.name
        if not plan.trains and pruner not in ("none", "wilcoxon"):
            raise ValueError(
                f"pruner '{pruner}' stops trainings, but trials of strategy '{self.strategy}' do not train; "
                "allowed: none, wilcoxon"
            )
        if plan.trains and pruner == "wilcoxon":
            raise ValueError(
                f"pruner 'wilcoxon' compares goals, but strategy '{self.strategy}' reports its training; "
                f"allowed: {', '.join(name for name in PRUNERS if name != 'wilcoxon')}"
            )
        self._check_trainings()

    def _check_trainings(self) -> None:
        plan, training, finalists = self.plan, self.training, self.finalists
        if plan.trains or finalists.seeds:
            check_hindsight(training.sac, self.environment)
            if training.report_every > training.steps:
                raise ValueError(
                    f"training.report_every = {training.report_every} exceeds training.steps = {training.steps}"
                )
        if plan.trains or (finalists.seeds and finalists.steps is None):
            check_start("training.sac.learning_starts", training.sac, "training.steps", training.steps)
        if finalists.seeds and finalists.steps is not None:
            check_start("training.sac.learning_starts", training.sac, "finalists.steps", finalists.steps)
        if plan.proposer:
            check_hindsight(self.joint.sac, self.environment)
            check_start("joint.sac.learning_starts", self.joint.sac, "joint.steps", self.joint.steps)

    @property
    def plan(self) -> Strategy:
        """What the strategy does."""
        return STRATEGIES[self.strategy]

    @property
    def robot(self) -> Robot:
        """The family of bodies."""
        return self.environment.make_robot()

    @property
    def space(self) -> DesignSpace:
        """All design variables of the robot."""
        return self.robot.design_space

    @property
    def optimised(self) -> dict[str, DesignVariable]:
        """What is optimised, by name: design variables, and options of robot or task."""
        return make_variables(self.variables, self.ranges, self.space)

    @property
    def objectives(self) -> dict[str, Objective]:
        """All objectives that the study names, by name: objective, secondary objectives and constraints."""
        names = (self.objective, *self.secondary_objectives, *self.constraints)
        return {name: find_objective(name, self.robot) for name in names}

    @property
    def primary(self) -> Objective:
        """The objective that decides who wins."""
        return self.objectives[self.objective]

    @property
    def controller_constraints(self) -> dict[str, float]:
        """Constraints that depend on the controller, and therefore on the backend [SI]."""
        return {name: limit for name, limit in self.constraints.items() if not self.objectives[name].of_body}

    def violations_text(self, values: Mapping[str, float], constraints: Mapping[str, float]) -> str:
        """Return the constraints [SI] that values [SI] violate, in words; empty if there are none."""
        broken = (
            self.objectives[name].violation_text(values[name], limit)
            for name, limit in constraints.items()
            if name in values and self.objectives[name].excess(values[name], limit) > 0.0
        )
        return "; ".join(broken)

    @property
    def success_distance(self) -> float:
        """Distance within which a goal counts as reached [m]."""
        row = self.environment.row
        options = {**row.task_options, **self.environment.task_options}
        return make_task(row.task, self.robot, **options).success_distance

    @property
    def test_backends(self) -> tuple[str, ...]:
        """Backends that finalists are tested on, the slow one first."""
        # Surrogate weights are for fixed options of the robot.
        varies = any(name.startswith("robot.") for name in self.variables)
        return ("fem", "surrogate") if self.environment.has_surrogate and not varies else ("fem",)

    @property
    def episode_steps(self) -> int:
        """Environment steps of an episode."""
        return self.environment.row.max_episode_steps

    @property
    def baseline(self) -> dict[str, float]:
        """The complete baseline design [SI]."""
        return dict(self.space.complete(self.environment.design))

    @property
    def baseline_values(self) -> dict[str, float]:
        """Value of each optimised variable in the baseline [SI]."""
        return {n: self.baseline.get(n, variable.baseline) for n, variable in self.optimised.items()}

    def body(self, values: Mapping[str, float]) -> tuple[dict[str, float], dict[str, float]]:
        """Return the complete design [SI] and the options [SI] of values of the optimised variables."""
        design, options = split_values(values)
        return dict(self.space.complete(design, self.baseline)), options

    def environment_of(self, options: Mapping[str, float]) -> EnvironmentConfig:
        """Return the environment with other values of options [SI]."""
        return with_options(self.environment, options)
