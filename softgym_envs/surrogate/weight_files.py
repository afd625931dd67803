"""Trained models on disk: weights (``model.safetensors``) and the card that describes them (``model.json``)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.errors import DataError, WeightsError
from softgym_envs.robots.base import Robot
from softgym_envs.runs import provenance
from softgym_envs.storage import atomic_write, hash_of, read_json, write_json
from softgym_envs.surrogate.identity import class_of, difference, fingerprint, is_shipped
from softgym_envs.surrogate.model import SurrogateModel
from softgym_envs.surrogate.networks import NETWORKS

FORMAT = 2


def card_of(robot: Robot, network: str) -> dict[str, Any]:
    """Return the entries that every card has and by which `load_model` checks that weights fit a robot."""
    return {
        "format": FORMAT,
        "network": network,
        "robot": robot.name,
        "class": class_of(robot),
        "mechanics_key": robot.mechanics_key,
        "design_variables": {n: [v.low, v.high, v.unit] for n, v in robot.design_space.variables.items()},
        "actuators": [[actuator.low, actuator.high] for actuator in robot.actuators],
    }


def new_card(robot: Robot, network: str) -> dict[str, Any]:
    """Return `card_of` for weights of a robot as it is now, with the fingerprint of one that is not of the suite."""
    card = card_of(robot, network)
    return card if is_shipped(robot) else {**card, "fingerprint": fingerprint(robot)}


def read_weights(folder: str | Path, robot: Robot) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the card and the weights of a folder after checking that they fit a robot.

    Raises:
        WeightsError: if a file is missing, truncated, of another format or for another robot; the message names the
            file and what is expected.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    folder = Path(folder)
    if folder.is_file():
        raise WeightsError(f"weights '{folder}' are a file; give their folder: '{folder.parent}'")
    card_path, weights_path = folder / "model.json", folder / "model.safetensors"
    for path in (card_path, weights_path):
        if not path.is_file():
            raise WeightsError(f"weights file '{path}' does not exist; train it with 'softgym fit'")
    try:
        card = read_json(card_path)
    except DataError as error:
        raise WeightsError(f"weights card {error}") from None
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise WeightsError(f"weights card '{card_path}' does not have format {FORMAT}")
    if card.get("robot") != robot.name or card.get("mechanics_key") != robot.mechanics_key:
        key = card.get("mechanics_key")
        wanted = {"robot": robot.name, **robot.mechanics_key}
        found = {"robot": card.get("robot"), **(key if isinstance(key, dict) else {})}
        different = sorted(k for k in wanted | found if wanted.get(k) != found.get(k))
        raise WeightsError(
            f"weights '{folder.name}' were trained for another robot: "
            + ", ".join(f"{k} = {found.get(k)!r}, needed {wanted.get(k)!r}" for k in different)
            + "; use backend='fem' or train weights with 'softgym fit'"
        )
    if card.get("class", card.get("robot")) != class_of(robot):
        raise WeightsError(
            f"weights '{folder.name}' were trained for the class {card.get('class', card.get('robot'))}, needed "
            f"{class_of(robot)}; use backend='fem' or train weights with 'softgym fit'"
        )
    if not is_shipped(robot) and (other := difference(card.get("fingerprint"), fingerprint(robot))):
        raise WeightsError(
            f"weights '{folder.name}' were trained for other bodies of robot '{robot.name}': {other}; was its code "
            "or a file changed? Use backend='fem' or train weights with 'softgym fit'"
        )
    expected = card_of(robot, str(card.get("network")))
    if card.get("actuators") != expected["actuators"]:
        raise WeightsError(
            f"weights '{folder.name}' have actuators = {card.get('actuators')}, needed {expected['actuators']}"
        )
    check_box(folder.name, card.get("design_variables"), expected["design_variables"])
    check_hash(weights_path, card)
    try:
        tensors = load_file(weights_path)
    except (SafetensorError, OSError, ValueError) as error:
        raise WeightsError(f"weights '{weights_path}' are damaged or truncated: {error}") from None
    if wrong := sorted(name for name, tensor in tensors.items() if not np.isfinite(tensor).all()):
        raise WeightsError(f"weights '{weights_path}' have values that are not finite in {', '.join(wrong)}")
    return card, tensors


def check_hash(path: Path, card: Mapping[str, Any]) -> None:
    """Check that a file of weights is the one that its card describes, by the entry ``sha256``.

    Raises:
        WeightsError: if it is another one, or the card does not say.
    """
    if card.get("sha256") != (found := hash_of(path)):
        raise WeightsError(
            f"weights '{path}' are damaged, or not those of the card beside them: their SHA-256 begins with "
            f"{found[:12]}, that of the card with {str(card.get('sha256'))[:12]}"
        )


def check_box(weights: str, learned: Any, needed: dict[str, list]) -> None:
    """Check that the box of a card's design variables contains that of a robot.

    Raises:
        WeightsError: naming the first variable whose box does not, or all variables if they are others.
    """
    if not isinstance(learned, dict) or learned.keys() != needed.keys():
        raise WeightsError(f"weights '{weights}' have design_variables = {learned}, needed {needed}")
    for name, (low, high, unit) in needed.items():
        own = learned[name]
        if not (isinstance(own, list) and len(own) == 3 and own[2] == unit and own[0] <= low and high <= own[1]):
            raise WeightsError(
                f"weights '{weights}' were trained for {name} = {own}, which does not contain {[low, high, unit]}; "
                "use another design_box of the robot, or train weights with 'softgym fit'"
            )


def load_model(folder: str | Path, robot: Robot, members: int | None = None) -> SurrogateModel:
    """Load weights (``model.safetensors``) and their card (``model.json``) for a robot.

    Args:
        folder: the folder with both files.
        robot: the robot they must be for.
        members: how many members of an ensemble to use; default all.

    Raises:
        WeightsError: if a file is missing, truncated, of another format or for another robot; the message names the
            file and what is expected.
    """
    card, tensors = read_weights(folder, robot)
    card_path, weights_path = Path(folder) / "model.json", Path(folder) / "model.safetensors"
    try:
        module = NETWORKS.find(str(card.get("network")))
    except ValueError as error:
        raise WeightsError(f"'{card_path}': {error}") from None
    try:
        return module.Model(robot, tensors, card, members)
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise WeightsError(f"weights '{weights_path}' do not fit network '{card['network']}': {error}") from error


def save_model(model: SurrogateModel, folder: str | Path) -> None:
    """Write a model's weights and its card, with the provenance of this run, for `load_model`."""
    write_weights(model.tensors, model.card, folder)


def write_weights(tensors: Mapping[str, np.ndarray], card: Mapping[str, Any], folder: str | Path) -> None:
    """Write weights in single precision and their card, with the provenance of this run, for `read_weights`."""
    from safetensors.numpy import save

    folder = Path(folder)
    # Not np.ascontiguousarray, which turns a scalar into a vector.
    weights = {name: np.array(value, dtype=np.float32, order="C") for name, value in tensors.items()}
    with atomic_write(folder / "model.safetensors") as stream:
        stream.write(save(weights))
    digest = hash_of(folder / "model.safetensors")
    write_json(folder / "model.json", {**card, "sha256": digest, "provenance": provenance()})
