"""Training of learned condensed models with torch: ``softgym fit``."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import time
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from softgym_envs.config import Config, provenance, save_resolved
from softgym_envs.errors import DataError
from softgym_envs.robots import make_robot
from softgym_envs.robots.robot import Robot
from softgym_envs.storage import atomic_write, write_json
from softgym_envs.surrogate.dataset import generate_dataset
from softgym_envs.surrogate.model import FORMAT, NETWORKS, Features, SurrogateModel, load_model
from softgym_envs.surrogate.sampling import SamplingPlan, learned_variables

__all__ = ["FitConfig", "fit", "generate", "test_errors"]


class SplitConfig(Config):
    """One dataset split."""

    groups: int = Field(gt=0)
    states: int = Field(gt=0)
    sequence: Literal["halton", "random"] = "random"
    seed: int = 0


class DataConfig(Config):
    """Three separate datasets: the best epoch is chosen on validation, and the test set is used once."""

    train: SplitConfig
    validation: SplitConfig
    test: SplitConfig


class NetworkConfig(Config):
    """Network kind and training hyper-parameters."""

    kind: Literal["residual", "thesis"] = "residual"
    width: int = Field(default=128, gt=0)
    depth: int = Field(default=3, gt=0)
    epochs: int = Field(default=300, gt=0)
    patience: int = Field(default=60, gt=0)
    batch_size: int = Field(default=512, gt=0)
    learning_rate: float = Field(default=3e-3, gt=0)


class FitConfig(Config):
    """A surrogate to be made: robot, data, network."""

    robot: str
    robot_options: dict[str, Any] = {}
    data: DataConfig
    network: NetworkConfig = NetworkConfig()
    workers: int = Field(default=2, gt=0)
    seed: int = 0


def _perceptron(inputs: int, outputs: int, width: int, depth: int, activation: str):
    import torch
    from torch import nn

    class AlgebraicSigmoid(nn.Module):
        def forward(self, x):
            return x * torch.rsqrt(1.0 + x * x)

    sizes = [inputs, *([width] * depth)]
    layers: list[nn.Module] = []
    for a, b in zip(sizes[:-1], sizes[1:], strict=True):
        layers += [nn.Linear(a, b), AlgebraicSigmoid() if activation == "algebraic" else nn.ReLU()]
    layers.append(nn.Linear(width, outputs))
    return nn.Sequential(*layers)


def _weights(net, prefix: str) -> dict[str, np.ndarray]:
    from torch import nn

    linear = [layer for layer in net if isinstance(layer, nn.Linear)]
    tensors = {}
    for k, layer in enumerate(linear):
        tensors[f"{prefix}.{k}.weight"] = layer.weight.detach().numpy().copy()
        tensors[f"{prefix}.{k}.bias"] = layer.bias.detach().numpy().copy()
    return tensors


class _Trainer:
    """Trains the parts of a model one after the other; a finished part is kept on disk and not trained again.

    Args:
        config: hyper-parameters.
        seed: of weights and batches; each part starts from it, so a resumed run equals an uninterrupted one.
        folder: where finished parts are kept.
        key: what the parts depend on (configuration and data); parts of another key are trained anew.
        progress: show progress bars.
    """

    def __init__(self, config: NetworkConfig, seed: int, folder: Path, key: str, progress: bool) -> None:
        self.config, self.seed, self.folder, self.key, self.progress = config, seed, folder, key, progress

    def perceptron(self, inputs: int, outputs: int, width: int, depth: int, activation: str):
        """A new network with seeded weights."""
        import torch

        torch.manual_seed(self.seed)
        return _perceptron(inputs, outputs, width, depth, activation)

    def optimise(self, name: str, net, loss, train_size: int, **changes: int) -> list[dict[str, float]]:
        """Adam with a cosine rate, early stop and the best epoch by validation loss; returns the history.

        ``loss(indices | None)`` is the loss on training rows, or on the validation set for None.

        Raises:
            DataError: if the training diverges.
        """
        import copy

        import torch
        from safetensors.torch import load, save
        from tqdm import tqdm

        path = self.folder / f"{name}-{self.key}.safetensors"
        history_path = path.with_suffix(".json")
        if path.exists() and history_path.exists():
            net.load_state_dict(load(path.read_bytes()))
            return json.loads(history_path.read_text())
        config = self.config.model_copy(update=changes)
        torch.manual_seed(self.seed)
        optimiser = torch.optim.Adam(net.parameters(), lr=config.learning_rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.epochs, config.learning_rate * 1e-3)
        best, best_state, best_epoch, history = float("inf"), net.state_dict(), 0, []
        bar = tqdm(range(config.epochs), desc=name, unit="epoch", disable=not self.progress)
        for epoch in bar:
            order = torch.randperm(train_size)
            total = 0.0
            for first in range(0, train_size, config.batch_size):
                rows = order[first : first + config.batch_size]
                value = loss(rows)
                optimiser.zero_grad()
                value.backward()
                optimiser.step()
                total += value.item() * len(rows)
            schedule.step()
            with torch.no_grad():
                validation = float(loss(None))
            if not math.isfinite(validation):
                bar.close()
                raise DataError(f"training of '{name}' diverged at epoch {epoch}: the validation loss is {validation}")
            history.append({"epoch": epoch, "train": total / train_size, "validation": validation})
            bar.set_postfix_str(f"train {total / train_size:.2e}, validation {validation:.2e}")
            if validation < best:
                best, best_state, best_epoch = validation, copy.deepcopy(net.state_dict()), epoch
            elif epoch - best_epoch >= config.patience:
                break
        bar.close()
        net.load_state_dict(best_state)
        # The history goes first: the part counts as finished when its weights are there.
        write_json(history_path, history)
        with atomic_write(path) as stream:
            stream.write(save(best_state))
        return history


class _Arrays:
    """A dataset as matrices, at baseline stiffness."""

    def __init__(self, robot: Robot, data: dict[str, np.ndarray], features: Features) -> None:
        n = len(robot.actuators) + 3 * len(robot.effectors)
        names = robot.design_space.names
        factor = np.ones(len(data["rest"]))
        if robot.stiffness_variable is not None:
            variable = robot.design_space[robot.stiffness_variable]
            factor = data["design"][:, names.index(robot.stiffness_variable)] / variable.baseline
        self.design = features.design(data["design"])
        self.actuation = features.actuation(data["displacement"])
        self.displacement = data["displacement"]
        self.effort = data["effort"] / factor[:, None]
        self.effector = data["effector"]
        upper = np.triu_indices(n)
        self.W = np.empty((len(factor), n, n))
        self.W[:, upper[0], upper[1]] = data["compliance"]
        self.W[:, upper[1], upper[0]] = data["compliance"]
        self.W *= factor[:, None, None]
        # The rest row of each row's own body: groups start with it.
        if np.abs(data["displacement"][data["rest"]]).max() > 1e-9:
            raise DataError(
                "bodies at rest have displaced actuators (gravity?); the networks need displacement 0 at rest"
            )
        starts = np.flatnonzero(data["rest"])
        if len(starts) == 0 or starts[0] != 0:
            raise DataError("the dataset has no rest state at its beginning")
        self.rest_rows = starts
        self.rest_of = starts[np.cumsum(data["rest"]) - 1]


def _log_cholesky(C: np.ndarray) -> np.ndarray:
    """Entries (B, n (n + 1) / 2) of lower triangular C (B, n, n), the diagonal as logarithms."""
    C = C.copy()
    diagonal = np.arange(C.shape[1])
    C[:, diagonal, diagonal] = np.log(C[:, diagonal, diagonal])
    rows, columns = np.tril_indices(C.shape[1])
    return C[:, rows, columns]


def _mean_scale(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of columns; a constant column has scale 0, so its mean is its prediction."""
    scale = values.std(axis=0)
    return values.mean(axis=0), np.where(scale > 1e-12 * np.abs(values).max(), scale, 0.0)


