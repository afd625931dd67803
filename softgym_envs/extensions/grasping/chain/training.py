"""Training of chains: the stiffness of the segments from the compliance of finite-element bodies at rest.

At rest, a chain is a linear frame. Its compliance between the markers while the servo is held, the motion of the
markers with the servo, and the stiffness of the servo are compared with those of finite elements. Large motions are not
learned: they follow from the kinematics of the segments. The other states of the data are for validation and test.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from softgym_envs.errors import DataError
from softgym_envs.executors import parallel_map
from softgym_envs.extensions.fitting.data.states import full_compliance
from softgym_envs.extensions.fitting.kinds import FitKind
from softgym_envs.extensions.fitting.trainer import History, Trainer, TrainingOptions
from softgym_envs.extensions.fitting.training import FitConfig, describe_datasets, generate_datasets
from softgym_envs.extensions.grasping.chain.body import FingerChain
from softgym_envs.extensions.grasping.chain.closings import closing_errors, kept_closings, summary
from softgym_envs.extensions.grasping.chain.model import ChainModel, depth_features, relative_stiffness, save_chain
from softgym_envs.extensions.grasping.robots.grasping_hands import GraspingFinger
from softgym_envs.robots.registry import make_robot
from softgym_envs.storage import atomic_write

if TYPE_CHECKING:
    from torch import Tensor


class Options(TrainingOptions):
    """Hyper-parameters of the networks of the segments."""

    kind: Literal["chain"] = "chain"
    optimiser: Literal["soap", "adam"] = "adam"
    steps: int = Field(default=1500, gt=0)
    batch_size: int = Field(default=32, gt=0)
    learning_rate: float = Field(default=3e-3, gt=0)
    width: int = Field(default=48, gt=0)
    members: int = Field(default=3, gt=0)


class ChainConfig(FitConfig):
    """Configuration of a learned chain: data of `MarkedFinger` and the networks of the segments.

    Attributes:
        chain: what is learned.
        robot: that with the points at which the compliance is learned.
        alone: False, because the servo has a largest torque, which chains know.
        closings: number of bodies of the validation set, and of the test set, that finite elements also close on
            objects.
    """

    chain: Literal["contact_aided_finger"]
    robot: Literal["softgym_envs.extensions.grasping.chain.data:MarkedFinger"] = (
        "softgym_envs.extensions.grasping.chain.data:MarkedFinger"
    )
    alone: Literal[False] = False
    network: Options = Options()
    closings: int = Field(default=12, gt=0)


class Rows(NamedTuple):
    """Parts of the compliance of N finite-element states, for the markers in the plane (2 m rows).

    Attributes:
        held: compliance at a fixed angle [m/N], shape (N, 2 m, 2 m).
        jacobian: derivative by the angle [m/rad], shape (N, 2 m).
        torsion: derivative of the torque by the angle [N m/rad], shape (N,).
        depth: compliance of the tip along z [m/N], shape (N,).
    """

    held: np.ndarray
    jacobian: np.ndarray
    torsion: np.ndarray
    depth: np.ndarray


def compliance_rows(data: Mapping[str, np.ndarray], stiffness: np.ndarray) -> Rows:
    """Return the parts of the compliance that a chain has.

    Args:
        data: columns of a dataset of `MarkedFinger`.
        stiffness: Young's moduli relative to the baseline, shape (N,).
    """
    size = 1 + data["effector"].shape[1]
    W = full_compliance(data["compliance"], size) * stiffness[:, None, None]
    planar = np.array([k for k in range(4, size) if (k - 4) % 3 < 2])
    torsion = 1.0 / W[:, 0, 0]
    jacobian = W[:, planar, 0] * torsion[:, None]
    held = W[:, planar[:, None], planar] - jacobian[:, :, None] * W[:, :1, planar]
    return Rows(held, jacobian, torsion, W[:, 3, 3])


class Batch(NamedTuple):
    """Bodies and their compliance at rest, as tensors; see `softgym_envs.extensions.grasping.chain.torch`."""

    frame: Any
    held: Tensor
    jacobian: Tensor
    torsion: Tensor

    def rows(self, index: Tensor) -> Batch:
        """Return some of the bodies."""
        return Batch(self.frame.rows(index), self.held[index], self.jacobian[index], self.torsion[index])


def rest_batch(chain: FingerChain, data: Mapping[str, np.ndarray]) -> Batch:
    """Return the states at rest of a dataset."""
    import torch

    from softgym_envs.extensions.grasping.chain.torch import Frame

    at_rest = {name: column[data["rest"].astype(bool)] for name, column in data.items()}
    rows = compliance_rows(at_rest, relative_stiffness(chain.robot, at_rest["design"]))
    frame = Frame.of_bodies(chain, chain.bodies(at_rest["design"]))
    return Batch(frame, *(torch.as_tensor(part) for part in rows[:3]))


def rest_loss(net: Any, batch: Batch) -> Tensor:
    """Return the sum of the mean squared relative errors of held compliance, motion with the servo and its stiffness.

    The compliance counts twice: entry by entry, relative to the markers' own, and as a whole.
    """
    held, jacobian, torsion = net.frame_response(batch.frame)
    scale = batch.held.diagonal(dim1=1, dim2=2).sqrt()
    error = held - batch.held
    motion = ((jacobian - batch.jacobian) ** 2).sum(dim=1) / (batch.jacobian**2).sum(dim=1)
    return (
        ((error / (scale[:, :, None] * scale[:, None])) ** 2).mean()
        + ((error**2).sum(dim=(1, 2)) / (batch.held**2).sum(dim=(1, 2))).mean()
        + motion.mean()
        + ((torsion / batch.torsion).log() ** 2).mean()
    )


def _train_member(
    trainer: Trainer, member: int, chain: FingerChain, data: tuple[Mapping, Mapping]
) -> tuple[int, dict[str, np.ndarray], History]:
    """Train one member; return its number, weights and history."""
    import torch

    from softgym_envs.extensions.grasping.chain.torch import ChainNet

    torch.set_num_threads(1)
    seed = trainer.seed + 1000 * member
    torch.manual_seed(seed)
    training, validation = (rest_batch(chain, part) for part in data)
    sizes = {kind: x.shape[-1] for kind, x in training.frame.features.items()}
    net = ChainNet(sizes, trainer.options.width)

    def loss(rows: Tensor | None) -> Tensor:
        return rest_loss(net, validation if rows is None else training.rows(rows))

    history = trainer.optimise(f"member {member}", net, loss, len(training.torsion), seed=seed)
    return member, {k: v.detach().numpy().copy() for k, v in net.state_dict().items()}, history


def train(
    chain: FingerChain, training: Mapping[str, np.ndarray], validation: Mapping[str, np.ndarray], trainer: Trainer
) -> tuple[dict[str, np.ndarray], dict[str, History]]:
    """Train the members of the ensemble; return the weights of `ChainModel` and the history of each member."""
    arguments = [(trainer, member, chain, (training, validation)) for member in range(trainer.options.members)]
    found = sorted(parallel_map(_train_member, arguments, trainer.workers), key=lambda result: result[0])
    tensors = {name: np.stack([state[name] for _, state, _ in found]) for name in found[0][1]}
    at_rest = {name: column[training["rest"].astype(bool)] for name, column in training.items()}
    depth = compliance_rows(at_rest, relative_stiffness(chain.robot, at_rest["design"])).depth
    features = depth_features(chain, at_rest["design"])
    tensors["depth"] = np.linalg.lstsq(features, np.log(depth), rcond=None)[0]
    return tensors, {f"member {k}": rows for k, _, rows in found}


def measure_errors(model: ChainModel, data: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return errors of a chain without contact on a dataset of `MarkedFinger`, at rest and under way.

    ``marker``: the largest distance between predicted and finite-element markers of a state [m]; ``tip`` likewise;
    ``held``, ``jacobian``, ``torsion``: relative errors of the parts of the compliance; ``effort``: of the torque,
    relative to the largest in the data. Data at rest have no errors of markers, tip and torque.
    """
    stiffness = relative_stiffness(model.robot, data["design"])
    truth = compliance_rows(data, stiffness)
    found = model.markers(data["design"], data["displacement"][:, 0])
    markers = data["effector"][:, 3:].reshape(len(stiffness), -1, 3)[:, :, :2]
    distance = np.linalg.norm(found.markers - markers, axis=2).max(axis=1)
    tip = np.linalg.norm(found.tip - data["effector"][:, :2], axis=1)
    held = np.linalg.norm(found.held - truth.held, axis=(1, 2)) / np.linalg.norm(truth.held, axis=(1, 2))
    jacobian = np.linalg.norm(found.jacobian - truth.jacobian, axis=1) / np.linalg.norm(truth.jacobian, axis=1)
    torsion = np.abs(found.torsion / truth.torsion - 1.0)
    depth = np.abs(model.depth(data["design"]) / truth.depth - 1.0)
    effort = np.abs(found.torque * stiffness - data["effort"][:, 0]) / np.abs(data["effort"]).max()
    errors: dict[str, float] = {"states": len(tip), "found": float(found.found.mean())}
    for name, values in {
        "marker": distance, "tip": tip, "held": held, "jacobian": jacobian, "torsion": torsion, "depth": depth,
        "effort": effort,
    }.items():  # fmt: skip
        if name in ("marker", "tip", "effort") and np.abs(data["displacement"]).max() < 1e-9:
            continue  # all states are at rest, where these are exact
        good = values[found.found]
        errors |= {
            f"{name}_median": float(np.median(good)),
            f"{name}_p95": float(np.quantile(good, 0.95)),
            f"{name}_worst": float(good.max()),
        }
    return errors


