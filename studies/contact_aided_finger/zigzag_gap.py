"""Explain the gap between the simulated and the measured contact-aided fingers (thesis, table 3.7).

    python -m benchmarks.zigzag_gap --folder results/zigzag_gap

closes the fingers that were built against the vertical plane for many values of what the thesis leaves uncertain, each
within a tolerance that the thesis gives or that `EFFECTS` states. It writes every evaluation to the folder, where an
interrupted run continues, prints one JSON object, and draws a picture. Nothing is fitted.

Four effects need no evaluation of their own. Without gravity, and with a contact stiffness in proportion to Young's
modulus, torques and forces are exactly proportional to that modulus. A compliant or inexact servo reaches a smaller
angle, so it reads the same curve elsewhere. An offset of the torque sensor is added at the end.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks.zigzag_designs import DESIGNS, FORCE_203, MEASURED, SIMULATED
from softgym_envs.config import provenance
from softgym_envs.errors import ConvergenceError
from softgym_envs.executors import parallel_map
from softgym_envs.robots.contact_aided_finger import ContactAidedFinger
from softgym_envs.robots.grasping import TOUCHING, GraspObject, evaluate_grasp
from softgym_envs.storage import JsonLines, write_json

YOUNG_MODULUS = 3.62e6
"""Of the thesis [Pa], from the hardness of the filament."""

ANGLES = 40
"""Number of angles over which the grasp energy of the thesis is summed."""


@dataclass(frozen=True)
class Setup:
    """What one evaluation assumes."""

    design: str = "B"
    angle: float = 30.0  # largest [deg]
    increments: int = 20
    mesh: str = "accurate"
    mesh_size: float = 12e-3  # [m]
    gap: float = 30.1e-3  # from the outer face to the object [m]
    object_friction: float = 0.85
    self_friction: float = 0.85
    poisson_ratio: float = 0.452
    length: float = 0.100  # [m]
    thickness: float = 0.020  # [m]
    wall: float = 0.0  # added to the thickness of every wall [m]


@dataclass(frozen=True)
class Reading:
    """What changes how a curve is read."""

    young_modulus: float = YOUNG_MODULUS  # [Pa]
    servo_compliance: float = 0.0  # [rad/(N m)]
    servo_error: float = 0.0  # commanded less reached angle [rad]
    torque_offset: float = 0.0  # read without load [N m]


@dataclass(frozen=True)
class Curve:
    """Torque of the servo and force on the object while a finger closes."""

    angle: list[float] = field(default_factory=list)  # [rad], from zero
    torque: list[float] = field(default_factory=list)  # [N m]
    force: list[float] = field(default_factory=list)  # along x [N]
    failure: str | None = None


@dataclass(frozen=True)
class Objectives:
    """Objectives of the thesis (eq. 3.10, 3.11 and 3.13)."""

    force: float  # [N]
    resistance: float  # [m]
    energy: float  # [N m rad], the sum over 40 angles


@dataclass(frozen=True)
class Effect:
    """One uncertain quantity."""

    low: float
    high: float
    unit: str
    source: str


EFFECTS = {
    "gap": Effect(30.0e-3, 35.3e-3, "m", "nominal 30 mm; the authors' calibration found 30.3 mm (C) and 35.3 mm (A)"),
    "object_friction": Effect(0.30, 0.85, "1", "both values of table 3.6; none was measured"),
    "self_friction": Effect(0.30, 0.85, "1", "both values of table 3.6; none was measured"),
    "poisson_ratio": Effect(0.40, 0.499, "1", "bounds of the authors' calibration (eq. 3.14), which found 0.451"),
    "length": Effect(0.098, 0.102, "m", "assumed: a third of the 6 mm foot; the thesis names it without a value"),
    "wall": Effect(-0.2e-3, 0.2e-3, "m", "assumed: half the 0.4 mm line of the printer (Prusa MK3)"),
    "thickness": Effect(0.0198, 0.0202, "m", "assumed: as the walls"),
    "young_modulus": Effect(2.97e6, 4.43e6, "Pa", "assumed: hardness Shore 60A +- 5, by the relation of the authors"),
    "servo_compliance": Effect(
        0.0, 0.038, "rad/(N m)", "assumed: 0.5 mm in a 1 kg strain gauge at full load, on an arm of 36.7 mm"
    ),
    "servo_error": Effect(-0.0056, 0.0056, "rad", "resolution of the servo, 0.321 deg (sec. 3.4.5)"),
    "torque_offset": Effect(-3.2e-3, 15e-3, "N m", "found by the authors' calibration for fingers A and C"),
}
"""Uncertain quantities. The arm follows from the largest torque of 0.36 N m that the gauge measures."""

READ = ("young_modulus", "servo_compliance", "servo_error", "torque_offset")
"""Effects that change how a curve is read, and need no evaluation."""

LOWEST_FORCE = {
    "gap": EFFECTS["gap"].high,
    "object_friction": EFFECTS["object_friction"].low,
    "self_friction": EFFECTS["self_friction"].low,
    "poisson_ratio": EFFECTS["poisson_ratio"].low,
    "length": EFFECTS["length"].high,
    "wall": EFFECTS["wall"].low,
    "thickness": EFFECTS["thickness"].low,
    "young_modulus": EFFECTS["young_modulus"].low,
    "servo_compliance": EFFECTS["servo_compliance"].high,
    "servo_error": EFFECTS["servo_error"].high,
    "torque_offset": EFFECTS["torque_offset"].high,
}
"""All effects at the end at which design B presses least, and at which the torque reads most."""

SAMPLE_ANGLE = {"A": 30.0, "B": 30.0, "203": 40.0}
"""Largest angle in the experiments that are compared [deg]."""

GRAM_FORCE = 9.80665e-3
"""[N]"""


def robot_of(setup: Setup) -> tuple[ContactAidedFinger, dict[str, float]]:
    """Return the finger of a setup and its design.

    A thicker wall grows to the inside of the left leg and to the outside of the zigzag, so that the inner side of the
    zigzag stays where it is, as far as the bounds of the distances allow (finger 203 has one at its bound).
    """
    base = DESIGNS[setup.design]
    robot = ContactAidedFinger(
        control_points=sum(name.startswith("d") for name in base),
        mesh=setup.mesh,
        mesh_size=setup.mesh_size,
        length=setup.length,
        thickness=setup.thickness,
    )
    changed = {name: value + (-setup.wall if name.startswith("d") else setup.wall) for name, value in base.items()}
    variables = robot.design_space.variables
    within = {name: min(max(value, variables[name].low), variables[name].high) for name, value in changed.items()}
    return robot, robot.design_space.complete({**within, "poisson_ratio": setup.poisson_ratio})


def close(setup: Setup) -> Curve:
    """Return the curves of a finger that closes against the plane, and why it does not reach the last angle."""
    robot, design = robot_of(setup)
    found = evaluate_grasp(
        robot,
        design,
        GraspObject(distance=setup.gap, friction=setup.object_friction),
        angle=math.radians(setup.angle),
        angles=setup.increments,
        self_friction=setup.self_friction,
    )
    columns = (found.angle, found.torque, found.force[:, 0])
    return Curve(*(np.abs([0.0, *values]).tolist() for values in columns), failure=found.reason or None)


def read(curve: Curve, reading: Reading, angle: float) -> Curve:
    """Return what is read at 40 even steps to a commanded angle [deg].

    A servo that goes a little too far is beyond the end of the curve, which goes on in a straight line there.
    """
    if curve.failure is not None:
        raise ConvergenceError(curve.failure)
    stiffness = reading.young_modulus / YOUNG_MODULUS
    reached, torque, force = (
        np.append(row, 2.0 * row[-1] - row[-2]) for row in (curve.angle, curve.torque, curve.force)
    )
    torque, force = stiffness * torque, stiffness * force
    commanded = reached + reading.servo_compliance * torque + reading.servo_error
    angles = math.radians(angle) * np.arange(1, ANGLES + 1) / ANGLES
    shown = np.abs(np.interp(angles, commanded, torque) + reading.torque_offset)
    columns = (angles, shown, np.interp(angles, commanded, force))
    return Curve(*(column.tolist() for column in columns))


def objectives(curve: Curve, reading: Reading, angle: float = 30.0) -> Objectives:
    """Return the objectives of the thesis at a commanded angle [deg]."""
    found = read(curve, reading, angle)
    torque, force = np.array(found.torque), np.array(found.force)
    touches = force > TOUCHING
    resistance = float(np.min(torque[touches] / force[touches], initial=math.inf))
    return Objectives(float(force[-1]), resistance, float(torque @ found.angle))


# -- what is evaluated ----------------------------------------------------------------------------------------------


def meshes(design: str) -> dict[str, Setup]:
    """Return setups that differ in mesh and number of increments, at the nominal gap and at that of finger A."""
    fine = Setup(design, increments=ANGLES)
    return {
        "published, linear, 3 mm": replace(fine, mesh="published", mesh_size=3e-3),
        "quadratic, 20 mm": replace(fine, mesh_size=20e-3),
        "quadratic, 12 mm": fine,
        "quadratic, 8 mm": replace(fine, mesh_size=8e-3),
        "quadratic, 12 mm, 20 increments": Setup(design),
        "published, linear, 3 mm, gap 35.3 mm": replace(fine, mesh="published", mesh_size=3e-3, gap=35.3e-3),
        "quadratic, 12 mm, 20 increments, gap 35.3 mm": Setup(design, gap=35.3e-3),
    }


def ends(design: str) -> dict[str, Setup]:
    """Return setups in which one quantity has one of its extreme values."""
    nominal = Setup(design)
    found = {
        f"{name} {value:g}": replace(nominal, **{name: value})
        for name, effect in EFFECTS.items()
        if name not in READ
        for value in (effect.low, effect.high)
        if value != getattr(nominal, name)
    }
    low = EFFECTS["object_friction"].low
    return found | {
        "both frictions low": replace(nominal, object_friction=low, self_friction=low),
        "lowest force": replace(nominal, **{name: value for name, value in LOWEST_FORCE.items() if name not in READ}),
    }


def sample(design: str, count: int, angle: float = 30.0) -> list[tuple[Setup, Reading]]:
    """Return setups and readings of a scrambled Sobol sequence, uniform between the ends of all effects."""
    from scipy.stats import qmc

    # What is only read has sequences of its own: more of it leaves all evaluations as they are.
    last = list(EFFECTS).index("torque_offset")
    points = np.hstack([qmc.Sobol(d, seed=seed).random(count) for seed, d in enumerate((last, len(EFFECTS) - last))])
    values = [
        {name: float(e.low + u * (e.high - e.low)) for (name, e), u in zip(EFFECTS.items(), row, strict=True)}
        for row in points
    ]
    base = Setup(design, angle=angle, increments=round(20 * angle / 30.0))
    return [
        (
            replace(base, **{name: value for name, value in row.items() if name not in READ}),
            Reading(**{name: row[name] for name in READ}),
        )
        for row in values
    ]


# -- results --------------------------------------------------------------------------------------------------------


def run(setups: Sequence[Setup], folder: Path, workers: int, progress: bool = True) -> dict[Setup, Curve]:
    """Return the curves of all setups; those that the folder holds are not computed again."""
    lines = JsonLines(folder / "curves.jsonl")
    known = {Setup(**record["setup"]): Curve(**record["curve"]) for record in lines.read()}
    missing = [setup for setup in dict.fromkeys(setups) if setup not in known]
    results = parallel_map(_close_one, [(setup,) for setup in missing], workers)
    with click.progressbar(results, length=len(missing), label="closings", hidden=not progress, file=sys.stderr) as bar:
        for setup, curve in bar:
            known[setup] = curve
            lines.append({"setup": asdict(setup), "curve": asdict(curve)})
    return {setup: known[setup] for setup in setups}


def _close_one(setup: Setup) -> tuple[Setup, Curve]:
    return setup, close(setup)


def shares(points: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the signed standardised coefficients of a linear fit (d,), and the share of the variance it explains.

    Points (n, d) are inputs that were drawn independently, so a squared coefficient is the share of its input.
    """
    x = (points - points.mean(0)) / points.std(0)
    y = (values - values.mean()) / values.std()
    matrix = np.column_stack([np.ones(len(x)), x])
    found, *_ = np.linalg.lstsq(matrix, y, rcond=None)
    return found[1:], float(1.0 - ((y - matrix @ found) ** 2).sum() / (y**2).sum())