def _standardise(values: np.ndarray, mean: np.ndarray | float, scale: np.ndarray) -> np.ndarray:
    return np.where(scale > 0.0, (values - mean) / np.where(scale > 0.0, scale, 1.0), 0.0)


def _fit_residual(
    robot: Robot, train: _Arrays, validation: _Arrays, trainer: _Trainer
) -> tuple[dict[str, np.ndarray], dict[str, list[dict[str, float]]]]:
    """Train the three parts of `ResidualModel`."""
    import torch

    config = trainer.config
    count = len(robot.actuators)
    a, e = slice(0, count), slice(count, None)

    def tensor(x):
        return torch.as_tensor(np.ascontiguousarray(x), dtype=torch.float32)

    tensors: dict[str, np.ndarray] = {}
    histories: dict[str, list[dict[str, float]]] = {}
    # 1. The rest pair of a design.
    rest = {}
    for key, arrays in (("train", train), ("validation", validation)):
        rows = arrays.rest_rows
        y = np.concatenate([_log_cholesky(np.linalg.cholesky(arrays.W[rows])), arrays.effector[rows]], axis=1)
        rest[key] = (arrays.design[rows], y)
    mean, scale = _mean_scale(rest["train"][1])
    inputs = {k: tensor(v[0]) for k, v in rest.items()}
    targets = {k: tensor(_standardise(v[1], mean, scale)) for k, v in rest.items()}
    net = trainer.perceptron(train.design.shape[1], len(mean), 64, 2, "algebraic")

    def rest_loss(rows):
        key = "validation" if rows is None else "train"
        x, y = (inputs[key], targets[key]) if rows is None else (inputs[key][rows], targets[key][rows])
        return ((net(x) - y) ** 2).mean()

    # Few rows, cheap epochs: many more of them, in small batches.
    histories["rest"] = trainer.optimise(
        "rest",
        net,
        rest_loss,
        len(rest["train"][0]),
        epochs=4 * config.epochs,
        patience=4 * config.patience,
        batch_size=min(128, config.batch_size),
    )
    tensors |= _weights(net, "rest") | {"rest_mean": mean, "rest_scale": scale}

    # 2. Efforts and effectors, as a residual of the rest slopes.
    zero = tensor(2.0 * (0.0 - robot.lower) / (robot.upper - robot.lower) - 1.0)
    parts = {}
    slopes = []
    for key, arrays in (("train", train), ("validation", validation)):
        W0 = arrays.W[arrays.rest_of]
        K0 = np.linalg.inv(W0[:, a, a])
        slope = np.concatenate([K0, W0[:, e, a] @ K0], axis=1)
        y = np.concatenate([arrays.effort, arrays.effector - arrays.effector[arrays.rest_of]], axis=1)
        parts[key] = [tensor(v) for v in (arrays.actuation, arrays.design, arrays.displacement, slope, y)]
        slopes.append(slope)
    y_scale = parts["train"][4].std(dim=0)
    state_scale = np.abs(slopes[0]).mean(axis=0).reshape(-1)
    state_scale_t = tensor(state_scale)
    net_state = trainer.perceptron(
        count + train.design.shape[1], len(state_scale), config.width, config.depth, "algebraic"
    )

    def state_loss(rows):
        actuation, design, displacement, slope, y = (
            parts["validation"] if rows is None else [v[rows] for v in parts["train"]]
        )
        at_rest = torch.cat([zero.expand(len(design), -1), design], dim=1)
        both = net_state(torch.cat([torch.cat([actuation, design], dim=1), at_rest]))
        residual = (both[: len(design)] - both[len(design) :]) * state_scale_t
        predicted = ((slope + residual.reshape(slope.shape)) @ displacement[:, :, None])[:, :, 0]
        return (((predicted - y) / y_scale) ** 2).mean()

    histories["state"] = trainer.optimise("state", net_state, state_loss, len(train.design))
    tensors |= _weights(net_state, "state") | {"state_scale": state_scale}

    # 3. The compliance, whitened by its rest value.
    whitened = {}
    for key, arrays in (("train", train), ("validation", validation)):
        C0 = np.linalg.cholesky(arrays.W[arrays.rest_of])
        half = np.linalg.solve(C0, arrays.W)
        T = np.linalg.cholesky(np.linalg.solve(C0, np.swapaxes(half, 1, 2)))
        whitened[key] = _log_cholesky(T)
    compliance_scale = _mean_scale(whitened["train"])[1]
    wanted = {k: tensor(_standardise(v, 0.0, compliance_scale)) for k, v in whitened.items()}
    net_compliance = trainer.perceptron(
        count + train.design.shape[1], len(compliance_scale), config.width, config.depth, "algebraic"
    )

    def compliance_loss(rows):
        key = "validation" if rows is None else "train"
        actuation, design = parts[key][0], parts[key][1]
        y = wanted[key]
        if rows is not None:
            actuation, design, y = actuation[rows], design[rows], y[rows]
        at_rest = torch.cat([zero.expand(len(design), -1), design], dim=1)
        both = net_compliance(torch.cat([torch.cat([actuation, design], dim=1), at_rest]))
        return ((both[: len(design)] - both[len(design) :] - y) ** 2).mean()

    histories["compliance"] = trainer.optimise("compliance", net_compliance, compliance_loss, len(train.design))
    tensors |= _weights(net_compliance, "compliance") | {"compliance_scale": compliance_scale}
    return tensors, histories


