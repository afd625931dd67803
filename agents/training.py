"""SAC training with stable-baselines3 on the batched surrogate environment."""

from __future__ import annotations

import csv
import json
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from agents.config import TrainConfig
from agents.evaluation import Evaluation, evaluate, evaluation_set
from agents.policy import Policy, read_tensors, save_policy
from softgym_envs.config import difference, load_config, provenance, save_resolved
from softgym_envs.errors import DataError, WeightsError
from softgym_envs.storage import atomic_write, read_json

if TYPE_CHECKING:
    from stable_baselines3 import SAC

    from agents.joint import DesignProposer


EVALUATION_SEED = 1_000_003
_BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts", "ends")


class CurvePoint(TypedDict):
    """A point of a learning curve: an evaluation during the training."""

    step: int
    seconds: float
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
    """Train a SAC policy, or resume an interrupted training in ``folder``.

    Writes ``policy.safetensors`` (actor and critics) with its card, ``curve.csv``, and TensorBoard logs if TensorBoard
    is installed. Until the end, ``checkpoint.safetensors`` holds weights, optimiser moments, replay buffer and random
    states, so that a resumed training gives the same policy as an uninterrupted one (all episodes restart after each
    evaluation). The saved policy is the one with the largest mean return in an evaluation; the card gives its step, and
    the CPU time of all processes that took part in the training.

    Args:
        config: configuration of the training.
        folder: folder of the results.
        initial: initial policy (actor and critics): a file or the name of a shipped one; replaces that of the
            configuration.
        report: called with step and outcome after each evaluation, and again on resuming with those of the last one,
            whose call an interruption may have lost; returning True stops the training.
        proposer: draws the sampled bodies and learns along with the policy; default a uniform draw from the box.
        progress: show a progress bar.

    Returns:
        The path of ``policy.safetensors``.

    Raises:
        ValueError: if the environment cannot be made; a new folder is then not created.
        ConfigError: if ``initial`` was trained for another environment, or the folder's configuration cannot be read.
        DataError: if the folder holds the training of another configuration.
        WeightsError: if ``initial`` or a checkpoint is damaged or does not fit the configuration.
    """
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
    best: dict[str, np.ndarray] = {}
    outcome: Evaluation | None = None
    model = _make_model(config)
    if checkpoint.exists():
        curve, best, outcome, spent = _restore(model, checkpoint)
        began -= spent
    elif config.initial is not None:
        start_from = Policy(config.initial)
        start_from.check_environment(config.environment)
        _load_weights(model, read_tensors(start_from.path), start_from.path)
    if proposer is not None:
        proposer.attach(model, config, folder)
    designs, goals = evaluation_set(config.environment, config.evaluation_episodes, EVALUATION_SEED)
    if not begun:  # after all checks, so that invalid values do not leave a folder behind
        save_resolved(folder, config)
    _log_to(model, folder)

    start = time.perf_counter() - (curve[-1]["seconds"] if curve else 0.0)
    bar = tqdm(total=config.steps, initial=model.num_timesteps, unit="step", desc=folder.name, disable=not progress)
    stopped = outcome is not None and report is not None and bool(report(model.num_timesteps, outcome))
    with bar:
        while model.num_timesteps < config.steps and not stopped:
            if proposer is not None:
                proposer.begin(model)
            target = min(config.steps, (model.num_timesteps // config.report_every + 1) * config.report_every)
            _learn(model, target, bar)
            scratch = folder / "latest.safetensors"
            save_policy(scratch, _weights(model), {"config": config.model_dump(mode="json")})
            outcome = evaluate(scratch, config.environment, goals, design=designs)
            curve.append(
                {
                    "step": model.num_timesteps,
                    "seconds": round(time.perf_counter() - start, 2),
                    "success_rate": outcome.success_rate,
                    "mean_distance": outcome.mean_distance,
                    "worst_distance": outcome.worst_distance,
                    "mean_return": outcome.mean_return,
                }
            )
            # A proposer concentrates on bodies other than those of the evaluation, so the last policy is kept.
            if proposer is not None or curve[-1]["mean_return"] >= max(row["mean_return"] for row in curve):
                best = _weights(model)
            bar.set_postfix_str(f"success {outcome.success_rate:.0%}, distance {1e3 * outcome.mean_distance:.2f} mm")
            for name in ("success_rate", "mean_distance", "mean_return"):
                model.logger.record(f"evaluation/{name}", getattr(outcome, name))
            model.logger.dump(model.num_timesteps)
            _write_curve(folder / "curve.csv", curve)
            if proposer is not None:
                proposer.save(model.num_timesteps)
            _save_checkpoint(model, checkpoint, curve, best, outcome, time.process_time() - began)
            stopped = report is not None and bool(report(model.num_timesteps, outcome))
    card = {
        "config": config.model_dump(mode="json"),
        "steps": int(model.num_timesteps),
        "best_step": _best_step(curve) if proposer is None else int(model.num_timesteps),
        "stopped_early": stopped,
        "cpu_seconds": round(time.process_time() - began, 2),
        "curve": curve,
        "provenance": provenance(),
    }
    if proposer is not None:
        proposer.finish(model)
    save_policy(result, best, card)
    for leftover in (folder / "latest.safetensors", folder / "latest.json", checkpoint):
        leftover.unlink(missing_ok=True)
    model.get_env().close()  # type: ignore[union-attr]
    return result


def cpu_before(policy: Path, began: float) -> float:
    """Return the CPU time [s] that earlier processes spent on a training that this process resumed.

    Args:
        policy: return value of `train`.
        began: ``time.process_time()`` before the call of `train`.
    """
    card = read_json(policy.with_suffix(".json"))
    return max(0.0, card.get("cpu_seconds", 0.0) - (time.process_time() - began))


def _best_step(curve: list[CurvePoint]) -> int:
    """Return the step of the evaluation with the largest mean return; the last one in case of a tie."""
    return int(max(curve, key=lambda row: (row["mean_return"], row["step"]))["step"])


def _make_model(config: TrainConfig) -> SAC:
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


def _log_to(model: SAC, folder: Path) -> None:
    """Write the model's log to a folder if TensorBoard is installed."""
    from stable_baselines3.common.logger import configure

    formats = ["tensorboard"] if find_spec("tensorboard") else []
    model.set_logger(configure(str(folder / "tensorboard"), formats))


def _learn(model: SAC, target: int, bar: Any) -> None:
    """Train up to ``target`` steps, beginning with new episodes, and show progress on the bar."""
    from stable_baselines3.common.callbacks import BaseCallback

    class Tick(BaseCallback):
        def _on_step(self) -> bool:
            bar.update(self.training_env.num_envs)
            return True

    # A resumed run cannot restore running episodes or the generators of other processes, so every run restarts them.
    model._last_obs = None
    if model.num_timesteps:
        seeds = np.random.SeedSequence([model.seed or 0, model.num_timesteps])
        model.get_env().seed(int(seeds.generate_state(1)[0]))  # type: ignore[union-attr]
    buffer: Any = model.replay_buffer
    if hasattr(buffer, "cut"):
        buffer.cut()
    model.learn(target - model.num_timesteps, callback=Tick(), reset_num_timesteps=False, log_interval=20)


def _weights(model: SAC) -> dict[str, np.ndarray]:
    state = model.policy.state_dict()
    tensors = {name: value.detach().cpu().numpy().copy() for name, value in state.items()}
    if model.log_ent_coef is not None:
        tensors["log_ent_coef"] = model.log_ent_coef.detach().cpu().numpy().copy()
    return tensors


def _load_weights(model: SAC, tensors: dict[str, np.ndarray], path: Path) -> None:
    import torch

    own = model.policy.state_dict()
    for name, value in own.items():
        if name not in tensors:
            raise WeightsError(f"policy '{path}' lacks tensor '{name}'")
        if tuple(tensors[name].shape) != tuple(value.shape):
            raise WeightsError(
                f"policy '{path}' does not fit: '{name}' has shape {tuple(tensors[name].shape)}, needed "
                f"{tuple(value.shape)}; train it with the same net_arch, cables and design_in_observation"
            )
    model.policy.load_state_dict({name: torch.as_tensor(tensors[name]) for name in own})
    if "log_ent_coef" in tensors and model.log_ent_coef is not None:
        with torch.no_grad():
            model.log_ent_coef.copy_(torch.as_tensor(tensors["log_ent_coef"]))


def _optimisers(model: SAC) -> dict[str, Any]:
    found = {"actor": model.actor.optimizer, "critic": model.critic.optimizer}
    if model.ent_coef_optimizer is not None:
        found["entropy"] = model.ent_coef_optimizer
    return found


def _save_checkpoint(
    model: SAC,
    path: Path,
    curve: list[CurvePoint],
    best: dict[str, np.ndarray],
    outcome: Evaluation,
    cpu_seconds: float,
) -> None:
    import torch
    from safetensors.numpy import save

    tensors = {f"weights/{name}": value for name, value in _weights(model).items()}
    tensors |= {f"best/{name}": value for name, value in best.items()}
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
        "step": int(model.num_timesteps),
        "updates": int(model._n_updates),
        "position": int(buffer.pos),
        "full": bool(buffer.full),
        "numpy": [int(position[0]), int(position[1]), float(position[2])],
        "actions": model.action_space.np_random.bit_generator.state,
        "curve": curve,
        "cpu_seconds": cpu_seconds,
        "outcome": outcome.to_json(),
    }
    with atomic_write(path) as stream:
        arrays = {k: np.ascontiguousarray(v) for k, v in tensors.items()}
        stream.write(save(arrays, metadata={"state": json.dumps(meta)}))


def _restore(model: SAC, path: Path) -> tuple[list[CurvePoint], dict[str, np.ndarray], Evaluation, float]:
    """Restore a model from a checkpoint.

    Returns:
        Learning curve, weights of the best policy so far, last evaluation, and CPU time spent so far [s].
    """
    import torch
    from safetensors import safe_open

    tensors = read_tensors(path)
    with safe_open(path, framework="numpy") as opened:
        meta = json.loads(opened.metadata()["state"])
    _load_weights(model, {k.removeprefix("weights/"): v for k, v in tensors.items() if k.startswith("weights/")}, path)
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
    best = {k.removeprefix("best/"): v for k, v in tensors.items() if k.startswith("best/")}
    return meta["curve"], best, Evaluation.from_json(meta["outcome"]), float(meta.get("cpu_seconds", 0.0))


def _write_curve(path: Path, curve: list[CurvePoint]) -> None:
    with atomic_write(path, "w") as stream:
        writer = csv.DictWriter(stream, CurvePoint.__annotations__)
        writer.writeheader()
        writer.writerows(curve)
