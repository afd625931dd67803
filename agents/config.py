"""Configuration of environments and of training."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

from pydantic import Field, field_validator, model_validator

from softgym_envs.backends.time_steps import shared_options
from softgym_envs.config import BesideConfig, Config
from softgym_envs.envs.options import EnvironmentOptions, default_backend, set_up
from softgym_envs.envs.registration import EnvironmentRow, find_row
from softgym_envs.envs.tasks.registry import TASKS, make_task
from softgym_envs.registry import class_path
from softgym_envs.robots.registry import make_robot

if TYPE_CHECKING:
    import gymnasium
    from gymnasium.envs.registration import EnvSpec

    from softgym_envs.envs.tasks.base import Task
    from softgym_envs.robots.base import Robot


class EnvironmentConfig(Config):
    """An environment by its ID, or a robot with a task, and the options of ``gymnasium.make``.

    A robot and a task are registered names or paths such as ``my_module:MyRobot``; in Python they may be classes, which
    are stored as their paths. With ``residual_scale`` the agent corrects the inverse QP: the executed action is
    ``clip(QP action + residual_scale * agent action, -1, 1)``.

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
    plant: dict[str, float | tuple[float, float]] | None = None
    residual_scale: float = Field(default=0.0, ge=0, le=2)

    @model_validator(mode="before")
    @classmethod
    def _paths_of_classes(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        paths = {name: class_path(data[name]) for name in ("robot", "task") if isinstance(data.get(name), type)}
        return {**data, **paths}

    @model_validator(mode="after")
    def _complete(self) -> EnvironmentConfig:
        if self.id is None and (self.robot is None or self.task is None):
            raise ValueError("an environment needs an id, or a robot and a task")
        if self.id is not None and (self.robot is not None or self.task is not None):
            raise ValueError("an environment takes an id, or a robot and a task, not both")
        row = self.row  # checks the ID, or the task
        if "backend" not in self.model_fields_set:
            backend = row.backend or default_backend(self.make_robot(), self.backend_options)
            object.__setattr__(self, "backend", backend)
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
        return make_robot(row.robot, **{**row.robot_options_on(self.backend), **self.robot_options})

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
        options = self.model_dump(exclude={"id", "robot", "task", "max_episode_steps", "residual_scale"})
        return {**options, **overrides}

    def make(self, **overrides: Any) -> gymnasium.Env:
        """Return the environment; ``overrides`` replace options of ``gymnasium.make``."""
        import gymnasium

        env = gymnasium.make(self._spec(), **self._options(overrides))
        return self._wrapped(env) if self.residual_scale else env

    def _wrapped(self, env: gymnasium.Env) -> gymnasium.Wrapper:
        from softgym_envs.agents.residual import ResidualQP

        return ResidualQP(env, self.residual_scale)

    def make_vec(self, num_envs: int, **overrides: Any) -> gymnasium.vector.VectorEnv:
        """Return the batched environment if there is one, else one process per environment."""
        import gymnasium

        if self.batched or not self.residual_scale:
            envs = gymnasium.make_vec(self._spec(), num_envs=num_envs, **self._options(overrides))
            if not self.residual_scale:
                return envs
            from softgym_envs.agents.residual import VectorResidualQP

            return VectorResidualQP(envs, self.residual_scale)
        return gymnasium.make_vec(
            self._spec(),
            num_envs=num_envs,
            vectorization_mode="async" if num_envs > 1 else "sync",
            # The QP of each environment runs in its process too.
            vector_kwargs={
                "autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP,
                # Set explicitly: the start method of joblib's workers cannot pickle these environments.
                **({"context": "fork"} if num_envs > 1 else {}),
            },
            wrappers=[self._wrapped],
            **self._options(overrides),
        )


class SACConfig(Config):
    """Hyperparameters of soft actor-critic, named as in stable-baselines3."""

    learning_rate: float = Field(default=1e-3, gt=0)
    final_learning_rate: float = Field(default=1e-4, gt=0, description="reached linearly at the last step")
    batch_size: int = Field(default=256, gt=0)
    buffer_size: int = Field(default=100_000, gt=0)
    gamma: float = Field(default=0.95, gt=0, le=1)
    tau: float = Field(default=0.01, gt=0, le=1)
    learning_starts: int = Field(default=1_000, ge=0)
    gradient_steps: int = Field(default=8, gt=0, description="per step of all environments together")
    net_arch: list[int] = [128, 128]
    ent_coef: float | str = "auto"
    target_entropy: float | Literal["auto"] = "auto"
    warm_up: Literal["actions", "postures"] = Field(
        default="actions",
        description="before learning starts: random actions, or in each episode straight to a random command",
    )
    hindsight: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="share of samples with a position reached later as goal; 0.8 is k = 4",
    )

    @field_validator("ent_coef")
    @classmethod
    def _entropy(cls, value: float | str) -> float | str:
        if isinstance(value, str) and value != "auto":
            start = value.removeprefix("auto_")
            try:
                positive = value.startswith("auto_") and float(start) > 0.0
            except ValueError:
                positive = False
            if not positive:
                raise ValueError("must be a number, 'auto' or 'auto_<positive start>'")
        return value

    @field_validator("net_arch")
    @classmethod
    def _layers(cls, value: list[int]) -> list[int]:
        return check_layers(value)