def _fit_thesis(
    robot: Robot, train: _Arrays, validation: _Arrays, trainer: _Trainer
) -> tuple[dict[str, np.ndarray], dict[str, list[dict[str, float]]]]:
    """Train the thesis' G and F on standardised (W upper triangle, delta_free)."""
    import torch

    config = trainer.config

    def tensor(x):
        return torch.as_tensor(np.ascontiguousarray(x), dtype=torch.float32)

    def outputs(arrays: _Arrays) -> np.ndarray:
        n = arrays.W.shape[1]
        upper = np.triu_indices(n)
        effort = np.concatenate([arrays.effort, np.zeros_like(arrays.effector)], axis=1)
        delta = np.concatenate([arrays.displacement, arrays.effector], axis=1)
        free = delta - np.einsum("bij,bj->bi", arrays.W, effort)
        return np.concatenate([arrays.W[:, upper[0], upper[1]], free], axis=1)

    y = {"train": outputs(train), "validation": outputs(validation)}
    arrays = {"train": train, "validation": validation}
    main_mean, main_scale = _mean_scale(y["train"])
    rest_mean, rest_scale = _mean_scale(y["train"][train.rest_rows])
    design = {k: tensor(v.design) for k, v in arrays.items()}
    rest = {k: tensor(_standardise(y[k][v.rest_of], rest_mean, rest_scale)) for k, v in arrays.items()}
    main_in = {k: torch.cat([tensor(v.actuation), rest[k]], dim=1) for k, v in arrays.items()}
    main_out = {k: tensor(_standardise(y[k], main_mean, main_scale)) for k in arrays}
    net_rest = trainer.perceptron(train.design.shape[1], len(rest_mean), config.width, config.depth, "relu")
    net_main = trainer.perceptron(main_in["train"].shape[1], len(main_mean), config.width, config.depth, "relu")

    def loss_of(net, x, target, rows_of=None):
        def loss(rows):
            if rows is None:
                return ((net(x["validation"]) - target["validation"]) ** 2).mean()
            rows = rows if rows_of is None else rows_of[rows]
            return ((net(x["train"][rows]) - target["train"][rows]) ** 2).mean()

        return loss

    rest_rows = torch.as_tensor(train.rest_rows)
    histories = {
        "rest": trainer.optimise("G", net_rest, loss_of(net_rest, design, rest, rest_rows), len(rest_rows)),
        "main": trainer.optimise("F", net_main, loss_of(net_main, main_in, main_out), len(train.design)),
    }
    tensors = _weights(net_rest, "rest") | _weights(net_main, "main")
    tensors |= {"rest_mean": rest_mean, "rest_scale": rest_scale, "main_mean": main_mean, "main_scale": main_scale}
    return tensors, histories


