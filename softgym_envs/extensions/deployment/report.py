"""Files of a study's winner: its body for CAD and slicers, its policy as an ONNX graph."""

from __future__ import annotations

from pathlib import Path

from softgym_envs.extensions.deployment.cad import export_body
from softgym_envs.extensions.deployment.policy_onnx import export_policy_onnx
from softgym_envs.extensions.report.exports import Winner, WinnerFile


def _write_body(path: Path, winner: Winner) -> None:
    export_body(winner.robot, path, winner.design)


def _write_policy(path: Path, winner: Winner) -> None:
    assert winner.policy is not None
    export_policy_onnx(winner.policy, path)


STL = WinnerFile(".stl", "the winner's body at rest as triangles, in millimetres", _write_body)
STEP = WinnerFile(".step", "its exact shape for CAD, in millimetres", _write_body)
ONNX = WinnerFile(
    ".onnx",
    "its policy as an ONNX graph, from sensor values to commands",
    _write_policy,
    lambda winner: winner.policy is not None,
)
