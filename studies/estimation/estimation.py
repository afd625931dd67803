"""Accuracy of the estimator on finite elements: touches at random places of the sensorized finger's grid.

``python -m benchmarks.estimation [--cavities 2] [--sealed] [--touches 100] [--readings 10]`` prints a line of JSON.
``softgym bench estimation`` has 300 touches of fingers with two and four cavities, ``softgym bench sealed_finger``
compares volumes of open cavities with pressures of sealed ones, and their stiffness.

Each touch is one body with a random pull, an error of the cable, a force and a place in a cell, constant over a number
of readings with new noise of the volumes. Its place is one point, which is not a corner of the estimator's cell: the
plant is another model than the estimator's. The force is that of the prior, cut off below 0.2 N.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from softgym_envs.errors import ConvergenceError
from softgym_envs.estimation import Estimator, Noise, Touch, finger_grid
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.registry import make_robot

LENGTH, LARGEST_PULL, FORCE = 0.120, 0.010, 2.0
TOUCHES, SEED = 60, 0
"""Of the comparison of open with sealed cavities."""
MANY_TOUCHES = 300
"""Of the accuracy of the estimator: chance moves a coverage of 95 % by 1.3 points."""


@dataclass(frozen=True)
class Found:
    """What ten or so readings of one touch told.

    Attributes:
        below: distance of the touch to the flange [m].
        force: of the touch [N].
        found_force: estimated [N].
        spread: its standard deviation [N].
        tip_error: distance of the estimated to the true tip [m].
        tip_distance: squared, in standard deviations, and its directions that have an uncertainty.
        slack: whether the cable hung slack.
        misfits: of each reading.
        equilibria: computed for all readings.
        seconds: CPU time of all readings.
        alone: CPU times of readings that need no new equilibrium [s].
    """

    below: float
    force: float
    found_force: float
    spread: float
    tip_error: float
    tip_distance: tuple[float, int]
    slack: bool
    misfits: tuple[float, ...]
    equilibria: int
    seconds: float
    alone: tuple[float, ...]

    @property
    def relative(self) -> float:
        """Size of the error of the force, as a part of the force."""
        return abs(self.found_force - self.force) / self.force

    @property
    def told(self) -> bool:
        """Whether the estimate claims to know the force to 10 %."""
        return self.spread <= 0.1 * self.found_force

    @property
    def tip_inside(self) -> bool:
        """Whether the true tip lies within the region of 95 %."""
        return self.tip_distance[0] <= float(chi2.ppf(0.95, self.tip_distance[1]))

    @property
    def force_inside(self) -> bool:
        """Whether the true force lies within the interval of 95 %."""
        return abs(self.found_force - self.force) <= 1.96 * self.spread


def sensor_noise(cavities: int, share: float, sealed: bool = False) -> Noise:
    """Return noise that is a share of the mean change of the baseline's volumes or pressures under the full pull."""
    robot = make_robot("sensorized_finger", cavities=cavities, sealed=sealed)
    change = Statics(robot.build()).solve([LARGEST_PULL]).condensed.delta.s
    level = share * float(np.abs(change).mean())
    return Noise(displacement=1e-4, volume=level, pressure=level)


def distance_in_deviations(error: np.ndarray, covariance: np.ndarray) -> tuple[float, int]:
    """Return the squared distance in standard deviations along the directions with an uncertainty, and their number.

    Of three coordinates of the tip, only those that the parameters move have an uncertainty.
    """
    values, axes = np.linalg.eigh(covariance)
    known = values > 1e-6 * values[-1]
    return float(((axes.T @ error)[known] ** 2 / values[known]).sum()), int(known.sum())