def test_errors(model: SurrogateModel, data: dict[str, np.ndarray]) -> dict[str, float]:
    """Errors of a model on a dataset, in metres and relative.

    ``effector`` is the distance between predicted and FEM effector at the same reached displacement; ``compliance``
    is the relative Frobenius error of W; ``effort`` is relative to the largest effort in the data.
    """
    context = model.context(data["design"])
    effort, effector = model.state(context, data["displacement"])
    W = model.compliance(context, data["displacement"])
    n = model.size
    upper = np.triu_indices(n)
    truth = np.empty((len(effort), n, n))
    truth[:, upper[0], upper[1]] = data["compliance"]
    truth[:, upper[1], upper[0]] = data["compliance"]
    distance = np.linalg.norm((effector - data["effector"]).reshape(len(effort), -1, 3), axis=2).max(axis=1)
    relative = np.linalg.norm(W - truth, axis=(1, 2)) / np.linalg.norm(truth, axis=(1, 2))
    eigenvalues = np.linalg.eigvalsh(0.5 * (W + np.swapaxes(W, 1, 2)))
    effort_error = np.abs(effort - data["effort"]).max(axis=1) / np.abs(data["effort"]).max()
    return {
        "states": len(effort),
        "effector_mean": float(distance.mean()),
        "effector_p99": float(np.quantile(distance, 0.99)),
        "effector_worst": float(distance.max()),
        "compliance_median": float(np.median(relative)),
        "compliance_p99": float(np.quantile(relative, 0.99)),
        "compliance_worst": float(relative.max()),
        "effort_mean": float(effort_error.mean()),
        "effort_worst": float(effort_error.max()),
        "positive_definite": float((eigenvalues[:, 0] > 0).mean()),
        "asymmetry_worst": float(np.abs(W - np.swapaxes(W, 1, 2)).max() / np.abs(W).max()),
    }


