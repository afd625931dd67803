"""Export of policies as self-contained C99 headers, in single precision; they need only ``math.h``."""

from __future__ import annotations

import json
from pathlib import Path
from string import Template

import numpy as np

from softgym_envs.agents.policy import Policy
from softgym_envs.envs.spaces import AgentSpaces
from softgym_envs.extensions.deployment.c_text import check_identifier, comment, initialiser, number
from softgym_envs.extensions.deployment.common import check_path
from softgym_envs.extensions.deployment.policy_onnx import exported_spaces, input_sizes
from softgym_envs.storage import atomic_write
from softgym_envs.version import __version__

#: Template of the functions that do not depend on the policy, with ``${p}`` for the prefix.
_FUNCTIONS = Path(__file__).with_name("policy_functions.h.in")


def export_policy_c(policy: Policy | str | Path, path: str | Path, *, name: str = "softgym_policy") -> Path:
    """Write a policy as a C99 header that includes the scaling of its observations, atomically.

    It defines ``<name>_action``, and ``<name>_next_command`` unless the policy was trained with ``residual_scale``: the
    caller then adds the action to that of a QP. The first comment of the header documents both.

    Args:
        policy: a policy, its file, or the name of a shipped one.
        path: output file, ending with ``.h``.
        name: prefix of everything the header defines, a C identifier.

    Returns:
        The path.

    Raises:
        WeightsError: if the policy cannot be read.
        ValueError: for another file ending, a prefix that is not an identifier, or a policy that `exported_spaces`
            refuses.
    """
    path = check_path(path, ".h")
    check_identifier(name)
    policy = policy if isinstance(policy, Policy) else Policy(policy)
    text = _header(policy, exported_spaces(policy), name)
    with atomic_write(path, "w") as stream:
        stream.write(text)
    return path


def _header(policy: Policy, spaces: AgentSpaces, name: str) -> str:
    """Return the text of the header."""
    upper, robot = name.upper(), spaces.robot
    sizes = input_sizes(spaces)
    layers = [*policy.hidden, policy.mean]
    n = len(robot.actuators)
    inputs = ", ".join(f"const float {key}[{size}]" for key, size in sizes.items())
    commands = not policy.environment.residual_scale
    constants = {f"weight{k}": weight.ravel() for k, (weight, _) in enumerate(layers)}
    constants |= {f"bias{k}": bias for k, (_, bias) in enumerate(layers)}
    constants |= {"low": spaces.lower, "high": spaces.upper, "effort_scale": spaces.effort_scale}
    if commands:
        constants["rate"] = spaces.rates
    width = max(len(bias) for _, bias in layers)
    bytes_ = 4 * sum(len(array) for array in constants.values())
    units = {key: "m" for key in ("effector", "goal")} | {"velocity": "m/s", "design": "SI units"}
    about = [
        f"Policy of a soft robot, written by softgym-envs {__version__} (C99, policy header format 1).",
        "",
        f"Trained in {json.dumps(policy.environment.model_dump(mode='json', exclude_defaults=True))}",
        *(
            f"{'Actuators' if k == 0 else '':10s} {k}: {a.name}, {a.low:g} to {a.high:g} {a.unit}"
            for k, a in enumerate(robot.actuators)
        ),
        *([f"Design     {', '.join(spaces.design_names)}"] if spaces.design_names else []),
        f"Network    {' x '.join(str(len(bias)) for _, bias in layers)} units",
        f"Memory     {bytes_} bytes of constants, about {4 * (2 * width + policy.observation_size)} bytes of stack",
        "",
        f"int {name}_action({inputs}, float action[{n}])",
        "    Action in [-1, 1] from measurements: command, displacement and effort of the actuators in SI units,",
        f"    {', '.join(f'{key} in {units[key]}' for key in sizes if key in units)}.",
        "    Returns 0; or 1, and action unchanged, if an input is not finite.",
        "",
    ]
    if commands:
        about += [
            f"void {name}_next_command(const float command[{n}], const float action[{n}], float next[{n}])",
            "    The command that the action leads to, within the rates and ranges of the actuators.",
        ]
    else:
        scale = policy.environment.residual_scale
        about += [f"The action corrects that of the inverse QP: clip(action of the QP + {scale:g} action, -1, 1)."]
    about += ["", "The functions have no state and are safe to call from several threads. Do not use -ffast-math."]
    parts = [comment(about), f"#ifndef {upper}_H\n#define {upper}_H\n\n#include <math.h>\n"]
    parts += [f"#define {upper}_{key.upper()} {size}" for key, size in sizes.items()]
    parts += ["", *(f"static const float {name}_{k}[{len(v)}] = {initialiser(v)};" for k, v in constants.items()), ""]
    parts += [Template(_FUNCTIONS.read_text()).substitute(p=name)]
    parts += [_action(policy, spaces, name, inputs, width)]
    if commands:
        parts += [_next_command(spaces, name, n)]
    parts += [f"#endif /* {upper}_H */\n"]
    return "\n".join(parts)


