"""Trained condensed models outside Python: a C header for microcontrollers, an ONNX graph for everything else.

Both compute what `softgym_envs.surrogate.potential.model.Model` computes, in single precision. The header holds one
body, prepared once, and needs nothing but ``math.h``; the graph takes the design as an input.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.storage import atomic_write
from softgym_envs.version import __version__

if TYPE_CHECKING:
    from softgym_envs.surrogate.model import SurrogateModel
    from softgym_envs.surrogate.potential.model import Model

__all__ = ["FORMATS", "export_c", "export_onnx"]

FORMATS = (".h", ".onnx")
"""Endings of the files that can be written."""

_EFFORTS = {"m": "N", "m3": "Pa", "rad": "N m"}
"""Unit of the effort that does work on a displacement of a unit."""

OPSET, IR_VERSION = 17, 8
"""What the graph is written in: old enough for runtimes of embedded boards, and all that it needs."""


def export_c(
    model: SurrogateModel,
    design: Mapping[str, float] | None,
    path: str | Path,
    *,
    members: int | None = None,
    name: str = "softgym",
) -> Path:
    """Write one body as a self-contained C99 header, atomically.

    It defines ``<name>_state`` and ``<name>_condensed``; its first comment says what they take and return.

    Args:
        model: a trained model of network ``"potential"``.
        design: the body, in SI units; missing variables take their baseline.
        path: where to, ending with ``.h``.
        members: how many members of the ensemble are averaged; default all that the model uses.
        name: prefix of everything the header defines, a C identifier.

    Returns:
        The path.

    Raises:
        DesignError: for a malformed design.
        ValueError: for another network, ending or number of members, a prefix that is no identifier, or weights that
            are not finite in single precision.
    """
    path = _check_path(path, ".h")
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise ValueError(f"name = {name!r} is no C identifier: a letter, then letters, digits and underscores")
    potential = _potential(model, members)
    complete = potential.robot.design_space.complete(design)
    text = _header(potential, complete, name)
    with atomic_write(path, "w") as stream:
        stream.write(text)
    return path


def export_onnx(model: SurrogateModel, path: str | Path, *, members: int | None = None) -> Path:
    """Write a model as an ONNX graph for every body and any number of states at once, atomically.

    Inputs are ``design`` (B, len(space)), in the order of the design space, and ``displacement`` (B, n_a); outputs
    ``effort`` (B, n_a), ``effector`` [m] (B, n_e) and ``W`` (B, n_a + n_e, n_a + n_e). All are float32 and in SI
    units. The metadata name robot, options, variables, actuators and units.

    Args:
        model: a trained model of network ``"potential"``.
        path: where to, ending with ``.onnx``.
        members: how many members of the ensemble are averaged; default all that the model uses.

    Returns:
        The path.

    Raises:
        ValueError: for another network, ending or number of members, or where ``onnx`` is not installed.
    """
    path = _check_path(path, ".onnx")
    potential = _potential(model, members)
    try:
        import onnx
    except ImportError:
        raise ValueError("ONNX files need the package onnx: pip install 'softgym-envs[onnx]'") from None
    data = _graph(potential, onnx).SerializeToString()
    with atomic_write(path) as stream:
        stream.write(data)
    return path


def _check_path(path: str | Path, ending: str) -> Path:
    path = Path(path)
    if path.suffix != ending:
        raise ValueError(f"'{path}' must end with {ending}")
    return path


def _potential(model: SurrogateModel, members: int | None) -> Model:
    """The model with the first of its members only."""
    from softgym_envs.surrogate.potential.model import Model

    if not isinstance(model, Model):
        raise ValueError(f"a model of network '{model.network}' cannot be exported; allowed: 'potential'")
    if not model.robot.convex:
        raise ValueError(f"the energy of robot '{model.robot.name}' is not convex, which exported models rely on")
    return model if members is None else Model(model.robot, model.tensors, model.card, members)


def _softplus(x: np.ndarray) -> np.ndarray:
    return np.logaddexp(0.0, np.asarray(x, dtype=float))


def _actuators(model: Model) -> list[dict[str, Any]]:
    return [
        {
            "name": a.name,
            "low": a.low,
            "high": a.high,
            "unit": a.unit,
            "effort_unit": _EFFORTS.get(a.unit, f"J/{a.unit}"),
        }
        for a in model.robot.actuators
    ]


# -- C -----------------------------------------------------------------------------------------------------------------


def _number(value: float) -> str:
    """The shortest decimal that is read as this very float32."""
    single = np.float32(value)
    plain = np.format_float_positional(single, unique=True, trim="0")
    short = np.format_float_scientific(single, unique=True, trim="0", exp_digits=1)
    return (plain if len(plain) <= len(short) else short) + "f"


def _initialiser(array: np.ndarray, indent: str = "    ") -> str:
    """An array as a C initialiser, in lines of at most 120 characters."""
    if array.ndim > 1:
        return "{\n" + ",\n".join(indent + _initialiser(part, indent + "    ") for part in array) + "}"
    lines, line = [], ""
    for number in map(_number, array):
        if line and len(indent) + len(line) + len(number) > 114:
            lines.append(line)
            line = ""
        line += f"{number}, "
    return "{" + f"\n{indent}".join(text.rstrip() for text in [*lines, line.rstrip(", ")]) + "}"


def _comment(lines: Iterable[str]) -> str:
    """A C comment; what would end it or look like another is taken apart."""
    text = "\n".join(f" * {line}".rstrip() for line in (x.replace("*/", "* /").replace("/*", "/ *") for x in lines))
    return f"/*\n{text}\n */\n"


def _constants(model: Model, design: Mapping[str, float]) -> dict[str, tuple[str, np.ndarray]]:
    """What the functions of the header read: name to (shape in C, values).

    Everything that only multiplies or adds once per call is put into the weights of the layer before: the shares of
    the members, the scales of the effector, and 1/2 of the ramp's derivative.
    """
    n, e = model.count, model.effectors
    values = np.array([[design[name] for name in model.robot.design_space.names]])
    context = model.context(values)
    stiffness = float(context.stiffness[0, 0])
    body = {key: array[0].astype(float) for key, array in context.arrays.items()}
    weights = {key: array.astype(float) for key, array in model.tensors.items()}
    share = 1.0 / model.members
    energy = model.energy_scale * stiffness
    constants = {
        "middle": ("[N]", model.middle),
        "half_range": ("[N]", model.half_range),
        "effort_scale": ("[N]", energy / model.half_range),
        "compliance_scale": ("", np.array(1.0 / energy)),
        "held_scale": ("", np.array(model.held_scale * share / stiffness)),
        "quadratic": ("[N][N]", body["quadratic"]),
        "linear": ("[N]", body["linear"]),
        "rest": ("[E]", model.effector_mean + model.effector_scale * body["x0"].mean(axis=0)),
        "slope": ("[E][N]", model.effector_scale * body["slope"].mean(axis=0)),
        "c1": ("[M][H]", body["c1"]),
        "c2": ("[M][H]", body["c2"]),
        "a": ("[M][H]", 0.5 * share * body["a"]),
        "b": ("[M][H]", share * body["b"]),
        "d1": ("[M][H]", body["d1"]),
        "d2": ("[M][H]", body["d2"]),
        "held_bias": ("[M][T]", body["held"]),
        "energy1": ("[M][N][H]", weights["energy1"].swapaxes(1, 2)),
        "energy2": ("[M][N][H]", weights["energy2"].swapaxes(1, 2)),
        "pass_on": ("[M][H][H]", _softplus(weights["pass_on"]).swapaxes(1, 2)),
        "shape1": ("[M][N][H]", weights["shape1"].swapaxes(1, 2)),
        "shape2": ("[M][H][H]", weights["shape2"].swapaxes(1, 2)),
        "effector": ("[M][E][H]", model.effector_scale * share * weights["effector"]),
        "held": ("[M][T][H]", weights["held"]),
    }
    sizes = {"N": n, "E": e, "M": model.members, "H": model.width, "T": e * (e + 1) // 2}
    singles = {}
    with np.errstate(over="ignore"):
        for key, (shape, array) in constants.items():
            single = np.asarray(array).astype(np.float32)
            if not np.isfinite(single).all():
                raise ValueError(f"'{key}' holds values that are not finite in single precision")
            assert single.shape == tuple(sizes[letter] for letter in re.findall(r"\w", shape)), key
            singles[key] = (shape, single)
    return singles


def _header(model: Model, design: Mapping[str, float], name: str) -> str:
    robot, n, e = model.robot, model.count, model.effectors
    constants = _constants(model, design)
    upper = name.upper()
    sizes = {
        "N": ("ACTUATORS", n, "n"),
        "E": ("COORDINATES", e, "e: three for each effector"),
        "M": ("MEMBERS", model.members, "networks that are averaged"),
        "H": ("WIDTH", model.width, "hidden units of a layer"),
        "T": ("TRIANGLE", e * (e + 1) // 2, "entries of a triangle of the held compliance"),
    }
    bytes_ = 4 * sum(array.size for _, array in constants.values())
    stack = 4 * ((2 * n + 6) * model.width + n * (3 * n + 3 * e) + 3 * e * e)
    variables = robot.design_space.variables
    units = {key: "" if variable.unit == "1" else f" {variable.unit}" for key, variable in variables.items()}
    about = [
        f"Condensed model of a soft robot, written by softgym-envs {__version__} (C99, header format 1).",
        "",
        f"Robot      {robot.name} ({robot.weights_name})",
        f"Options    {json.dumps(robot.mechanics_key)}",
        *(f"{'Design' if k == 0 else '':10s} {key} = {design[key]!r}{units[key]}" for k, key in enumerate(variables)),
        *(
            f"{'Actuators' if k == 0 else '':10s} {k}: {a['name']}, {a['low']:g} to {a['high']:g} {a['unit']}, "
            f"effort in {a['effort_unit']}"
            for k, a in enumerate(_actuators(model))
        ),
        f"Effectors  {', '.join(robot.effectors)}: x, y, z of each in m",
        f"Network    potential, {model.members} member(s) of width {model.width}",
        f"Memory     {bytes_} bytes of constants, about {stack} bytes of stack",
        "",
        f"void {name}_state(const float displacement[{n}], float effort[{n}], float effector[{e}])",
        "    Efforts that hold the actuators at given displacements, and where the effectors then are.",
        "",
        f"int {name}_condensed(const float displacement[{n}], float effort[{n}], float effector[{e}], "
        f"float W[{(n + e) ** 2}])",
        f"    The same, and the compliance W ({n + e}, {n + e}), row after row, actuators before effectors: what moves",
        "    by how much per effort, d(displacement, effector) = W d(effort, force on the effectors). W is symmetric.",
        "    At the efforts (effort, force) the tangent predicts W (effort, force) + free, where",
        "    free = (displacement, effector) - W (effort, 0).",
        "    Returns 0, or 1 where single precision does not suffice or an input is not finite; W is then untouched.",
        "",
        "All quantities are in SI units. The model was trained within the ranges of the actuators; beyond them it",
        "extrapolates, and nothing is clipped. The functions keep no state and may be called from several threads.",
        "",
        "Compile with -O3 -fno-math-errno where you can: square roots then are plain instructions, with equal results.",
    ]
    parts = [
        _comment(about),
        f"#ifndef {upper}_H\n#define {upper}_H\n\n#include <math.h>\n",
        "\n".join(f"#define {upper}_{word} {value} /* {meaning} */" for word, value, meaning in sizes.values()),
        "",
    ]
    for key, (shape, array) in constants.items():
        dimensions = re.sub(r"\w", lambda letter: f"{upper}_{sizes[letter.group()][0]}", shape)
        value = _initialiser(array) if array.ndim else _number(float(array))
        parts.append(f"static const float {name}_{key}{dimensions} = {value};")
    parts.append(Template(_FUNCTIONS).substitute(p=name, P=upper))
    parts.append(f"#endif /* {upper}_H */\n")
    return "\n".join(parts)


#: The functions of the header. The arithmetic is that of the compiled kernels of the potential network; loops run over
#: hidden units innermost, which compilers turn into vector instructions without permission to reorder sums.
_FUNCTIONS = r"""
/* Sum of x[k] y[k] over the hidden units, in eight partial sums. */
static inline float ${p}_dot(const float *x, const float *y)
{
    float part[8] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
    float sum = 0.0f;
    int k, l;
    for (k = 0; k + 8 <= ${P}_WIDTH; k += 8)
        for (l = 0; l < 8; ++l)
            part[l] += x[k + l] * y[k + l];
    for (; k < ${P}_WIDTH; ++k)
        sum += x[k] * y[k];
    for (l = 0; l < 8; ++l)
        sum += part[l];
    return sum;
}

