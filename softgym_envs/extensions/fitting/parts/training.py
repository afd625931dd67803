"""Training of a learned leg: ``softgym fit --config tetrapod_leg``."""

from __future__ import annotations

import hashlib
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from softgym_envs.config import Config
from softgym_envs.extensions.beams.parts.pose import PLACE, TURN, WEIGHT
from softgym_envs.extensions.beams.parts.weights import LegDomain, card_of_leg, write_leg
from softgym_envs.extensions.fitting.kinds import FitKind
from softgym_envs.extensions.fitting.parts.data import LegStates, held_states, swing_poses
from softgym_envs.extensions.fitting.trainer import Trainer, TrainingOptions
from softgym_envs.extras import require
from softgym_envs.runs import RunFolder
from softgym_envs.storage import atomic_write
from softgym_envs.wording import counted

if TYPE_CHECKING:
    from torch import Tensor

SOFTEST, STIFFEST = 0.5, 1e-7
"""Bounds on the principal compliances in whose metric errors are measured."""
WRENCH, MIDDLE, ENERGY, STIFFNESS = 25.0, 100.0, 0.02, 3.0
"""Weights of the squares of errors: of the tip's motion under the error of its wrench, of the middle of mass, of the
energy, and of the stiffness."""
OUTLIER = 4.0
"""Loss of a state above which it counts less: some states are on another branch than others at the same pose."""
QUANTILE, SMALLEST, ERROR_WIDTH = 0.95, 1e-4, 48
"""Share of errors that `ErrorNetwork` covers, error that counts as none, and the width of the network."""
CHECKED = 4000
"""States of the validation on which the loss is computed."""


class PartData(Config):
    """States of a learned leg, see `data`.

    Attributes:
        bodies: random bodies whose legs' poses are used.
        steps: control steps of each.
        copies: how many legs are held at each pose: its own and, every second time, one of other dimensions.
        boundary: share of bodies, and of other dimensions, at the boundary of the design box.
        seed: of bodies, commands, dimensions and shifts.
    """

    bodies: int = Field(default=320, gt=1)
    steps: int = Field(default=48, gt=0)
    copies: int = Field(default=4, gt=0)
    boundary: float = Field(default=0.0, ge=0.0, le=1.0)
    seed: int = Field(default=0, ge=0)


class PartNetwork(TrainingOptions):
    """Hyper-parameters of `LegNetwork`.

    Attributes:
        width: of the hidden layers.
        depth: their number.
    """

    width: int = Field(default=128, gt=0)
    depth: int = Field(default=3, gt=0)
    steps: int = Field(default=6000, gt=0)
    batch_size: int = Field(default=384, gt=0)
    learning_rate: float = Field(default=3e-3, gt=0)


class PartConfig(Config):
    """Configuration of a learned part.

    Attributes:
        part: what is learned: ``"leg"``, a printed leg of the Tetrapod.
        data: its states.
        network: its network and the training.
        seed: of the training.
    """

    part: Literal["leg"]
    data: PartData = PartData()
    network: PartNetwork = PartNetwork()
    seed: int = 0


def generate_part_data(config: PartConfig, folder: str | Path) -> LegStates:
    """Return the states of a learned part; those in the folder, if they are of the same configuration."""
    path, plan = Path(folder) / "states.npz", json.dumps(config.data.model_dump(), sort_keys=True)
    if path.exists():
        with np.load(path, allow_pickle=False) as kept:
            if str(kept["plan"]) == plan:
                return LegStates(*(kept[name] for name in LegStates._fields))
    plan_of = config.data
    poses = swing_poses(plan_of.bodies, plan_of.steps, plan_of.seed, plan_of.boundary)
    found = held_states(poses, plan_of.copies, plan_of.seed, plan_of.boundary)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as stream:
        np.savez_compressed(stream, allow_pickle=False, plan=np.array(plan), **found._asdict())
    return found