def _action(policy: Policy, spaces: AgentSpaces, name: str, inputs: str, width: int) -> str:
    """Return the function that scales the observation and evaluates the network."""
    robot, n, size = spaces.robot, len(spaces.robot.actuators), policy.observation_size
    place = {key: part.start for key, part in spaces.slices.items()}
    share = "({0}[i] - 0.5f * ({1}_high[i] + {1}_low[i])) / (0.5f * ({1}_high[i] - {1}_low[i]))"
    position = number(1.0 / spaces.position_scale)
    lines = [
        f"    for (i = 0; i < {n}; ++i) {{",
        f"        x[{place['command']} + i] = {share.format('command', name)};",
        f"        x[{place['displacement']} + i] = {share.format('displacement', name)};",
        f"        x[{place['effort']} + i] = {name}_squash(effort[i] / {name}_effort_scale[i]);",
        "    }",
        "    for (i = 0; i < 3; ++i) {",
        f"        x[{place['effector']} + i] = effector[i] * {position};",
        f"        x[{place['goal']} + i] = goal[i] * {position};",
    ]
    if spaces.moving:
        lines += [f"        x[{place['velocity']} + i] = {name}_squash(velocity[i] * {number(1.0 / robot.size)});"]
    lines += ["    }"]
    for i, scale in enumerate(np.broadcast_to(spaces.axes / spaces.error_scale, 3)):
        lines += [f"    x[{place['error'] + i}] = {name}_squash((goal[{i}] - effector[{i}]) * {number(scale)});"]
    for k, variable in enumerate(robot.design_space[key] for key in spaces.design_names):
        low, high = (np.log(end) if variable.log else end for end in (variable.low, variable.high))
        shown = f"logf(design[{k}])" if variable.log else f"design[{k}]"
        lines += [f"    x[{place['design'] + k}] = ({shown} - {number(low)}) * {number(2.0 / (high - low))} - 1.0f;"]
    lines += [
        f"    for (i = 0; i < {size}; ++i) {{",
        "        if (!isfinite(x[i]))",
        "            return 1;",
        f"        x[i] = {name}_clip(x[i], -1.0f, 1.0f);",
        "    }",
    ]
    source, counts = "x", [size, *(len(bias) for _, bias in (*policy.hidden, policy.mean))]
    for k, (inside, outside) in enumerate(zip(counts[:-1], counts[1:], strict=True)):
        target = ("y", "z")[k % 2]
        lines += [f"    {name}_layer({name}_weight{k}, {name}_bias{k}, {source}, {inside}, {outside}, {target});"]
        if k < len(policy.hidden):
            lines += [
                f"    for (i = 0; i < {outside}; ++i)",
                f"        {target}[i] = {target}[i] > 0.0f ? {target}[i] : 0.0f;",
            ]
        source = target
    lines += [f"    for (i = 0; i < {n}; ++i)", f"        action[i] = tanhf({source}[i]);", "    return 0;"]
    buffers = f"x[{size}], y[{width}]" + (f", z[{width}]" if policy.hidden else "")
    head = f"static inline int {name}_action({inputs}, float action[{n}])\n{{\n    float {buffers};\n    int i;\n"
    return head + "\n".join(lines) + "\n}\n"


def _next_command(spaces: AgentSpaces, name: str, n: int) -> str:
    """Return the function that turns an action into a command."""
    target = f"command[i] + action[i] * {name}_rate[i]"
    if spaces.action_mode == "absolute":
        aim = f"0.5f * ({name}_high[i] + {name}_low[i] + action[i] * ({name}_high[i] - {name}_low[i]))"
        target = f"command[i] + {name}_clip({aim} - command[i], -{name}_rate[i], {name}_rate[i])"
    return (
        f"static inline void {name}_next_command(const float command[{n}], const float action[{n}], float next[{n}])\n"
        "{\n    int i;\n"
        f"    for (i = 0; i < {n}; ++i)\n"
        f"        next[i] = {name}_clip({target}, {name}_low[i], {name}_high[i]);\n"
        "}\n"
    )
