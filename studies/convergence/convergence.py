"""Convergence of every robot with its mesh: baseline and five random bodies on three levels, with estimates of errors.

The levels are the mesh ``accurate``, one coarser and one finer in the same proportions (for most robots the mesh
``reference``). Their values ``f(h) = f(0) + c h^p`` give the order ``p`` and the converged value (Richardson 1911,
Roache 1994). Orders of meshes that are not nested scatter, so an order outside 0.5 to 4 is replaced by the nearer
bound. The published mesh is compared with the same converged value.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import gymnasium
import numpy as np

import softgym_envs  # noqa: F401  (registers the environments)
from benchmarks.recorded import results
from softgym_envs.designs import DesignSpace
from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.base import Robot
from softgym_envs.robots.registry import make_robot
from softgym_envs.surrogate.correction import order_of
from softgym_envs.testing import box_mesh

MM = 1e-3

BODIES = 5
"""Random bodies of each robot besides its baseline."""


@dataclass(frozen=True)
class Study:
    """Levels and command of one robot.

    Attributes:
        robot: registered name.
        levels: options of the levels from coarse to fine, by name; the second is the mesh ``accurate``.
        sizes: of their elements, in any unit, shape (3,); None: the cube root of volume per unknown, where the outline
            keeps elements from growing in proportion.
        command: displacements of the actuators.
        options: further options of the robot.
        steps: increments in which the command is reached.
    """

    robot: str
    levels: Mapping[str, Mapping[str, Any]]
    sizes: tuple[float, float, float] | None
    command: tuple[float, ...]
    options: Mapping[str, Any]
    steps: int = 2


def scaled(size: float, ratio: float = 0.6) -> tuple[dict[str, dict[str, Any]], tuple[float, float, float]]:
    """Return levels whose elements are larger and smaller than those of ``accurate`` [m] by a ratio."""
    sizes = (size / ratio, size, size * ratio)
    names = ("coarser", "accurate", "finer")
    levels = {name: {"mesh": "accurate", "mesh_size": h} for name, h in zip(names, sizes, strict=True)}
    return levels, sizes


def beams(counts: Sequence[int]) -> tuple[dict[str, dict[str, Any]], tuple[float, float, float]]:
    """Return levels with these numbers of beam elements: those of ``published``, ``accurate`` and ``reference``."""
    names = ("published", "accurate", "reference")
    coarse, middle, fine = (1.0 / count for count in counts)
    return {name: {"mesh": name} for name in names}, (coarse, middle, fine)


TRUNK_LEVELS = {
    "coarser": {"mesh": "accurate", "layers": 12, "rings": 1},
    "accurate": {"mesh": "accurate"},
    "finer": {"mesh": "reference"},
}

GRIPPER_LEVELS = {
    "coarser": {"mesh": "accurate", "mesh_size": 10 * MM},
    "accurate": {"mesh": "accurate"},
    "finer": {"mesh": "reference"},
}
GRIPPER_SIZES = (10 * MM, 6 * MM, 4.2 * MM)

STUDIES = {
    "finger": Study("finger", *scaled(10 * MM), (10 * MM, 10 * MM), {"self_contact": False}),
    "finger_sideways": Study("finger", *scaled(10 * MM), (10 * MM, 8 * MM), {"self_contact": False}),
    "finger_1cable": Study("finger", *scaled(10 * MM), (10 * MM,), {"cables": 1, "self_contact": False}),
    "diamond": Study("diamond", scaled(17 * MM)[0], None, (15 * MM, 0.0, 0.0, 0.0), {}, steps=4),
    "cable_trunk": Study(
        "cable_trunk",
        TRUNK_LEVELS,
        (1.0, 1 / 2, 1 / 3),
        (15 * MM, 0.0, 0.0, 0.0, 5 * MM, 0.0, 0.0, 0.0),
        {},
        steps=3,
    ),  # fmt: skip
    # Each body of a gripper takes five to ten CPU minutes and up to 8 GB.
    "two_finger_gripper": Study(
        "two_finger_gripper", GRIPPER_LEVELS, GRIPPER_SIZES, (6 * MM, 4 * MM, 4 * MM, 2 * MM), {}
    ),
    "three_finger_gripper": Study(
        "three_finger_gripper",
        GRIPPER_LEVELS,
        GRIPPER_SIZES,
        (4 * MM, 2 * MM, 4 * MM, 2 * MM, 3 * MM, 3 * MM),
        {},
    ),
    "contact_aided_finger": Study("contact_aided_finger", *scaled(8 * MM), (math.radians(10.0),), {}),
    "trunk": Study("trunk", *beams((5, 10, 20)), (20e-9, 0.0, 0.0, 10e-9, 0.0, 0.0), {}),
    "tetrapod": Study("tetrapod", *beams((6, 12, 24)), (0.5, 0.0, 0.0, 0.0), {}),
}
"""Studies by name. ``finger_sideways`` shows where the errors of grippers come from."""


@dataclass(frozen=True)
class Level:
    """One body on one mesh.

    Attributes:
        body: ``"baseline"``, or the number of a random body.
        mesh: name of the level.
        unknowns: number of equations.
        tip: displacement of the effector by the command [mm], shape (3,).
        effort: of the first actuator.
        compliance: ``W_aa`` of the first actuator at rest.
        seconds: CPU time of the last increment.
        slack: number of cables that the command leaves slack.
        failure: why there is no value.
    """

    body: str
    mesh: str
    unknowns: int
    tip: tuple[float, ...]
    effort: float
    compliance: float
    seconds: float
    slack: int = 0
    failure: str = ""


def order_and_limit(values: Sequence[Any], sizes: Sequence[float]) -> tuple[float, Any]:
    """Return the observed order, within its bounds, and the converged value of a quantity on three meshes.

    Args:
        values: on the coarse, middle and fine mesh: numbers or vectors; the order of vectors is that of their norms.
        sizes: of the elements, decreasing.
    """
    coarse, middle, fine = (np.asarray(value, dtype=float) for value in values)
    first, second = (float(np.linalg.norm(difference)) for difference in (coarse - middle, middle - fine))
    order = order_of(first / second if second else math.inf, sizes)
    limit = fine + (fine - middle) / ((sizes[1] / sizes[2]) ** order - 1.0)
    return order, limit if limit.ndim else float(limit)


def measure(robot: Robot, design: Mapping[str, float], body: str, mesh: str, study: Study) -> Level:
    """Return tip, effort and compliance of one body on one mesh."""
    unknowns = 0
    nan = float("nan")
    try:
        model = robot.build(design)
        unknowns = model.equations
        statics = Statics(model)
        rest = statics.solve(np.zeros(len(robot.actuators)))
        for k in range(study.steps):
            start = time.process_time()
            state = statics.solve((k + 1) / study.steps * np.array(study.command))
            seconds = time.process_time() - start
    except (ConvergenceError, InfeasibleDesign) as error:
        return Level(body, mesh, unknowns, (nan,) * 3, nan, nan, nan, failure=str(error))
    tip = 1e3 * (state.condensed.delta.e[:3] - rest.condensed.delta.e[:3])
    compliance = float(rest.condensed.W.aa[0, 0])
    slack = int((robot.unilateral & (state.condensed.delta.a > np.array(study.command) + 1e-9)).sum())
    return Level(body, mesh, unknowns, tuple(map(float, tip)), float(state.effort[0]), compliance, seconds, slack)


def converge(name: str) -> dict[str, object]:
    """Convergence of one robot: all levels of the baseline and the random bodies, and estimates of the errors."""
    study = STUDIES[name]
    meshes = {"published": {"mesh": "published"}, **study.levels}
    robots = {mesh: make_robot(study.robot, **study.options, **options) for mesh, options in meshes.items()}
    rng = np.random.default_rng(17)
    first = next(iter(robots.values()))
    designs = {"baseline": first.design_space.baseline}
    designs |= {str(k + 1): first.design_space.sample(rng) for k in range(BODIES)}
    rows = []
    for body, design in designs.items():
        for mesh, robot in robots.items():
            rows.append(measure(robot, design, body, mesh, study))
            print(f"  {name} {rows[-1]}", flush=True)
    return {
        "command": list(study.command),
        "sizes": study.sizes and list(study.sizes),
        "designs": {body: dict(design) for body, design in designs.items()},
        "rows": [asdict(row) for row in rows],
        "errors": errors(rows, list(study.levels), study.sizes),
    }


def errors(rows: Sequence[Level], levels: Sequence[str], given: Sequence[float] | None) -> dict[str, dict[str, Any]]:
    """Return for each body the converged values, orders, and relative errors of every mesh."""
    found: dict[str, dict[str, Any]] = {}
    for body in dict.fromkeys(row.body for row in rows):
        of_body = {row.mesh: row for row in rows if row.body == body}
        if any(of_body[level].failure for level in levels):
            continue
        sizes = given or [of_body[level].unknowns ** (-1.0 / 3.0) for level in levels]
        tip_order, tip = order_and_limit([of_body[level].tip for level in levels], sizes)
        effort_order, effort = order_and_limit([of_body[level].effort for level in levels], sizes)
        found[body] = {
            "tip [mm]": tip.tolist(),
            "tip, order": tip_order,
            "effort": effort,
            "effort, order": effort_order,
            "meshes": {
                mesh: {
                    "tip": float(np.linalg.norm(row.tip - tip) / np.linalg.norm(tip)),
                    "effort": row.effort / effort - 1.0,
                }
                for mesh, row in of_body.items()
            },
        }
    return found


# -- the finger: what elements cost, fillets, and remeshing along a line of designs -----------------------------------


STEPS, SIZES = 20, {"16.7 mm": 10 * MM / 0.6, "13 mm": 13 * MM, "10 mm (`accurate`)": 10 * MM}
"""Control steps, and sizes of the elements, in the comparison of costs."""


def finger_costs() -> dict[str, object]:
    """Control steps per CPU second of the accurate finger against the size of its elements, beside their errors.

    Steps are those of FingerReach under random actions, with self-contact. Errors are those of the baseline and the
    random bodies of the finger's study against its recorded converged values.
    """
    study, known = STUDIES["finger"], results("convergence_finger")
    rows = []
    for name, size in SIZES.items():
        options = {"mesh": "accurate", "mesh_size": size}
        env = gymnasium.make("SoftGym/FingerReach-v0", backend="fem", robot_options=options)
        env.action_space.seed(0)
        env.reset(seed=0)
        seconds = []
        for _ in range(STEPS):
            start = time.process_time()
            env.step(env.action_space.sample())
            seconds.append(time.process_time() - start)
        robot, tips, efforts = make_robot("finger", **options, **study.options), [], []
        for body, converged in known["errors"].items():
            level = measure(robot, known["designs"][body], body, name, study)
            tip = np.array(converged["tip [mm]"])
            tips.append(float(np.linalg.norm(level.tip - tip) / np.linalg.norm(tip)))
            efforts.append(level.effort / converged["effort"] - 1.0)
        rows.append(
            {
                "elements": name,
                "unknowns": level.unknowns,
                "steps per CPU second": 1.0 / statistics.median(seconds),
                "tip": tips,
                "effort": efforts,
            }
        )
        print(f"  {rows[-1]}", flush=True)
    return {"bodies": list(known["errors"]), "rows": rows}


def fillets() -> dict[str, object]:
    """Tension and tip of the two-cable finger at 10 mm against the radius of its re-entrant edges."""
    study, rows = STUDIES["finger"], []
    for radius in (0.0, 0.5 * MM, 1.0 * MM):
        robot = make_robot("finger", mesh="accurate", self_contact=False, fillet=radius)
        rows.append(asdict(measure(robot, robot.design_space.baseline, f"{1e3 * radius:g} mm", "accurate", study)))
        print(f"  {rows[-1]}", flush=True)
    return {"rows": rows}


def scatter() -> dict[str, object]:
    """Scatter of tension and tip of the two-cable finger over the length of its segments, 36 to 44 mm.

    Relative deviations from a fitted quadratic polynomial: those of a smooth response are far below those of meshes.
    """
    lengths = np.linspace(0.036, 0.044, 9)
    result: dict[str, object] = {"lengths [m]": lengths.tolist()}
    for meshing in ("morph", "remesh"):
        robot = make_robot("finger", mesh="accurate", self_contact=False, meshing=meshing)
        variables = [
            replace(v, low=lengths[0], high=lengths[-1]) if v.name == "length" else v for v in robot.design_space
        ]
        robot.design_space = DesignSpace(*variables)
        rows = [measure(robot, {"length": float(x)}, f"{x:g}", meshing, STUDIES["finger"]) for x in lengths]
        for name, values in (("tension", [row.effort for row in rows]), ("tip", [row.tip[1] for row in rows])):
            fit = np.polynomial.Polynomial.fit(lengths, values, 2)(lengths)
            result[f"{meshing}: {name}, values"] = values
            result[f"{meshing}: {name}, largest deviation"] = float(np.abs(values / fit - 1.0).max())
            # Three coefficients are fitted.
            spread = np.sqrt(((values / fit - 1.0) ** 2).sum() / (len(lengths) - 3))
            result[f"{meshing}: {name}, standard deviation"] = float(spread)
    return result


# -- guides of cables ---------------------------------------------------------------------------------------------


def guides() -> dict[str, object]:
    """Compliance ``W_aa`` of one cable against the mesh: guides on single points and averaged guides.

    A cable in a cube of silicone of 20 mm, and both cables of the finger.
    """
    cube: dict[str, list[float]] = {}
    for radius in (0.0, 2.0 * MM):
        for cells in (2, 4, 8, 12):
            nodes, tetrahedra = box_mesh((0.02, 0.02, 0.02), (cells,) * 3)
            model = MechanicalModel.from_mesh(nodes, tetrahedra, fixed=nodes[:, 2] == 0.0, element="quadratic")
            model.add_cable("cable", [[0.01, 0.01, 0.014]], [0.01, 0.01, 0.05], radius=radius)
            cube.setdefault(f"{1e3 * radius:g} mm", []).append(_first_compliance(model))
    finger: dict[str, list[float]] = {}
    unknowns = []
    for factor in (1.0 / 0.6, 1.0, 0.6):
        for radius in (0.0, 1.0 * MM, 3.0 * MM):
            size = factor * 10 * MM
            robot = make_robot("finger", mesh="accurate", self_contact=False, mesh_size=size, guide_radius=radius)
            model = robot.build()
            finger.setdefault(f"{1e3 * radius:g} mm", []).append(_first_compliance(model))
        unknowns.append(model.equations)
    return {"cube, cells": [2, 4, 8, 12], "cube [m/N]": cube, "finger, unknowns": unknowns, "finger [m/N]": finger}


def _first_compliance(model: MechanicalModel) -> float:
    actuators = len(model.constraints["a"])
    return float(Statics(model).solve(np.zeros(actuators)).condensed.W.aa[0, 0])


def of(name: str) -> Callable[[], dict[str, object]]:
    """Return the benchmark of one study."""

    def run() -> dict[str, object]:
        return converge(name)

    run.__doc__ = f"Convergence of the robot '{name}' with its mesh."
    return run


BENCHMARKS = {
    "convergence_guides": guides,
    "convergence_finger_costs": finger_costs,
    "convergence_fillets": fillets,
    "convergence_scatter": scatter,
    **{f"convergence_{name}": of(name) for name in STUDIES},
}
"""Benchmarks by name: each robot, guides of cables, fillets, and scatter between designs."""