def summary(folder: Path, workers: int, counts: Mapping[str, int], progress: bool = True) -> dict[str, Any]:
    """Return all results as a JSON object; ``counts`` has the number of samples of each design."""
    samples = {name: sample(name, count, SAMPLE_ANGLE[name]) for name, count in counts.items()}
    named = {name: meshes(name) | (ends(name) if name == "B" else {}) for name in counts if name in MEASURED}
    setups = [setup for table in named.values() for setup in table.values()]
    setups += [setup for rows in samples.values() for setup, _ in rows]
    curves = run(setups, folder, workers, progress)
    result: dict[str, Any] = {"effects": {name: asdict(effect) for name, effect in EFFECTS.items()}, "designs": {}}
    for name, rows in samples.items():
        found: dict[str, Any] = {"sample": spread(rows, curves)}
        if name in named:
            nominal = curves[Setup(name)]
            found["published"], found["measured"] = SIMULATED[name], MEASURED[name]
            found["nominal"] = asdict(objectives(nominal, Reading()))
            found["meshes"] = {label: asdict(objectives(curves[s], Reading())) for label, s in meshes(name).items()}
        else:
            found["force"] = force_band(rows, curves)
        if name == "B":
            found["ends"] = {label: asdict(objectives(curves[s], Reading())) for label, s in ends(name).items()}
            for effect in READ:
                for value in (EFFECTS[effect].low, EFFECTS[effect].high):
                    reading = replace(Reading(), **{effect: value})
                    found["ends"][f"{effect} {value:g}"] = asdict(objectives(nominal, reading))
            all_read = Reading(**{effect: LOWEST_FORCE[effect] for effect in READ})
            found["ends"]["lowest force"] = asdict(objectives(curves[ends(name)["lowest force"]], all_read))
        result["designs"][name] = found
    return result