class Batch:
    """States as tensors, with the metric of their errors.

    Args:
        states: the states.
    """

    def __init__(self, states: LegStates) -> None:
        import torch

        compliance = 0.5 * (states.compliance + states.compliance.transpose(0, 2, 1))
        known = np.isfinite(compliance).all(axis=(1, 2))
        values, vectors = np.linalg.eigh(np.where(known[:, None, None], compliance, np.eye(6)))
        size = np.clip(np.abs(values), STIFFEST, SOFTEST)
        root = vectors * np.sqrt(size)[:, None] @ vectors.transpose(0, 2, 1)
        root[~known] = np.diag([0.05] * 3 + [0.3] * 3)
        # The stiffness in this metric: its principal values are 1 and, where the leg is unstable with a free tip, -1.
        stiffness = vectors * (size / values)[:, None] @ vectors.transpose(0, 2, 1)
        columns = (states.y, states.shape, states.energy, states.wrench, states.middle, root, stiffness, known)
        self.parts = tuple(torch.tensor(column, dtype=torch.float32) for column in columns)

    def __len__(self) -> int:
        return len(self.parts[0])


def leg_loss(net: Any, parts: tuple[Tensor, ...], directions: Tensor, *, training: bool) -> tuple[Tensor, Tensor]:
    """Return the losses of states (n,), and the motion of the tip under the errors of the wrench (n, 6).

    Args:
        net: the network.
        parts: of a `Batch`.
        directions: along which the stiffness is compared, shape (n, 6).
        training: whether derivatives of the result are needed.
    """
    import torch

    y, shape, energy, wrench, middle, root, stiffness, known = parts
    with torch.enable_grad():
        place = y[:, PLACE].clone().requires_grad_(True)
        weight = y[:, WEIGHT].clone().requires_grad_(True)
        spin = torch.zeros_like(place, requires_grad=True)
        turn = y[:, TURN].reshape(-1, 3, 3)
        W = _cross(spin)
        turned = turn + W @ turn + 0.5 * W @ (W @ turn)
        found = net(torch.cat([place, turned.reshape(-1, 9), weight], 1), shape)
        dp, dw, dg = torch.autograd.grad(found.sum(), (place, spin, weight), create_graph=True)
        moved = (root @ (torch.cat([dp, dw], 1) - wrench)[..., None])[..., 0]
        along = (root @ directions[..., None])[..., 0]
        product = (torch.cat([dp, dw], 1) * along).sum()
        bent = torch.cat(torch.autograd.grad(product, (place, spin), create_graph=training), 1)
        wrong = (root @ bent[..., None] - stiffness @ directions[..., None])[..., 0].square().sum(1) * known / 6.0
        loss = WRENCH * moved.square().sum(1) + MIDDLE * (dg + middle).square().sum(1)
        loss = loss + ENERGY * (found - energy).square() + STIFFNESS * wrong / (1.0 + wrong.detach()).sqrt()
        return loss / (1.0 + loss.detach() / OUTLIER).sqrt(), moved.detach()


def _cross(v: Tensor) -> Tensor:
    """Return the matrices (n, 3, 3) of the cross products with vectors (n, 3)."""
    import torch

    zero = torch.zeros_like(v[:, 0])
    rows = [zero, -v[:, 2], v[:, 1], v[:, 2], zero, -v[:, 0], -v[:, 1], v[:, 0], zero]
    return torch.stack(rows, 1).reshape(-1, 3, 3)


