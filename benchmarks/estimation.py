"""Accuracy of the estimator on finite elements: touches at random places of the sensorized finger's grid.

``python -m benchmarks.estimation [--cavities 2] [--sealed] [--touches 100] [--readings 10]`` prints a line of JSON.
``softgym bench sealed_finger`` compares volumes of open cavities with pressures of sealed ones, and their stiffness.

Each touch is one body with a random pull, an error of the cable, a force and a place in a cell, constant over a number
of readings with new noise of the volumes. Its place is one point, which is not a corner of the estimator's cell: the
plant is another model than the estimator's. The force is that of the prior, cut off below 0.2 N.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping

import numpy as np
from scipy.stats import chi2

from softgym_envs.errors import ConvergenceError
from softgym_envs.estimation import Estimator, Noise, Touch, finger_grid
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.registry import make_robot

LENGTH, LARGEST_PULL, FORCE = 0.120, 0.010, 2.0


def measure(
    cavities: int,
    touches: int,
    readings: int,
    pitch: float,
    noise_share: float,
    seed: int,
    design: Mapping[str, float],
    sealed: bool = False,
) -> dict[str, float | None]:
    """Return errors, coverage and speed of a body whose missing variables take their baseline.

    The noise of volumes or pressures is a share of their change under the full pull in the baseline, one for all.
    """
    rng = np.random.default_rng(seed)
    robot = make_robot("sensorized_finger", cavities=cavities, sealed=sealed)
    change = Statics(robot.build()).solve([LARGEST_PULL]).condensed.delta.s
    level = noise_share * float(np.abs(change).mean())
    noise = Noise(displacement=1e-4, volume=level, pressure=level)
    grid = finger_grid(pitch)
    tip, force, inside, forces_inside, misfits, certain = [], [], [], [], [], []
    cpu, alone, steps, solved, buckled = 0.0, [], 0, 0, 0
    for _ in range(touches):
        cell = (int(rng.integers(grid.cells[0])), int(rng.integers(grid.cells[1])))
        corners = grid.corners(cell)
        point = corners[0] + rng.random() * (corners[1] - corners[0]) + rng.random() * (corners[2] - corners[0])
        command = np.array([rng.uniform(0.001, LARGEST_PULL)])
        pull = command + noise.displacement * rng.standard_normal(1)
        true_force = 0.0
        while true_force < 0.2:
            true_force = abs(FORCE * rng.standard_normal())
        estimator = Estimator(robot, design=design, load=Touch(grid, cell, FORCE), noise=noise)
        body = robot.build(design)
        body.add_contact("touch", point, radius=estimator.radius)
        try:
            state = Statics(body).solve(pull, contact=true_force * np.array(grid.normal))
        except ConvergenceError:  # the finger has buckled: there is no reading to explain
            buckled += 1
            continue
        begin, found_equilibria = time.process_time(), 0
        for _ in range(readings):
            measured = state.condensed.delta.s + level * rng.standard_normal(cavities)
            found = estimator.update(estimator.reading(command, measured))
            misfits.append(found.misfit)
            found_equilibria += found.equilibria
        cpu += time.process_time() - begin
        steps += readings
        solved += found_equilibria
        for _ in range(20):
            begin = time.process_time()
            if not estimator.update(estimator.reading(command, measured)).equilibria:
                alone.append(time.process_time() - begin)
        error = found.effector - state.condensed.delta.e
        tip.append(float(np.linalg.norm(error)))
        force.append(float(found.load[0] - true_force) / true_force)
        # Three coordinates of the tip, of which only those that the parameters move have an uncertainty.
        values, axes = np.linalg.eigh(found.effector_covariance)
        known = values > 1e-6 * values[-1]
        inside.append(float(((axes.T @ error)[known] ** 2 / values[known]).sum()) <= chi2.ppf(0.95, known.sum()))
        spread = float(np.sqrt(found.load_covariance[0, 0]))
        certain.append(spread <= 0.1 * found.load[0])
        forces_inside.append(abs(found.load[0] - true_force) <= 1.96 * spread)
    size = np.abs(force)
    return {
        "cavities": cavities,
        "touches": len(tip),
        "touches without equilibrium": buckled,
        "readings": readings,
        "noise of pressure [Pa]" if sealed else "volume noise [mm3]": level if sealed else level * 1e9,
        "tip error mean [% of length]": 100 * float(np.mean(tip)) / LENGTH,
        "tip error 95th [% of length]": 100 * float(np.percentile(tip, 95)) / LENGTH,
        "tip error worst [% of length]": 100 * float(np.max(tip)) / LENGTH,
        "force error median [%]": 100 * float(np.median(size)),
        "force error mean [%]": 100 * float(size.mean()),
        "force error 95th [%]": 100 * float(np.percentile(size, 95)),
        "force within 10 % [%]": 100 * float((size <= 0.1).mean()),
        "force told to 10 % [% of touches]": 100 * float(np.mean(certain)),
        "force error of those, median [%]": 100 * float(np.median(size[certain])) if any(certain) else None,
        "force error of those, mean [%]": 100 * float(np.mean(size[certain])) if any(certain) else None,
        "coverage tip [%]": 100 * float(np.mean(inside)),
        "coverage force [%]": 100 * float(np.mean(forces_inside)),
        "misfit mean": float(np.mean(misfits)),
        "updates on finite elements per CPU s": steps / cpu,
        "equilibria per update": solved / steps,
        "updates per CPU s without a new equilibrium": 1.0 / float(np.mean(alone)),
    }


def sealed_finger() -> dict[str, object]:
    """Sensorized finger: stiffness that sealed air adds, and estimates from its pressure beside those from volumes."""
    result: dict[str, object] = {}
    for mesh, cavities in (("published", 2), ("published", 4), ("accurate", 2)):
        pair = []
        for sealed in (False, True):
            statics = Statics(make_robot("sensorized_finger", cavities=cavities, sealed=sealed, mesh=mesh).build())
            for pull in np.linspace(0.25, 1.0, 4) * LARGEST_PULL:
                state = statics.solve([pull])
            pair.append((float(state.effort[0]), float(state.condensed.W.ee[1, 1]), state.condensed.delta))
        (tension, compliance, delta), (sealed_tension, sealed_compliance, sealed_delta) = pair
        result[f"{mesh}, {cavities} cavities"] = {
            "tension, open [N]": tension,
            "tension, sealed [%]": 100.0 * (sealed_tension / tension - 1.0),
            "compliance of the tip along y, sealed [%]": 100.0 * (sealed_compliance / compliance - 1.0),
            "tip, sealed [mm]": 1e3 * float(np.linalg.norm(sealed_delta.e - delta.e)),
            "pressure [kPa]": 1e-3 * float(np.mean(sealed_delta.s)),
        }
    for cavities in (2, 4):
        for sealed in (False, True):
            found = measure(cavities, 60, 10, 5e-3, 0.01, 0, {}, sealed)
            result[f"estimate, {cavities} cavities, {'sealed' if sealed else 'open'}"] = found
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cavities", type=int, default=2)
    parser.add_argument("--sealed", action="store_true", help="pressures of sealed cavities instead of volumes")
    parser.add_argument("--touches", type=int, default=100)
    parser.add_argument("--readings", type=int, default=10)
    parser.add_argument("--pitch", type=float, default=5e-3)
    parser.add_argument("--noise", type=float, default=0.01, help="of the sensors' change under the full pull")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--design", type=json.loads, default={}, help="JSON object of design variables, SI units")
    given = parser.parse_args()
    options = (given.touches, given.readings, given.pitch, given.noise, given.seed, given.design, given.sealed)
    result = measure(given.cavities, *options)
    print(json.dumps({name: round(value, 4) for name, value in result.items() if value is not None}))
