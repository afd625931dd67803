"""What the algorithms of stable-baselines3 have in common as learners."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.agents.learners.base import Learner, Tensors

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from torch.optim import Optimizer


class SB3Learner(Learner):
    """A learner around a model of stable-baselines3.

    Attributes:
        model: that of stable-baselines3.
    """

    model: BaseAlgorithm

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
        self.begin()
        model.learn(target - model.num_timesteps, callback=Tick(), reset_num_timesteps=False, log_interval=20)

    def begin(self) -> None:  # noqa: B027 - optional
        """Prepare new episodes, before each part of the training; by default nothing."""

    @abstractmethod
    def optimisers(self) -> dict[str, Optimizer]:
        """Return the optimisers by name."""

    def schedule_learning_rate(self, first: float, last: float) -> None:
        """Let the learning rate fall linearly over all steps of the training.

        stable-baselines3 measures progress within one call of its ``learn``, but a training consists of many.
        """
        model, steps = self.model, self.config.steps
        model.lr_schedule = lambda _: first + (last - first) * min(model.num_timesteps / steps, 1.0)

    def state(self) -> tuple[Tensors, dict[str, Any]]:
        import torch

        model, tensors = self.model, {}
        for name, optimiser in self.optimisers().items():
            for key, moments in optimiser.state_dict()["state"].items():
                for part, value in moments.items():
                    tensors[f"optimiser/{name}/{key}/{part}"] = torch.as_tensor(value).cpu().numpy()
        tensors["random/torch"] = torch.get_rng_state().numpy()
        _, keys, *position = np.random.get_state()  # noqa: NPY002 - generator of stable-baselines3
        tensors["random/numpy"] = np.asarray(keys)
        meta = {
            "step": self.step,
            "updates": int(model._n_updates),
            "numpy": [int(position[0]), int(position[1]), float(position[2])],
            "actions": model.action_space.np_random.bit_generator.state,
        }
        return tensors, meta

    def restore(self, tensors: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
        import torch

        model = self.model
        for name, optimiser in self.optimisers().items():
            state = optimiser.state_dict()
            moments: dict[int, dict[str, Any]] = {}
            prefix = f"optimiser/{name}/"
            for key, value in tensors.items():
                if key.startswith(prefix):
                    index, part = key.removeprefix(prefix).split("/")
                    moments.setdefault(int(index), {})[part] = torch.as_tensor(value)
            state["state"] = moments
            optimiser.load_state_dict(state)
        model.num_timesteps = meta["step"]
        model._n_updates = meta["updates"]
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
