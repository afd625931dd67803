"""Parts of the configuration of a study; quantities are in SI units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from softgym_envs.agents.config import EnvironmentConfig, LearnerConfig, TrainConfig
from softgym_envs.codesign.sampling import check_options
from softgym_envs.config import Config


@dataclass(frozen=True)
class Strategy:
    """How a body gets its score."""

    trains: bool = False  # each trial trains a policy of its own
    policy: bool = False  # the study needs a given shared policy, to start trainings or to score bodies

    @property
    def shares_policy(self) -> bool:
        """Whether the given shared policy scores all bodies."""
        return not self.trains and self.policy


STRATEGIES: dict[str, Strategy] = {
    "scratch": Strategy(trains=True),
    "warm_start": Strategy(trains=True, policy=True),
    "policy": Strategy(policy=True),
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


LEAST_OF_KINDS = 4
"""Fewest goals of a refinement that are half missed and half reached: two of a kind have a scatter."""


class PrunerConfig(Config):
    """Algorithm that stops hopeless trials: a key of `PRUNERS`, and further arguments of its class."""

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

    Goals come from a ``source``. ``"family"``: effector positions that random bodies reach under random commands, the
    same for every body. ``"zone"``: points in a box, the work zone of the designer, reachable or not. ``"task"``: as
    the task draws them for the baseline body; for tasks whose goals are paths.
    """

    source: Literal["family", "zone", "task"] = "family"
    zone: ZoneConfig | None = None
    vary: tuple[str, ...] | None = Field(
        default=None, min_length=1, description="what differs among the random bodies; default the optimised variables"
    )
    count: int = Field(default=40, ge=1, description="goals that every trial is scored on")
    unseen_count: int = Field(default=30, ge=2, description="goals that only finalists are tested on")
    training_count: int = Field(default=300, ge=1, description="goals for training episodes; not used by 'task'")
    seed: int = Field(default=0, ge=0)
    command_low: float = Field(
        default=0.0, ge=0.0, lt=1.0, description="smallest random command of 'family' as a fraction of the range"
    )

    @model_validator(mode="after")
    def _zone_where_needed(self) -> GoalsConfig:
        if (self.source == "zone") != (self.zone is not None):
            raise ValueError("'zone' (center, half_size) must be given with source 'zone', and only with it")
        return self


class TrainingConfig(LearnerConfig):
    """Training for one body, in a trial or as a finalist; see `softgym_envs.agents.config.TrainConfig`.

    All trials have the same seed and then differ by their bodies only.
    """

    steps: int = Field(default=2_500, ge=1, description="environment steps of one trial")
    report_every: int = Field(default=500, ge=1, description="environment steps between two reports to the pruner")
    evaluation_episodes: int = Field(default=32, ge=1, description="episodes of each report")

    def on(
        self,
        environment: EnvironmentConfig,
        goals: np.ndarray,
        design: Mapping[str, float],
        sample_design: bool | Sequence[str] = False,
        **changes: Any,
    ) -> TrainConfig:
        """Return the configuration of this training in an environment.

        Args:
            environment: the environment.
            goals: goals of the training [m], shape (k, 3); none for those that the task draws.
            design: complete design [SI].
            sample_design: names of the variables that vary in the training; default none.
            **changes: keys of the training with other values.
        """
        update: dict[str, Any] = {"design": dict(design), "sample_design": sample_design}
        if len(goals):
            update["task_options"] = {**environment.task_options, "goals": goals.tolist()}
        keys = self.model_dump(include=set(TrainConfig.model_fields))
        return TrainConfig(environment=environment.model_copy(update=update), **{**keys, **changes})


class ScreenConfig(Config):
    """Screen before the trials: the inverse QP scores many bodies, and the best become trials."""

    enabled: bool = False
    candidates: int = Field(default=32, ge=2, description="bodies to score, spread evenly over the design box")
    keep: float = Field(default=0.15, gt=0.0, le=1.0, description="fraction of the candidates that become trials")
    goals: int = Field(default=10, ge=1, description="goals per candidate: the first of the selection goals")

    @property
    def kept(self) -> int:
        """Number of candidates that become trials."""
        return max(1, round(self.keep * self.candidates)) if self.enabled else 0


class RefinementConfig(Config):
    """A finer mesh, on which baseline and winner are tested too.

    The difference to the mesh of the environment, extrapolated to elements of size zero, widens the intervals of the
    report.
    """

    robot_options: dict[str, Any] = Field(
        min_length=1, description="options of the robot that make the mesh finer, such as {mesh_size: 0.0075} [m]"
    )
    goals: int = Field(ge=1, description="how many of the unseen goals")
    choose: Literal["first", "missed"] = Field(
        default="first",
        description="which goals: the first ones, which are a random sample; or half of them among those that the "
        "baseline misses on the mesh of the study, weighted by their share of all unseen goals",
    )
    ratio: float | None = Field(
        default=None,
        gt=0.0,
        lt=1.0,
        description="size of its elements over that of the coarser mesh; default: the ratio of the numbers of unknowns "
        "for robots made of beams, its cube root for others",
    )

    @model_validator(mode="after")
    def _two_of_each_kind(self) -> RefinementConfig:
        if self.choose == "missed" and self.goals < LEAST_OF_KINDS:
            raise ValueError(f"choose = 'missed' needs two goals of each kind; allowed: goals from {LEAST_OF_KINDS}")
        return self


class FinalistsConfig(Config):
    """The check on FEM.

    The winner has the best score on the selection goals, by the ``"surrogate"`` in its trial or by ``"fem"`` in the
    check. The unseen goals never decide. A body that cannot be simulated on FEM cannot win.
    """

    count: int = Field(default=3, ge=0, description="best bodies to test besides the baseline; 0: no check")
    choose: Literal["surrogate", "fem"] = "surrogate"
    test: Literal["episodes", "ends"] = Field(
        default="episodes",
        description="whole episodes on FEM; or where they end on the surrogate, for meshes on which steps take seconds",
    )
    last_steps: int = Field(default=4, ge=1, description="of 'ends': steps of a policy on FEM; the inverse QP settles")
    refinement: RefinementConfig | None = None
    fem_options: dict[str, Any] = Field(default_factory=dict, description="options of the FEM backend")
    seeds: int = Field(default=0, ge=0, description="policies to train anew per body; 0: test that of its trial")
    steps: int | None = Field(default=None, ge=1, description="of each of these trainings; default those of a trial")
