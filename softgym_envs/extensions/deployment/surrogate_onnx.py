"""A trained model as an ONNX graph, for every body of the robot, in single precision."""

from __future__ import annotations

import json
import tempfile
import warnings
from pathlib import Path
from typing import Any

from softgym_envs.extensions.deployment.common import actuator_records, check_path, exportable
from softgym_envs.storage import atomic_write
from softgym_envs.surrogate.model import SurrogateModel
from softgym_envs.surrogate.potential.model import Model
from softgym_envs.version import __version__

OPSET = 17
"""Version of the operator set: old enough for the runtimes of embedded boards, and sufficient for the graph."""

_NAMES = {"inputs": ("design", "displacement"), "outputs": ("effort", "effector", "W")}


def export_onnx(model: SurrogateModel, path: str | Path, *, members: int | None = None) -> Path:
    """Write a model as an ONNX graph for every body and any number of states at once, atomically.

    Inputs are ``design`` (B, len(space)), in the order of the design space, and ``displacement`` (B, n_a); outputs
    ``effort`` (B, n_a), ``effector`` [m] (B, n_e) and ``W`` (B, n_a + n_e, n_a + n_e). All are float32 and in SI
    units. The metadata name robot, options, variables, actuators and units.

    Args:
        model: a trained model of network ``"potential"``.
        path: the file, ending with ``.onnx``.
        members: how many members of the ensemble are averaged; default all that the model uses.

    Returns:
        The path.

    Raises:
        ValueError: for an unsupported network, file ending or number of members, if ``onnx`` is not installed, or for
            values that are not finite in single precision.
    """
    path = check_path(path, ".onnx")
    potential = exportable(model, members)
    if model.sensors:
        raise ValueError(f"robot '{model.robot.name}' cannot be exported: its sensor rows are not part of a graph")
    try:
        import onnx
    except ImportError:
        raise ValueError("ONNX files need the package onnx: pip install 'softgym-envs[onnx]'") from None
    graph = onnx.load_from_string(_traced(potential))
    _describe(graph, potential, onnx)
    onnx.checker.check_model(graph, full_check=True)
    with atomic_write(path) as stream:
        stream.write(graph.SerializeToString())
    return path


def _traced(model: Model) -> bytes:
    """Return the graph of a model as torch exports it."""
    import torch

    from softgym_envs.extensions.fitting.torch_potential import TorchModel

    net = TorchModel(model, dtype=torch.float32, inverse=_eliminate).eval()
    design = torch.tensor(model.robot.design_space.baseline.array, dtype=torch.float32).expand(2, -1)
    displacement = torch.as_tensor(model.middle, dtype=torch.float32).expand(2, -1)
    if not all(bool(torch.isfinite(value).all()) for value in net(design, displacement)):
        raise ValueError("the model's results are not finite in single precision")
    names = [*_NAMES["inputs"], *_NAMES["outputs"]]
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        file = Path(folder) / "model.onnx"
        # The tracing exporter is deprecated, but its successor (``dynamo=True``) needs three more packages, operator
        # set 18 and twenty times as long for the same result. Tracing also warns about sizes that become constants; the
        # batch size is not one of them.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            net,
            (design, displacement),
            file,
            dynamo=False,
            opset_version=OPSET,
            input_names=list(_NAMES["inputs"]),
            output_names=list(_NAMES["outputs"]),
            dynamic_axes={name: {0: "B"} for name in names},
        )
        return file.read_bytes()


def _eliminate(matrix: Any) -> Any:
    """Invert symmetric positive definite matrices (B, n, n) with entries of order one: Gauss-Jordan, no pivoting.

    ONNX has no inverse. Each step eliminates one column of (A | 1) by a rank-one update of the whole matrix.
    """
    import torch

    n = matrix.shape[2]
    unit = torch.eye(n, dtype=matrix.dtype)
    work = torch.cat([matrix, 0.0 * matrix + unit], dim=2)
    for k in range(n):
        column = unit[:, k : k + 1]
        row = work[:, k : k + 1] / work[:, k : k + 1, k : k + 1]
        # The pivot's own row is cleared first, so that it becomes ``row`` without a difference of large numbers.
        work = work * (1.0 - column) - (work[:, :, k : k + 1] * (1.0 - column) - column) * row
    return work[:, :, n:]


def _describe(graph: Any, model: Model, onnx: Any) -> None:
    """Add the description and the metadata to a graph."""
    robot = model.robot
    graph.producer_name, graph.producer_version = "softgym-envs", __version__
    graph.graph.name = robot.learning.weights
    graph.doc_string = (
        "Condensed model of a soft robot: efforts that hold its actuators at given displacements, effector positions "
        "[m], and the compliance W of actuators and effectors. SI units."
    )
    variables = [
        {"name": v.name, "low": v.low, "high": v.high, "baseline": v.baseline, "unit": v.unit}
        for v in robot.design_space
    ]
    properties = {
        "robot": robot.name,
        "weights_name": robot.learning.weights,
        "mechanics_key": json.dumps(robot.mechanics_key),
        "design": json.dumps(variables),
        "displacement": json.dumps(actuator_records(model)),
        "effector": json.dumps({"names": robot.effectors, "coordinates": "xyz", "unit": "m"}),
        "members": str(model.members),
        "softgym-envs": __version__,
    }
    onnx.helper.set_model_props(graph, properties)
