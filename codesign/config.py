"""Configuration of a co-design study; all quantities are in SI units."""

from __future__ import annotations

import re
from itertools import product
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from softgym_envs.agents.learners import LEARNERS
from softgym_envs.codesign.parts import (
    PRUNERS,
    STRATEGIES,
    FinalistsConfig,
    GoalsConfig,
    PrunerConfig,
    ScreenConfig,
    Strategy,
    TrainingConfig,
)
from softgym_envs.codesign.problem import StudyProblem, refuse
from softgym_envs.codesign.sampling import SamplerConfig
from softgym_envs.codesign.scheduling.storage import JOURNAL, find_storage
from softgym_envs.codesign.variables import is_option
from softgym_envs.config import BesideConfig
from softgym_envs.envs.tasks.reach import Reach


class StudyConfig(StudyProblem):
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
            Python also the function or `Metric` itself.
        secondary_objectives: further objectives; the study then looks for the Pareto front of all of them.
        constraints: largest allowed values of objectives that are minimised, smallest of those that are maximised [SI];
            a body that violates one cannot win.
        strategy: how bodies are scored. ``"policy"``: by one shared policy. ``"warm_start"``: each trial
            fine-tunes that policy. ``"scratch"``: each trial trains a policy (plain nesting). ``"qp"``: by the
            inverse QP, without training.
        policy: shared policy, for ``"policy"`` and ``"warm_start"``: a file, the folder of a
            training or the name of a shipped one.
        trials: number of bodies, the baseline and those of the screen included.
        workers: number of workers with one thread each.
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

    strategy: Literal["policy", "warm_start", "scratch", "qp"] = "policy"
    policy: Annotated[str | None, BesideConfig()] = None
    trials: int = Field(ge=1)
    workers: int = Field(default=1, ge=1)
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
        user = storage.partition("://")[2].rpartition("@")[0]
        if ":" in user or re.search(r"pass|pwd|secret|token", storage.partition("?")[2], re.IGNORECASE):
            raise ValueError("remove the password: the address is written to files; use ~/.pgpass or PGPASSWORD")
        find_storage(storage)
        return storage

    @model_validator(mode="after")
    def _consistent(self) -> StudyConfig:
        for name in self.goals.vary or ():
            self.space[name]
        self._check_goals()
        self._check_strategy()
        self._check_pruner()
        self._check_trainings()
        refuse(
            bool(self.secondary_objectives or self.constraints) and self.sampler.name == "cmaes",
            "sampler 'cmaes' supports neither secondary objectives nor constraints; allowed: tpe, gp, nsgaii",
        )
        refuse(
            1 + self.screen.kept > self.trials,
            f"trials = {self.trials} is too few for the baseline and {self.screen.kept} bodies found before the trials",
        )
        self._check_finalists()
        return self

    def _check_goals(self) -> None:
        goals, row, trains = self.goals, self.environment.row, self.plan.trains
        refuse(
            goals.source == "family" and not self.environment.has_surrogate,
            f"goals.source = 'family' needs a surrogate: give the weights of robot '{row.robot}' as "
            "environment.backend_options.weights; allowed without: task, zone",
        )
        refuse(
            goals.source != "task"
            and bool(trains or self.finalists.seeds)
            and not issubclass(self.environment.task_class, Reach),
            f"goals.source = '{goals.source}' makes points, but task '{row.task}' trains on paths; allowed: task",
        )
        refuse(
            self.screen.enabled and self.screen.goals > goals.count,
            f"screen.goals = {self.screen.goals} exceeds goals.count = {goals.count}",
        )
        for name in self.variables:
            refuse(
                goals.source == "task" and name.startswith("task."),
                f"goals.source = 'task' depends on '{name}', so bodies would have different goals",
            )
        if goals.zone is not None:
            corners = np.array(list(product((-1.0, 1.0), repeat=3))) * goals.zone.half_size
            self.robot.check_point("goals.zone.center", goals.zone.center)
            self.robot.check_point("a corner of goals.zone", np.asarray(goals.zone.center) + corners)

    def _check_finalists(self) -> None:
        found, unseen = self.finalists, self.goals.unseen_count
        refuse(found.count >= self.trials > 1, f"finalists.count = {found.count} must be below trials = {self.trials}")
        if found.refinement is not None:
            refuse(
                found.refinement.goals > unseen,
                f"finalists.refinement.goals = {found.refinement.goals} exceeds goals.unseen_count = {unseen}",
            )
        if found.test == "ends":
            self._check_ends()

    def _check_ends(self) -> None:
        """Refuse studies whose episodes end elsewhere than a few steps from the end on the surrogate."""
        environment, robot, row = self.environment, self.robot, self.environment.row
        ends, allowed = "finalists.test = 'ends'", "; allowed: episodes"
        refuse(
            not issubclass(environment.task_class, Reach),
            f"{ends} needs one position as goal, but task '{row.task}' has others{allowed}",
        )
        refuse(
            "surrogate" not in self.test_backends,
            f"{ends} starts where episodes end on a surrogate, and there is none for all bodies of robot "
            f"'{row.robot}'{allowed}",
        )
        refuse(
            len(robot.effectors) != 1,
            f"{ends} needs one effector, but robot '{row.robot}' has {', '.join(robot.effectors)}{allowed}",
        )
        backend = {**environment.on("fem").backend_options, **self.finalists.fem_options}
        for what, value in (("environment.plant", environment.plant), ("options of the FEM backend", backend)):
            refuse(bool(value), f"{ends} solves for equilibria without {what}, got {value}{allowed}")
        load = environment.make_task(robot).load
        refuse(
            load is not None and load.on_body,
            f"{ends} does not know what touches the body in task '{row.task}'{allowed}",
        )
        for name, metric in self.objectives.items():
            refuse(
                metric.over_path,
                f"{ends} knows the ends of episodes only, but '{name}' is a mean over the steps{allowed}",
            )
        robot.needs_displacements(ends)
        learner = self.training.learner
        refuse(
            LEARNERS[learner].has_memory and bool(self.plan.trains or self.finalists.seeds),
            f"{ends} needs policies without memory, but training.learner = {learner}{allowed}",
        )

    def _check_strategy(self) -> None:
        plan, strategy = self.plan, f"strategy '{self.strategy}'"
        refuse(
            plan.policy and not self.policy,
            f"{strategy} needs 'policy': a shared policy, which is trained with design_in_observation",
        )
        refuse(not plan.policy and bool(self.policy), f"{strategy} does not use policy = '{self.policy}'; remove it")
        for name in filter(is_option, self.variables):
            refuse(
                plan.policy,
                f"{strategy} uses a policy that was trained with fixed options, so '{name}' cannot vary; "
                "allowed: qp, scratch",
            )
        refuse(
            bool(self.finalists.seeds) and self.strategy == "qp",
            f"finalists.seeds = {self.finalists.seeds} trains policies, but strategy 'qp' has none; allowed: 0",
        )
        shown = self.environment.design_in_observation
        refuse(
            plan.shares_policy and shown is not True and not set(self.variables) <= set(shown or ()),
            f"{strategy} needs a policy that reads the design: add {', '.join(self.variables)} to "
            "environment.design_in_observation",
        )

    def _check_pruner(self) -> None:
        pruner, trains = self.pruner.name, self.plan.trains
        refuse(
            bool(self.secondary_objectives) and pruner != "none",
            f"pruner '{pruner}' supports one objective only; allowed: none",
        )
        refuse(
            not trains and pruner not in ("none", "wilcoxon"),
            f"pruner '{pruner}' stops trainings, but trials of strategy '{self.strategy}' do not train; "
            "allowed: none, wilcoxon",
        )
        refuse(
            trains and pruner == "wilcoxon",
            f"pruner 'wilcoxon' compares goals, but strategy '{self.strategy}' reports its training; "
            f"allowed: {', '.join(name for name in PRUNERS if name != 'wilcoxon')}",
        )

    def _check_trainings(self) -> None:
        """Refuse trainings that would end before they report or learn anything."""
        own, retrained = self.plan.trains, self.finalists.seeds
        if own or retrained:
            run = self.training
            refuse(
                run.report_every > run.steps,
                f"training.report_every = {run.report_every} exceeds training.steps = {run.steps}",
            )
            known = own or self.finalists.steps is None
            run.check_training(
                self.environment, run.steps if known else None, section="training.", end="training.steps"
            )
        if retrained and self.finalists.steps is not None:
            self.training.check_training(
                self.environment, self.finalists.steps, section="training.", end="finalists.steps"
            )

    @property
    def plan(self) -> Strategy:
        """What the strategy does."""
        return STRATEGIES[self.strategy]
