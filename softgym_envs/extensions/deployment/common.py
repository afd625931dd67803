"""Shared by all export formats: which models can be exported, and how their actuators are described."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from softgym_envs.surrogate.model import SurrogateModel
from softgym_envs.surrogate.potential.model import Model
from softgym_envs.units import effort_unit

FORMATS = (".h", ".onnx")
"""File endings of the export formats."""


def check_path(path: str | Path, ending: str) -> Path:
    """Return the path, or raise ``ValueError`` if it has another ending."""
    path = Path(path)
    if path.suffix != ending:
        raise ValueError(f"'{path}' must end with {ending}")
    return path


def exportable(model: SurrogateModel, members: int | None) -> Model:
    """Return the model with its first members only.

    Raises:
        ValueError: for an unsupported network, an energy that is not convex, or a wrong number of members.
    """
    if not isinstance(model, Model):
        raise ValueError(f"a model of network '{model.network}' cannot be exported; allowed: 'potential'")
    if not model.robot.learning.convex:
        raise ValueError(f"robot '{model.robot.name}' cannot be exported: its energy is not convex")
    return model if members is None else Model(model.robot, model.tensors, model.card, members)


def actuator_records(model: Model) -> list[dict[str, Any]]:
    """Name, range and units of the actuators, for headers and metadata."""
    return [
        {
            "name": a.name,
            "low": a.low,
            "high": a.high,
            "unit": a.unit,
            "effort_unit": effort_unit(a.unit),
        }
        for a in model.robot.actuators
    ]