def touches(
    cavities: int,
    count: int,
    readings: int,
    pitch: float,
    noise: Noise,
    seed: int,
    design: Mapping[str, float],
    sealed: bool = False,
) -> list[Found]:
    """Return what the estimator finds under random touches of a body, whose missing variables take their baseline.

    Touches under which the finger buckles are left out: there is no reading to explain.
    """
    rng = np.random.default_rng(seed)
    robot = make_robot("sensorized_finger", cavities=cavities, sealed=sealed)
    grid, result = finger_grid(pitch), []
    for _ in range(count):
        cell = (int(rng.integers(grid.cells[0])), int(rng.integers(grid.cells[1])))
        corners = grid.corners(cell)
        point = corners[0] + rng.random() * (corners[1] - corners[0]) + rng.random() * (corners[2] - corners[0])
        command = np.array([rng.uniform(0.001, LARGEST_PULL)])
        pull = command + noise.displacement * rng.standard_normal(1)
        force = 0.0
        while force < 0.2:
            force = abs(FORCE * float(rng.standard_normal()))
        estimator = Estimator(robot, design=design, load=Touch(grid, cell, FORCE), noise=noise)
        body = robot.build(design)
        body.add_contact("touch", point, radius=estimator.radius)
        try:
            state = Statics(body).solve(pull, contact=force * np.array(grid.normal))
        except ConvergenceError:
            continue
        level, equilibria, misfits = noise.pressure if sealed else noise.volume, 0, []
        begin = time.process_time()
        for _ in range(readings):
            measured = state.condensed.delta.s + level * rng.standard_normal(cavities)
            found = estimator.update(estimator.reading(command, measured))
            misfits.append(found.misfit)
            equilibria += found.equilibria
        seconds, alone = time.process_time() - begin, []
        for _ in range(20):
            begin = time.process_time()
            if not estimator.update(estimator.reading(command, measured)).equilibria:
                alone.append(time.process_time() - begin)
        error = found.effector - state.condensed.delta.e
        result.append(
            Found(
                below=-float(point[2]),
                force=force,
                found_force=float(found.load[0]),
                spread=float(np.sqrt(found.load_covariance[0, 0])),
                tip_error=float(np.linalg.norm(error)),
                tip_distance=distance_in_deviations(error, found.effector_covariance),
                slack=bool(state.slack.any()),
                misfits=tuple(misfits),
                equilibria=equilibria,
                seconds=seconds,
                alone=tuple(alone),
            )
        )
    return result


def measure(
    cavities: int,
    count: int,
    readings: int,
    pitch: float,
    noise_share: float,
    seed: int,
    design: Mapping[str, float],
    sealed: bool = False,
) -> dict[str, float | None]:
    """Return errors, coverage and speed of the estimator, see `touches`.

    The noise of volumes or pressures is a share of their change under the full pull in the baseline, one for all.
    """
    noise = sensor_noise(cavities, noise_share, sealed)
    found = touches(cavities, count, readings, pitch, noise, seed, design, sealed)
    tip, size = np.array([touch.tip_error for touch in found]), np.array([touch.relative for touch in found])
    certain = np.array([touch.told for touch in found])
    steps = readings * len(found)
    return {
        "cavities": cavities,
        "touches": len(found),
        "touches without equilibrium": count - len(found),
        "readings": readings,
        "noise of pressure [Pa]" if sealed else "volume noise [mm3]": noise.pressure if sealed else noise.volume * 1e9,
        "tip error mean [% of length]": 100 * float(tip.mean()) / LENGTH,
        "tip error 95th [% of length]": 100 * float(np.percentile(tip, 95)) / LENGTH,
        "tip error worst [% of length]": 100 * float(tip.max()) / LENGTH,
        "force error median [%]": 100 * float(np.median(size)),
        "force error mean [%]": 100 * float(size.mean()),
        "force error 95th [%]": 100 * float(np.percentile(size, 95)),
        "force within 10 % [%]": 100 * float((size <= 0.1).mean()),
        "force told to 10 % [% of touches]": 100 * float(certain.mean()),
        "force error of those, median [%]": 100 * float(np.median(size[certain])) if certain.any() else None,
        "force error of those, mean [%]": 100 * float(size[certain].mean()) if certain.any() else None,
        "coverage tip [%]": 100 * float(np.mean([touch.tip_inside for touch in found])),
        "coverage force [%]": 100 * float(np.mean([touch.force_inside for touch in found])),
        "misfit mean": float(np.mean([touch.misfits for touch in found])),
        "updates on finite elements per CPU s": steps / sum(touch.seconds for touch in found),
        "equilibria per update": sum(touch.equilibria for touch in found) / steps,
        "updates per CPU s without a new equilibrium": 1.0 / float(np.mean([t for f in found for t in f.alone])),
    }


def accuracy() -> dict[str, object]:
    """Errors, coverage and speed of the estimator on finite elements, with two and four open cavities."""
    return {f"{cavities} cavities": measure(cavities, MANY_TOUCHES, 10, 5e-3, 0.01, SEED, {}) for cavities in (2, 4)}


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
            found = measure(cavities, TOUCHES, 10, 5e-3, 0.01, SEED, {}, sealed)
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
