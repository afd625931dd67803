"""Weights of learned parts on disk, and where they may be trusted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.errors import DataError, WeightsError
from softgym_envs.extensions.beams.parts.energy import LegFunction
from softgym_envs.extensions.beams.parts.leg import VARIABLES, LegScale
from softgym_envs.extensions.beams.parts.pose import PLACE, TURN
from softgym_envs.extensions.beams.robots.tetrapod import Tetrapod
from softgym_envs.robots.base import Robot
from softgym_envs.storage import read_json
from softgym_envs.surrogate.domain import EDGE
from softgym_envs.surrogate.weight_files import check_hash, write_weights

FORMAT = 1
SHIPPED = Path(__file__).parent / "tetrapod_leg"


@dataclass(frozen=True)
class LegDomain:
    """Poses and loads of the states that a leg is learned from.

    Attributes:
        turn: smallest and largest turn of the tip in the plane of the leg [rad].
        across: smallest component of the tip's axis across the plane along that of the root.
        longest: largest distance of the ends over the length.
        force: largest force over EI / L^2.
        moment: largest moment over EI / L.
    """

    turn: tuple[float, float] = (-np.pi / 12, np.pi * 13 / 12)
    across: float = 0.6
    longest: float = 1.0006
    force: float = 200.0
    moment: float = 30.0

    def contains(self, y: np.ndarray) -> np.ndarray:
        """Whether the domain contains poses (..., 15), shape (...)."""
        R = y[..., TURN]
        turn = np.arctan2(-(R[..., 0] + R[..., 8]), R[..., 2] - R[..., 6]) + 0.5 * np.pi
        far = np.linalg.norm(y[..., PLACE], axis=-1)
        low, high = self.turn
        return (turn > low) & (turn < high) & (R[..., 4] > self.across) & (far < self.longest)

    def carries(self, wrench: np.ndarray) -> np.ndarray:
        """Whether wrenches (..., 6) on the tip are within the limits, shape (...)."""
        force, moment = (np.linalg.norm(part, axis=-1) for part in (wrench[..., :3], wrench[..., 3:]))
        return (force < self.force) & (moment < self.moment)


def card_of_leg(width: int, depth: int) -> dict[str, Any]:
    """Return the entries by which `read_leg` checks that weights fit the legs of the Tetrapod."""
    space = Tetrapod().design_space
    return {
        "format": FORMAT,
        "part": "leg",
        "width": width,
        "depth": depth,
        "design_variables": {name: [space[name].low, space[name].high, space[name].unit] for name in VARIABLES},
    }


def write_leg(tensors: Mapping[str, np.ndarray], card: Mapping[str, Any], folder: str | Path) -> None:
    """Write weights and their card, with the provenance of this run."""
    write_weights(tensors, card, folder)


def read_leg(folder: str | Path | None = None) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the card and the weights of a learned leg; by default those that ship.

    Raises:
        WeightsError: if a file is missing or damaged, or of another part; the message names the file.
    """
    folder = (SHIPPED if folder is None else Path(folder)).resolve()
    card = folder / "model.json"
    return _read(folder, card.stat().st_mtime_ns if card.is_file() else 0)


