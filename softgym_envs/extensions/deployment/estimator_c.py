"""The estimator on a learned model as one self-contained C99 header, and a closed loop with the controller's header."""

from __future__ import annotations

from pathlib import Path
from string import Template

import numpy as np
from scipy.stats import chi2

from softgym_envs.backends.surrogate import TOLERANCE
from softgym_envs.extensions.deployment.c_loads import loaded_text
from softgym_envs.extensions.deployment.c_text import check_identifier, comment, functions, names_of
from softgym_envs.extensions.deployment.common import exportable
from softgym_envs.extensions.fitting.row_errors import KNOTS
from softgym_envs.extensions.sensing.estimator import IMPROBABLE
from softgym_envs.extensions.sensing.learned import PLACES, STEP, LearnedEstimator
from softgym_envs.extensions.sensing.loads import TouchGrid, cell_nodes
from softgym_envs.extensions.sensing.readings import LARGEST_RESIDUAL, MAX_GROWTH
from softgym_envs.storage import atomic_write
from softgym_envs.version import __version__

_HERE = Path(__file__).parent

COMPILE_LOOP = "cc -std=c99 -O3 -fno-math-errno loop.c -o loop -lm"
"""Compiles the example, beside the header of a controller."""


def export_estimator_c(
    estimator: LearnedEstimator,
    grid: TouchGrid,
    folder: str | Path,
    *,
    expected_force: float = 2.0,
    name: str = "softgym",
) -> tuple[Path, Path]:
    """Write an estimator as ``estimator.h``, and ``loop.c``, an example that runs it with a controller.

    The header computes what `LearnedEstimator` computes, and needs only ``math.h``. It contains the learned model with
    the layers that take force and place of a touch, so it finds the model of a touched body where it runs. The example
    needs ``controller.h`` of the same body in the same folder (`export_controller_c`).

    Args:
        estimator: its design, noise, model, and the number and accuracy of its steps.
        grid: whose cells are touched.
        folder: of the two files; it is made if it does not exist.
        expected_force: standard deviation of a force before any reading [N].
        name: prefix of everything the header defines, ``<name>_estimator``, a C identifier.

    Returns:
        The paths of header and program.

    Raises:
        ValueError: for a prefix that is not an identifier, an expected force that is not positive, a grid whose places
            the model does not take, or weights that are not finite in single precision.
    """
    check_identifier(name)
    if not 0.0 < expected_force < np.inf:
        raise ValueError(f"expected_force = {expected_force} N must be positive")
    folder = Path(folder)
    header = _header(estimator, grid, expected_force, name)
    folder.mkdir(parents=True, exist_ok=True)
    program = Template((_HERE / "loop.c.in").read_text()).substitute(
        p=name, P=name.upper(), compile=COMPILE_LOOP, **_example(estimator, grid)
    )
    paths = folder / "estimator.h", folder / "loop.c"
    for path, text in zip(paths, (header, program), strict=True):
        with atomic_write(path, "w") as stream:
            stream.write(text)
    return paths