def fit_part(
    config: PartConfig, folder: str | Path, data_folder: str | Path, *, progress: bool = True
) -> dict[str, float]:
    """Generate missing data, train a learned part, test it on bodies of its own and write the weights.

    Args:
        config: part, data and network.
        folder: of ``model.safetensors`` and ``model.json``.
        data_folder: of the states.
        progress: show progress bars.

    Returns:
        The errors on the test states: of bodies whose poses the network has not seen.
    """
    require("train")
    import torch

    from softgym_envs.extensions.fitting.parts.network import ErrorNetwork, LegNetwork

    folder = Path(folder)
    every = generate_part_data(config, data_folder)
    known = LegDomain().contains(every.y) & LegDomain().carries(every.wrench)
    states = LegStates(*(column[known] for column in every))
    tested, checked = (states.body % 10 == k for k in (0, 1))
    torch.set_num_threads(1)
    torch.manual_seed(config.seed)
    net = LegNetwork(config.network.width, config.network.depth)
    splits = [Batch(LegStates(*(c[rows] for c in states))) for rows in (~(tested | checked), checked, tested)]
    training, validation, test = splits
    generator = torch.Generator().manual_seed(config.seed)
    chosen = torch.randperm(len(validation), generator=generator)[:CHECKED]
    fixed = torch.randn(len(chosen), 6, generator=generator)

    def loss(index: Tensor | None) -> Tensor:
        if index is None:
            return leg_loss(net, tuple(p[chosen] for p in validation.parts), fixed, training=False)[0].mean()
        directions = torch.randn(len(index), 6, generator=generator)
        return leg_loss(net, tuple(p[index] for p in training.parts), directions, training=True)[0].mean()

    inputs = {"config": config.model_dump(mode="json"), "data_sha256": _digest(states)}
    key = hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:12]
    start = time.perf_counter()
    trainer = Trainer(config.network, config.seed, folder / "parts", key, progress)
    history = trainer.optimise("leg", net, loss, len(training))
    torch.manual_seed(config.seed)
    bound = ErrorNetwork(ERROR_WIDTH)
    learned, seen = ((split.parts[0], split.parts[1], _moved(net, split).log()) for split in (training, validation))

    def quantile_loss(index: Tensor | None) -> Tensor:
        y, shape, size = seen if index is None else (column[index] for column in learned)
        above = size - bound(y, shape)
        return torch.maximum(QUANTILE * above, (QUANTILE - 1.0) * above).mean()

    trainer.optimise("errors", bound, quantile_loss, len(training))
    size = _moved(net, test)
    with torch.no_grad():
        covered = size <= bound(test.parts[0], test.parts[1]).exp()
    errors = {
        "states": len(test),
        "moved_median": float(size.median()),
        "moved_p95": float(size.quantile(0.95)),
        "covered": float(covered.double().mean()),
        "best_validation": min(row["validation"] for row in history),
    }
    card = {
        **card_of_leg(config.network.width, config.network.depth),
        **inputs,
        "states": {name: len(split) for name, split in zip(("train", "validation", "test"), splits, strict=True)},
        "left_out": int((~known).sum()),
        "training_seconds": round(time.perf_counter() - start, 1),
        "test": errors,
    }
    tensors = net.state_dict() | {f"errors.{name}": value for name, value in bound.state_dict().items()}
    write_leg({name: value.numpy() for name, value in tensors.items()}, card, folder)
    RunFolder(folder, PartConfig, "a fit").begin(config)
    return errors


def _moved(net: Any, batch: Batch) -> Tensor:
    """Return how far tips move under the errors of their wrenches, over the length, shape (n,)."""
    import torch

    found = [
        leg_loss(net, tuple(p[rows] for p in batch.parts), torch.zeros(len(rows), 6), training=False)[1].norm(dim=1)
        for rows in torch.arange(len(batch)).split(2000)
    ]
    return torch.cat(found).clamp(min=SMALLEST)


def _digest(states: LegStates) -> str:
    digest = hashlib.sha256()
    for column in states:
        digest.update(np.ascontiguousarray(column).tobytes())
    return digest.hexdigest()


def _describe_data(config: PartConfig, folder: Path, *, progress: bool = True) -> list[str]:
    """Generate the states of a part if they are missing, and say how many there are."""
    return [counted(len(generate_part_data(config, folder).body), "state")]


KIND = FitKind(PartConfig, _describe_data, fit_part)
