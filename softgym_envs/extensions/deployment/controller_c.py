"""A controller as one self-contained C99 header: learned model, inverse QP and PI correction (thesis, algorithm 2)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from string import Template

import numpy as np

from softgym_envs.backends.surrogate import solve_displacements
from softgym_envs.control.inverse_qp import InverseQP
from softgym_envs.control.pi_correction import PICorrection
from softgym_envs.extensions.deployment.c_text import check_identifier, comment, functions, names_of
from softgym_envs.extensions.deployment.common import exportable
from softgym_envs.extensions.deployment.embedded import MAX_SETTLING_STEPS, SETTLED, SLACK, settling_span
from softgym_envs.extensions.deployment.surrogate_c import header_text
from softgym_envs.robots.base import Robot
from softgym_envs.storage import atomic_write
from softgym_envs.surrogate.model import SurrogateModel
from softgym_envs.surrogate.potential.model import Model
from softgym_envs.units import effort_unit
from softgym_envs.version import __version__
from softgym_envs.wording import counted

_HERE = Path(__file__).parent
_UNBOUNDED = 1e30

COMPILE = "cc -std=c99 -O3 -fno-math-errno main.c -o main -lm"
"""Compiles the example."""

#: What the two drives do differently, as C.
_STATE = {
    "displacement": """\
    if (${p}_settle(controller->command, controller->displacement, effort, effector, W, K, slack))
        return 2;
    for (i = 0; i < N; ++i)
        if (slack[i] || (${p}_unilateral[i] && effort[i] < 0.0))
            effort[i] = 0.0;""",
    "effort": """\
    if (${p}_evaluate(controller->displacement, effort, effector, W) || ${p}_stiffness(W, K))
        return 2;""",
}
_BOUNDS = {
    "displacement": """\
        first[i] = least;
        last[i] = most;
        low[N + i] = fmax(-fmax(effort[i] - ${p}_least_effort[i], 0.0), -${p}_effort_rate[i]);
        high[N + i] = fmin(${p}_most_effort[i] - effort[i], ${p}_effort_rate[i]);
""",
    "effort": """\
        value = controller->command[i];
        first[i] = ${p}_clip(value - ${p}_effort_rate[i], ${p}_least_effort[i], ${p}_most_effort[i]);
        last[i] = ${p}_clip(value + ${p}_effort_rate[i], ${p}_least_effort[i], ${p}_most_effort[i]);
        low[N + i] = first[i] - effort[i];
        high[N + i] = last[i] - effort[i];
""",
}
_PREDICT = {
    "displacement": """\
    for (i = 0; i < N; ++i) {
        controller->displacement[i] += scale[i] * x[i];
        controller->effort[i] = next[i];
    }
""",
    "effort": """\
    for (i = 0; i < N; ++i)
        controller->effort[i] = next[i] = command[i];
    for (i = 0; i < N; ++i)
        for (j = 0; j < N; ++j)
            controller->displacement[i] += W[i * S + j] * (next[j] - effort[j]);
""",
}
_START = {
    "displacement": "    return 0;\n",
    "effort": """\
    {
        float W[(${P}_ACTUATORS + ${P}_COORDINATES) * (${P}_ACTUATORS + ${P}_COORDINATES)];
        double effort[${P}_ACTUATORS];
        int j;
        if (${p}_evaluate(controller->displacement, effort, controller->effector, W))
            return 1;
        for (i = 0; i < ${P}_ACTUATORS; ++i) /* the displacements without effort, to first order */
            for (j = 0; j < ${P}_ACTUATORS; ++j)
                controller->displacement[i] -= W[i * (${P}_ACTUATORS + ${P}_COORDINATES) + j] * effort[j];
        return 0;
    }
