"""Training of a policy by one of the learning methods, with evaluations, checkpoints, resumption and extension."""

from __future__ import annotations

import csv
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypedDict

import numpy as np

from softgym_envs.agents.config import TrainConfig
from softgym_envs.agents.evaluation import Evaluation, evaluate, evaluation_set
from softgym_envs.agents.learners import LEARNERS
from softgym_envs.agents.learners.base import Learner, Tensors
from softgym_envs.agents.policy import Policy, read_tensors, save_policy
from softgym_envs.envs.parallel import cpu_seconds
from softgym_envs.errors import DataError, WeightsError
from softgym_envs.extras import require
from softgym_envs.runs import RunFolder, provenance
from softgym_envs.storage import atomic_write, read_json, read_signed, write_signed
from softgym_envs.wording import counted

if TYPE_CHECKING:
    from stable_baselines3 import SAC


EVALUATION_SEED = 1_000_003
"""Seed of the bodies and goals of all learning curves, far from the seeds of trainings."""

POLICY = "policy.safetensors"
LATEST = "latest.safetensors"
CHECKPOINT = "checkpoint.safetensors"
"""Files of a folder: the policy that is kept, the one that an evaluation reads, and the state of the training."""


class CurvePoint(TypedDict):
    """A point of a learning curve: an evaluation during the training.

    ``seconds`` is wall time since the beginning, ``learning_seconds`` CPU time without the evaluations.
    """

    step: int
    seconds: float
    learning_seconds: float
    success_rate: float
    mean_distance: float
    worst_distance: float
    mean_return: float


class DesignProposer(Protocol):
    """Draws the bodies of training episodes, and learns along with the policy; for the learner ``"sac"``."""

    def attach(self, model: SAC, config: TrainConfig, folder: Path) -> None:
        """Start drawing the bodies of a training, continuing where an interrupted run stopped."""

    def begin(self, model: SAC) -> None:
        """Prepare for the next part of the training."""

    def save(self, step: int) -> None:
        """Write what is needed to continue from ``step``."""

    def finish(self, model: SAC) -> None:
        """Write the most promising bodies."""


def train(
    config: TrainConfig,
    folder: str | Path,
    *,
    initial: str | Path | None = None,
    report: Callable[[int, Evaluation], bool] | None = None,
    proposer: DesignProposer | None = None,
    progress: bool = True,
    keep_checkpoint: bool = False,
) -> Path:
    """Train a policy, resume an interrupted training in ``folder``, or extend one there to more steps.

    Writes ``policy.safetensors`` (for SAC, actor and critics) with its card and ``curve.csv``; SAC also writes
    TensorBoard logs if TensorBoard is installed. Until the end, ``checkpoint.safetensors`` holds weights, optimiser
    moments, replay buffer and random states, so that a resumed training gives the same policy as an uninterrupted one
    (all episodes restart after each evaluation). The saved policy is the one with the largest mean return in an
    evaluation; the card gives its step, and the CPU time of all processes that took part in the training.

    A folder with a checkpoint is extended by the same configuration with more ``steps``; a training that has not ended
    may also be shortened, to any number of steps from where it stands. What a learner plans over all steps, such as its
    learning rate, is from then on that of a training of the new number of steps. Until the training ends, the folder
    keeps the previous policy, if there is one. ``provenance.json`` and the card list each change of the steps, and
    other code (sources or versions) than began the training.

    Args:
        config: configuration of the training.
        folder: folder of the results.
        initial: initial policy (for SAC with critics): a file or the name of a shipped one; replaces that of the
            configuration.
        report: called with step and outcome after each evaluation, and again on resuming with those of the last one,
            whose call an interruption may have lost; returning True stops the training.
        proposer: draws the sampled bodies and learns along with the policy, for the learner ``"sac"``; default a
            uniform draw from the box.
        progress: show a progress bar.
        keep_checkpoint: keep the checkpoint at the end, so that the training can be extended.

    Returns:
        The path of ``policy.safetensors``.

    Raises:
        ValueError: if the environment cannot be made; a new folder is then not created.
        ConfigError: if ``initial`` was trained for another environment, the folder's configuration cannot be read or is
            another one, or another process trains there.
        DataError: if the folder holds a training that cannot end at these steps.
        WeightsError: if ``initial`` or a checkpoint is damaged or does not fit the configuration.
    """
    require("train")
    import torch
    from tqdm import tqdm

    torch.set_num_threads(1)
    if initial is not None:
        config = config.model_copy(update={"initial": str(initial)})
    folder = Path(folder)
    place = RunFolder(folder, TrainConfig, "a training")
    earlier = _earlier_steps(config, place)
    if earlier is not None and is_finished(folder, config.steps):
        return folder / POLICY
    run = _Run(config, folder, proposer)

    def stop() -> bool:
        return run.outcome is not None and report is not None and bool(report(run.learner.step, run.outcome))

    # Files are written after all checks, so that invalid values neither leave a folder behind nor change one.
    with (
        place.alone(),
        tqdm(total=config.steps, initial=run.learner.step, unit="step", desc=folder.name, disable=not progress) as bar,
    ):
        if earlier is None:
            place.begin(config)
        elif earlier != config.steps:
            _save_extension(place, config, earlier, run.learner.step)
        if earlier is not None and run.learner.step and (change := place.continued()) and progress:
            tqdm.write(f"warning: {change}")
        run.learner.log_to(folder)
        stopped = stop()
        while run.learner.step < config.steps and not stopped:
            run.learn(bar.update)
            bar.set_postfix_str(run.evaluate())
            run.save()
            stopped = stop()
    return run.finish(stopped, keep_checkpoint)


