"""Soft actor-critic of stable-baselines3 (model-free)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agents.config import TrainConfig
from agents.learners.base import Learner, Tensors, check_weights

if TYPE_CHECKING:
    from stable_baselines3 import SAC

_BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts", "ends")


class SACLearner(Learner):
    """Soft actor-critic on batched environments.

    Attributes:
        model: that of stable-baselines3.
    """

    def __init__(self, config: TrainConfig) -> None:
        super().__init__(config)
        self.model = make_model(config)

    @property
    def step(self) -> int:  # type: ignore[override]
        return int(self.model.num_timesteps)

    def learn(self, target: int, progress: Callable[[int], object]) -> None:
        from stable_baselines3.common.callbacks import BaseCallback

        class Tick(BaseCallback):
            def _on_step(self) -> bool:
                progress(self.training_env.num_envs)
                return True

        model = self.model
        # A resumed run cannot restore running episodes or the generators of other processes: every run restarts them.
        model._last_obs = None
        if model.num_timesteps:
            seeds = np.random.SeedSequence([model.seed or 0, model.num_timesteps])
            model.get_env().seed(int(seeds.generate_state(1)[0]))  # type: ignore[union-attr]
        buffer: Any = model.replay_buffer
        if hasattr(buffer, "cut"):
            buffer.cut()
        model.learn(target - model.num_timesteps, callback=Tick(), reset_num_timesteps=False, log_interval=20)

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
        import torch

        model, tensors = self.model, {}
        for name, optimiser in _optimisers(model).items():
            for key, moments in optimiser.state_dict()["state"].items():
                for part, value in moments.items():
                    tensors[f"optimiser/{name}/{key}/{part}"] = torch.as_tensor(value).cpu().numpy()
        buffer: Any = model.replay_buffer
        filled = buffer.buffer_size if buffer.full else buffer.pos
        for name in _BUFFER:
            if hasattr(buffer, name):
                tensors[f"buffer/{name}"] = getattr(buffer, name)[:filled]
        tensors["random/torch"] = torch.get_rng_state().numpy()
        _, keys, *position = np.random.get_state()  # noqa: NPY002 - generator of stable-baselines3
        tensors["random/numpy"] = np.asarray(keys)
        meta = {
            "step": self.step,
            "updates": int(model._n_updates),
            "position": int(buffer.pos),
            "full": bool(buffer.full),
            "numpy": [int(position[0]), int(position[1]), float(position[2])],
            "actions": model.action_space.np_random.bit_generator.state,
        }
        return tensors, meta

    def restore(self, tensors: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
        import torch

        model = self.model
        for name, optimiser in _optimisers(model).items():
            state = optimiser.state_dict()
            moments: dict[int, dict[str, Any]] = {}
            prefix = f"optimiser/{name}/"
            for key, value in tensors.items():
                if key.startswith(prefix):
                    index, part = key.removeprefix(prefix).split("/")
                    moments.setdefault(int(index), {})[part] = torch.as_tensor(value)
            state["state"] = moments
            optimiser.load_state_dict(state)
        buffer: Any = model.replay_buffer
        for name in _BUFFER:
            if hasattr(buffer, name):
                stored = tensors[f"buffer/{name}"]
                getattr(buffer, name)[: len(stored)] = stored
        buffer.pos, buffer.full = meta["position"], meta["full"]
        model.num_timesteps, model._n_updates = meta["step"], meta["updates"]
        torch.set_rng_state(torch.as_tensor(tensors["random/torch"]))
        np.random.set_state(("MT19937", tensors["random/numpy"], *meta["numpy"]))  # noqa: NPY002 - as above
        model.action_space.np_random.bit_generator.state = meta["actions"]

    def log_to(self, folder: Path) -> None:
        """Write the model's log to a folder if TensorBoard is installed."""
        from stable_baselines3.common.logger import configure

        formats = ["tensorboard"] if find_spec("tensorboard") else []
        self.model.set_logger(configure(str(folder / "tensorboard"), formats))

    def record(self, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            self.model.logger.record(name, value)
        self.model.logger.dump(self.step)

    def close(self) -> None:
        self.model.get_env().close()  # type: ignore[union-attr]


def make_model(config: TrainConfig) -> SAC:
    """Return the model of stable-baselines3 of a training."""
    from stable_baselines3 import SAC

    from agents.hindsight import HindsightBuffer
    from agents.vec_env import SB3VecEnv
    from agents.warm_up import PostureSAC

    env = SB3VecEnv(config.environment.make_vec(config.num_envs))
    sac = config.sac
    postures = sac.warm_up == "postures"
    extra: dict[str, Any] = {}
    if sac.hindsight or postures:
        single: Any = config.environment.make().unwrapped
    if sac.hindsight:
        options = {"spaces": single.spaces, "task": single.task, "share": sac.hindsight}
        extra = {"replay_buffer_class": HindsightBuffer, "replay_buffer_kwargs": options}
    if postures:
        extra["spaces"] = single.spaces
    model = (PostureSAC if postures else SAC)(
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
    # stable-baselines3 measures progress within one call of learn(), but a training consists of many.
    fall = sac.final_learning_rate - sac.learning_rate
    model.lr_schedule = lambda _: sac.learning_rate + fall * min(model.num_timesteps / config.steps, 1.0)
    return model


def _optimisers(model: SAC) -> dict[str, Any]:
    found = {"actor": model.actor.optimizer, "critic": model.critic.optimizer}
    if model.ent_coef_optimizer is not None:
        found["entropy"] = model.ent_coef_optimizer
    return found