""",
}
_FROM = {"displacement": "controller->command[i]", "effort": "controller->displacement[i]"}
_COMMAND = {
    "displacement": "${p}_clip(controller->displacement[i] + scale[i] * x[i], first[i], last[i])",
    "effort": "${p}_clip(next[i], first[i], last[i])",
}


def export_controller_c(
    model: SurrogateModel,
    design: Mapping[str, float] | None,
    folder: str | Path,
    *,
    controller: InverseQP | None = None,
    correction: PICorrection | None = None,
    members: int | None = None,
    name: str = "softgym",
    robot: Robot | None = None,
) -> tuple[Path, Path]:
    """Write the controller of one body as ``controller.h``, and ``main.c``, an example that steps it.

    The header computes what `EmbeddedLoop` computes on the same model, and needs only ``math.h``. It includes the
    header of `export_c`. The program runs the loop on the model itself in place of a robot; its first comment states
    how to compile it.

    Args:
        model: a trained model of network ``"potential"``.
        design: the body, in SI units; missing variables take their baseline.
        folder: of the two files; it is made if it does not exist.
        controller: ranges, rates, weights and the quantity that is commanded, the same for all actuators; default
            `InverseQP.for_robot`, which commands displacements.
        correction: gains and limits of the closed loop; default `PICorrection` with the gains of the thesis.
        members: how many members of the ensemble are averaged; default all that the model uses.
        name: prefix of everything the header defines, a C identifier.
        robot: whose design and effectors are controlled; default that of the model. A robot whose touch is learned has
            a model with more of both.

    Returns:
        The paths of header and program.

    Raises:
        DesignError: for a malformed design.
        ValueError: for an unsupported network or number of members, a prefix that is not an identifier, weights that
            are not finite in single precision, or a controller of another number of actuators or of both quantities.
    """
    check_identifier(name)
    folder = Path(folder)
    potential, robot = exportable(model, members), robot or model.robot
    controller = InverseQP.for_robot(robot) if controller is None else controller
    if len(controller.rates) != potential.count:
        raise ValueError(
            f"the controller has {counted(len(controller.rates), 'actuator')}, the model {potential.count}"
        )
    if controller.by_effort.any() != controller.by_effort.all():
        raise ValueError("the controller commands displacements and efforts; allowed: one quantity for all actuators")
    drive = "effort" if controller.by_effort.all() else "displacement"
    header = _header(potential, robot, design, controller, correction or PICorrection(), drive, name)
    folder.mkdir(parents=True, exist_ok=True)
    paths = folder / "controller.h", folder / "main.c"
    for path, text in zip(paths, (header, _program(potential, robot, design, controller, drive, name)), strict=True):
        with atomic_write(path, "w") as stream:
            stream.write(text)
    return paths


def _header(
    model: Model,
    robot: Robot,
    design: Mapping[str, float] | None,
    controller: InverseQP,
    correction: PICorrection,
    drive: str,
    name: str,
) -> str:
    """Return the text of the header."""
    n, e, upper = model.count, 3 * len(robot.effectors), name.upper()
    goal_weights = np.ones(e) if controller.goal_weights is None else controller.goal_weights
    constants = {
        "lower": controller.lower,
        "upper": controller.upper,
        "rate": controller.rates,
        "span": settling_span(controller),
        "least_effort": controller.min_effort,
        "most_effort": controller.max_effort,
        "effort_rate": controller.effort_rates,
        "goal_weight": goal_weights,
    }
    if drive == "effort":
        del constants["span"]
    unit = effort_unit(model.robot.actuators[0].unit) if drive == "effort" else model.robot.actuators[0].unit
    about = [
        f"Controller of a soft robot, written by softgym-envs {__version__} (C99, controller header format 1):",
        "thesis, algorithm 2: learned condensed model, inverse QP with bounds, and a PI correction of the goal.",
        "",
        f"Commands {drive}s in {unit}.",
        "",
        f"int {name}_controller_start({name}_controller *controller)",
        "    Go to rest. Call it once before the first step. Returns 0; or 1 if the model has no result.",
        "",
        f"int {name}_controller_step({name}_controller *controller, const double goal[{e}],",
        f"                           const double *measured, double command[{n}])",
        "    The next command towards a goal of the effector [m]. measured: effector [m], or NULL for an open loop.",
        "    Returns 0; or, with command unchanged, 1 if an input is not finite, 2 if the model finds no state, 3 if",
        "    no command satisfies all bounds.",
        "",
        "All quantities are in SI units. Nothing is allocated; the only state is in the struct. Do not compile with",
        "-ffast-math, which removes the checks for values that are not finite.",
    ]
    names = names_of(name) | {"slack": repr(SLACK), "settled": repr(SETTLED), "most_steps": str(MAX_SETTLING_STEPS)}
    numbers = {
        "proportional": correction.proportional,
        "integral": correction.integral,
        "limit": correction.limit,
        "slip": correction.slip,
        "effort_weight": float(controller.effort_weight),
        "step_weight": float(controller.step_weight),
    }
    pieces = {"start": _START, "state": _STATE, "from": _FROM, "bounds": _BOUNDS, "command": _COMMAND} | {
        "predict": _PREDICT
    }
    body = Template((_HERE / "controller.h.in").read_text()).substitute(
        names,
        quantity=f"{drive}s [{unit}]",
        **{key: repr(float(value)) for key, value in numbers.items()},
        **{key: Template(piece[drive]).substitute(names) for key, piece in pieces.items()},
    )
    parts = [
        comment(about),
        header_text(model, design, name, robot),
        f"#ifndef {upper}_CONTROLLER_H\n#define {upper}_CONTROLLER_H\n",
        *(
            f"static const double {name}_{key}[{len(value)}] = {{{', '.join(map(_literal, value))}}};"
            for key, value in constants.items()
        ),
        *(
            [f"static const int {name}_unilateral[{n}] = {{{', '.join(str(int(v)) for v in controller.unilateral)}}};"]
            if drive == "displacement"
            else []
        ),
        "",
        functions("qp", names),
        functions("evaluate", names),
        *([functions("settle", names)] if drive == "displacement" else []),
        body,
        f"#endif /* {upper}_CONTROLLER_H */\n",
    ]
    return "\n".join(parts)


def _program(
    model: Model, robot: Robot, design: Mapping[str, float] | None, controller: InverseQP, drive: str, name: str
) -> str:
    """Return the text of the example: its goal is where 30 % of every second actuator's range moves the effector."""
    space, e = model.robot.design_space, 3 * len(robot.effectors)
    command = (robot.lower + 0.3 * (robot.upper - robot.lower) * (np.arange(model.count) % 2 == 0))[None]
    context = model.context(space.complete(robot.design_space.complete(design)).array[None])
    goal = solve_displacements(model, context, command, np.zeros_like(command), robot.unilateral).effector[:, :e]
    weights = np.ones(e) if controller.goal_weights is None else controller.goal_weights
    return Template((_HERE / "main.c.in").read_text()).substitute(
        p=name,
        P=name.upper(),
        goal=", ".join(f"{value:.6f}" for value in goal[0]),
        weights=", ".join(_literal(float(weight > 0.0)) for weight in weights),
        drive=drive,
        compile=COMPILE,
    )


def _literal(value: float) -> str:
    """Return a number as C source; unbounded ones become 1e30."""
    return repr(float(np.clip(value, -_UNBOUNDED, _UNBOUNDED)))
