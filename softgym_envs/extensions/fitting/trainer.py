"""Optimisation of the parts of a network with torch; each finished part is kept on disk."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from softgym_envs.config import Config
from softgym_envs.errors import DataError
from softgym_envs.storage import atomic_write, write_json

PATIENCE = 5

History = list[dict[str, float]]
"""Rows of ``step``, ``train`` and ``validation``: losses along a training."""


class TrainingOptions(Config):
    """Hyper-parameters of `Trainer.optimise`.

    SOAP (Vyas et al. 2024, arXiv:2409.11321) is Adam in the eigenbasis of Shampoo's preconditioner. The networks are
    small and their losses ill-conditioned: SOAP reaches in 4000 steps what Adam needs more than 24,000 for.

    The learning rate follows one cycle, or with ``"plateau"`` is halved whenever the validation loss has not fallen for
    `PATIENCE` of the 100 times it is computed.
    """

    optimiser: Literal["soap", "adam"] = "soap"
    schedule: Literal["cycle", "plateau"] = "cycle"
    steps: int = Field(default=4000, gt=0)
    batch_size: int = Field(default=128, gt=0)
    learning_rate: float = Field(default=1e-2, gt=0)


class Trainer:
    """Trains the parts of a model; a finished part is kept on disk and not trained again.

    Args:
        options: hyper-parameters of the network.
        seed: seed of weights and batches; each part starts from it, so a resumed run equals an uninterrupted one.
        folder: where finished parts are kept, or None.
        key: digest of what the parts depend on (configuration and data); parts with another key are ignored.
        progress: show progress bars.
        workers: number of processes that train independent parts at the same time.
    """

    def __init__(
        self,
        options: Any,
        seed: int,
        folder: Path | None = None,
        key: str = "",
        progress: bool = False,
        workers: int = 1,
    ) -> None:
        self.options, self.seed, self.folder, self.key = options, seed, folder, key
        self.progress, self.workers = progress, workers

    def optimise(self, name: str, net: Any, loss: Callable, train_size: int, seed: int | None = None) -> History:
        """Train a network, leave it at its best validation loss and return the history.

        Args:
            name: what the part is called in messages and file names.
            net: a torch module.
            loss: takes indices of training rows and returns the loss on them, or for None that on the validation set.
            train_size: number of training rows.
            seed: seed of the batches; default that of the trainer.

        Raises:
            DataError: if the training diverges.
        """
        import torch
        from safetensors import SafetensorError
        from safetensors.torch import load, save
        from tqdm import tqdm

        options = self.options
        path = None if self.folder is None else self.folder / f"{name.replace(' ', '_')}-{self.key}.safetensors"
        if path is not None and path.exists() and path.with_suffix(".json").exists():
            try:
                net.load_state_dict(load(path.read_bytes()))
                return json.loads(path.with_suffix(".json").read_text())
            except (SafetensorError, ValueError, RuntimeError, OSError) as error:
                aside = path.with_suffix(".corrupt")
                path.rename(aside)
                print(f"'{path}' is damaged ({error}): renamed to '{aside.name}'; training the part again")
        generator = torch.Generator().manual_seed(self.seed if seed is None else seed)
        optimiser = _optimiser(options, net.parameters())
        rates = torch.optim.lr_scheduler
        plateau = rates.ReduceLROnPlateau(optimiser, factor=0.5, patience=PATIENCE)
        cycle = None
        if options.schedule == "cycle":
            cycle = rates.OneCycleLR(
                optimiser, options.learning_rate, total_steps=options.steps, pct_start=0.05, final_div_factor=1e3
            )
        batch = min(options.batch_size, train_size)
        check = max(1, options.steps // 100)
        best, best_state, total, since, history = float("inf"), net.state_dict(), 0.0, 0, []
        order = torch.empty(0, dtype=torch.int64)
        with tqdm(total=options.steps, desc=name, unit="step", disable=not self.progress) as bar:
            for step in range(options.steps):
                if len(order) < batch:
                    order = torch.cat([order, torch.randperm(train_size, generator=generator)])
                value = loss(order[:batch])
                order = order[batch:]
                optimiser.zero_grad()
                value.backward()
                torch.nn.utils.clip_grad_norm_(net.parameters(), 10.0)
                optimiser.step()
                if cycle is not None:
                    cycle.step()
                total, since = total + value.item(), since + 1
                if (step + 1) % check and step + 1 < options.steps:
                    continue
                net.eval()  # without dropout
                with torch.no_grad():
                    validation = float(loss(None))
                net.train()
                if cycle is None:
                    plateau.step(validation)
                if not math.isfinite(validation):
                    raise DataError(
                        f"training of '{name}' diverged at step {step}: the validation loss is {validation}"
                    )
                history.append({"step": step + 1, "train": total / since, "validation": validation})
                bar.set_postfix_str(f"train {total / since:.2e}, validation {validation:.2e}")
                bar.update(since)
                total, since = 0.0, 0
                if validation < best:
                    best, best_state = validation, copy.deepcopy(net.state_dict())
        net.load_state_dict(best_state)
        if path is not None:
            # The history is written first: a part counts as finished when its weights exist.
            write_json(path.with_suffix(".json"), history)
            with atomic_write(path) as stream:
                stream.write(save(best_state))
        return history


def _optimiser(options: Any, parameters: Iterable[Any]) -> Any:
    import torch

    if options.optimiser == "adam":
        return torch.optim.Adam(parameters, lr=options.learning_rate, betas=(0.9, 0.99))
    from pytorch_optimizer import SOAP

    return SOAP(parameters, lr=options.learning_rate, betas=(0.95, 0.95), weight_decay=0.0, precondition_frequency=10)
