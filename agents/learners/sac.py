"""Soft actor-critic of stable-baselines3 (model-free)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field, field_validator

from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.agents.learners.base import Tensors, check_layers, check_weights
from softgym_envs.agents.learners.sb3 import SB3Learner
from softgym_envs.config import Config

if TYPE_CHECKING:
    from stable_baselines3 import SAC
    from torch.optim import Optimizer

_BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts", "ends")


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
    ent_coef: float | str = Field(default="auto_0.02", description="a number, 'auto' or 'auto_' and the start")
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


class SACLearner(SB3Learner):
    """Soft actor-critic on batched environments.

    Attributes:
        model: that of stable-baselines3.
    """

    Config = SACConfig
    title = "SAC"

    @classmethod
    def check(cls, settings: Any, environment: EnvironmentConfig, steps: int | None, *, section: str, end: str) -> None:
        # The stored actions include the QP's action for the original goal, so they do not fit another goal.
        if settings.hindsight and environment.residual_scale:
            raise ValueError(
                f"sac.hindsight = {settings.hindsight:g} cannot be combined with environment.residual_scale = "
                f"{environment.residual_scale:g}: the QP's action depends on the goal; allowed: 0"
            )
        if steps is not None and settings.learning_starts >= steps:
            raise ValueError(
                f"{section}sac.learning_starts = {settings.learning_starts} must be below {end} = {steps}, or nothing "
                f"would be learned; allowed: 0 to {steps - 1}"
            )

    @classmethod
    def update_seconds(cls, config: TrainConfig) -> float:
        return 0.005 * float(config.settings.gradient_steps)

    model: SAC

    def __init__(self, config: TrainConfig) -> None:
        super().__init__(config)
        self.model = make_model(config)
        self.schedule_learning_rate(config.settings.learning_rate, config.settings.final_learning_rate)

    def begin(self) -> None:
        """End the running episodes in the replay buffer."""
        buffer: Any = self.model.replay_buffer
        if hasattr(buffer, "cut"):
            buffer.cut()

    def optimisers(self) -> dict[str, Optimizer]:
        """Return those of the actor, the critic and, if it is learned, the entropy."""
        model = self.model
        found = {"actor": model.actor.optimizer, "critic": model.critic.optimizer}
        if model.ent_coef_optimizer is not None:
            found["entropy"] = model.ent_coef_optimizer
        return found

    def weights(self) -> Tensors:
        model = self.model
        tensors = {name: value.detach().cpu().numpy().copy() for name, value in model.policy.state_dict().items()}
        if model.log_ent_coef is not None:
            tensors["log_ent_coef"] = model.log_ent_coef.detach().cpu().numpy().copy()
        return tensors

    def load_weights(self, tensors: Mapping[str, np.ndarray], path: Path) -> None:
        import torch

        model = self.model
        own = model.policy.state_dict()
        check_weights({name: value.shape for name, value in own.items()}, tensors, path)
        model.policy.load_state_dict({name: torch.as_tensor(tensors[name]) for name in own})
        if "log_ent_coef" in tensors and model.log_ent_coef is not None:
            with torch.no_grad():
                model.log_ent_coef.copy_(torch.as_tensor(tensors["log_ent_coef"]))

    def state(self) -> tuple[Tensors, dict[str, Any]]:
        tensors, meta = super().state()
        buffer: Any = self.model.replay_buffer
        filled = buffer.buffer_size if buffer.full else buffer.pos
        for name in _BUFFER:
            if hasattr(buffer, name):
                tensors[f"buffer/{name}"] = getattr(buffer, name)[:filled]
        return tensors, meta | {"position": int(buffer.pos), "full": bool(buffer.full)}

    def restore(self, tensors: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
        super().restore(tensors, meta)
        buffer: Any = self.model.replay_buffer
        for name in _BUFFER:
            if hasattr(buffer, name):
                stored = tensors[f"buffer/{name}"]
                getattr(buffer, name)[: len(stored)] = stored
        buffer.pos, buffer.full = meta["position"], meta["full"]
        filled = len(tensors["buffer/rewards"])
        if buffer.full and filled < buffer.buffer_size:  # a shorter training had just filled its smaller buffer
            buffer.pos, buffer.full = filled, False


def make_model(config: TrainConfig) -> SAC:
    """Return the model of stable-baselines3 of a training."""
    from stable_baselines3 import SAC

    from softgym_envs.agents.hindsight import HindsightBuffer
    from softgym_envs.agents.vec_env import SB3VecEnv
    from softgym_envs.agents.warm_up import PostureSAC

    env = SB3VecEnv(config.environment.make_vec(config.num_envs))
    sac = config.settings
    postures = sac.warm_up == "postures"
    extra: dict[str, Any] = {}
    if sac.hindsight or postures:
        single: Any = config.environment.make().unwrapped
    if sac.hindsight:
        options = {"spaces": single.spaces, "task": single.task, "share": sac.hindsight}
        extra = {"replay_buffer_class": HindsightBuffer, "replay_buffer_kwargs": options}
    if postures:
        extra["spaces"] = single.spaces
    return (PostureSAC if postures else SAC)(
        "MlpPolicy",
        env,
        learning_rate=sac.learning_rate,
        batch_size=sac.batch_size,
        buffer_size=min(sac.buffer_size, config.steps + config.num_envs),
        gamma=sac.gamma,
        tau=sac.tau,
        learning_starts=sac.learning_starts,
        train_freq=1,
        gradient_steps=sac.gradient_steps,
        ent_coef=sac.ent_coef,
        target_entropy=sac.target_entropy,
        policy_kwargs={"net_arch": list(sac.net_arch), "optimizer_kwargs": {"fused": True}},
        seed=config.seed,
        device="cpu",
        **extra,
    )