/* z[j] = bias[j] + sum of u[i] weight[i][j] over the actuators. */
static inline void ${p}_enter(const float *bias, const float weight[][${P}_WIDTH], const float *u, float *z)
{
    int i, j;
    for (j = 0; j < ${P}_WIDTH; ++j)
        z[j] = bias[j];
    for (i = 0; i < ${P}_ACTUATORS; ++i)
        for (j = 0; j < ${P}_WIDTH; ++j)
            z[j] += u[i] * weight[i][j];
}

/* z[j] += sum of x[k] weight[k][j] over the hidden units. */
static inline void ${p}_mix(const float *x, const float weight[][${P}_WIDTH], float *z)
{
    float sum[${P}_WIDTH];
    int j, k;
    for (j = 0; j < ${P}_WIDTH; ++j)
        sum[j] = z[j];
    for (k = 0; k < ${P}_WIDTH; ++k)
        for (j = 0; j < ${P}_WIDTH; ++j)
            sum[j] += x[k] * weight[k][j];
    for (j = 0; j < ${P}_WIDTH; ++j)
        z[j] = sum[j];
}

/* Actuation in [-1, 1], and the parts of effort (scaled) and effector that are linear in it. */
static inline void ${p}_begin(const float *displacement, float *u, float *effort, float *effector)
{
    int i, j;
    for (i = 0; i < ${P}_ACTUATORS; ++i)
        u[i] = (displacement[i] - ${p}_middle[i]) / ${p}_half_range[i];
    for (i = 0; i < ${P}_ACTUATORS; ++i) {
        effort[i] = ${p}_linear[i];
        for (j = 0; j < ${P}_ACTUATORS; ++j)
            effort[i] += ${p}_quadratic[i][j] * u[j];
    }
    for (i = 0; i < ${P}_COORDINATES; ++i) {
        effector[i] = ${p}_rest[i];
        for (j = 0; j < ${P}_ACTUATORS; ++j)
            effector[i] += ${p}_slope[i][j] * u[j];
    }
}

