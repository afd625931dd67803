"""Training of a policy by one of the learning methods, with evaluations, checkpoints and resumption."""

from __future__ import annotations

import csv
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

import numpy as np

from softgym_envs.agents.config import TrainConfig
from softgym_envs.agents.evaluation import Evaluation, evaluate, evaluation_set
from softgym_envs.agents.learners import make_learner
from softgym_envs.agents.learners.base import Learner, Tensors
from softgym_envs.agents.policy import Policy, read_tensors, save_policy
from softgym_envs.config import difference, load_config, provenance, save_resolved
from softgym_envs.errors import DataError
from softgym_envs.extras import require
from softgym_envs.storage import atomic_write, read_json

if TYPE_CHECKING:
    from stable_baselines3 import SAC

    from softgym_envs.agents.joint import DesignProposer


EVALUATION_SEED = 1_000_003


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


def train(
    config: TrainConfig,
    folder: str | Path,
    *,
    initial: str | Path | None = None,
    report: Callable[[int, Evaluation], bool] | None = None,
    proposer: DesignProposer | None = None,
    progress: bool = True,
) -> Path:
    """Train a policy, or resume an interrupted training in ``folder``.

    Writes ``policy.safetensors`` (for SAC, actor and critics) with its card and ``curve.csv``; SAC also writes
    TensorBoard logs if TensorBoard is installed. Until the end, ``checkpoint.safetensors`` holds weights, optimiser
    moments, replay buffer and random states, so that a resumed training gives the same policy as an uninterrupted one
    (all episodes restart after each evaluation). The saved policy is the one with the largest mean return in an
    evaluation; the card gives its step, and the CPU time of all processes that took part in the training.

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

    Returns:
        The path of ``policy.safetensors``.

    Raises:
        ValueError: if the environment cannot be made; a new folder is then not created.
        ConfigError: if ``initial`` was trained for another environment, or the folder's configuration cannot be read.
        DataError: if the folder holds the training of another configuration.
        WeightsError: if ``initial`` or a checkpoint is damaged or does not fit the configuration.
    """
    require("train")
    import torch
    from tqdm import tqdm

    torch.set_num_threads(1)
    if initial is not None:
        config = config.model_copy(update={"initial": str(initial)})
    folder = Path(folder)
    result = folder / "policy.safetensors"
    resolved = folder / "config.yaml"
    begun = resolved.exists()
    if begun:
        other = difference(load_config(resolved, TrainConfig), config)
        if other is not None:
            raise DataError(f"'{folder}' holds a training with another configuration: {other}; choose a new folder")
        if result.exists():
            return result

    began = time.process_time()
    checkpoint = folder / "checkpoint.safetensors"
    curve: list[CurvePoint] = []
    best: Tensors = {}
    outcome: Evaluation | None = None
    learner = make_learner(config)
    if checkpoint.exists():
        curve, best, outcome, spent = _restore(learner, checkpoint)
        began -= spent
    elif config.initial is not None:
        start_from = Policy(config.initial)
        start_from.check_environment(config.environment, any_task=True)
        learner.load_weights(read_tensors(start_from.path), start_from.path)
    if proposer is not None:
        proposer.attach(_model(learner), config, folder)
    designs, goals = evaluation_set(config.environment, config.evaluation_episodes, EVALUATION_SEED)
    if not begun:  # after all checks, so that invalid values do not leave a folder behind
        save_resolved(folder, config)
    learner.log_to(folder)

    start = time.perf_counter() - (curve[-1]["seconds"] if curve else 0.0)
    learning = curve[-1]["learning_seconds"] if curve else 0.0
    bar = tqdm(total=config.steps, initial=learner.step, unit="step", desc=folder.name, disable=not progress)
    stopped = outcome is not None and report is not None and bool(report(learner.step, outcome))
    with bar:
        while learner.step < config.steps and not stopped:
            if proposer is not None:
                proposer.begin(_model(learner))
            target = min(config.steps, (learner.step // config.report_every + 1) * config.report_every)
            cpu = time.process_time()
            learner.learn(target, bar.update)
            learning += time.process_time() - cpu
            scratch = folder / "latest.safetensors"
            save_policy(scratch, learner.weights(), {"config": config.model_dump(mode="json")})
            outcome = evaluate(scratch, config.environment, goals, design=designs)
            curve.append(
                {
                    "step": learner.step,
                    "seconds": round(time.perf_counter() - start, 2),
                    "learning_seconds": round(learning, 3),
                    "success_rate": outcome.success_rate,
                    "mean_distance": outcome.mean_distance,
                    "worst_distance": outcome.worst_distance,
                    "mean_return": outcome.mean_return,
                }
            )
            # A proposer concentrates on bodies other than those of the evaluation, so the last policy is kept.
            if proposer is not None or curve[-1]["mean_return"] >= max(row["mean_return"] for row in curve):
                best = learner.weights()
            scale = config.environment.task_class.distance_scale
            distance = f"{scale.name} {scale.text(outcome.mean_distance, 2)}"
            bar.set_postfix_str(f"success {outcome.success_rate:.0%}, {distance}")
            shown = ("success_rate", "mean_distance", "mean_return")
            learner.record({f"evaluation/{name}": getattr(outcome, name) for name in shown})
            _write_curve(folder / "curve.csv", curve)
            if proposer is not None:
                proposer.save(learner.step)
            _save_checkpoint(learner, checkpoint, curve, best, outcome, time.process_time() - began)
            stopped = report is not None and bool(report(learner.step, outcome))
    card = {
        "config": config.model_dump(mode="json"),
        "steps": learner.step,
        "best_step": _best_step(curve) if proposer is None else learner.step,
        "stopped_early": stopped,
        "cpu_seconds": round(time.process_time() - began, 2),
        "curve": curve,
        "provenance": provenance(),
    }
    if proposer is not None:
        proposer.finish(_model(learner))
    save_policy(result, best, card)
    for leftover in (folder / "latest.safetensors", folder / "latest.json", checkpoint):
        leftover.unlink(missing_ok=True)
    learner.close()
    return result


def cpu_before(policy: Path, began: float) -> float:
    """Return the CPU time [s] that earlier processes spent on a training that this process resumed.

    Args:
        policy: return value of `train`.
        began: ``time.process_time()`` before the call of `train`.
    """
    card = read_json(policy.with_suffix(".json"))
    return max(0.0, card.get("cpu_seconds", 0.0) - (time.process_time() - began))


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
    from safetensors import safe_open

    tensors = read_tensors(path)
    with safe_open(path, framework="numpy") as opened:
        meta = json.loads(opened.metadata()["training"])

    def part(name: str) -> Tensors:
        return {k.removeprefix(f"{name}/"): v for k, v in tensors.items() if k.startswith(f"{name}/")}

    learner.load_weights(part("weights"), path)
    learner.restore(part("state"), meta["state"])
    return meta["curve"], part("best"), Evaluation.from_json(meta["outcome"]), float(meta["cpu_seconds"])


def _write_curve(path: Path, curve: list[CurvePoint]) -> None:
    with atomic_write(path, "w") as stream:
        writer = csv.DictWriter(stream, CurvePoint.__annotations__)
        writer.writeheader()
        writer.writerows(curve)
