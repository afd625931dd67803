"""One body of a trained model as a self-contained C99 header, in single precision; it needs only ``math.h``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from softgym_envs.extensions.deployment.c_text import (
    check_identifier,
    comment,
    definitions,
    functions,
    names_of,
    single_precision,
)
from softgym_envs.extensions.deployment.common import actuator_records, check_path, exportable
from softgym_envs.robots.base import Robot
from softgym_envs.storage import atomic_write
from softgym_envs.surrogate.model import Context, SurrogateModel
from softgym_envs.surrogate.potential.model import Model
from softgym_envs.version import __version__

SIZES = {
    "N": ("ACTUATORS", "n"),
    "E": ("COORDINATES", "e: three for each effector"),
    "M": ("MEMBERS", "networks that are averaged"),
    "H": ("WIDTH", "hidden units of a layer"),
    "T": ("TRIANGLE", "entries of a triangle of the held compliance"),
}
"""Macro and meaning of the sizes of a model, by the letters that shapes of constants use."""


def export_c(
    model: SurrogateModel,
    design: Mapping[str, float] | None,
    path: str | Path,
    *,
    members: int | None = None,
    name: str = "softgym",
    robot: Robot | None = None,
) -> Path:
    """Write one body as a self-contained C99 header, atomically.

    It defines ``<name>_state`` and ``<name>_condensed``; its first comment documents both.

    Args:
        model: a trained model of network ``"potential"``.
        design: the body, in SI units; missing variables take their baseline.
        path: the file, ending with ``.h``.
        members: how many members of the ensemble are averaged; default all that the model uses.
        name: prefix of everything the header defines, a C identifier.
        robot: whose design and effectors the header has; default that of the model. A robot whose touch is learned has
            a model with more of both.

    Returns:
        The path.

    Raises:
        DesignError: for a malformed design.
        ValueError: for an unsupported network, file ending or number of members, a prefix that is not an identifier, or
            weights that are not finite in single precision.
    """
    path = check_path(path, ".h")
    check_identifier(name)
    potential = exportable(model, members)
    text = header_text(potential, design, name, robot)
    with atomic_write(path, "w") as stream:
        stream.write(text)
    return path


def sizes_of(model: Model, e: int) -> dict[str, int]:
    """Return the sizes of a model with ``e`` effector coordinates, by letter."""
    return {"N": model.count, "E": e, "M": model.members, "H": model.width, "T": e * (e + 1) // 2}


def macros(sizes: Mapping[str, int], meanings: Mapping[str, tuple[str, str]], name: str) -> str:
    """Return the definitions of sizes."""
    return "\n".join(
        f"#define {name.upper()}_{meanings[letter][0]} {value} /* {meanings[letter][1]} */"
        for letter, value in sizes.items()
    )


def network_constants(model: Model, stiffness: float, e: int) -> dict[str, tuple[str, np.ndarray]]:
    """Return the constants that all bodies share: name to (shape in C, values).

    Constant factors and terms are folded into the weights: the share of each member in the mean, the scales of the
    effector, and the factor one half of the ramp's derivative. The arithmetic is that of the compiled kernels; the
    innermost loops run over hidden units, so compilers can vectorise them without being allowed to reorder sums.

    Args:
        model: the ensemble.
        stiffness: what scales its efforts.
        e: how many of its passive rows are kept.
    """
    weights = {key: array.astype(float) for key, array in model.tensors.items()}
    share, energy = 1.0 / model.members, model.energy_scale * stiffness
    return {
        "middle": ("[N]", model.middle),
        "half_range": ("[N]", model.half_range),
        "effort_scale": ("[N]", energy / model.half_range),
        "compliance_scale": ("", np.array(1.0 / energy)),
        "held_scale": ("", np.array(model.held_scale * share / stiffness)),
        "energy1": ("[M][N][H]", weights["energy1"].swapaxes(1, 2)),
        "energy2": ("[M][N][H]", weights["energy2"].swapaxes(1, 2)),
        "pass_on": ("[M][H][H]", np.logaddexp(0.0, weights["pass_on"]).swapaxes(1, 2)),
        "shape1": ("[M][N][H]", weights["shape1"].swapaxes(1, 2)),
        "shape2": ("[M][H][H]", weights["shape2"].swapaxes(1, 2)),
        "effector": ("[M][E][H]", (model.effector_scale * share * weights["effector"])[:, :e]),
        # Rows of a Cholesky factor: the first ones are the factor of the first rows of the compliance.
        "held": ("[M][T][H]", weights["held"][:, : e * (e + 1) // 2]),
    }


def body_constants(model: Model, context: Context, e: int) -> dict[str, tuple[str, np.ndarray]]:
    """Return the constants of one body."""
    body = {key: array[0].astype(float) for key, array in context.arrays.items()}
    share = 1.0 / model.members
    return {
        "quadratic": ("[N][N]", body["quadratic"]),
        "linear": ("[N]", body["linear"]),
        "rest": ("[E]", (model.effector_mean + model.effector_scale * body["x0"].mean(axis=0))[:e]),
        "slope": ("[E][N]", (model.effector_scale * body["slope"].mean(axis=0))[:e]),
        "c1": ("[M][H]", body["c1"]),
        "c2": ("[M][H]", body["c2"]),
        "a": ("[M][H]", 0.5 * share * body["a"]),
        "b": ("[M][H]", share * body["b"]),
        "d1": ("[M][H]", body["d1"]),
        "d2": ("[M][H]", body["d2"]),
        "held_bias": ("[M][T]", body["held"][:, : e * (e + 1) // 2]),
    }


def header_text(model: Model, given: Mapping[str, float] | None, name: str, robot: Robot | None = None) -> str:
    """Return the text of the header of one body; see `export_c` for the arguments and errors."""
    robot = robot or model.robot
    n, e = model.count, 3 * len(robot.effectors)
    design = robot.design_space.complete(given)
    space, sizes = model.robot.design_space, sizes_of(model, e)
    context = model.context(space.complete(design).array[None])
    constants = single_precision(
        network_constants(model, float(context.stiffness[0, 0]), e) | body_constants(model, context, e), sizes
    )
    upper = name.upper()
    bytes_ = 4 * sum(array.size for _, array in constants.values())
    stack = 4 * ((2 * n + 6) * model.width + n * (3 * n + 3 * e) + 3 * e * e)
    units = {v.name: "" if v.unit == "1" else f" {v.unit}" for v in robot.design_space}
    about = [
        f"Condensed model of a soft robot, written by softgym-envs {__version__} (C99, header format 1).",
        "",
        f"Robot      {robot.name} ({robot.learning.weights})",
        f"Options    {json.dumps(robot.mechanics_key)}",
        *(f"{'Design' if k == 0 else '':10s} {key} = {design[key]!r}{units[key]}" for k, key in enumerate(design)),
        *(
            f"{'Actuators' if k == 0 else '':10s} {k}: {a['name']}, {a['low']:g} to {a['high']:g} {a['unit']}, "
            f"effort in {a['effort_unit']}"
            for k, a in enumerate(actuator_records(model))
        ),
        f"Effectors  {', '.join(robot.effectors)}: x, y, z of each in m",
        f"Network    potential, {model.members} member(s) of width {model.width}",
        f"Memory     {bytes_} bytes of constants, about {stack} bytes of stack",
        "",
        f"void {name}_state(const float displacement[{n}], float effort[{n}], float effector[{e}])",
        "    Efforts that hold the actuators at given displacements, and the effector positions.",
        "",
        f"int {name}_condensed(const float displacement[{n}], float effort[{n}], float effector[{e}], "
        f"float W[{(n + e) ** 2}])",
        f"    The same, and the symmetric compliance W ({n + e}, {n + e}), row after row, actuators before effectors:",
        "    d(displacement, effector) = W d(effort, force on the effectors).",
        "    At the efforts (effort, force) the tangent predicts W (effort, force) + free, where",
        "    free = (displacement, effector) - W (effort, 0).",
        "    Returns 0; or 1, and W unchanged, if an input is not finite or single precision is not sufficient.",
        "",
        "All quantities are in SI units. The model was trained within the ranges of the actuators and extrapolates",
        "outside them without clipping. The functions have no state and are safe to call from several threads.",
        "",
        "Compile with -O3 -fno-math-errno if you can: square roots become single instructions, with the same results.",
    ]
    parts = [
        comment(about),
        f"#ifndef {upper}_H\n#define {upper}_H\n\n#include <math.h>\n",
        macros(sizes, SIZES, name),
        "",
        *definitions(constants, {letter: macro for letter, (macro, _) in SIZES.items()}, name),
        functions("functions", names_of(name)),
        f"#endif /* {upper}_H */\n",
    ]
    return "\n".join(parts)