def domain_of(
    model: ChainModel, training: Mapping[str, np.ndarray], validation: Mapping[str, np.ndarray]
) -> dict[str, Any]:
    """Return where a chain may be trusted.

    Returns:
        ``design``: the ranges of the training; ``inflation``: factor that turns the relative spread of the members into
        a bound on the relative error of the held compliance of 95 % of the validation states; ``limit``: spread that
        98 % of the validation bodies stay below.
    """
    names = model.robot.design_space.names
    truth = compliance_rows(validation, relative_stiffness(model.robot, validation["design"]))
    found = model.markers(validation["design"], validation["displacement"][:, 0])
    error = np.linalg.norm(found.held - truth.held, axis=(1, 2)) / np.linalg.norm(truth.held, axis=(1, 2))
    spread = model.spread(validation["design"])
    return {
        "design": {
            n: [float(c.min()), float(c.max())]
            for n, c in zip(names, training["design"].T, strict=True)
            if n != model.robot.learning.stiffness_variable
        },
        "inflation": float(np.quantile((error / spread)[found.found], 0.95)),
        "limit": float(np.quantile(spread, 0.98)),
    }


def _bodies(data: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the bodies of a dataset, shape (S, len(space))."""
    return data["design"][data["rest"].astype(bool)]


def fit_chain(
    config: ChainConfig, folder: str | Path, data_folder: str | Path, *, progress: bool = True
) -> dict[str, float]:
    """Generate missing data, train, test once, and write the weights with their card.

    Args:
        config: robot, data and networks.
        folder: folder for ``model.safetensors``, ``model.json`` and ``history.npz``.
        data_folder: folder of the datasets ``train``, ``validation`` and ``test``.
        progress: show progress bars.

    Returns:
        The errors on the test set.
    """
    folder, data_folder = Path(folder), Path(data_folder)
    chain = FingerChain(make_robot(config.robot, **config.robot_options))
    data = generate_datasets(config, data_folder, progress=progress)
    digest = hashlib.sha256()
    for split in data.values():
        for column in split.values():
            digest.update(np.ascontiguousarray(column).tobytes())
    inputs = {
        "config": config.model_dump(mode="json", exclude={"workers"}),
        "data_sha256": digest.hexdigest(),
    }
    key = hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:12]
    trainer = Trainer(config.network, config.seed, folder / "parts", key, progress, config.workers)
    start = time.perf_counter()
    tensors, histories = train(chain, data["train"], data["validation"], trainer)
    seconds = time.perf_counter() - start
    model = ChainModel(chain.robot, tensors, {})
    errors = measure_errors(model, data["test"])
    finger = GraspingFinger(object="any", **config.robot_options)
    contact = {
        split: kept_closings(
            data_folder / split / "closings.npz", finger, _bodies(data[split])[: config.closings], config.seed
        )
        for split in ("validation", "test")
    }
    domain = domain_of(model, data["train"], data["validation"])
    # The box and the limit of the spread decide which closings count.
    model = ChainModel(chain.robot, tensors, {"domain": domain})
    found = closing_errors(model, finger, contact["validation"])
    trusted = np.isfinite(found.tip) & ~found.folded & found.known[:, None]
    if not trusted.any():
        raise DataError(
            "the members agree on no closing of the validation bodies, so their errors cannot be calibrated: take more "
            "bodies (data.train.groups, closings) or steps (network.steps)"
        )
    domain["tip_inflation"] = float(np.quantile((found.tip / found.spread[:, None])[trusted], 0.95))
    errors |= {
        f"contact_{name}": value
        for name, value in summary(closing_errors(model, finger, contact["test"]), contact["test"]).items()
    }
    card = {
        **inputs,
        "domain": domain,
        "states": {split: len(columns["rest"]) for split, columns in data.items()},
        "training_seconds": round(seconds, 1),
        "best_validation": {part: min(row["validation"] for row in rows) for part, rows in histories.items()},
        "test": errors,
    }
    save_chain(ChainModel(chain.robot, tensors, card), folder)
    history = {f"{p}_{k}": np.array([row[k] for row in rows]) for p, rows in histories.items() for k in rows[0]}
    with atomic_write(folder / "history.npz") as stream:
        np.savez_compressed(stream, allow_pickle=False, **history)
    return errors


KIND = FitKind(ChainConfig, describe_datasets, fit_chain)
