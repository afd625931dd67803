"""Configuration of environments and of SAC training."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, field_validator, model_validator

from softgym_envs.config import Config
from softgym_envs.envs.registration import ENVIRONMENTS
from softgym_envs.errors import unknown_name
from softgym_envs.robots import make_robot

if TYPE_CHECKING:
    import gymnasium

    from softgym_envs.robots.base import Robot

__all__ = ["EnvironmentConfig", "SACConfig", "TrainConfig", "check_hindsight", "check_start"]


class EnvironmentConfig(Config):
    """An environment: its ID and the options of ``gymnasium.make``; the backend is by default that of its row.

    With ``residual_scale`` the agent acts on top of the inverse QP: the action that is done is
    ``clip(action of the QP + residual_scale * action of the agent, -1, 1)``.
    """

    id: str
    backend: str = "surrogate"
    design: dict[str, float] | None = None
    sample_design: bool | list[str] = False
    design_in_observation: bool | list[str] = False
    action_mode: str = "increment"
    robot_options: dict[str, Any] = {}
    task_options: dict[str, Any] = {}
    backend_options: dict[str, Any] = {}
    residual_scale: float = Field(
        default=0.0, ge=0, le=2, description="share of the agent's action on top of the QP's; 0: no QP"
    )

    @model_validator(mode="before")
    @classmethod
    def _default_backend(cls, data: Any) -> Any:
        row = ENVIRONMENTS.get(str(data.get("id"))) if isinstance(data, dict) else None
        return {"backend": row.backend, **data} if row is not None else data

    @field_validator("id")
    @classmethod
    def _known(cls, value: str) -> str:
        if value not in ENVIRONMENTS:
            raise ValueError(unknown_name("environment", value, ENVIRONMENTS))
        return value

    def on(self, backend: str) -> EnvironmentConfig:
        """The same environment on another backend; options of the present backend do not apply there."""
        options = self.backend_options if backend == self.backend else {}
        return self.model_copy(update={"backend": backend, "backend_options": options})

    def robot(self) -> Robot:
        """Make the family of bodies.

        Raises:
            ValueError: for a wrong option of the robot.
        """
        row = ENVIRONMENTS[self.id]
        return make_robot(row.robot, **{**row.robot_options, **self.robot_options})

    def _options(self, overrides: dict[str, Any]) -> dict[str, Any]:
        options = self.model_dump(exclude={"id", "residual_scale"})
        return {**options, **overrides}

    def make(self, **overrides: Any) -> gymnasium.Env:
        """Return the environment; ``overrides`` replace options of ``gymnasium.make``."""
        import gymnasium

        import softgym_envs  # noqa: F401 - registers the IDs

        env = gymnasium.make(self.id, **self._options(overrides))
        return self._wrapped(env) if self.residual_scale else env

    def _wrapped(self, env: gymnasium.Env) -> gymnasium.Wrapper:
        from agents.residual import ResidualQP

        return ResidualQP(env, self.residual_scale)

    def make_vec(self, num_envs: int, **overrides: Any) -> gymnasium.vector.VectorEnv:
        """Return the batched environment on the surrogate, or one process for each environment on finite elements."""
        import gymnasium

        import softgym_envs  # noqa: F401 - registers the IDs

        if self.backend == "surrogate":
            envs = gymnasium.make_vec(self.id, num_envs=num_envs, **self._options(overrides))
            if not self.residual_scale:
                return envs
            from agents.residual import VectorResidualQP

            return VectorResidualQP(envs, self.residual_scale)
        return gymnasium.make_vec(
            self.id,
            num_envs=num_envs,
            vectorization_mode="async" if num_envs > 1 else "sync",
            vector_kwargs={
                "autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP,
                # Said, because joblib's workers have a start method of their own that cannot pickle these.
                **({"context": "fork"} if num_envs > 1 else {}),
            },
            wrappers=[self._wrapped] if self.residual_scale else [],
            **self._options(overrides),
        )


class SACConfig(Config):
    """Hyper-parameters of soft actor-critic, named as in stable-baselines3."""

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
    hindsight: float = Field(
        default=0.0, ge=0, le=1, description="share of samples whose goal is an effector reached later; 0.8 is k = 4"
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
        if any(width < 1 for width in value):
            raise ValueError("must be positive widths")
        return value


class TrainConfig(Config):
    """One SAC training run."""

    environment: EnvironmentConfig
    sac: SACConfig = SACConfig()
    steps: int = Field(default=40_000, gt=0, description="environment steps, over all sub-environments")
    num_envs: int = Field(default=16, gt=0)
    seed: int = Field(default=0, ge=0)
    initial: str | None = Field(default=None, description="policy to start from: a file or the name of a shipped one")
    evaluation_episodes: int = Field(default=64, gt=0)
    report_every: int = Field(default=4_000, gt=0, description="environment steps between evaluations")

    @model_validator(mode="after")
    def _consistent(self) -> TrainConfig:
        check_hindsight(self.sac, self.environment)
        check_start("sac.learning_starts", self.sac, "steps", self.steps)
        return self


def check_hindsight(sac: SACConfig, environment: EnvironmentConfig) -> None:
    """Raise ValueError for hindsight goals on top of the QP."""
    # What was done held the QP's action for the goal of then; it says nothing about another goal.
    if sac.hindsight and environment.residual_scale:
        raise ValueError(
            f"sac.hindsight = {sac.hindsight:g} cannot be had on top of the QP "
            f"(environment.residual_scale = {environment.residual_scale:g}), whose action depends on the goal; "
            "allowed: 0"
        )


def check_start(key: str, sac: SACConfig, end: str, steps: int) -> None:
    """Raise ValueError for a training that ends before its first update.

    Args:
        key: of ``learning_starts``, for the message.
        sac: hyper-parameters.
        end: key of ``steps``, for the message.
        steps: environment steps of the training.
    """
    if sac.learning_starts >= steps:
        raise ValueError(
            f"{key} = {sac.learning_starts} is not below {end} = {steps}: nothing would be learned; "
            f"allowed: 0 to {steps - 1}"
        )
