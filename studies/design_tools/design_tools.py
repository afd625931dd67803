"""The design tools on problems of the thesis: optima (sec. 4.5.3) and calibration."""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent
PUBLISHED = {
    "bending_angle": {"length": 0.038, "height": 0.0206, "joint_height": 0.0063},
    "contact_force": {"length": 0.042, "height": 0.022, "joint_height": 0.0079},
}
"""Thesis, section 4.5.3: the best designs for dexterity and for strength."""


def _shown(design: dict[str, float]) -> list[float]:
    """Length, height and joint height [mm]."""
    return [round(1e3 * design[name], 2) for name in ("length", "height", "joint_height")]


def optima() -> dict[str, object]:
    """Dexterity and strength of the one-cable finger (thesis, eq. 4.15 to 4.17), by gradient and TPE from every corner.

    Designs are length, height and joint height [mm]; angles are in rad, forces in N.
    """
    from softgym_envs.codesign.tools.config import OptimiseConfig
    from softgym_envs.codesign.tools.gradient import optimise
    from softgym_envs.codesign.tools.search import search
    from softgym_envs.config import check_config

    bodies = {
        "robot": "finger",
        "robot_options": {"cables": 1},
        "variables": ["length", "height", "joint_height"],
        "actuation": [0.010],
    }
    result: dict[str, object] = {}
    for metric in ("bending_angle", "contact_force", "normal_force"):

        def configured(solver: dict[str, Any], metric: str = metric) -> OptimiseConfig:
            data = {"name": metric, "bodies": bodies, "objectives": [{"metric": metric}], "solver": solver}
            return check_config(OptimiseConfig, data, metric)

        by_gradient = configured({"method": "gradient"})
        found = optimise(by_gradient)
        best = found.best
        result[f"{metric}: gradient, design"] = _shown(best.design)
        result[f"{metric}: gradient, surrogate and FEM"] = [best.surrogate[metric], (best.fem or {})[metric]]
        least = best.cost + 1e-4  # of the normalised cost
        ends = [descent.cost for descent in found.descents]
        result[f"{metric}: gradient, corners that lead there"] = f"{sum(end < least for end in ends)} of {len(ends)}"
        result[f"{metric}: gradient, grid of {found.grid} and all descents [s]"] = round(found.seconds, 2)

        box = by_gradient.bodies.box()
        began, values, designs = time.perf_counter(), [], []
        for corner in box.corners():
            start = {name: box.design(corner)[name] for name in box.names}
            by_tpe = configured({"method": "search", "sampler": {"name": "tpe"}, "trials": 60, "starts": [start]})
            with tempfile.TemporaryDirectory() as folder:
                (row,) = search(by_tpe, folder, progress=False).front
            values.append(row.metrics[metric])
            designs.append(row.design)
        fem = by_gradient.bodies.evaluator((metric,), "fem")
        for name, k in (("best", int(np.argmax(values))), ("worst", int(np.argmin(values)))):
            result[f"{metric}: TPE, 60 trials, {name} corner, design"] = _shown(designs[k])
            result[f"{metric}: TPE, {name} corner, surrogate and FEM"] = [values[k], fem(designs[k])[metric]]
        result[f"{metric}: TPE, all corners [s]"] = round(time.perf_counter() - began, 1)
        if metric in PUBLISHED:
            result[f"{metric}: thesis, design"] = _shown(PUBLISHED[metric])
            result[f"{metric}: thesis' design on FEM"] = fem({**box.reference, **PUBLISHED[metric]})[metric]
    return result


def calibration() -> dict[str, object]:
    """Calibration of the one-cable finger from FEM states: Poisson's ratio, Young's modulus, noise of 1 %."""
    from softgym_envs.codesign.tools.calibration import calibrate
    from softgym_envs.codesign.tools.config import CalibrationConfig
    from softgym_envs.codesign.tools.measurements import measure
    from softgym_envs.config import check_config
    from softgym_envs.robots.registry import make_robot

    robot = make_robot("finger", cables=1)

    def configured(fit: list[str], **options: Any) -> CalibrationConfig:
        data = {"name": "x", "robot": "finger", "robot_options": {"cables": 1}, "data": "none", "fit": fit, **options}
        return check_config(CalibrationConfig, data, "calibration")

    def positions(count: int) -> Any:
        data = measure(robot, {"poisson_ratio": 0.47}, np.linspace(0.0, 0.010, count)[:, None])
        return replace(data, effort=np.full_like(data.effort, np.nan))

    result: dict[str, object] = {}
    starts = [{"poisson_ratio": nu} for nu in (0.45, 0.47, 0.49)]
    three = positions(3)
    for name, options in (
        ("surrogate", {}),
        ("surrogate, then FEM", {"refine": True}),
        ("surrogate, TPE", {"method": "tpe"}),
    ):
        found = calibrate(configured(["poisson_ratio"], starts=starts, level=None, **options), data=three)
        ends = [round(fit.found["poisson_ratio"], 5) for fit in found.fits]
        result[f"nu 0.47, 3 positions, {name}: from each start"] = ends
        result[f"nu 0.47, 3 positions, {name}: found"] = round(found.design["poisson_ratio"], 6)
        result[f"nu 0.47, 3 positions, {name}: all starts [s]"] = round(found.seconds, 2)
    tensions = measure(robot, {"poisson_ratio": 0.47}, np.linspace(0.0, 0.010, 3)[:, None])
    found = calibrate(configured(["poisson_ratio"], starts=starts, level=None), data=tensions)
    result["nu 0.47, 3 positions and tensions, surrogate: found"] = round(found.design["poisson_ratio"], 6)
    result["nu 0.47, 3 positions and tensions, surrogate: all starts [s]"] = round(found.seconds, 2)
    pulled = measure(robot, {"young_modulus": 2.2e6}, [[2.0], [5.0], [10.0], [15.0]], driven="effort")
    found = calibrate(configured(["young_modulus"]), data=pulled)
    result["E 2.2 MPa, 4 efforts, surrogate: error [%]"] = 100.0 * (found.design["young_modulus"] / 2.2e6 - 1.0)
    result["E 2.2 MPa, 4 efforts, surrogate [s]"] = round(found.seconds, 2)
    both = calibrate(configured(["young_modulus", "poisson_ratio"], refine=True, level=None), data=pulled)
    result["E and nu, 4 efforts, surrogate, then FEM: errors"] = [
        both.design["young_modulus"] / 2.2e6 - 1.0,
        both.design["poisson_ratio"] - 0.47,
    ]

    rng = np.random.default_rng(0)
    eleven, runs = positions(11), 40
    for fit, data, truth in (("poisson_ratio", eleven, 0.47), ("young_modulus", pulled, 2.2e6)):
        covered, widths = 0, []
        for _ in range(runs):
            intervals = calibrate(configured([fit]), data=data.with_noise(0.01, rng)).intervals or {}
            low, high = intervals[fit]
            covered += low <= truth <= high
            widths.append(high - low)
        result[f"{fit}, 1 % noise, {len(data)} states: 95 % intervals that cover the truth"] = f"{covered} of {runs}"
        result[f"{fit}, 1 % noise, {len(data)} states: median width of the interval"] = float(np.median(widths))
    return result