def spread(rows: Sequence[tuple[Setup, Reading]], curves: Mapping[Setup, Curve]) -> dict[str, Any]:
    """Return quantiles of the objectives over a sample, and which quantity they follow."""
    whole = [(setup, reading) for setup, reading in rows if curves[setup].failure is None]
    found = [asdict(objectives(curves[setup], reading)) for setup, reading in whole]
    points = np.array([[(asdict(setup) | asdict(reading))[name] for name in EFFECTS] for setup, reading in whole])
    out: dict[str, Any] = {"count": len(rows), "failures": len(rows) - len(whole)}
    for key in found[0]:
        values = np.array([row[key] for row in found])
        low, middle, high = np.quantile(values, (0.05, 0.5, 0.95))
        out[key] = {
            "low": float(low),
            "median": float(middle),
            "high": float(high),
            "smallest": float(values.min()),
            "largest": float(values.max()),
        }
        if len(whole) > 2 * len(EFFECTS) and np.isfinite(values).all():
            weights, explained = shares(points, values)
            out[key] |= {"weights": dict(zip(EFFECTS, weights.tolist(), strict=True)), "explained": explained}
    return out


def force_band(rows: Sequence[tuple[Setup, Reading]], curves: Mapping[Setup, Curve]) -> dict[str, Any]:
    """Return the 5, 50 and 95 % quantiles of the force at ten angles to 40 degrees [N], and the measured force."""
    forces = [
        read(curves[setup], reading, 40.0).force[3::4] for setup, reading in rows if curves[setup].failure is None
    ]
    low, middle, high = np.quantile(forces, (0.05, 0.5, 0.95), axis=0).tolist()
    measured = (GRAM_FORCE * np.array(FORCE_203)).tolist()
    return {"angle": list(range(4, 41, 4)), "low": low, "median": middle, "high": high, "measured": measured}