def check_layers(widths: list[int]) -> list[int]:
    """Return the widths of hidden layers.

    Raises:
        ValueError: for a width below 1.
    """
    if any(width < 1 for width in widths):
        raise ValueError("must be positive widths")
    return widths


class PPOConfig(Config):
    """Hyperparameters of proximal policy optimisation, named as in stable-baselines3."""

    learning_rate: float = Field(default=1e-3, gt=0)
    final_learning_rate: float = Field(default=1e-4, gt=0, description="reached linearly at the last step")
    n_steps: int = Field(default=25, gt=0, description="of each environment between updates")
    batch_size: int = Field(default=400, gt=1, description="at most all steps between updates")
    n_epochs: int = Field(default=6, gt=0)
    gamma: float = Field(default=0.9, gt=0, le=1)
    gae_lambda: float = Field(default=0.9, gt=0, le=1)
    clip_range: float = Field(default=0.2, gt=0)
    ent_coef: float = Field(default=0.0, ge=0)
    log_std_init: float = -0.5
    net_arch: list[int] = [64, 64]

    @field_validator("net_arch")
    @classmethod
    def _layers(cls, value: list[int]) -> list[int]:
        return check_layers(value)


class GradientConfig(Config):
    """Hyperparameters of the learners that know the model."""

    learning_rate: float = Field(default=2e-3, gt=0)
    final_learning_rate: float = Field(default=4e-5, gt=0, description="reached linearly at the last step")
    net_arch: list[int] = [128, 128]
    members: int | None = Field(
        default=1, ge=1, description="of the surrogate's ensemble, in training; evaluations use all"
    )

    @field_validator("net_arch")
    @classmethod
    def _layers(cls, value: list[int]) -> list[int]:
        return check_layers(value)


class AnalyticConfig(GradientConfig):
    """Hyperparameters of the analytic policy gradient (`softgym_envs.agents.learners.analytic`)."""

    slack_pull: float = Field(
        default=0.3, ge=0, description="how strongly commands of slack cables follow the displacement that is reached"
    )
    effort_weight: float = Field(
        default=1.0,
        ge=0,
        description="factor of the effort's share in the derivatives; above 1 for redundant actuators, which otherwise "
        "end up working against each other",
    )


class CloningConfig(GradientConfig):
    """Hyperparameters of the imitation of the inverse QP (`softgym_envs.agents.learners.cloning`)."""

    batch_size: int = Field(default=256, gt=0)
    gradient_steps: int = Field(default=8, gt=0, description="per step of all environments together")
    lead: float = Field(
        default=0.2, gt=0, le=1, description="share of the steps until the policy acts alone in all environments"
    )