def _loads(estimator: LearnedEstimator, grid: TouchGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what a touch does to the design of the model.

    Returns:
        The design without force at the first corner of the grid (d,); its derivatives by the force [N] and by both
        indices of cells (3, d); and these indices where the model has learned the body without touch (2,).

    Raises:
        ValueError: if the design does not depend linearly on force and indices.
    """
    robot, space = estimator.robot, estimator.model.robot.design_space
    names, learned = estimator.model.robot.learning.loads, robot.learning.touch
    assert learned is not None  # the estimator refuses other robots
    columns = [space.names.index(name) for name in names]
    untouched = space.complete(estimator.design).array

    def design(force: float, first: float, second: float) -> np.ndarray:
        point = np.array(grid.corner) + grid.pitch * (first * np.array(grid.along) + second * np.array(grid.across))
        touch = learned.design(estimator.design, point, force * np.array(grid.normal))
        found = untouched.copy()
        found[columns] = [touch[name] for name in names]
        return found

    base = design(0.0, 0.0, 0.0)
    loads = np.array([design(1.0, 0.0, 0.0), design(0.0, 1.0, 0.0), design(0.0, 0.0, 1.0)]) - base
    numbers = np.array([1.5, *grid.cells])
    if not np.allclose(design(*numbers), base + numbers @ loads, rtol=0.0, atol=1e-9):
        raise ValueError(f"the learned touch of '{robot.name}' does not depend linearly on force and place")
    indices = np.linalg.lstsq(loads[1:].T, untouched - base, rcond=None)[0]
    if not np.allclose(base + indices @ loads[1:], untouched, rtol=0.0, atol=1e-9):
        raise ValueError(f"the grid does not contain the place of the untouched body of '{robot.name}'")
    return base, loads, indices


def _header(estimator: LearnedEstimator, grid: TouchGrid, expected_force: float, name: str) -> str:
    """Return the text of the header."""
    p, upper = f"{name}_estimator", f"{name.upper()}_ESTIMATOR"
    model = exportable(estimator.model, None)
    robot, noise = estimator.robot, estimator.noise
    n, k, own = model.count, model.sensors, 3 * len(robot.effectors)
    base, loads, untouched = _loads(estimator, grid)
    text, bytes_ = loaded_text(model, base, loads, p)
    coordinates, shares = cell_nodes(PLACES)
    units = model.features.units[n + model.effectors :]
    constants = {
        f"rate[{n}]": model.span,
        f"span[{n}]": model.span,
        f"rest_volume[{k}]": estimator.rest_volumes,
        f"unit[{k}]": units,
        f"log_shares[{len(shares)}]": np.log(shares),
        f"coordinates[{len(shares)}][2]": 0.5 * (coordinates + 1.0),
        f"lower[{n}]": robot.lower,
        f"range[{n}]": robot.upper - robot.lower,
        f"bias[{KNOTS}][{own + k}]": estimator.errors.mean,
        f"deviation[{KNOTS}][{own + k}]": estimator.errors.deviation,
        f"learned[{n}][2]": np.column_stack([model.domain.low, model.domain.high]),
        "largest_force": np.array(estimator.largest_force),
    }
    bytes_ += 8 * sum(array.size for array in constants.values())
    numbers = {
        "slack": 10.0 * TOLERANCE,
        "settled": TOLERANCE,
        "accuracy": estimator.accuracy,
        "volume_noise": noise.volume,
        "displacement_noise": noise.displacement,
        "expected_force": expected_force,
        "improbable": float(chi2.ppf(IMPROBABLE, k)),
        "most_growth": MAX_GROWTH,
        "unexplained": LARGEST_RESIDUAL**2 * k,
    }
    counts = {"most_steps": 26, "steps": estimator.steps, "knots": KNOTS}
    counts |= {"columns": grid.cells[0], "rows": grid.cells[1]}
    names = names_of(p, many=True) | {key: repr(float(value)) for key, value in numbers.items()}
    names |= {key: str(value) for key, value in counts.items()}
    about = [
        f"Estimator of a touched soft robot, written by softgym-envs {__version__} (C99, estimator header format 2):",
        "thesis, sec. 3.3.6, on a learned model: shape, force and place of a touch from volumes of cavities.",
        "",
        f"Robot      {robot.name} ({model.robot.learning.weights})",
        *(
            f"{'Design' if i == 0 else '':10s} {key} = {estimator.design[key]!r}"
            for i, key in enumerate(estimator.design)
        ),
        f"Grid       {grid.cells[0]} x {grid.cells[1]} cells of {grid.pitch:g} m, numbered from 0",
        f"Memory     {bytes_} bytes of constants; the state is the struct",
        "",
        f"void {p}_start({p} *estimator)",
        "    Nothing is known and nothing touched. Call it once before the first reading.",
        "",
        f"int {p}_touch({p} *estimator, const int *cell)",
        "    Another cell is touched from now on, given by two indices; NULL: nothing. Call it when that changes.",
        "    Returns 0; or 1, and the estimator unchanged, if the grid does not have the cell.",
        "",
        f"int {p}_update({p} *estimator, const double command[{n}], const double volumes[{k}],",
        f"                           {p}_result *result)",
        "    One reading: displacements that the actuators are commanded [m], volumes of the cavities [m3]. Readings",
        "    in a row under one command are explained together by their mean. The result holds means and covariances",
        "    over all that explains the readings. Under a command that the model has not learned, and for readings",
        "    that nothing explains, result->distrust says so, and the reading is forgotten.",
        "    Returns 0; or, with everything unchanged, 1 if an input is not finite or a volume is impossible, as in a",
        "    wrong unit, 2 if the model finds no state.",
        "",
        "Nothing is allocated; the only state is in the struct. Do not compile with -ffast-math, which removes the",
        f"checks for values that are not finite. #define {upper}_REAL float before the header halves the state and",
        "avoids double precision in most of the work on distributions.",
    ]
    parts = [
        comment(about),
        f"#ifndef {upper}_H\n#define {upper}_H\n\n#include <math.h>\n#include <stddef.h>\n",
        text,
        f"#define {upper}_SENSORS {k} /* volumes of cavities */",
        f"#define {upper}_OWN {own} /* coordinates of the robot's own effectors, of which a touched point is none */",
        f"#define {upper}_UNKNOWNS {n + 1} /* errors of the actuators, and the force */",
        f"#define {upper}_PLACES {len(shares)} /* in a cell */\n",
        *(f"static const double {p}_{key} = {_braces(array)};" for key, array in constants.items()),
        f"static const float {p}_untouched[2] = {_braces(untouched.astype(np.float32))};",
        f"static const float {p}_force_step = {STEP * estimator.stiffness!r}f;",
        f"static const int {p}_known_body = {int(estimator.knows_body)};",
        f"static const int {p}_unilateral[{n}] = {_braces(robot.unilateral.astype(int))};\n",
        functions("qp", names),
        functions("evaluate", names),
        functions("settle", names),
        Template((_HERE / "estimator.h.in").read_text()).substitute(names),
        f"#endif /* {upper}_H */\n",
    ]
    return "\n".join(parts)


def _example(estimator: LearnedEstimator, grid: TouchGrid) -> dict[str, str]:
    """Return the numbers of the example: a touch in the lower part of the grid, and the goal without it."""
    model, robot = estimator.model, estimator.robot
    command = (robot.lower + 0.3 * (robot.upper - robot.lower))[None]
    context = model.context(model.robot.design_space.complete(estimator.design).array[None])
    goal = model.effector(context, command)[0][0, : 3 * len(robot.effectors)]
    cell = grid.cells[0] // 2, (3 * grid.cells[1]) // 4
    return {
        "goal": ", ".join(f"{value:.6f}" for value in goal),
        "cell": ", ".join(map(str, cell)),
        "force": f"{0.3 * estimator.largest_force:.3f}",
    }


def _braces(array: np.ndarray) -> str:
    """Return numbers as a C initialiser."""
    if array.ndim == 0:
        return repr(array.item())
    return "{" + ", ".join(_braces(part) for part in np.asarray(array)) + "}"