def is_finished(folder: str | Path, steps: int) -> bool:
    """Return whether a folder holds the policy of a finished training of at least so many steps."""
    return _finished_steps(folder) >= steps


def _finished_steps(folder: str | Path) -> int:
    """Return the steps of the finished training whose policy a folder holds; 0 if it holds none."""
    card = (Path(folder) / POLICY).with_suffix(".json")  # written after the policy
    return read_json(card)["config"]["steps"] if card.exists() else 0


def _earlier_steps(config: TrainConfig, place: RunFolder[TrainConfig]) -> int | None:
    """Return the steps of the training that a folder holds, finished or not; None if it holds none.

    Raises:
        ConfigError: if the folder's configuration cannot be read, or is that of another training.
        DataError: if it is that of a finished training that cannot go on to the steps of ``config``.
    """
    if not place.begun:
        return None
    place.accept(config, ["steps"])
    stored, folder = place.config, place.path
    finished = _finished_steps(folder)
    if config.steps < finished:
        raise DataError(
            f"'{folder}' holds a finished training of {counted(finished, 'step')}, got steps = {config.steps}; choose "
            f"a new folder, or steps = {finished} or more"
        )
    path = folder / CHECKPOINT
    made = _meta(path)["curve"][-1]["step"] if finished < config.steps < stored.steps and path.exists() else 0
    if config.steps < made:
        raise DataError(
            f"'{folder}' holds a training that has made {made} of {counted(stored.steps, 'step')}, got "
            f"steps = {config.steps}; choose a new folder, or steps = {made} or more"
        )
    if 0 < finished < config.steps and not path.exists():
        raise DataError(
            f"'{folder}' holds a finished training of {counted(finished, 'step')} without '{CHECKPOINT}', so it cannot "
            f"be extended to {config.steps}; choose a new folder, and start from this policy with --initial "
            f"{folder / POLICY}"
        )
    return stored.steps


def _save_extension(place: RunFolder[TrainConfig], config: TrainConfig, earlier: int, step: int) -> None:
    """Record that a training planned for ``earlier`` steps, which has made ``step``, ends at other ones."""
    path = place.path / "provenance.json"
    origin = read_signed(path)
    extension = {"from_steps": earlier, "to_steps": config.steps, "at_step": step, "provenance": provenance()}
    write_signed(path, {**origin, "extensions": [*origin.get("extensions", []), extension]})
    place.keep(config)