# -- picture --------------------------------------------------------------------------------------------------------


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Draw the forces and energies of finger B over one quantity at a time, and the curve of finger 203."""
    from softgym_envs.codesign.report.plots import BASELINE, MUTED, WINNER
    from softgym_envs.codesign.tools.plots import figure

    one = result["designs"]["B"]
    nominal, measured, published = one["nominal"], one["measured"], one["published"]
    with figure(path, 3, width=4.6, height=4.2) as axes:
        for axis, key, number, words in ((axes[0], "force", 0, "contact force [N]"), (axes[1], "energy", 2, "energy")):
            labels = ["mesh", *EFFECTS, "all, 5 to 95 %"]
            for place, name in enumerate(labels):
                if name == "mesh":
                    values = [row[key] for label, row in one["meshes"].items() if "gap" not in label]
                elif name.startswith("all"):
                    values = [one["sample"][key][end] for end in ("low", "high")]
                else:
                    values = [row[key] for label, row in one["ends"].items() if label.startswith(name + " ")]
                    values.append(nominal[key])
                color = WINNER if name.startswith("all") else MUTED
                axis.barh(-place, max(values) - min(values), left=min(values), height=0.6, color=color)
            axis.axvline(nominal[key], color=MUTED, lw=1, label="nominal, accurate mesh")
            axis.axvline(published[number], color=BASELINE, ls=":", label="published simulation")
            axis.axvline(measured[number], color=BASELINE, label="measured")
            axis.set_yticks(-np.arange(len(labels)), [label.replace("_", " ") for label in labels])
            axis.set_xlim(left=0.0)
            axis.set_xlabel(f"finger B: {words}")
        axes[0].legend(fontsize=7, loc="lower right")
        band = result["designs"]["203"]["force"]
        axes[2].fill_between(band["angle"], band["low"], band["high"], color=WINNER, alpha=0.4, lw=0, label="5 to 95 %")
        axes[2].plot(band["angle"], band["median"], color=WINNER, label="median")
        axes[2].plot(band["angle"], band["measured"], color=BASELINE, marker="o", ms=3, label="measured")
        axes[2].set_xlabel("angle of the servo [deg]")
        axes[2].set_ylabel("finger 203: contact force [N]")
        axes[2].legend(fontsize=7)


@click.command(help=__doc__)
@click.option("--folder", type=click.Path(path_type=Path), default=Path("results/zigzag_gap"), show_default=True)
@click.option("--workers", type=int, default=1, show_default=True)
@click.option("--samples", type=int, default=32, show_default=True, help="For B; a quarter for A and 203.")
def main(folder: Path, workers: int, samples: int) -> None:
    """Evaluate, print and draw everything."""
    result = summary(folder, workers, {"B": samples, "203": samples // 4, "A": samples // 4})
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "zigzag_gap.json", {**provenance(), **result})
    draw(result, folder / "zigzag_gap.png")
    click.echo(json.dumps(result))


if __name__ == "__main__":
    main()
