"""Configuration of a co-design study. Lengths and all other quantities are SI."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from agents.config import EnvironmentConfig, SACConfig, check_hindsight, check_start
from agents.joint import PROPOSERS
from codesign.objectives import OBJECTIVES
from codesign.sampling import SamplerConfig, check_options
from softgym_envs.config import Config
from softgym_envs.designs import DesignSpace
from softgym_envs.envs.tasks.reach import Reach
from softgym_envs.robots.base import Robot

__all__ = [
    "JOURNAL",
    "PRUNERS",
    "STRATEGIES",
    "FinalistsConfig",
    "GoalsConfig",
    "JointConfig",
    "PrunerConfig",
    "ScreenConfig",
    "Strategy",
    "StudyConfig",
    "TrainingConfig",
    "ZoneConfig",
]

JOURNAL = "journal"
"""``storage`` of a study whose trials are kept in its folder."""


@dataclass(frozen=True)
class Strategy:
    """How a body gets its score.

    Args:
        trains: each trial trains a policy of its own.
        policy: it needs a design-conditioned policy: to start from where it trains, else as the judge of all bodies.
        proposer: name in `agents.joint.PROPOSERS`: bodies and their judge are first trained together.
    """

    trains: bool = False
    policy: bool = False
    proposer: str | None = None

    @property
    def judges(self) -> bool:
        """One policy scores all bodies: the given one, or that of the joint training."""
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
"""Registry: name to class of `optuna.pruners`. Their steps are environment steps of training; those of ``"wilcoxon"``,
for strategies that train nothing in a trial, are goals, each of which is compared with the same goal of the best body.
"""


class PrunerConfig(Config):
    """Who stops hopeless trials: ``name`` of `PRUNERS`, and further arguments of its class."""

    name: Literal["none", "median", "percentile", "hyperband", "successive_halving", "threshold", "wilcoxon"] = "none"
    options: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _known_options(self) -> PrunerConfig:
        import optuna

        check_options("pruner", self.name, getattr(optuna.pruners, PRUNERS[self.name]), self.options)
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
    """Training for one body, in a trial or as a finalist; see `agents.config.TrainConfig`.

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