class _Run:
    """A training in its folder: the learner, and what its evaluations have found so far.

    A new run continues from the checkpoint of the folder, if there is one.

    Args:
        config: of the training.
        folder: of the results.
        proposer: draws the sampled bodies and learns along with the policy, if any.

    Attributes:
        learner: the learner.
        outcome: of the last evaluation; None before the first.

    Raises:
        ValueError: if the environment cannot be made.
        ConfigError: if the initial policy was trained for another environment.
        WeightsError: if it or the checkpoint is damaged or does not fit the configuration.
    """

    def __init__(self, config: TrainConfig, folder: Path, proposer: DesignProposer | None) -> None:
        self._began = cpu_seconds()
        self._config, self._folder, self._proposer = config, folder, proposer
        self._checkpoint = folder / CHECKPOINT
        self._curve: list[CurvePoint] = []
        self._best: Tensors = {}
        self.outcome: Evaluation | None = None
        self.learner: Learner = LEARNERS[config.learner](config)
        if self._checkpoint.exists():
            self._curve, self._best, self.outcome, spent = _restore(self.learner, self._checkpoint)
            self._began -= spent
        elif config.initial is not None:
            start = Policy(config.initial)
            start.check_environment(config.environment, any_task=True)
            self.learner.load_weights(read_tensors(start.path), start.path)
        if proposer is not None:
            proposer.attach(_model(self.learner), config, folder)
        self._designs, self._goals = evaluation_set(config.environment, config.evaluation_episodes, EVALUATION_SEED)
        self._start = time.perf_counter() - (self._curve[-1]["seconds"] if self._curve else 0.0)
        self._learning_seconds = self._curve[-1]["learning_seconds"] if self._curve else 0.0

    @property
    def _cpu_seconds(self) -> float:
        return cpu_seconds() - self._began

    def learn(self, tick: Callable[[int], object]) -> None:
        """Learn until the next evaluation is due."""
        config, learner = self._config, self.learner
        if self._proposer is not None:
            self._proposer.begin(_model(learner))
        target = min(config.steps, (learner.step // config.report_every + 1) * config.report_every)
        cpu = cpu_seconds()
        learner.learn(target, tick)
        self._learning_seconds += cpu_seconds() - cpu

    def evaluate(self) -> str:
        """Evaluate the present policy, keep the best one, and return the outcome as text."""
        config, learner = self._config, self.learner
        scratch = self._folder / LATEST
        save_policy(scratch, learner.weights(), {"config": config.model_dump(mode="json")})
        outcome = self.outcome = evaluate(scratch, config.environment, self._goals, design=self._designs)
        self._curve.append(
            {
                "step": learner.step,
                "seconds": round(time.perf_counter() - self._start, 2),
                "learning_seconds": round(self._learning_seconds, 3),
                "success_rate": outcome.success_rate,
                "mean_distance": outcome.mean_distance,
                "worst_distance": outcome.worst_distance,
                "mean_return": outcome.mean_return,
            }
        )
        # A proposer concentrates on bodies other than those of the evaluation, so the last policy is kept.
        if self._proposer is not None or outcome.mean_return >= max(row["mean_return"] for row in self._curve):
            self._best = learner.weights()
        shown = ("success_rate", "mean_distance", "mean_return")
        learner.record({f"evaluation/{name}": getattr(outcome, name) for name in shown})
        scale = config.environment.task_class.distance_scale
        return f"success {outcome.success_rate:.0%}, {scale.name} {scale.text(outcome.mean_distance, 2)}"

    def save(self) -> None:
        """Write the learning curve and the checkpoint, from which the training can continue."""
        assert self.outcome is not None
        _write_curve(self._folder / "curve.csv", self._curve)
        if self._proposer is not None:
            self._proposer.save(self.learner.step)
        _save_checkpoint(self.learner, self._checkpoint, self._curve, self._best, self.outcome, self._cpu_seconds)

    def finish(self, stopped: bool, keep_checkpoint: bool) -> Path:
        """Write the policy with its card, remove what is no longer needed and return the path of the policy."""
        card = {
            "config": self._config.model_dump(mode="json"),
            "steps": self.learner.step,
            "best_step": _best_step(self._curve) if self._proposer is None else self.learner.step,
            "stopped_early": stopped,
            "cpu_seconds": round(self._cpu_seconds, 2),
            "curve": self._curve,
            "provenance": provenance(),
        }
        origin = read_signed(self._folder / "provenance.json")
        card |= {key: origin[key] for key in ("extensions", "continued") if key in origin}
        if self._proposer is not None:
            self._proposer.finish(_model(self.learner))
        save_policy(self._folder / POLICY, self._best, card)
        latest = self._folder / LATEST
        for leftover in (latest, latest.with_suffix(".json"), *([] if keep_checkpoint else [self._checkpoint])):
            leftover.unlink(missing_ok=True)
        self.learner.close()
        return self._folder / POLICY


def cpu_before(policy: Path, began: float) -> float:
    """Return the CPU time [s] that earlier processes spent on a training that this process resumed.

    Args:
        policy: return value of `train`.
        began: ``cpu_seconds()`` before the call of `train`.
    """
    card = read_json(policy.with_suffix(".json"))
    return max(0.0, card.get("cpu_seconds", 0.0) - (cpu_seconds() - began))


def _model(learner: Learner) -> SAC:
    """Return the model whose critic or episodes a design proposer learns from.

    Raises:
        ValueError: for another learner than SAC.
    """
    from softgym_envs.agents.learners.sac import SACLearner

    if not isinstance(learner, SACLearner):
        raise ValueError(f"joint training needs learner 'sac', got '{learner.config.learner}'")
    return learner.model


def _best_step(curve: list[CurvePoint]) -> int:
    """Return the step of the evaluation with the largest mean return; the last one in case of a tie."""
    return int(max(curve, key=lambda row: (row["mean_return"], row["step"]))["step"])


def _save_checkpoint(
    learner: Learner,
    path: Path,
    curve: list[CurvePoint],
    best: Tensors,
    outcome: Evaluation,
    cpu_seconds: float,
) -> None:
    from safetensors.numpy import save

    tensors, state = learner.state()
    tensors = {f"state/{name}": value for name, value in tensors.items()}
    tensors |= {f"weights/{name}": value for name, value in learner.weights().items()}
    tensors |= {f"best/{name}": value for name, value in best.items()}
    meta = {"state": state, "curve": curve, "cpu_seconds": cpu_seconds, "outcome": outcome.to_json()}
    with atomic_write(path) as stream:
        arrays = {k: np.ascontiguousarray(v) for k, v in tensors.items()}
        stream.write(save(arrays, metadata={"training": json.dumps(meta)}))


def _restore(learner: Learner, path: Path) -> tuple[list[CurvePoint], Tensors, Evaluation, float]:
    """Restore a learner from a checkpoint.

    Returns:
        Learning curve, weights of the best policy so far, last evaluation, and CPU time spent so far [s].
    """
    tensors, meta = read_tensors(path), _meta(path)

    def part(name: str) -> Tensors:
        return {k.removeprefix(f"{name}/"): v for k, v in tensors.items() if k.startswith(f"{name}/")}

    learner.load_weights(part("weights"), path)
    learner.restore(part("state"), meta["state"])
    return meta["curve"], part("best"), Evaluation.from_json(meta["outcome"]), float(meta["cpu_seconds"])


def _meta(path: Path) -> dict[str, Any]:
    """Return all but the tensors of a checkpoint.

    Raises:
        WeightsError: if it is damaged.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as opened:
            return json.loads(opened.metadata()["training"])
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise WeightsError(f"checkpoint '{path}' is damaged or truncated: {error}") from None


def _write_curve(path: Path, curve: list[CurvePoint]) -> None:
    with atomic_write(path, "w") as stream:
        writer = csv.DictWriter(stream, CurvePoint.__annotations__)
        writer.writeheader()
        writer.writerows(curve)