@lru_cache(maxsize=4)
def _read(folder: Path, version: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    card_path, weights_path = folder / "model.json", folder / "model.safetensors"
    for path in (card_path, weights_path):
        if not path.is_file():
            raise WeightsError(
                f"weights file '{path}' of a leg does not exist; train it with 'softgym fit --config tetrapod_leg'"
            )
    try:
        card = read_json(card_path)
    except DataError as error:
        raise WeightsError(f"weights card {error}") from None
    needed = card_of_leg(0, 0)
    for name in ("format", "part", "design_variables"):
        if not isinstance(card, dict) or card.get(name) != needed[name]:
            found = card.get(name) if isinstance(card, dict) else card
            raise WeightsError(f"weights card '{card_path}' has {name} = {found!r}, needed {needed[name]!r}")
    check_hash(weights_path, card)
    try:
        tensors = load_file(weights_path)
    except (SafetensorError, OSError, ValueError) as error:
        raise WeightsError(f"weights '{weights_path}' are damaged or truncated: {error}") from None
    if wrong := sorted(name for name, tensor in tensors.items() if not np.isfinite(tensor).all()):
        raise WeightsError(f"weights '{weights_path}' have values that are not finite in {', '.join(wrong)}")
    if not any(name.startswith("errors.") for name in tensors):
        raise WeightsError(f"weights '{weights_path}' do not know their errors: train them again")
    return card, tensors


class LegEnergy(LegFunction):
    """Energy of the legs of one body that knows where it was learned, see `PoseEnergy`.

    Args:
        tensors: weights of the network.
        shape: of the legs, as for `LegFunction`.
        inflation: factor of the errors.
    """

    domain = LegDomain()

    def __init__(self, tensors: Mapping[str, np.ndarray], shape: np.ndarray, inflation: float) -> None:
        super().__init__(tensors, shape)
        self._inflation = inflation

    def knows(self, y: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        force, by_turn = gradient[..., PLACE], gradient[..., TURN].reshape(-1, 3, 3)
        turn = y[..., TURN].reshape(-1, 3, 3)
        moment = np.cross(turn, by_turn, axis=1).sum(axis=2)
        return self.domain.contains(y) & self.domain.carries(np.concatenate([force, moment], axis=-1))

    def errors(self, y: np.ndarray) -> np.ndarray:
        return self._inflation * super().errors(y)


class LearnedLeg:
    """The printed leg of a Tetrapod, learned: a part of `Robot.parts`.

    Args:
        folder: of the weights; default the shipped ones.

    Attributes:
        card: of the weights.
        tensors: the weights, by the names of `LegNetwork`.
        domain: poses and loads that it has learned.
        inflation: see `inflation_of`, inside the box of dimensions and at its corners.
        limit: largest uncertainty of a trusted state [m]; infinite if only the goal tolerance limits it.

    Raises:
        WeightsError: as `read_leg`.
    """

    domain = LegDomain()

    def __init__(self, folder: str | Path | None = None) -> None:
        self.card, self.tensors = read_leg(folder)
        trust = self.card.get("trust", {})
        self.inflation = float(trust.get("inside", 1.0)), float(trust.get("corners", 1.0))
        self.limit = float(trust.get("limit", np.inf))
        bounds = [self.card["design_variables"][name] for name in VARIABLES]
        self._low, self._high = (np.array([bound[k] for bound in bounds], dtype=float) for k in (0, 1))

    def inflation_of(self, design: Mapping[str, float]) -> float:
        """Return the factor of the errors of a body's legs.

        The logarithm is linear in the share of dimensions at their bounds, as in `softgym_envs.surrogate.domain`.
        """
        values = np.array([design[name] for name in VARIABLES])
        away = np.abs(2.0 * values - self._low - self._high) / (self._high - self._low)
        share = float(np.clip((away - 1.0) / EDGE + 1.0, 0.0, 1.0).mean())
        inside, corners = self.inflation
        return float(inside ** (1.0 - share) * corners**share)

    def __call__(self, design: Mapping[str, float], gravity: np.ndarray) -> dict[str, Any]:
        """Return the options of `PoseParts` for the legs of a body."""
        scale = LegScale.of(design)
        return {
            "energy": LegEnergy(self.tensors, scale.shape, self.inflation_of(design)),
            "length": float(scale.length),
            "scale": float(scale.energy),
            "weight": float(scale.weight) * gravity,
            "mass": float(scale.mass),
            "young_modulus": float(design["young_modulus"]),
        }


def of_learned_parts(robot: Robot, folder: str | Path | None = None) -> tuple[Robot, LearnedLeg]:
    """Return a robot whose bodies consist of learned parts, and the part.

    Args:
        robot: the robot.
        folder: of the weights of the part; default the shipped ones.

    Raises:
        WeightsError: as `read_leg`.
        ValueError: for a robot that may touch something.
    """
    if robot.may_touch:
        raise ValueError(
            f"robot '{robot.name}': learned parts touch nothing, got obstacles or self_contact; use backend='fem'"
        )
    part = LearnedLeg(folder)
    return robot.of_parts({"leg": part}), part