def generate(config: FitConfig, data_folder: str | Path, *, progress: bool = True) -> dict[str, dict[str, np.ndarray]]:
    """Generate the datasets ``train``, ``validation`` and ``test`` of a surrogate, or take up what is there."""
    save_resolved(data_folder, config)
    return {
        split: generate_dataset(
            Path(data_folder) / split,
            config.robot,
            SamplingPlan(**getattr(config.data, split).model_dump()),
            robot_options=config.robot_options,
            workers=config.workers,
            progress=progress,
        )
        for split in ("train", "validation", "test")
    }


def fit(config: FitConfig, folder: str | Path, data_folder: str | Path, *, progress: bool = True) -> dict[str, float]:
    """Generate the data (or take up what is there), train, test once, and write the weights with their card.

    Args:
        config: what to make.
        folder: where ``model.safetensors``, ``model.json`` and ``history.npz`` go.
        data_folder: where the datasets ``train``, ``validation`` and ``test`` live.
        progress: show progress bars.

    Returns:
        The errors on the test set.
    """
    import torch
    from safetensors.numpy import save

    folder, data_folder = Path(folder), Path(data_folder)
    robot = make_robot(config.robot, **config.robot_options)
    data = generate(config, data_folder, progress=progress)
    digest = hashlib.sha256()
    for split in data.values():
        for column in split.values():
            digest.update(np.ascontiguousarray(column).tobytes())
    asked: dict[str, Any] = {
        "config": config.model_dump(mode="json", exclude={"workers"}),
        "data_sha256": digest.hexdigest(),
    }
    card_path = folder / "model.json"
    if card_path.exists():
        model = load_model(folder, robot)
        same = all(model.card["config"].get(k) == v for k, v in asked["config"].items())
        if same and model.card["data_sha256"] == asked["data_sha256"]:
            return model.card["test"]
    torch.set_num_threads(config.workers)
    features = Features(robot.design_space, learned_variables(robot), robot.lower, robot.upper)
    arrays = {split: _Arrays(robot, data[split], features) for split in ("train", "validation")}
    key = hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()[:12]
    trainer = _Trainer(config.network, config.seed, folder / "parts", key, progress)
    start = time.perf_counter()
    fit_network = {"residual": _fit_residual, "thesis": _fit_thesis}[config.network.kind]
    tensors, histories = fit_network(robot, arrays["train"], arrays["validation"], trainer)
    seconds = time.perf_counter() - start
    model = NETWORKS[config.network.kind](robot, tensors, {})
    errors = test_errors(model, data["test"])
    card = {
        "format": FORMAT,
        "network": config.network.kind,
        "robot": robot.name,
        "signature": robot.signature,
        "design_variables": {n: [v.low, v.high, v.unit] for n, v in robot.design_space.variables.items()},
        "actuators": [[actuator.low, actuator.high] for actuator in robot.actuators],
        "config": config.model_dump(mode="json"),
        "states": {split: len(columns["rest"]) for split, columns in data.items()},
        "data_sha256": asked["data_sha256"],
        "training_seconds": round(seconds, 1),
        "best_validation": {part: min(row["validation"] for row in rows) for part, rows in histories.items()},
        "test": errors,
        "provenance": provenance(),
    }
    folder.mkdir(parents=True, exist_ok=True)
    weights = {name: np.ascontiguousarray(value, dtype=np.float32) for name, value in tensors.items()}
    with atomic_write(folder / "model.safetensors") as stream:
        stream.write(save(weights))
    write_json(folder / "model.json", card)
    history = {f"{p}_{k}": np.array([row[k] for row in rows]) for p, rows in histories.items() for k in rows[0]}
    with atomic_write(folder / "history.npz") as stream:
        np.savez_compressed(stream, allow_pickle=False, **history)
    save_resolved(folder, config)
    load_model(folder, robot)  # what was written can be read
    shutil.rmtree(trainer.folder, ignore_errors=True)
    return errors
