"""The problem that a study solves: which bodies it compares, and by which objectives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Self

from pydantic import Field, field_validator, model_validator

from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.codesign.metrics.metric import Direction, Metric, find_metric, metric_name
from softgym_envs.codesign.metrics.sources import BODY, DESIGN, EPISODES
from softgym_envs.codesign.variables import OptionRange, make_variables, split_values, with_options
from softgym_envs.config import Config
from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.envs.tasks.base import DistanceScale
from softgym_envs.robots.base import Robot


def refuse(wrong: bool, message: str) -> None:
    """Raise ValueError with a message if something is wrong."""
    if wrong:
        raise ValueError(message)


class StudyProblem(Config):
    """Bodies and objectives of a study; `softgym_envs.codesign.config.StudyConfig` documents the keys."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
    title: str = ""
    environment: EnvironmentConfig
    variables: tuple[str, ...] = Field(min_length=1)
    ranges: dict[str, OptionRange] = Field(default_factory=dict)
    objective: str = "mean_distance"
    secondary_objectives: tuple[str, ...] = ()
    constraints: dict[str, float] = Field(default_factory=dict)

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
        return metric_name(objective)

    @field_validator("secondary_objectives", mode="before")
    @classmethod
    def _all_importable(cls, objectives: Any) -> Any:
        return [metric_name(o) for o in objectives] if isinstance(objectives, list | tuple) else objectives

    @model_validator(mode="after")
    def _well_posed(self) -> Self:
        make_variables(self.variables, self.ranges, self.space)
        objectives = (self.objective, *self.secondary_objectives)
        for name in objectives:
            refuse(objectives.count(name) > 1, f"objective '{name}' is named twice")
        for name, metric in self.objectives.items():  # looking them up also refuses unknown names
            refuse(
                metric.source not in (EPISODES, BODY, DESIGN),
                f"metric '{name}' is read from {metric.source.name}, which a study does not compute; use it in a "
                "search of designs",
            )
        refuse(
            self.primary.of_body,
            f"objective '{self.objective}' does not depend on the controller; use it in 'secondary_objectives' or "
            "'constraints', or run a design search",
        )
        return self

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
    def objectives(self) -> dict[str, Metric]:
        """All objectives that the study names, by name: objective, secondary objectives and constraints."""
        names = (self.objective, *self.secondary_objectives, *self.constraints)
        return {name: self._find(name) for name in names}

    def _find(self, name: str) -> Metric:
        return replace(find_metric(name, self.robot, self.environment.task_class), name=name)

    @property
    def shown_objectives(self) -> dict[str, Metric]:
        """What every comparison of bodies shows, by name: the objective, success rate and final distance."""
        return {name: self._find(name) for name in dict.fromkeys((self.objective, "success_rate", "mean_distance"))}

    @property
    def primary(self) -> Metric:
        """The objective that decides who wins."""
        return self.objectives[self.objective]

    @property
    def score_names(self) -> tuple[str, ...]:
        """Names of the objectives that have a score, the one that decides first."""
        return self.objective, *self.secondary_objectives

    @property
    def titles(self) -> list[str]:
        """Name of each of these, with its SI unit."""
        return [self.objectives[name].stored_name for name in self.score_names]

    def signed(self, scores: Sequence[float]) -> list[float]:
        """Return the values [SI] behind scores, or scores of values: the sign of what is minimised differs."""
        return [self.objectives[name].score(score) for name, score in zip(self.score_names, scores, strict=True)]

    @property
    def directions(self) -> list[Direction]:
        """Direction of each of these."""
        return [self.objectives[name].direction for name in self.score_names]

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
    def distance(self) -> Metric:
        """Mean final distance, in the unit that people read for the task."""
        return self._find("mean_distance")

    @property
    def effort(self) -> Metric:
        """Mean effort of the actuators, in the unit that people read for the robot."""
        return self._find("mean_effort")

    @property
    def distance_scale(self) -> DistanceScale:
        """How people read a single distance of the task."""
        return self.environment.task_class.distance_scale

    @property
    def success_distance(self) -> float:
        """Distance within which a goal counts as reached, in the unit of `Task.distance`."""
        return self.environment.make_task(self.robot).success_distance

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
