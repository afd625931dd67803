"""What carries over to another robot: numbers identified on the tendon rod v6, or a residual learned on it?

python studies/measured_residual/residual.py V6_FOLDER V4_FILE

``V6_FOLDER`` has the recordings of `softgym validate tendon_rod`; ``V4_FILE`` is a table of poses of the robot v4.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.config import check_config
from softgym_envs.extensions.design.calibration import calibrate, predicted
from softgym_envs.extensions.design.config import CalibrationConfig
from softgym_envs.extensions.design.measurements import Measurements
from softgym_envs.extensions.measured.tendon_rod_recordings import CONFIG, SINGLE, centred_pulls, read, rmse
from softgym_envs.runs import provenance

CARRIED = ("stretch",)
"""Nuisances that belong to tendons and drives, not to one assembly."""
FOLDS, WIDTHS, RIDGES = 5, (0.5, 1.0, 2.0, 4.0), (1e-3, 1e-2, 1e-1, 1.0)


def features(data: Measurements) -> np.ndarray:
    """Pulls [mm] (N, 9) less the mean pull of their segment."""
    return 1e3 * centred_pulls(data)


class Residual:
    """Kernel ridge regression of the error of the tip on the pulls; width and ridge by folds over whole trials."""

    def __init__(self, x: np.ndarray, y: np.ndarray, trial: np.ndarray) -> None:
        self._x, self._scale, self._mean = x, x.std(axis=0).mean() * x.shape[1] ** 0.5, y.mean(axis=0)
        fold = np.unique(trial, return_inverse=True)[1] % FOLDS
        best: tuple[float, Any] = (np.inf, None)
        for width in WIDTHS:
            for ridge in RIDGES:
                error = np.zeros_like(y)
                for k in range(FOLDS):
                    out = fold == k
                    error[out] = y[out] - self._fit(x[~out], y[~out], width, ridge)(x[out])
                best = min(best, (float((error**2).sum()), (width, ridge)), key=lambda each: each[0])
        self.chosen = best[1]
        self._function = self._fit(x, y, *self.chosen)

    def _fit(self, x: np.ndarray, y: np.ndarray, width: float, ridge: float) -> Any:
        def kernel(a: np.ndarray) -> np.ndarray:
            square = ((a[:, None] - x[None]) ** 2).sum(axis=2)
            return np.exp(-square / (2.0 * (width * self._scale) ** 2))

        mean = y.mean(axis=0)
        weights = np.linalg.solve(kernel(x) + ridge * np.eye(len(x)), y - mean)
        return lambda a: mean + kernel(a) @ weights

    def __call__(self, x: np.ndarray) -> np.ndarray:
        return self._function(x)


def turned(tips: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Turn tips about the axis so that they fit best: nobody knows how the cameras of another robot stand."""
    a, b = tips - tips.mean(axis=0), measured - measured.mean(axis=0)
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a[:, :2] * b[:, :2]).sum())
    c, s = np.cos(angle), np.sin(angle)
    return tips @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def main(folder: Path, other: Path) -> None:
    """Fit on the v6, score there and on the v4, and write results.json."""
    everything = read(next(folder.glob("*train.csv")))
    single = np.array([SINGLE in name for name in everything.trial])
    poses, slack = everything.part(~single), everything.part(single)
    held = list(poses.trials[1::2])
    train, test = poses.split(held)
    v4 = read(other)

    def config(version: str) -> CalibrationConfig:
        return check_config(CalibrationConfig, {**CONFIG, "robot_options": {"version": version}, "held_out": held}, "")

    result = calibrate(config("v6"), data=poses)
    textbook = replace(result, design={**result.design, "twist": 0.0}, nuisances={})
    kept = {name: value for name, value in result.nuisances.items() if name in CARRIED}
    carried = replace(result, nuisances=kept)

    def tips(version: str, values: Any, data: Measurements, *, centre: bool) -> np.ndarray:
        made = config(version)
        made = made.model_copy(update={"nuisances": {k: v for k, v in made.nuisances.items() if k in values.nuisances}})
        design = {**values.design, "young_modulus": made.make_robot().design_space.baseline["young_modulus"]}
        if centre:
            data = Measurements("displacement", centred_pulls(data), data.effort, data.effector, data.trial)
        return predicted(made, replace(values, design=design), data)[:, data.displacement.shape[1] :]

    trial, rows = np.array(train.trial), {}
    models = {"textbook": (textbook, True), "identified": (result, False)}
    for name, (values, centre) in models.items():
        base = tips("v6", values, train, centre=centre)
        residual = Residual(features(train), train.effector - base, trial)
        row: dict[str, Any] = {"residual": dict(zip(("width", "ridge"), residual.chosen, strict=True))}
        for where, data in (("fitted", train), ("held out", test), ("slack", slack)):
            found = tips("v6", values, data, centre=centre)
            row[where] = [rmse(found - data.effector), rmse(found + residual(features(data)) - data.effector)]
        on_v4 = {"textbook": (textbook, True), "identified": (carried, True)}[name]
        found = tips("v4", *on_v4[:1], v4, centre=on_v4[1])
        with_residual = found + residual(features(v4))
        row["v4"] = [rmse(turned(each, v4.effector) - v4.effector) for each in (found, with_residual)]
        rows[name] = row
        print(name, json.dumps(row), flush=True)
    counts = {"fitted": len(train), "held out": len(test), "slack": len(slack), "v4": len(v4)}
    Path(__file__).with_name("results.json").write_text(
        json.dumps({**provenance(), "poses": counts, "rmse_mm": rows}, indent=1) + "\n"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
