"""Export of policies as ONNX graphs, whose inputs are measurements in SI units."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.agents.policy import Policy
from softgym_envs.storage import atomic_write
from softgym_envs.version import __version__

if TYPE_CHECKING:
    from softgym_envs.envs.spaces import AgentSpaces


OPSET, IR_VERSION = 17, 8
"""Version of the ONNX operators and file format, the same as for surrogates."""


def export_policy_onnx(policy: Policy | str | Path, path: str | Path) -> Path:
    """Write a policy as an ONNX graph that includes the scaling of its observations, atomically.

    Inputs, all float32 and in SI units, for any number B of states at once: ``command``, ``displacement`` and
    ``effort`` of the actuators (B, n_a), ``effector`` and ``goal`` [m] (B, 3), in dynamics the effector's ``velocity``
    [m/s] (B, 3), and ``design`` (B, k) for a policy that observes its body. Outputs are the ``action`` (B, n_a) in
    [-1, 1] and the resulting ``next_command`` (B, n_a), within rates and ranges. A policy trained with
    ``residual_scale`` has no ``next_command``: the caller adds its action to that of a QP. The metadata name
    environment, actuators, design variables and training steps.

    Args:
        policy: a policy, its file, or the name of a shipped one.
        path: output file, ending with ``.onnx``.

    Returns:
        The path.

    Raises:
        WeightsError: if the policy cannot be read.
        ValueError: for another file ending, a policy that `exported_spaces` refuses, or if ``onnx`` is not installed.
    """
    path = Path(path)
    if path.suffix != ".onnx":
        raise ValueError(f"'{path}' must end with .onnx")
    try:
        import onnx
    except ImportError:
        raise ValueError("ONNX files need the package onnx: pip install 'softgym-envs[onnx]'") from None
    policy = policy if isinstance(policy, Policy) else Policy(policy)
    data = _graph(policy, exported_spaces(policy), policy.environment, onnx).SerializeToString()
    with atomic_write(path) as stream:
        stream.write(data)
    return path


def exported_spaces(policy: Policy) -> AgentSpaces:
    """Return the observation and action spaces of the environment in which a policy was trained.

    Raises:
        ValueError: for a policy that the exported formats cannot hold: one that has a memory, or that observes sensors
            in place of the effector, or a choice of its body.
    """
    if policy.remembers:
        raise ValueError(f"policy '{policy.path}' has a memory and cannot be exported; allowed: policies without")
    env = policy.environment.make()
    env.close()
    spaces: AgentSpaces = env.unwrapped.spaces  # type: ignore[attr-defined]
    spaces.robot.needs_displacements(f"export of policy '{policy.path}'")
    if spaces.sensors:
        raise ValueError(
            f"policy '{policy.path}' observes sensors in place of the effector and cannot be exported; allowed: "
            "policies that observe the effector"
        )
    space = spaces.robot.design_space
    if chosen := [name for name in spaces.design_names if space[name].choices]:
        raise ValueError(
            f"policy '{policy.path}' observes choices of its body ({', '.join(chosen)}) and cannot be exported; "
            "allowed: policies that observe numbers only"
        )
    return spaces


def input_sizes(spaces: AgentSpaces) -> dict[str, int]:
    """Return the measurements that a policy needs, in their order, with their sizes."""
    n = len(spaces.robot.actuators)
    sizes = {"command": n, "displacement": n, "effort": n, "effector": 3, "goal": 3}
    if spaces.moving:
        sizes["velocity"] = 3
    if spaces.design_names:
        sizes["design"] = len(spaces.design_names)
    return sizes


class _Nodes:
    """Builder of the nodes and constants of a graph."""

    def __init__(self, onnx: Any) -> None:
        self.onnx = onnx
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def __call__(self, operator: str, *inputs: str | np.ndarray | float, output: str = "", **attributes: Any) -> str:
        names = [value if isinstance(value, str) else self._constant(value) for value in inputs]
        name = output or f"v{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(operator, names, [name], **attributes))
        return name

    def _constant(self, value: np.ndarray | float) -> str:
        name = f"c{len(self.constants)}"
        self.constants.append(self.onnx.numpy_helper.from_array(np.asarray(value, dtype=np.float32), name))
        return name

    def squashed(self, value: str) -> str:
        """Return the output of x / (1 + |x|)."""
        return self("Div", value, self("Add", self("Abs", value), 1.0))


def _graph(policy: Policy, spaces: AgentSpaces, config: EnvironmentConfig, onnx: Any) -> Any:
    robot, n = spaces.robot, len(spaces.robot.actuators)
    sizes = input_sizes(spaces)
    g = _Nodes(onnx)
    h = _observation(spaces, g)
    for weight, bias in policy.hidden:
        h = g("Relu", g("Add", g("MatMul", h, weight), bias))
    weight, bias = policy.mean
    action = g("Tanh", g("Add", g("MatMul", h, weight), bias), output="action")
    outputs = ["action"]
    if not config.residual_scale:
        outputs.append(_next_command(spaces, g, action))

    def value(name: str, size: int) -> Any:
        return onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["B", size])

    graph = onnx.helper.make_graph(
        g.nodes,
        "policy",
        [value(name, size) for name, size in sizes.items()],
        [value(name, n) for name in outputs],
        g.constants,
    )
    model = onnx.helper.make_model(
        graph,
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="softgym-envs",
        producer_version=__version__,
    )
    space = robot.design_space
    described = {
        "environment": json.dumps(config.model_dump(mode="json")),
        "actuators": json.dumps(
            [{"name": a.name, "low": a.low, "high": a.high, "unit": a.unit} for a in robot.actuators]
        ),
        "design": json.dumps([{"name": name, "unit": space[name].unit} for name in spaces.design_names]),
        "steps": str(policy.card.get("steps")),
    }
    onnx.helper.set_model_props(model, described)
    onnx.checker.check_model(model)
    return model


def _observation(spaces: AgentSpaces, g: _Nodes) -> str:
    """Add the nodes of `AgentSpaces.observe`; return their output."""
    parts = [g("Div", g("Sub", name, spaces.middle), spaces.half_range) for name in ("command", "displacement")]
    parts.append(g.squashed(g("Div", "effort", spaces.effort_scale)))
    parts += [g("Div", name, spaces.position_scale) for name in ("effector", "goal")]
    parts.append(g.squashed(g("Mul", g("Sub", "goal", "effector"), spaces.axes / spaces.error_scale)))
    if spaces.moving:
        parts.append(g.squashed(g("Div", "velocity", spaces.robot.size)))
    if spaces.design_names:
        parts.append(_unit_design(spaces, g))
    return g("Clip", g("Concat", *parts, axis=-1), -1.0, 1.0)


def _next_command(spaces: AgentSpaces, g: _Nodes, action: str) -> str:
    """Add the nodes of `AgentSpaces.command`; return their output."""
    if spaces.action_mode == "increment":
        target = g("Add", "command", g("Mul", action, spaces.rates))
    else:
        step = g("Sub", g("Add", g("Mul", action, spaces.half_range), spaces.middle), "command")
        target = g("Add", "command", g("Min", g("Max", step, -spaces.rates), spaces.rates))
    return g("Min", g("Max", target, spaces.lower), spaces.upper, output="next_command")


def _unit_design(spaces: AgentSpaces, g: _Nodes) -> str:
    """Add the nodes that scale design variables to [-1, 1]; return their output."""
    variables = [spaces.robot.design_space[name] for name in spaces.design_names]
    is_log = np.array([variable.log for variable in variables])
    low, high = (np.array([getattr(variable, end) for variable in variables]) for end in ("low", "high"))
    low, high = (np.where(is_log, np.log(np.where(is_log, end, 1.0)), end) for end in (low, high))
    shown = "design"
    if is_log.any():
        # Both branches are evaluated, and the logarithm must only get positive numbers.
        inside = g("Log", g("Max", "design", 1e-30))
        mixed = g("Mul", inside, is_log.astype(float))
        shown = g("Add", mixed, g("Mul", "design", (~is_log).astype(float)))
    return g("Sub", g("Mul", g("Sub", shown, low), 2.0 / (high - low)), 1.0)
