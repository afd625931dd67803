"""The tendon-driven cone against its recordings: fitted to half of them, predicted for the others."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.config import check_config
from softgym_envs.errors import DataError
from softgym_envs.extensions.design.calibration import calibrate, fitted_units, predicted
from softgym_envs.extensions.design.config import CalibrationConfig
from softgym_envs.extensions.design.fit_page import Page, Picture, Table, drawn, parameter_table
from softgym_envs.extensions.design.measurements import Measurements
from softgym_envs.extensions.design.plots import BASELINE, WINNER
from softgym_envs.extensions.measured.comparison import SOURCES, Comparison, Line, files_in, left_out
from softgym_envs.extensions.measured.recordings import matched, read_marker_table
from softgym_envs.extensions.measured.tendon_cone import DRUM, MARKERS, TendonCone
from softgym_envs.mechanics.solvers.statics import Statics

FITTED = ("m1_u01", "m1_u02", "m2_u015", "m2_u025")
"""Recordings to which the cone is fitted: every second torque of each motor. All others are held out."""
NAME = re.compile(r"m([12])_u0(\d+)$")
"""Name of a recording: the motor, and the digits of its torque after the point [N m]."""
BASE = np.array([0.21735, 0.0552, 0.1748])
"""Where the marker at the base is in the frame of the cameras [m]."""
CENTRE = np.array([-0.03, -0.013, 0.0])
"""From that marker to the middle of the base in the frame of the cameras [m], as in the authors' code."""
TURN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation from the frame of the cameras to that of the cone."""
CONFIG: dict[str, Any] = {
    "name": "tendon_cone",
    "robot": "tendon_cone",
    "backend": "fem",
    "fit": ["young_modulus", "density"],
    "nuisances": {
        **{f"turn_{a}": {"kind": "frame", "part": f"turn_{a}", "bounds": [-0.3, 0.3], "unit": "rad"} for a in "xyz"},
    },
    "data": "none",
    "intervals": "linear",
}
"""What is fitted: the material, and how the frame of the cameras is turned against the cone's."""


def tensions(name: str) -> np.ndarray:
    """Return the tensions [N] (2,) that a recording's name states.

    Raises:
        DataError: for another name.
    """
    found = NAME.fullmatch(name)
    if found is None:
        raise DataError(f"recording '{name}' must be named m1_u0... or m2_u0..., with the torque's digits")
    effort = np.zeros(2)
    effort[int(found[1]) - 1] = float(f"0.{found[2]}") / DRUM
    return effort


def markers_of(path: Path, robot: TendonCone) -> np.ndarray:
    """Return the four markers in the frame of the cone [m] (4, 3), in their order.

    The file has five unnamed markers. That of the base does not move; the others are those nearest to where the cone
    with the authors' first material has them.

    Raises:
        DataError: if there are not five markers, or none at the base.
    """
    points = np.nanmean(read_marker_table(path).markers, axis=0)
    base = int(np.linalg.norm(points - BASE, axis=1).argmin())
    if len(points) != 5 or np.linalg.norm(points[base] - BASE) > 0.02:
        raise DataError(f"recording '{path}' must have five markers, one at the base near {BASE.tolist()} m")
    own = (np.delete(points, base, axis=0) - points[base] - CENTRE) @ TURN.T
    expected = Statics(robot.build()).solve(tensions(path.stem), "effort").condensed.delta.e
    return own[matched(own, expected.reshape(-1, 3))]


def read(folder: Path) -> Measurements:
    """Return all recordings of a folder, each as one state of its own trial; see `files_in` and `markers_of`."""
    source = SOURCES["tendon_cone"]
    paths = [path for path in files_in(folder, "m[12]_u*.csv", source) if NAME.fullmatch(path.stem)]
    missing = [name for name in FITTED if name not in {path.stem for path in paths}]
    if missing:
        raise DataError(f"folder '{folder}' lacks {missing[0]}.csv; copy {source.files} of {source.origin}")
    robot = TendonCone()
    effort = np.array([tensions(path.stem) for path in paths])
    effector = np.array([markers_of(path, robot).ravel() for path in paths])
    names = tuple(path.stem for path in paths)
    return Measurements("effort", np.full_like(effort, np.nan), effort, effector, names)