static inline void ${p}_state(const float *displacement, float *effort, float *effector)
{
    float u[${P}_ACTUATORS], z[${P}_WIDTH], h[${P}_WIDTH], upper[${P}_WIDTH], lower[${P}_WIDTH];
    float r;
    int m, i, j;
    ${p}_begin(displacement, u, effort, effector);
    for (m = 0; m < ${P}_MEMBERS; ++m) {
        /* energy: forward, */
        ${p}_enter(${p}_c1[m], ${p}_energy1[m], u, z);
        for (j = 0; j < ${P}_WIDTH; ++j) {
            r = sqrtf(1.0f + z[j] * z[j]);
            h[j] = 0.5f * (z[j] + r);
            lower[j] = 0.5f * (1.0f + z[j] / r);
        }
        ${p}_enter(${p}_c2[m], ${p}_energy2[m], u, z);
        ${p}_mix(h, ${p}_pass_on[m], z);
        /* and backward */
        for (j = 0; j < ${P}_WIDTH; ++j)
            upper[j] = ${p}_a[m][j] * (1.0f + z[j] / sqrtf(1.0f + z[j] * z[j]));
        for (j = 0; j < ${P}_WIDTH; ++j)
            lower[j] *= ${p}_b[m][j] + ${p}_dot(${p}_pass_on[m][j], upper);
        for (i = 0; i < ${P}_ACTUATORS; ++i)
            effort[i] += ${p}_dot(lower, ${p}_energy1[m][i]) + ${p}_dot(upper, ${p}_energy2[m][i]);
        /* effector */
        ${p}_enter(${p}_d1[m], ${p}_shape1[m], u, z);
        for (j = 0; j < ${P}_WIDTH; ++j) {
            h[j] = z[j] / sqrtf(1.0f + z[j] * z[j]);
            z[j] = ${p}_d2[m][j];
        }
        ${p}_mix(h, ${p}_shape2[m], z);
        for (j = 0; j < ${P}_WIDTH; ++j)
            h[j] = z[j] / sqrtf(1.0f + z[j] * z[j]);
        for (i = 0; i < ${P}_COORDINATES; ++i)
            effector[i] += ${p}_dot(h, ${p}_effector[m][i]);
    }
    for (i = 0; i < ${P}_ACTUATORS; ++i)
        effort[i] *= ${p}_effort_scale[i];
}

