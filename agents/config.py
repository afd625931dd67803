"""Configuration of environments and of training."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, cast

from pydantic import (
    Field,
    SerializationInfo,
    SerializerFunctionWrapHandler,
    ValidationError,
    field_validator,
    model_serializer,
    model_validator,
)

from softgym_envs.agents.learners import LEARNERS
from softgym_envs.backends.time_steps import shared_options
from softgym_envs.config import BesideConfig, Config, first_problem
from softgym_envs.envs.options import EnvironmentOptions, default_backend, set_up
from softgym_envs.envs.registration import EnvironmentRow, find_row
from softgym_envs.envs.tasks.registry import TASKS, make_task
from softgym_envs.registry import allow_code, class_path, is_place
from softgym_envs.robots.registry import ROBOTS, make_robot

if TYPE_CHECKING:
    import gymnasium
    from gymnasium.envs.registration import EnvSpec

    from softgym_envs.envs.tasks.base import Task
    from softgym_envs.robots.base import Robot


class EnvironmentConfig(Config):
    """An environment by its ID, or a robot with a task, and the options of ``gymnasium.make``.

    A robot and a task are registered names or paths such as ``my_module:MyRobot``; in Python they may be classes, which
    are stored as their paths. With ``residual_scale`` the agent corrects the inverse QP, or what stands for it in the
    task (`Task.qp_agent`), or the agent ``residual_on``: the executed action is ``clip(its action + residual_scale *
    agent action, -1, 1)``.

    Attributes:
        id: ID of an environment, in place of robot and task.
        robot: registered name or ``module:class``, in place of ``id``.
        task: registered name or ``module:class``, in place of ``id``.
        max_episode_steps: time limit; default that of the ID or the task.
        backend: ``"surrogate"``, ``"fem"`` or ``"hybrid"``; default that of the ID, or the surrogate if weights ship.
        design: body of every episode; missing variables take their baseline.
        sample_design: draw the body at each reset: True for all variables, or their names.
        design_in_observation: include the body in the observation: True for all variables, or their names.
        action_mode: ``"increment"`` or ``"absolute"``.
        robot_options: options of the robot.
        task_options: options of the task.
        backend_options: options of the backend.
        plant: how the robot differs from its model, fixed or drawn at each reset (`softgym_envs.envs.plant`).
        residual_scale: factor of the agent's action when it is added to that of the QP; 0 for no QP.
        residual_on: agent that needs no training in place of the QP, where environments run one by one.
    """

    id: str | None = None
    robot: str | None = None
    task: str | None = None
    max_episode_steps: int | None = Field(default=None, gt=0)
    backend: str = "surrogate"
    design: dict[str, float] | None = None
    sample_design: bool | list[str] = False
    design_in_observation: bool | list[str] = False
    action_mode: str = "increment"
    robot_options: Annotated[dict[str, Any], BesideConfig()] = {}
    task_options: Annotated[dict[str, Any], BesideConfig()] = {}
    backend_options: Annotated[dict[str, Any], BesideConfig()] = {}
    plant: dict[str, float | tuple[float, float] | dict[str, float | tuple[float, float]]] | None = None
    residual_scale: float = Field(default=0.0, ge=0, le=2)
    residual_on: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _paths_of_classes(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        paths = {name: class_path(data[name]) for name in ("robot", "task") if isinstance(data.get(name), type)}
        allow_code(*paths.values())
        return {**data, **paths}

    @field_validator("design", mode="before")
    @classmethod
    def _numbers(cls, design: Any) -> Any:
        for name, value in design.items() if isinstance(design, dict) else ():
            if isinstance(value, str | bool):
                raise ValueError(f"'{name}' = {value!r} must be a number")
        return design

    @model_validator(mode="after")
    def _complete(self) -> EnvironmentConfig:
        if self.id is None and (self.robot is None or self.task is None):
            raise ValueError("an environment needs an id, or a robot and a task")
        if self.id is not None and (self.robot is not None or self.task is not None):
            raise ValueError("an environment takes an id, or a robot and a task, not both")
        row = self.row  # checks the ID, or the task
        if is_place(self.robot):
            ROBOTS.class_of(self.robot)
        if "backend" not in self.model_fields_set:
            backend = row.backend or default_backend(self.make_robot(), self.backend_options)
            object.__setattr__(self, "backend", backend)
        if self.residual_on is not None and (not self.residual_scale or self.batched):
            raise ValueError(
                f"residual_on = '{self.residual_on}' needs residual_scale > 0 and an environment that is not batched, "
                f"got residual_scale = {self.residual_scale:g} and {self.title} on backend '{self.backend}'"
            )
        return self

    @property
    def row(self) -> EnvironmentRow:
        """Robot, task, time limit and default options.

        Raises:
            ValueError: for an unknown ID or task.
        """
        if self.id is not None:
            row = find_row(self.id)
        else:
            task = cast("str", self.task)
            row = EnvironmentRow(cast("str", self.robot), task, TASKS.class_of(task).max_episode_steps)
        if self.max_episode_steps is not None:
            row = replace(row, max_episode_steps=self.max_episode_steps)
        return row

    @property
    def title(self) -> str:
        """The ID, or robot and task."""
        return self.id or f"{self.robot} {self.task}"

    @property
    def task_class(self) -> type[Task]:
        """Class of the task."""
        return TASKS.class_of(self.row.task)

    @property
    def has_surrogate(self) -> bool:
        """Whether surrogate weights ship for the robot or are given."""
        return (self.row.backend or default_backend(self.make_robot(), self.backend_options)) == "surrogate"

    @property
    def batched(self) -> bool:
        """Whether many episodes run at once in one process, see `SoftRobotVectorEnv`."""
        row, options = self.row, {**self._options({}), **self.row.defaults}
        del options["backend"]
        return set_up(row.robot, row.task, self.backend, EnvironmentOptions.check(options)).batched

    @property
    def uncorrected(self) -> EnvironmentConfig:
        """The same environment for agents that act alone, without residual."""
        return self.model_copy(update={"residual_scale": 0.0, "residual_on": None})

    def on(self, backend: str) -> EnvironmentConfig:
        """Return the same environment on another backend, with those options of the present one that mean the same."""
        options = self.backend_options if backend == self.backend else shared_options(self.backend_options)
        return self.model_copy(update={"backend": backend, "backend_options": options})

    def make_robot(self) -> Robot:
        """Return the robot.

        Raises:
            ValueError: for an unknown robot or a wrong robot option.
        """
        row = self.row
        if row.robot is None:
            raise ValueError(f"environment '{self.id}' needs a robot: give robot and task in place of the id")
        return make_robot(row.robot, **{**row.robot_options, **self.robot_options})

    def make_task(self, robot: Robot | None = None) -> Task:
        """Return the task, for a robot that `make_robot` returned or a new one.

        Raises:
            ValueError: for an unknown task or a wrong option.
        """
        row = self.row
        return make_task(row.task, robot or self.make_robot(), **{**row.task_options, **self.task_options})

    def _spec(self) -> EnvSpec:
        return self.row.spec(self.id or "SoftGym/Configured-v0")

    def _options(self, overrides: dict[str, Any]) -> dict[str, Any]:
        options = self.model_dump(exclude={"id", "robot", "task", "max_episode_steps", "residual_scale", "residual_on"})
        return {**options, **overrides}

    def make(self, **overrides: Any) -> gymnasium.Env:
        """Return the environment; ``overrides`` replace options of ``gymnasium.make``."""
        import gymnasium

        env = gymnasium.make(self._spec(), **self._options(overrides))
        return self._wrapped(env) if self.residual_scale else env

    def _wrapped(self, env: gymnasium.Env) -> gymnasium.Wrapper:
        from softgym_envs.agents.residual import ResidualQP

        return ResidualQP(env, self.residual_scale, self.residual_on or "qp")

    def make_vec(self, num_envs: int, **overrides: Any) -> gymnasium.vector.VectorEnv:
        """Return the batched environment if there is one, else one process per environment."""
        import gymnasium

        if self.batched or not self.residual_scale:
            envs = gymnasium.make_vec(self._spec(), num_envs=num_envs, **self._options(overrides))
            if not self.residual_scale:
                return envs
            from softgym_envs.agents.residual import VectorResidualQP

            return VectorResidualQP(envs, self.residual_scale)
        # The QP of each environment runs in its process too.
        return gymnasium.make_vec(self._spec(), num_envs=num_envs, wrap=self._wrapped, **self._options(overrides))


class LearnerConfig(Config):
    """A learning method and its hyperparameters.

    In a file, the hyperparameters stand under the name of the learner: ``sac: {gamma: 0.9}``.

    Attributes:
        learner: a name in `softgym_envs.agents.learners.LEARNERS`.
        settings: hyperparameters, of the class ``Config`` of the learner.
        num_envs: number of sub-environments; for evolution the size of a generation.
        seed: seed of everything random.
    """

    learner: str = "sac"
    settings: Any = None
    num_envs: int = Field(default=16, gt=0)
    seed: int = Field(default=0, ge=0)

    @model_validator(mode="before")
    @classmethod
    def _settings_of_learner(cls, data: Any) -> Any:
        """Make the settings from the section with the learner's name; refuse sections of other learners."""
        if not isinstance(data, dict):
            return data
        name = data.get("learner", cls.model_fields["learner"].default)
        kind = LEARNERS.find(name).Config
        settings, section = data.get("settings"), data.get(name, {})
        if settings is None:
            try:
                settings = kind.model_validate(section)
            except ValidationError as error:
                inside = "." if error.errors()[0]["loc"] else ": "
                raise ValueError(f"{name}{inside}{first_problem(error)}") from None
        elif not isinstance(settings, kind):
            raise ValueError(
                f"settings of learner '{name}' stand under '{name}' in a file, got settings = {settings!r}"
            )
        for other in set(LEARNERS) & set(data) - {name}:
            raise ValueError(f"{other} = {data[other]!r} has no effect on learner '{name}'; allowed: {name}")
        return {**{key: value for key, value in data.items() if key != name}, "settings": settings}

    @model_serializer(mode="wrap")
    def _section_of_learner(self, handler: SerializerFunctionWrapHandler, info: SerializationInfo) -> dict[str, Any]:
        data: dict[str, Any] = handler(self)
        if info.exclude_unset and not data["settings"]:
            del data["settings"]
        return {self.learner if key == "settings" else key: value for key, value in data.items()}

    def check_training(
        self, environment: EnvironmentConfig, steps: int | None, *, section: str = "", end: str = "steps"
    ) -> None:
        """Raise ValueError for hyperparameters that contradict an environment or the length of a training.

        Args:
            environment: what the policy is trained in.
            steps: environment steps of the training; None if they are not known.
            section: of these hyperparameters, for messages: ``"training."``.
            end: key of the number of steps, for messages.
        """
        LEARNERS[self.learner].check(self.settings, environment, steps, section=section, end=end)


class TrainConfig(LearnerConfig):
    """One training run.

    Attributes:
        environment: what the policy is trained in.
        steps: environment steps, over all sub-environments.
        initial: initial policy: a file, the folder of a training or the name of a shipped one, for the same
            robot and goals of the same kind.
        evaluation_episodes: number of episodes of each evaluation.
        report_every: environment steps between evaluations. Learners begin new episodes after each, so all
            sub-environments should make several episodes in between.
    """

    environment: EnvironmentConfig
    steps: int = Field(default=40_000, gt=0)
    initial: Annotated[str | None, BesideConfig()] = None
    evaluation_episodes: int = Field(default=64, gt=0)
    report_every: int = Field(default=4_000, gt=0)

    @model_validator(mode="after")
    def _consistent(self) -> TrainConfig:
        self.check_training(self.environment, self.steps)
        return self