class RecurrentConfig(GradientConfig):
    """Hyperparameters of the imitation by a network with memory (`softgym_envs.extensions.learners.recurrent`)."""

    net_arch: list[int] = Field(default=[64], min_length=1, max_length=1, description="width of the memory")
    batch_size: int = Field(default=32, gt=0, description="episodes of each update")
    gradient_steps: int = Field(default=8, gt=0, description="updates after each episode")
    lead: float = Field(
        default=0.2, gt=0, le=1, description="share of the steps until the policy acts alone in all episodes"
    )


class EvolutionConfig(Config):
    """Hyperparameters of the evolution of weights (`softgym_envs.extensions.learners.evolution`)."""

    step_size: float = Field(default=0.2, gt=0, description="first standard deviation of each weight")
    net_arch: list[int] = Field(default=[], description="widths of hidden layers; none for a linear policy")

    @field_validator("net_arch")
    @classmethod
    def _layers(cls, value: list[int]) -> list[int]:
        return check_layers(value)


class LearnerConfig(Config):
    """A learning method and its hyperparameters.

    Attributes:
        learner: ``"sac"``, ``"ppo"`` or ``"evolution"``, model-free, for every environment; or, model-based,
            ``"analytic"``, which follows derivatives of the reward and needs the surrogate, ``"cloning"``, which
            imitates the inverse QP, or ``"recurrent"``, which imitates it with a memory where goals are positions.
        sac: hyperparameters of SAC.
        ppo: hyperparameters of PPO.
        analytic: hyperparameters of the analytic policy gradient.
        cloning: hyperparameters of the imitation.
        recurrent: hyperparameters of the imitation with a memory.
        evolution: hyperparameters of the evolution of weights.
        num_envs: number of sub-environments; for ``"evolution"`` the size of a generation.
        seed: seed of everything random.
    """

    learner: Literal["sac", "ppo", "analytic", "cloning", "recurrent", "evolution"] = "sac"
    sac: SACConfig = Field(default_factory=SACConfig)
    ppo: PPOConfig = Field(default_factory=PPOConfig)
    analytic: AnalyticConfig = Field(default_factory=AnalyticConfig)
    cloning: CloningConfig = Field(default_factory=CloningConfig)
    recurrent: RecurrentConfig = Field(default_factory=RecurrentConfig)
    evolution: EvolutionConfig = Field(default_factory=EvolutionConfig)
    num_envs: int = Field(default=16, gt=0)
    seed: int = Field(default=0, ge=0)


class TrainConfig(LearnerConfig):
    """One training run.

    Attributes:
        environment: what the policy is trained in.
        steps: environment steps, over all sub-environments.
        initial: initial policy: a file or the name of a shipped one, for the same robot and goals of the same kind.
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
        if self.learner == "sac":
            check_hindsight(self.sac, self.environment)
            check_start("sac.learning_starts", self.sac, "steps", self.steps)
        return self


def check_hindsight(sac: SACConfig, environment: EnvironmentConfig) -> None:
    """Raise ValueError for hindsight goals with a residual agent."""
    # The stored actions include the QP's action for the original goal, so they do not fit another goal.
    if sac.hindsight and environment.residual_scale:
        raise ValueError(
            f"sac.hindsight = {sac.hindsight:g} cannot be combined with environment.residual_scale = "
            f"{environment.residual_scale:g}: the QP's action depends on the goal; allowed: 0"
        )


def check_start(key: str, sac: SACConfig, end: str, steps: int) -> None:
    """Raise ValueError for a training that would end before its first update.

    Args:
        key: key of ``learning_starts``, for the message.
        sac: hyper-parameters.
        end: key of the number of steps, for the message.
        steps: environment steps of the training.
    """
    if sac.learning_starts >= steps:
        raise ValueError(
            f"{key} = {sac.learning_starts} must be below {end} = {steps}, or nothing would be learned; "
            f"allowed: 0 to {steps - 1}"
        )