def distances(readings: np.ndarray, data: Measurements) -> np.ndarray:
    """Return the distance of each marker from where it was measured [m], shape (N, markers)."""
    error = readings[:, data.effort.shape[1] :] - data.effector
    return np.linalg.norm(error.reshape(len(data), -1, 3), axis=2)


def compare(folder: Path) -> Comparison:
    """Fit the cone to half of the recordings and predict the others; see `Source.compare`."""
    source = SOURCES["tendon_cone"]
    data = read(folder)
    held_out = [name for name in data.trials if name not in FITTED]
    config = check_config(CalibrationConfig, {**CONFIG, "held_out": held_out}, "the comparison")
    began = time.process_time()
    result = calibrate(config, data=data)
    seconds = time.process_time() - began
    fitted, others = data.split(held_out)
    readings = predicted(config, result, data)
    every = dict(zip(data.trials, 1e3 * distances(readings, data), strict=True))
    errors = {"fitted": [every[name] for name in fitted.trials], "held out": [every[name] for name in others.trials]}
    mean = {kind: float(np.mean(values)) for kind, values in errors.items() if values}
    alone = check_config(CalibrationConfig, {**CONFIG, "nuisances": {}, "held_out": held_out}, "the comparison")
    single = calibrate(alone, data=data)
    single_error = 1e3 * float(distances(predicted(alone, single, others), others).mean()) if held_out else np.nan
    lines = [
        Line("mean distance of the markers, fitted recordings", f"{mean['fitted']:.1f} mm", source.others),
        *([Line("  held-out recordings", f"{mean['held out']:.1f} mm", "")] if held_out else []),
        Line("  held out, with modulus and density alone", f"{single_error:.1f} mm", "two numbers fitted"),
        Line("identification", f"{seconds:.1f} CPU s", ""),
        *left_out(folder, [Path(f"{name}.csv") for name in data.trials]),
    ]
    rows = [
        [
            name,
            *(f"{value:.1f}" for value in values),
            f"{values.mean():.1f}",
            "held out" if name in held_out else "fitted",
        ]
        for name, values in every.items()
    ]
    n = data.effort.shape[1]

    def draw(axes: list[Any]) -> None:
        for axis, across in zip(axes, (0, 1), strict=True):
            for color, symbol, label, values in (
                (BASELINE, "o", "measured", data.effector),
                (WINNER, "x", "computed", readings[:, n:]),
            ):
                at = 1e3 * values.reshape(len(data), -1, 3)
                axis.plot(at[..., across].ravel(), at[..., 2].ravel(), symbol, color=color, label=label)
            for measured, computed in zip(data.effector, readings[:, n:], strict=True):
                ends = 1e3 * np.stack([measured.reshape(-1, 3), computed.reshape(-1, 3)])
                axis.plot(ends[..., across], ends[..., 2], "-", color="0.7", lw=0.8)
            axis.set_xlabel(f"{'xy'[across]} [mm]")
            axis.set_aspect("equal", adjustable="datalim")
        axes[0].set_ylabel("z [mm]")
        axes[0].legend()

    table = parameter_table(result, fitted_units(config))
    page = Page(
        "Tendon-driven cone: measured and computed",
        [
            f"Fitted to {len(fitted)} recordings, the markers are {mean['fitted']:.1f} mm off in the mean"
            + (f"; on {len(others)} that were held out {mean['held out']:.1f} mm." if held_out else "."),
            f"Recordings: {source.origin}, {source.folder}. Others: {source.others}.",
            "The cone is a tapered rod with tendons through discs, under its weight. Markers are told apart by where "
            "the cone with the authors' first material has them.",
            *result.notes,
        ],
        [
            Picture(
                "Markers of all recordings", drawn(draw, 2), "From both sides; a line joins measured and computed."
            ),
            Table("Distance by recording [mm]", ["recording", *MARKERS, "mean", ""], rows),
            table,
        ],
    )
    return Comparison(lines, [" ".join(row).strip() for row in table.rows], page)
