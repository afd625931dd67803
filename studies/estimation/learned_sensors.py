"""The sensorized finger on its learned model: errors by stratum, and the estimator with a plant of finite elements.

``softgym bench learned_sensors learned_sensors_4cavities`` records both; ``python -m benchmarks.learned_sensors 4``
prints those of the finger with four cavities.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from benchmarks.estimation import LARGEST_PULL, LENGTH
from benchmarks.recorded import results
from benchmarks.tables import markdown
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.backends.surrogate import SurrogateBackend
from softgym_envs.errors import ConvergenceError
from softgym_envs.estimation import Noise, Readings, Touch, finger_grid
from softgym_envs.estimation.learned import LearnedEstimator
from softgym_envs.estimation.model_errors import measured_errors
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.base import MeshedRobot, Robot
from softgym_envs.robots.registry import make_robot
from softgym_envs.surrogate.calibration import learned_bounds
from softgym_envs.surrogate.pretrained import pretrained_model

BODIES, STATES, TOUCHES, READINGS, FORCE = 16, 4, 150, 10, 1.0
STRATA = {"untouched": None, "touch, 15 to 65 mm": (0.015, 0.065), "touch, 65 to 115 mm": (0.065, 0.115)}


def bodies(learner: MeshedRobot, count: int = BODIES // 2) -> Iterator[tuple[bool, dict[str, float]]]:
    """Yield bodies of the learned box: ``count`` inside of it, then as many vertices, and whether they are vertices.

    Vertices to which the mesh of the baseline does not move are left out: they are not those that are learned.
    """
    rng, bounds = np.random.default_rng(7), learned_bounds(pretrained_model(learner))
    for number in range(2 * count):
        at_bounds = number >= count
        while True:
            shares = rng.integers(2, size=len(bounds)) if at_bounds else rng.random(len(bounds))
            values = zip(bounds.items(), shares, strict=True)
            design = {name: float(low + share * (high - low)) for (name, (low, high)), share in values}
            if learner.body(design).origin == "morphed":
                break
        yield at_bounds, design


def strata(robot: Robot) -> dict[str, float]:
    """Errors of tip, volumes and tension under random commands, on bodies that no weights have seen.

    Touches have up to 2 N at the baseline's stiffness. A state counts for its stratum; slack cables are also counted
    on their own. ``new mesh`` are the untouched states of bodies inside the box with meshes of their own.
    """
    rng, learner = np.random.default_rng(7), robot.under_touch()
    assert isinstance(learner, MeshedRobot)
    found: dict[str, list[tuple[float, float, float]]] = {
        name: [] for name in (*STRATA, "slack cable", "vertices", "new mesh")
    }
    cases = [(at, design, name, learner) for at, design in bodies(learner) for name in STRATA]
    cases += [(False, design, "new mesh", robot) for at, design in bodies(learner) if not at]
    for at_bounds, design, stratum, body in cases:
        backend, place = SurrogateBackend(robot, design), STRATA.get(stratum)
        below = 0.065 if place is None else float(rng.uniform(*place))
        force = 0.0 if place is None else float(rng.uniform(0.0, 2.0))
        load = {"touch_force": force, "touch_below": below, "touch_beside": float(rng.uniform(-0.0075, 0.0075))}
        context = backend.model.context(learner.design_space.complete({**design, **load}).array[None])
        statics = Statics(body.build({**design, **load} if body is learner else design))
        for command in np.sort(rng.uniform(robot.lower[0], robot.upper[0], STATES)):
            try:
                truth = statics.solve([command])
            except ConvergenceError:
                continue
            target = np.array([[command]])
            reached, effort, _ = backend.model.search(context, target, target, robot.unilateral, 5e-5, 25)
            tip = np.linalg.norm(backend.model.effector(context, reached)[0][0, :3] - truth.condensed.delta.e[:3])
            volumes = np.abs(backend.model.sensed(context, reached)[0] - truth.condensed.delta.s).max()
            tension = abs(max(float(effort[0, 0]), 0.0) - float(truth.effort[0]))
            row = (1e3 * float(tip), 1e9 * float(volumes), tension)
            slack = bool(truth.slack[0])
            names = ["vertices"] if at_bounds else [stratum, *(["slack cable"] if slack else [])]
            for name in names:
                found[name].append(row)
    result: dict[str, float] = {}
    for name, rows in found.items():
        result[f"{name}: states"] = len(rows)
        if not rows:
            continue
        for quantity, values in zip(("tip [mm]", "volume [mm3]", "tension [N]"), np.array(rows).T, strict=True):
            result[f"{name}: {quantity}, mean"] = float(values.mean())
            result[f"{name}: {quantity}, worst"] = float(values.max())
    return result


@dataclass(frozen=True)
class Setting:
    """What the estimator reads, and what it knows of its model's errors.

    Attributes:
        fem: whether the plant is finite elements; otherwise it is the model itself.
        many: whether each touch is on another body of the learned box; otherwise all are on the baseline.
        calibrated: whether the errors of the model were measured on the body; otherwise they are those of the weights.
    """

    fem: bool = True
    many: bool = False
    calibrated: bool = False


SETTINGS = {
    "unseen bodies": Setting(many=True),
    "baseline": Setting(),
    "baseline, calibrated": Setting(calibrated=True),
    "the model itself": Setting(fem=False),
}
"""Plants by name."""


def estimates(robot: MeshedRobot, setting: Setting) -> dict[str, float]:
    """Errors, coverage and speed of the estimator on the learned model.

    Noise of the volumes is 1 % of their change under the full pull; touches are random points of the 5 mm grid. Those
    of the calibration have another seed.
    """
    rng, grid, learner = np.random.default_rng(3), finger_grid(), robot.under_touch()
    assert isinstance(learner, MeshedRobot)
    change = Statics(robot.build()).solve([LARGEST_PULL]).condensed.delta.s
    noise = Noise(displacement=1e-4, volume=0.01 * float(np.abs(change).mean()))
    model, errors = pretrained_model(learner), None
    if setting.calibrated:
        errors = measured_errors(SurrogateBackend(robot), FEMBackend(robot), grid)
    names = ("tip", "force", "inside", "force inside", "known", "below", "first", "later")
    kept: dict[str, list[float]] = {name: [] for name in names}
    others = (design for at_bounds, design in bodies(learner, TOUCHES) if not at_bounds)
    for _ in range(TOUCHES):
        design = robot.design_space.complete(next(others) if setting.many else None)
        cell = (int(rng.integers(grid.cells[0])), int(rng.integers(grid.cells[1])))
        place = rng.uniform(-1.0, 1.0, (1, 2))
        point = grid.inside(cell, place)[0]
        command = np.array([rng.uniform(0.001, LARGEST_PULL)])
        pull = command + noise.displacement * rng.standard_normal(1)
        force = 0.0
        while not 0.2 <= force <= 2.0:
            force = abs(FORCE * float(rng.standard_normal()))
        load = {**design, **robot.touch_design(design, point, force * np.array(grid.normal))}
        if setting.fem:
            try:
                state = Statics(learner.build(load)).solve(pull)
            except ConvergenceError:
                continue
            volumes, tip = state.condensed.delta.s, state.condensed.delta.e[:3]
        else:
            context = model.context(learner.design_space.complete(load).array[None])
            reached = model.search(context, pull[None], pull[None], robot.unilateral, 5e-5, 25)[0]
            volumes, tip = model.sensed(context, reached)[0], model.effector(context, reached)[0][0, :3]
        estimator = LearnedEstimator(
            robot, design=design, noise=noise, model=model, exact=not setting.fem, errors=errors
        )
        estimator.touch(Touch(grid, cell, FORCE))
        for number in range(READINGS):
            measured = estimator.rest_volumes + volumes + noise.volume * rng.standard_normal(len(volumes))
            begin = time.process_time()
            found = estimator.update(Readings(command, measured))
            kept["later" if number else "first"].append(time.process_time() - begin)
        error, spread = found.effector - tip, float(np.sqrt(found.load_covariance[0, 0]))
        values, axes = np.linalg.eigh(found.effector_covariance)
        known = values > 1e-6 * values[-1]
        kept["tip"].append(float(np.linalg.norm(error)) / LENGTH)
        kept["force"].append(abs(float(found.load[0]) - force) / force)
        inside = float(((axes.T @ error)[known] ** 2 / values[known]).sum()) <= chi2.ppf(0.95, known.sum())
        kept["inside"].append(float(inside))
        kept["force inside"].append(float(abs(found.load[0] - force) <= 1.96 * spread))
        kept["known"].append(float(spread <= 0.1 * found.load[0]))
        kept["below"].append(-float(point[2]))
    certain, sizes, far = np.array(kept["known"], dtype=bool), np.array(kept["force"]), np.array(kept["below"]) > 0.055
    return {
        "touches": len(sizes),
        "tip error, mean [% of length]": 100 * float(np.mean(kept["tip"])),
        "tip error, 95 % [% of length]": 100 * float(np.percentile(kept["tip"], 95)),
        "tip error, worst [% of length]": 100 * float(np.max(kept["tip"])),
        "force error, median [%]": 100 * float(np.median(sizes)),
        "force error, mean [%]": 100 * float(sizes.mean()),
        "force error, mean, 55 to 115 mm below the flange [%]": 100 * float(sizes[far].mean()),
        "force claimed to 10 % [% of touches]": 100 * float(certain.mean()),
        "force error of these, mean [%]": 100 * float(sizes[certain].mean()) if certain.any() else float("nan"),
        "coverage, tip [%]": 100 * float(np.mean(kept["inside"])),
        "coverage, force [%]": 100 * float(np.mean(kept["force inside"])),
        "first readings of a touch [1/CPU s]": 1.0 / float(np.mean(kept["first"][1:])),
        "later readings [1/CPU s]": 1.0 / float(np.mean(kept["later"])),
    }


def _record(cavities: int) -> dict[str, object]:
    """Errors of the learned sensorized finger by stratum, and of the estimator on it."""
    robot = make_robot("sensorized_finger", cavities=cavities, meshing="morph")
    assert isinstance(robot, MeshedRobot)
    result: dict[str, object] = {
        f"stratum: {name}": value for name, value in strata(make_robot("sensorized_finger", cavities=cavities)).items()
    }
    for name, setting in SETTINGS.items():
        result |= {f"plant: {name}: {key}": value for key, value in estimates(robot, setting).items()}
    return result


def learned_sensors() -> dict[str, object]:
    """Errors of the learned sensorized finger with two cavities by stratum, and of the estimator on it."""
    return _record(2)


def learned_sensors_4cavities() -> dict[str, object]:
    """Errors of the learned sensorized finger with four cavities by stratum, and of the estimator on it."""
    return _record(4)


GROUPS = {2: "learned_sensors", 4: "learned_sensors_4cavities"}
"""Recorded results by the number of cavities."""


def strata_table() -> str:
    """Mean and worst errors of each stratum."""
    quantities = ("tip [mm]", "volume [mm3]", "tension [N]")
    rows = []
    for cavities, group in GROUPS.items():
        found = results(group)
        for name in (*STRATA, "slack cable", "vertices", "new mesh"):
            if not found[f"stratum: {name}: states"]:
                continue
            errors = [[found[f"stratum: {name}: {q}, {kind}"] for kind in ("mean", "worst")] for q in quantities]
            cells = (f"{mean:.2f}, {worst:.2f}" for mean, worst in errors)
            rows.append([str(cavities), name, str(found[f"stratum: {name}: states"]), *cells])
    heads = [f"{quantity}: mean, worst" for quantity in quantities]
    return markdown(["cavities", "stratum", "states", *heads], rows, "rlrrrr")


def estimates_table() -> str:
    """Results of the estimator with all plants."""
    plants = [(group, cavities, name) for cavities, group in GROUPS.items() for name in SETTINGS]
    first = f"plant: {next(iter(SETTINGS))}: "
    names = [name.removeprefix(first) for name in results(GROUPS[2]) if name.startswith(first)]
    rows = [[name, *(f"{results(g)[f'plant: {plant}: {name}']:.3g}" for g, _, plant in plants)] for name in names]
    return markdown(["", *(f"{cavities}: {plant}" for _, cavities, plant in plants)], rows, "l" + "r" * len(plants))


TABLES = {"learned_sensors_strata": strata_table, "learned_sensors_estimates": estimates_table}
"""Tables of pages by name."""

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cavities", type=int, choices=GROUPS, nargs="?", default=2)
    json.dump(_record(parser.parse_args().cavities), sys.stdout, indent=2)
