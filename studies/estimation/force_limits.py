"""How well a force can be found from the sensors at all, beside what both estimators find under the same touches.

``softgym bench force_limits`` measures on finite elements: the estimator on finite elements, the one on the learned
model whose errors were measured on this body, and the Cramer-Rao limit, by the height of the touch and for several
fingers; then the limit for other sensors.

The limit is the standard deviation of the force that the Fisher information of all readings of a touch leaves, taken
at the true state with the exact derivatives of the sensors there. It counts what is known before any reading: the error
of the cable, the place in the touched cell, and the force, whose half-normal prior has this variance. An estimate with
a normal error of that size errs by ``sqrt(2 / pi)`` of it in the mean.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass

import numpy as np
from scipy.special import erf

from benchmarks.estimation import LARGEST_PULL, sensor_noise
from benchmarks.recorded import results
from benchmarks.tables import markdown
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.backends.surrogate import SurrogateBackend
from softgym_envs.errors import ConvergenceError
from softgym_envs.estimation import Estimator, LearnedEstimator, Noise, Readings, Touch, finger_grid, measured_errors
from softgym_envs.estimation.loads import Cell
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.base import Robot
from softgym_envs.robots.registry import make_robot

TOUCHES, READINGS, SEED = 60, 10, 11
FORCE, WEAKEST, STRONGEST = 1.0, 0.2, 2.0
"""Forces are drawn with a standard deviation of the first between the others [N], which the learned model knows."""
HALF_NORMAL = 1.0 - 2.0 / np.pi
"""Variance of the size of a normal variable."""
BANDS = ((15, 40), (40, 55), (55, 115), (15, 115))
"""Heights of touches below the flange [mm]; the hinges with the cavities are at 40 and 80 mm."""


@dataclass(frozen=True)
class Sensors:
    """Sensors in the units of those of the table: their noise and pitch, and what else is known.

    Attributes:
        noise: standard deviation of a volume over that of the table.
        pitch: of the grid over 5 mm; 0 if the place is known.
        tension: noise of the measured tension over 1 % of that under the full pull; None if it is not measured.
        cable: error of the cable over 0.1 mm.
    """

    noise: float = 1.0
    pitch: float = 1.0
    tension: float | None = None
    cable: float = 1.0


SENSORS = {
    "as in the tables above": Sensors(),
    "place of the touch known exactly": Sensors(pitch=0.0),
    "grid of 2.5 mm": Sensors(pitch=0.5),
    "cable known exactly": Sensors(cable=0.0),
    "noise of the volumes 0.1 %": Sensors(noise=0.1),
    "tension of the cable measured to 1 %": Sensors(tension=1.0),
    "all of these": Sensors(0.1, 0.0, 1.0, 0.0),
}
"""Sensors by name."""


@dataclass(frozen=True)
class TouchedBody:
    """One touch and what the sensors of the body read without noise.

    Attributes:
        cell: touched cell.
        place: in the cell, two numbers from -1 to 1.
        force: of the touch [N].
        command: of the cable [m], shape (1,).
        noise: of the readings, in standard deviations, shape (r, n_s).
        change: of the volumes [m3], shape (n_s,).
        below: distance to the flange [m].
        slope: derivatives of volumes and then the tension by the error of the cable, the force, and both coordinates of
            the place, shape (n_s + 1, 4).
    """

    cell: Cell
    place: np.ndarray
    force: float
    command: np.ndarray
    noise: np.ndarray
    change: np.ndarray
    below: float
    slope: np.ndarray

    def limit(self, noise: Noise, tension: float, sensors: Sensors = SENSORS["as in the tables above"]) -> float:
        """Return the smallest standard deviation of the force [N].

        Args:
            noise: of cable and volumes in the tables.
            tension: 1 % of the tension under the full pull [N].
            sensors: those that read.
        """
        share = 1.0 if sensors.tension is None else sensors.tension
        deviations = np.array([sensors.noise * noise.volume] * (len(self.slope) - 1) + [share * tension])
        kept = slice(0, len(self.slope) - (sensors.tension is None))
        # What is known exactly is no unknown.
        prior = np.array([sensors.cable * noise.displacement, FORCE * HALF_NORMAL**0.5, *[sensors.pitch / 3**0.5] * 2])
        unknown = prior > 0.0
        scaled = (self.slope / deviations[:, None])[kept][:, unknown]
        information = len(self.noise) * scaled.T @ scaled + np.diag(prior[unknown] ** -2)
        return float(np.sqrt(np.linalg.inv(information)[int(unknown[0]), int(unknown[0])]))


def touched_bodies(robot: Robot, design: Mapping[str, float], count: int, noise: Noise) -> Iterator[TouchedBody]:
    """Yield random touches; those under which the finger buckles are left out. Places and forces are alike for all."""
    rng, grid = np.random.default_rng(SEED), finger_grid()
    sensors = len(robot.sensor_scale)
    # Measured tensions add their rows; the readings of this estimator are not used.
    probing = Noise(displacement=noise.displacement, volume=noise.volume, effort=1.0)
    for _ in range(count):
        cell = (int(rng.integers(grid.cells[0])), int(rng.integers(grid.cells[1])))
        place, force = rng.uniform(-1.0, 1.0, 2), 0.0
        command = np.array([rng.uniform(0.001, LARGEST_PULL)])
        pull = command + noise.displacement * rng.standard_normal(1)
        while not WEAKEST <= force <= STRONGEST:
            force = abs(FORCE * float(rng.standard_normal()))
        read = rng.standard_normal((READINGS, 4))[:, :sensors]  # the same draws with two and with four cavities
        point = grid.inside(cell, place[None])[0]
        probe = Estimator(robot, design=design, load=Touch(grid, cell, FORCE), noise=probing)
        body = robot.build(design)
        body.add_contact("touch", point, radius=probe.radius)
        try:
            state = Statics(body).solve(pull, contact=force * np.array(grid.normal))
            load = np.array([force, *place])
            slope = probe.predict(probe.linearise(pull, load), pull, load)[1]
        except ConvergenceError:
            continue
        yield TouchedBody(cell, place, force, command, read, state.condensed.delta.s, -float(point[2]), slope)


@dataclass(frozen=True)
class Band:
    """Errors of the force under the touches of a band of heights.

    Attributes:
        touches: their number.
        rms: root of the mean square of the errors [N].
        mean: mean size of the errors, each relative to its force [%].
        median: likewise.
        within: share of touches with an error of at most 10 % of their force [%].
        of_range: mean size of the errors, relative to the largest force [%].
    """

    touches: int
    rms: float
    mean: float
    median: float
    within: float
    of_range: float


def measured_band(errors: np.ndarray, forces: np.ndarray) -> Band:
    """Summarise errors [N]."""
    sizes = np.abs(errors)
    return Band(
        touches=len(errors),
        rms=float(np.sqrt(np.mean(errors**2))),
        mean=100.0 * float(np.mean(sizes / forces)),
        median=100.0 * float(np.median(sizes / forces)),
        within=100.0 * float(np.mean(sizes <= 0.1 * forces)),
        of_range=100.0 * float(np.mean(sizes)) / STRONGEST,
    )


def limiting_band(deviations: np.ndarray, forces: np.ndarray) -> Band:
    """Summarise what normal errors with these standard deviations [N] would be expected to give."""
    mean = np.sqrt(2.0 / np.pi) * deviations
    return Band(
        touches=len(deviations),
        rms=float(np.sqrt(np.mean(deviations**2))),
        mean=100.0 * float(np.mean(mean / forces)),
        median=100.0 * float(np.median(0.6745 * deviations / forces)),
        within=100.0 * float(np.mean(erf(0.1 * forces / (deviations * np.sqrt(2.0))))),
        of_range=100.0 * float(np.mean(mean)) / STRONGEST,
    )


def _estimates(estimator: Estimator | LearnedEstimator, touch: TouchedBody, noise: Noise) -> float:
    """Return the force that an estimator finds from all readings of a touch [N]."""
    for deviations in touch.noise:
        change = touch.change + noise.volume * deviations
        found = estimator.update(Readings(touch.command, estimator.rest_volumes + change))
    return float(found.load[0])


def case(cavities: int, design: Mapping[str, float], learned: bool, count: int = TOUCHES) -> dict[str, object]:
    """Return errors by band of the estimators and of the limit, and the limit of other sensors over all heights."""
    robot, grid = make_robot("sensorized_finger", cavities=cavities), finger_grid()
    noise = sensor_noise(cavities, 0.01)
    tension = 0.01 * float(Statics(robot.build(design)).solve([LARGEST_PULL]).effort[0])
    errors = measured_errors(SurrogateBackend(robot), FEMBackend(robot), grid) if learned else None
    touches: list[TouchedBody] = []
    found: dict[str, list[float]] = {name: [] for name in ("finite elements", "learned")[: 1 + learned]}
    for touch in touched_bodies(robot, design, count, noise):
        load = Touch(grid, touch.cell, FORCE)
        estimators: dict[str, Estimator | LearnedEstimator] = {
            "finite elements": Estimator(robot, design=design, load=load, noise=noise)
        }
        if learned:
            estimators["learned"] = LearnedEstimator(robot, load=load, noise=noise, errors=errors)
        touches.append(touch)
        for name, estimator in estimators.items():
            found[name].append(_estimates(estimator, touch, noise) - touch.force)
    forces, below = (np.array([getattr(touch, name) for touch in touches]) for name in ("force", "below"))
    limits = {n: np.array([t.limit(noise, tension, s) for t in touches]) for n, s in SENSORS.items()}
    result: dict[str, object] = {
        "volume noise [mm3]": 1e9 * noise.volume,
        "touches without equilibrium": count - len(touches),
    }
    for low, high in BANDS:
        chosen = (below > 1e-3 * low) & (below <= 1e-3 * high)
        if chosen.any():
            bands = {name: measured_band(np.array(values)[chosen], forces[chosen]) for name, values in found.items()}
            bands["limit"] = limiting_band(limits[next(iter(SENSORS))][chosen], forces[chosen])
            result[f"{low} to {high} mm"] = {name: asdict(band) for name, band in bands.items()}
    result["sensors"] = {name: asdict(limiting_band(values, forces)) for name, values in limits.items()}
    return result


def fingers() -> dict[str, tuple[int, dict[str, float], bool]]:
    """Return cavities, design, and whether its model is learned, of each finger, by name."""

    def end(front: str, name: str) -> dict[str, float]:
        values = results(front)[f"end for {name} [mm, rad]"]
        return {key: value if key == "slope" else 1e-3 * value for key, value in values.items()}

    return {
        "2 cavities, baseline": (2, {}, True),
        "4 cavities, baseline": (4, {}, True),
        "2 cavities, most information": (2, end("sensor_information_front", "information"), False),
        "4 cavities, most sensitive": (4, end("sensor_four_cavities_front", "pressure sensitivity"), False),
    }


def force_limits() -> dict[str, object]:
    """Errors of the force of both estimators beside the Cramer-Rao limit, by height, design and sensors."""
    return {name: case(*given) for name, given in fingers().items()}


ESTIMATORS = ("limit", "finite elements", "learned")
"""Order within a cell of the tables."""


def _cell(bands: Mapping[str, Mapping[str, float]], quantity: str, form: str) -> str:
    """Return the values of limit and estimators, separated by strokes."""
    return " / ".join(f"{bands[name][quantity]:{form}}" for name in ESTIMATORS if name in bands)


def by_height_table() -> str:
    """Errors of the force by height of the touch, for fingers whose models are learned."""
    rows = []
    for finger, found in results("force_limits").items():
        for low, high in BANDS:
            bands = found[f"{low} to {high} mm"]
            if "learned" not in bands:
                break
            title = "all" if (low, high) == BANDS[-1] else f"{low} to {high} mm"
            values = [("rms", ".3f"), ("mean", ".1f"), ("within", ".0f"), ("of_range", ".1f")]
            cells = [_cell(bands, *value) for value in values]
            rows.append([finger, title, str(bands["limit"]["touches"]), *cells])
    head = ["finger", "below the flange", "touches", "root mean square [N]", "mean [%]", "within 10 % [% of touches]"]
    return markdown([*head, "mean, of 2 N [%]"], rows, "llrrrrr")


def designs_table() -> str:
    """Errors of the force with several fingers: all heights, and touches beside or below the upper hinge."""
    rows = []
    for finger, found in results("force_limits").items():
        cells = []
        for low, high in (BANDS[-1], BANDS[-2]):
            bands = {name: band for name, band in found[f"{low} to {high} mm"].items() if name != "learned"}
            cells += [_cell(bands, "mean", ".1f"), _cell(bands, "within", ".0f")]
        rows.append([finger, *cells])
    (low, high), unit = BANDS[-2], "within 10 % [% of touches]"
    head = ["finger", "all: mean [%]", f"all: {unit}", f"{low} to {high} mm: mean [%]", f"{low} to {high} mm: {unit}"]
    return markdown(head, rows, "lrrrr")


def sensors_table() -> str:
    """Shares of touches whose force other sensors could find within 10 %."""
    found = results("force_limits")
    rows = [[name, *(f"{each['sensors'][name]['within']:.0f}" for each in found.values())] for name in SENSORS]
    return markdown(["sensors", *found], rows, "l" + "r" * len(found))


TABLES = {
    "force_by_height": by_height_table,
    "force_by_design": designs_table,
    "force_by_sensors": sensors_table,
}
"""Tables of pages by name."""