static inline int ${p}_condensed(const float *displacement, float *effort, float *effector, float *W)
{
    enum { N = ${P}_ACTUATORS, E = ${P}_COORDINATES, S = ${P}_ACTUATORS + ${P}_COORDINATES };
    float u[N], z[${P}_WIDTH], h[${P}_WIDTH], slope[${P}_WIDTH], curve[${P}_WIDTH], lower[${P}_WIDTH];
    float first[${P}_WIDTH], tangent[N][${P}_WIDTH];
    float K[N][N]; /* Hessian of the scaled energy, and then its Cholesky factor: lower triangles */
    float C[E][E], L[E][E]; /* held compliance and the factor of one member: lower triangles */
    float Z[N][S]; /* W = Z^T Z + C */
    float r, value;
    int m, i, j, k;
    ${p}_begin(displacement, u, effort, effector);
    for (i = 0; i < N; ++i) {
        for (j = 0; j < N; ++j) {
            K[i][j] = ${p}_quadratic[i][j];
            Z[i][j] = 0.0f;
        }
        Z[i][i] = ${p}_half_range[i];
        for (j = 0; j < E; ++j)
            Z[i][N + j] = ${p}_slope[j][i];
    }
    for (i = 0; i < E; ++i)
        for (j = 0; j < E; ++j)
            C[i][j] = 0.0f;
    for (m = 0; m < ${P}_MEMBERS; ++m) {
        /* energy: forward with tangents, */
        ${p}_enter(${p}_c1[m], ${p}_energy1[m], u, z);
        for (j = 0; j < ${P}_WIDTH; ++j) {
            r = 1.0f / sqrtf(1.0f + z[j] * z[j]);
            h[j] = 0.5f * (z[j] + 1.0f / r);
            slope[j] = 0.5f * (1.0f + z[j] * r);
            curve[j] = 0.5f * r * r * r;
        }
        ${p}_enter(${p}_c2[m], ${p}_energy2[m], u, z);
        ${p}_mix(h, ${p}_pass_on[m], z);
        for (i = 0; i < N; ++i) {
            for (j = 0; j < ${P}_WIDTH; ++j) {
                first[j] = slope[j] * ${p}_energy1[m][i][j];
                tangent[i][j] = ${p}_energy2[m][i][j];
            }
            ${p}_mix(first, ${p}_pass_on[m], tangent[i]);
        }
        /* and backward */
        for (j = 0; j < ${P}_WIDTH; ++j) {
            r = 1.0f / sqrtf(1.0f + z[j] * z[j]);
            h[j] = ${p}_a[m][j] * (1.0f + z[j] * r);
            z[j] = ${p}_a[m][j] * r * r * r;
        }
        for (j = 0; j < ${P}_WIDTH; ++j)
            lower[j] = ${p}_b[m][j] + ${p}_dot(${p}_pass_on[m][j], h);
        for (j = 0; j < ${P}_WIDTH; ++j) {
            slope[j] *= lower[j];
            curve[j] *= lower[j];
        }
        for (i = 0; i < N; ++i) {
            effort[i] += ${p}_dot(slope, ${p}_energy1[m][i]) + ${p}_dot(h, ${p}_energy2[m][i]);
            for (j = 0; j < ${P}_WIDTH; ++j) {
                first[j] = curve[j] * ${p}_energy1[m][i][j];
                lower[j] = z[j] * tangent[i][j];
            }
            for (k = 0; k <= i; ++k)
                K[i][k] += ${p}_dot(first, ${p}_energy1[m][k]) + ${p}_dot(lower, tangent[k]);
        }
        /* effector, its Jacobian, and the compliance that is left while the actuators are held */
        ${p}_enter(${p}_d1[m], ${p}_shape1[m], u, z);
        for (j = 0; j < ${P}_WIDTH; ++j) {
            r = 1.0f / sqrtf(1.0f + z[j] * z[j]);
            h[j] = z[j] * r;
            slope[j] = r * r * r;
            z[j] = ${p}_d2[m][j];
        }
        ${p}_mix(h, ${p}_shape2[m], z);
        for (j = 0; j < ${P}_WIDTH; ++j) {
            r = 1.0f / sqrtf(1.0f + z[j] * z[j]);
            h[j] = z[j] * r;
            curve[j] = r * r * r;
        }
        for (i = 0; i < N; ++i) {
            for (j = 0; j < ${P}_WIDTH; ++j) {
                first[j] = slope[j] * ${p}_shape1[m][i][j];
                lower[j] = 0.0f;
            }
            ${p}_mix(first, ${p}_shape2[m], lower);
            for (j = 0; j < ${P}_WIDTH; ++j)
                lower[j] *= curve[j];
            for (k = 0; k < E; ++k)
                Z[i][N + k] += ${p}_dot(lower, ${p}_effector[m][k]);
        }
        k = 0;
        for (i = 0; i < E; ++i) {
            effector[i] += ${p}_dot(h, ${p}_effector[m][i]);
            for (j = 0; j <= i; ++j, ++k) {
                value = ${p}_held_bias[m][k] + ${p}_dot(h, ${p}_held[m][k]);
                L[i][j] = i == j ? expf(value) : value;
            }
        }
        for (i = 0; i < E; ++i)
            for (j = 0; j <= i; ++j)
                for (k = 0; k <= j; ++k)
                    C[i][j] += L[i][k] * L[j][k];
    }
    for (i = 0; i < N; ++i)
        effort[i] *= ${p}_effort_scale[i];
    /* K = L L^T in place, and Z = L^-1 (half_range, Jacobian^T) in place */
    for (i = 0; i < N; ++i) {
        for (j = 0; j <= i; ++j) {
            value = K[i][j];
            for (k = 0; k < j; ++k)
                value -= K[i][k] * K[j][k];
            if (j < i)
                K[i][j] = value / K[j][j];
            else if (value > 0.0f && value <= 1e38f)
                K[i][i] = sqrtf(value);
            else
                return 1;
        }
        for (j = 0; j < S; ++j) {
            value = Z[i][j];
            for (k = 0; k < i; ++k)
                value -= K[i][k] * Z[k][j];
            Z[i][j] = value / K[i][i];
        }
    }
    for (i = 0; i < S; ++i)
        for (j = 0; j <= i; ++j) {
            value = 0.0f;
            for (k = 0; k < N; ++k)
                value += Z[k][i] * Z[k][j];
            value *= ${p}_compliance_scale;
            if (j >= N)
                value += ${p}_held_scale * C[i - N][j - N];
            W[i * S + j] = value;
            W[j * S + i] = value;
        }
    return 0;
}
"""


# -- ONNX --------------------------------------------------------------------------------------------------------------


class _Builder:
    """Collects the nodes of a graph; values are names.

    Args:
        onnx: the module.
    """

    def __init__(self, onnx: Any) -> None:
        self.onnx = onnx
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self._known: dict[tuple, str] = {}

    def constant(self, array: Any, dtype: type = np.float32) -> str:
        """A constant; equal ones are kept once."""
        array = np.ascontiguousarray(array, dtype=dtype).reshape(np.shape(array))
        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self._known:
            if not np.isfinite(array).all():
                raise ValueError("the model holds values that are not finite in single precision")
            self._known[key] = f"constant_{len(self.constants)}"
            self.constants.append(self.onnx.numpy_helper.from_array(array, self._known[key]))
        return self._known[key]

    def _name(self, value: Any) -> str:
        return value if isinstance(value, str) else self.constant(value)

    def __call__(self, operator: str, *inputs: Any, output: str | None = None, **attributes: Any) -> str:
        """Add a node; inputs are names, or numbers and arrays that become constants."""
        output = output or f"value_{len(self.nodes)}"
        names = [self._name(value) for value in inputs]
        self.nodes.append(self.onnx.helper.make_node(operator, names, [output], **attributes))
        return output

    def sum(self, first: Any, *others: Any) -> str:
        """Sum of values."""
        total = self._name(first)
        for other in others:
            total = self("Add", total, other)
        return total

    def shaped(self, value: str, *shape: int) -> str:
        """Another shape; 0 keeps a dimension, -1 is what is left."""
        return self("Reshape", value, self.constant(shape, np.int64))

    def split(self, value: str, sizes: list[int]) -> list[str]:
        """Parts along the last axis."""
        outputs = [f"value_{len(self.nodes)}_{k}" for k in range(len(sizes))]
        inputs = [value, self.constant(sizes, np.int64)]
        self.nodes.append(self.onnx.helper.make_node("Split", inputs, outputs, axis=-1))
        return outputs

    def wide(self, value: str) -> str:
        """A new third axis."""
        return self("Unsqueeze", value, self.constant([2], np.int64))

    def turned(self, value: str) -> str:
        """Matrices (B, i, j) transposed."""
        return self("Transpose", value, perm=[0, 2, 1])

    def squared(self, factor: str) -> str:
        """``L L^T`` of matrices (M, B, i, j)."""
        return self("MatMul", factor, self("Transpose", factor, perm=[0, 1, 3, 2]))

    def mean(self, value: str) -> str:
        """Mean over the members, the first axis."""
        return self("ReduceMean", value, axes=[0], keepdims=0)

    def reciprocal_root(self, z: str) -> str:
        """``1 / sqrt(1 + z^2)``."""
        return self("Reciprocal", self("Sqrt", self("Add", self("Mul", z, z), 1.0)))

    def cube(self, r: str) -> str:
        """``r^3``."""
        return self("Mul", self("Mul", r, r), r)

    def triangular(self, entries: str, size: int) -> str:
        """Lower triangular matrices (M, B, size, size) with positive diagonals from their entries (M, B, t)."""
        rows, columns = np.tril_indices(size)
        place = np.zeros((len(rows), size * size))
        place[np.arange(len(rows)), rows * size + columns] = 1.0
        diagonal = (rows == columns).astype(float)
        positive = self("Mul", self("Exp", self("Mul", entries, diagonal)), diagonal)
        filled = self("Add", self("Mul", entries, 1.0 - diagonal), positive)
        return self.shaped(self("MatMul", filled, place), 0, 0, size, size)

    def inverse(self, matrix: str, size: int) -> str:
        """Inverse of symmetric positive definite matrices (B, size, size) of order one: Gauss-Jordan, no pivoting.

        ONNX has no inverse. Each step eliminates one column of (A | 1) by a rank-one update of the whole.
        """
        unit = np.eye(size)
        work = self("Concat", matrix, self("Add", self("Mul", matrix, 0.0), unit), axis=2)
        for k in range(size):
            index = self.constant([k], np.int64)
            row = self("Gather", work, index, axis=1)
            column = self("Gather", work, index, axis=2)
            row = self("Div", row, self("Gather", row, index, axis=2))
            # The pivot's own row becomes ``row``: everything of it but the unit vector is taken away first.
            others = self("Mul", work, 1.0 - unit[:, [k]])
            column = self("Sub", self("Mul", column, 1.0 - unit[:, [k]]), unit[:, [k]])
            work = self("Sub", others, self("Mul", column, row))
        half = self.split(work, [size, size])[1]
        return self("Mul", self("Add", half, self.turned(half)), 0.5)


def _features(model: Model, g: _Builder) -> Any:
    """Scaled design (B, d) as `Features.design` has it; zeros (1, 1) if there is none."""
    space = model.robot.design_space
    columns: list[str] = []

    def scaled(value: str, low: float, high: float) -> str:
        return g("Sub", g("Mul", g("Sub", value, low), 2.0 / (high - low)), 1.0)

    for name in model.features.learned:
        variable = space[name]
        value = g("Gather", "design", g.constant([space.names.index(name)], np.int64), axis=1)
        if variable.log:
            columns.append(scaled(g("Log", value), np.log(variable.low), np.log(variable.high)))
        else:
            columns.append(scaled(value, variable.low, variable.high))
        if name == "poisson_ratio":
            low, high = np.log(1.0 - 2.0 * variable.low), np.log(1.0 - 2.0 * variable.high)
            columns.append(scaled(g("Log", g("Sub", 1.0, g("Mul", value, 2.0))), low, high))
    return g("Concat", *columns, axis=1) if columns else np.zeros((1, 1))


def _graph(model: Model, onnx: Any) -> Any:
    """The graph; values of members are (M, B, ...)."""
    from softgym_envs.surrogate.potential.model import coefficient_sizes

    g = _Builder(onnx)
    n, e, w = model.count, model.effectors, model.width
    t = {key: np.asarray(array, dtype=float) for key, array in model.tensors.items()}

    # The body: layers of the design.
    h: Any = _features(model, g)
    for k in range(3):
        h = g("Add", g("MatMul", h, t[f"body.{k}.weight"].swapaxes(1, 2)), t[f"body.{k}.bias"][:, None])
        if k < 2:
            h = g("Mul", h, g.reciprocal_root(h))
    sizes = list(coefficient_sizes(n, e, w).values())
    c1, c2, a, b, quadratic, linear, x0, slope, held, d1, d2 = g.split(h, sizes)
    a, b = (g("Softplus", g("Sub", value, 4.0)) for value in (a, b))
    factor = g.triangular(quadratic, n)
    quadratic = g.mean(g.squared(factor))
    slope = g.shaped(g.mean(slope), -1, e, n)

    # Energy.
    A1, A2, P = t["energy1"], t["energy2"], _softplus(t["pass_on"])
    A1_T, A2_T, P_T = (weight.swapaxes(1, 2) for weight in (A1, A2, P))

    def gradient(u: Any) -> tuple[str, str, str, str]:
        """Gradient without its constant part (B, n); derivatives of the first ramp, curvatures of both."""
        z1 = g("Add", g("MatMul", u, A1_T), c1)
        r1 = g.reciprocal_root(z1)
        h1 = g("Mul", g("Add", z1, g("Reciprocal", r1)), 0.5)
        slope1 = g("Mul", g("Add", g("Mul", z1, r1), 1.0), 0.5)
        z2 = g.sum(g("MatMul", h1, P_T), g("MatMul", u, A2_T), c2)
        r2 = g.reciprocal_root(z2)
        half = g("Mul", a, 0.5)
        upper = g("Mul", half, g("Add", g("Mul", z2, r2), 1.0))
        lower = g("Add", g("MatMul", upper, P), b)
        inner = g("Add", g("MatMul", g("Mul", slope1, lower), A1), g("MatMul", upper, A2))
        column = g.shaped(u if isinstance(u, str) else g.constant(u), -1, n, 1)
        outer = g.shaped(g("MatMul", quadratic, column), -1, n)
        curve1 = g("Mul", g("Mul", g.cube(r1), 0.5), lower)
        return g("Add", g.mean(inner), outer), slope1, curve1, g("Mul", half, g.cube(r2))

    u = g("Div", g("Sub", "displacement", model.middle), model.half_range)
    scaled, slope1, curve1, curve2 = gradient(u)
    if "rest" in t:
        scaled = g("Sub", scaled, gradient(t["rest"][None])[0])
    else:
        scaled = g("Add", scaled, g.mean(linear))
    tangent = g("Add", g("MatMul", g("Mul", g.wide(slope1), A1_T[:, None]), P_T[:, None]), A2_T[:, None])
    first = g("MatMul", g("Mul", g.wide(curve1), A1_T[:, None]), A1[:, None])
    second = g("MatMul", g("Mul", g.wide(curve2), tangent), g("Transpose", tangent, perm=[0, 1, 3, 2]))
    hessian = g("Add", first, second)
    hessian = g("Add", g.mean(hessian), quadratic)

    # Effector, its Jacobian, and the compliance that is left while the actuators are held.
    B1, B2, V, H = (t[key].swapaxes(1, 2) for key in ("shape1", "shape2", "effector", "held"))
    z = g("Add", g("MatMul", u, B1), d1)
    r = g.reciprocal_root(z)
    s1 = g.cube(r)
    z = g("Add", g("MatMul", g("Mul", z, r), B2), d2)
    r = g.reciprocal_root(z)
    last, s2 = g("Mul", z, r), g.cube(r)
    linear_part = g.shaped(g("MatMul", slope, g.shaped(u, -1, n, 1)), -1, e)
    effector = g.sum(g.mean(g("Add", g("MatMul", last, V), x0)), linear_part)
    g("Add", g("Mul", effector, model.effector_scale), model.effector_mean, output="effector")
    inner = g("Mul", g("MatMul", g("Mul", g.wide(s1), B1[:, None]), B2[:, None]), g.wide(s2))
    jacobian = g.turned(g.mean(g("MatMul", inner, V[:, None])))
    jacobian = g("Mul", g("Add", jacobian, slope), model.effector_scale)
    factor = g.triangular(g("Add", held, g("MatMul", last, H)), e)
    C = g("Mul", g.mean(g.squared(factor)), model.held_scale)

    # Efforts and W of the body's own stiffness.
    half = model.half_range
    effort = g("Mul", scaled, model.energy_scale / half)
    flexible = g.inverse(hessian, n)
    moved = g("MatMul", jacobian, flexible)
    W_aa = g("Mul", flexible, half[:, None] * half / model.energy_scale)
    W_ea = g("Mul", moved, half / model.energy_scale)
    W_ee = g("Mul", g("MatMul", moved, g.turned(jacobian)), 0.5 / model.energy_scale)
    W_ee = g.sum(W_ee, g.turned(W_ee), C)
    above = g("Concat", W_aa, g.turned(W_ea), axis=2)
    W = g("Concat", above, g("Concat", W_ea, W_ee, axis=2), axis=1)
    space, variable = model.robot.design_space, model.robot.stiffness_variable
    if variable is None:
        g("Identity", effort, output="effort")
        g("Identity", W, output="W")
    else:
        value = g("Gather", "design", g.constant([space.names.index(variable)], np.int64), axis=1)
        stiffness = g("Div", value, space[variable].baseline)
        g("Mul", effort, stiffness, output="effort")
        g("Div", W, g.wide(stiffness), output="W")
    return _finished(model, g)


def _finished(model: Model, g: _Builder) -> Any:
    """The model of the nodes, with inputs, outputs and metadata, checked."""
    helper = g.onnx.helper
    size = model.size

    def tensor(name: str, *shape: int) -> Any:
        return helper.make_tensor_value_info(name, g.onnx.TensorProto.FLOAT, ["B", *shape])

    robot = model.robot
    inputs = [tensor("design", len(robot.design_space)), tensor("displacement", model.count)]
    outputs = [tensor("effort", model.count), tensor("effector", model.effectors), tensor("W", size, size)]
    graph = helper.make_graph(g.nodes, robot.weights_name, inputs, outputs, initializer=g.constants)
    opset = [helper.make_opsetid("", OPSET)]
    made = helper.make_model(graph, opset_imports=opset, ir_version=IR_VERSION, producer_name="softgym-envs")
    made.producer_version = __version__
    made.doc_string = (
        "Condensed model of a soft robot: efforts that hold its actuators at given displacements, effector positions "
        "[m], and the compliance W of actuators and effectors. SI units."
    )
    variables = [
        {"name": v.name, "low": v.low, "high": v.high, "baseline": v.baseline, "unit": v.unit}
        for v in robot.design_space
    ]
    properties = {
        "robot": robot.name,
        "variant": robot.weights_name,
        "mechanics_key": json.dumps(robot.mechanics_key),
        "design": json.dumps(variables),
        "displacement": json.dumps(_actuators(model)),
        "effector": json.dumps({"names": robot.effectors, "coordinates": "xyz", "unit": "m"}),
        "members": str(model.members),
        "softgym-envs": __version__,
    }
    helper.set_model_props(made, properties)
    g.onnx.checker.check_model(made, full_check=True)
    return made