class JointConfig(TrainingConfig):
    """Training of bodies and policy together, before the trials; for the strategies ``"critic"``, ``"distribution"``.

    Attributes:
        steps: environment steps.
        report_every: environment steps between two checkpoints, and two questions to the critic.
        keep: number of its most promising bodies that become trials.
        options: arguments of the proposer, see `agents.joint`.
    """

    steps: int = Field(default=40_000, ge=1)
    report_every: int = Field(default=4_000, ge=1)
    keep: int = Field(default=4, ge=1, le=32)
    options: dict[str, int | float] = Field(default_factory=dict)


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
        seeds: policies trained anew for each finalist, with seeds 1, 2, ... beside that of the trial; 0: the policy of
            the trial itself is tested.
        steps: environment steps of each of them; default: those of a trial.
    """

    count: int = Field(default=3, ge=0)
    choose: Literal["surrogate", "fem"] = "surrogate"
    fem_options: dict[str, Any] = Field(default_factory=dict)
    seeds: int = Field(default=0, ge=0)
    steps: int | None = Field(default=None, ge=1)


class StudyConfig(Config):
    """A co-design study.

    Attributes:
        name: of the study, and of its folder.
        title: of the report; default: the name.
        environment: robot, task and backend of the trials. Its ``design`` (default: the robot's baseline) is the
            baseline body of the study and gives the variables that are not optimised.
        variables: names of the design variables to optimise.
        objective: what is optimised, a name in `codesign.objectives.OBJECTIVES`; the winner is the best in it.
        also: further objectives: the study then looks for the Pareto front of all of them.
        limits: largest allowed values of objectives that are better when smaller, smallest of the others [SI]; a body
            that breaks one cannot win.
        strategy: ``"policy"`` lets one design-conditioned policy judge all bodies as it is, ``"warm_start"`` fine-tunes
            it in each trial, ``"scratch"`` trains a policy in each trial (plain nesting), ``"critic"`` and
            ``"distribution"`` train bodies and a policy together and then let it judge, ``"qp"`` trains none and asks
            the inverse QP.
        policy: design-conditioned policy, for ``"warm_start"`` and ``"policy"``: a file or the name of a shipped one.
        joint: training of bodies and policy together, for ``"critic"`` and ``"distribution"``.
        trials: number of bodies, the baseline and those of the screen included.
        workers: processes, one thread each.
        executor: what they are: ``"processes"`` of this machine, or tasks of a ``"ray"`` cluster.
        storage: where trials are kept: the ``"journal"`` of the folder, for one machine, or a PostgreSQL database that
            many machines share, ``postgresql://user@host:port/database``.
        heartbeat: a worker of a database that gave no sign of life for so long counts as dead, and its trial runs
            again [s].
        patience: how long a database that does not answer is waited for [s].
        attempts: workers that a body may cost without any progress of its training, before it counts as infeasible.
        sampler: who proposes bodies; Gaussian processes need the fewest, but learn nothing from pruned trials.
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
    objective: str = "mean_distance"
    also: tuple[str, ...] = ()
    limits: dict[str, float] = Field(default_factory=dict)
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
            raise ValueError("the address must hold no password, it is written to files; use ~/.pgpass or PGPASSWORD")
        if url.get_backend_name() != "postgresql" or not url.database:
            raise ValueError(f"allowed: {JOURNAL}, postgresql://user@host:port/database")
        return storage

    @field_validator("environment")
    @classmethod
    def _comparable(cls, environment: EnvironmentConfig) -> EnvironmentConfig:
        if environment.sample_design:
            raise ValueError("sample_design must be false: a trial has one body; 'variables' names what is optimised")
        environment.make_robot().design_space.complete(environment.design)
        return environment

    @model_validator(mode="after")
    def _consistent(self) -> StudyConfig:
        space = self.space
        repeated = [name for name in self.variables if self.variables.count(name) > 1]
        if repeated:
            raise ValueError(f"variables: '{repeated[0]}' is named twice")
        for name in (*self.variables, *(self.goals.vary or ())):
            space[name]
        self._check_objectives()
        self._check_strategy()
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
        named = (self.objective, *self.also, *self.limits)
        for name in named:
            if name not in OBJECTIVES:
                raise ValueError(f"unknown objective '{name}'; allowed: {', '.join(OBJECTIVES)}")
        if OBJECTIVES[self.objective].of_body:
            allowed = ", ".join(name for name, objective in OBJECTIVES.items() if not objective.of_body)
            raise ValueError(
                f"objective '{self.objective}' asks nothing of the controller: name it in 'also' or 'limits'; allowed: "
                f"{allowed}"
            )
        objectives = (self.objective, *self.also)
        repeated = [name for name in objectives if objectives.count(name) > 1]
        if repeated:
            raise ValueError(f"objective '{repeated[0]}' is named twice")
        if self.also and self.pruner.name != "none":
            raise ValueError(f"pruner '{self.pruner.name}' compares one number, and there are several; allowed: none")
        if (self.also or self.limits) and self.sampler.name == "cmaes":
            raise ValueError("sampler 'cmaes' knows neither several objectives nor limits; allowed: tpe, gp, nsgaii")

    def _check_strategy(self) -> None:
        plan = self.plan
        if plan.policy and not self.policy:
            raise ValueError(f"strategy '{self.strategy}' needs 'policy', a trained design-conditioned policy")
        if not plan.policy and self.policy:
            raise ValueError(f"policy = '{self.policy}' is of no use to strategy '{self.strategy}'; remove it")
        if self.strategy != "qp" and self.environment.backend != "surrogate" and plan.proposer:
            raise ValueError(
                f"environment.backend = '{self.environment.backend}' has no joint training; allowed: surrogate"
            )
        row = self.environment.row
        if self.goals.source == "family" and not self.environment.has_surrogate:
            raise ValueError(
                f"goals.source = 'family' needs a surrogate, which robot '{row.robot}' has not; allowed: task, zone"
            )
        trains = plan.trains or plan.proposer or self.finalists.seeds
        if self.goals.source != "task" and trains and not issubclass(self.environment.task_class, Reach):
            raise ValueError(
                f"goals.source = '{self.goals.source}' gives points to train on, task '{row.task}' takes paths; "
                "allowed: task"
            )
        if self.finalists.seeds and self.strategy == "qp":
            raise ValueError(
                f"finalists.seeds = {self.finalists.seeds} trains policies, strategy 'qp' has none; allowed: 0"
            )
        shown = self.environment.design_in_observation
        if plan.judges and shown is not True and not set(self.variables) <= set(shown or ()):
            raise ValueError(
                f"strategy '{self.strategy}' needs a policy that sees the body: name {', '.join(self.variables)} in "
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
                f"pruner '{pruner}' has no training to stop in strategy '{self.strategy}'; allowed: none, wilcoxon"
            )
        if plan.trains and pruner == "wilcoxon":
            raise ValueError(
                f"pruner 'wilcoxon' compares goals, strategy '{self.strategy}' reports its training; "
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
    def episode_steps(self) -> int:
        """Environment steps of an episode."""
        return self.environment.row.max_episode_steps

    @property
    def baseline(self) -> dict[str, float]:
        """The complete baseline design [SI]."""
        return dict(self.space.complete(self.environment.design))
