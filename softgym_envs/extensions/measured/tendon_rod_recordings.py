"""The tendon rod against its recordings: fitted to training poses, predicted for held-out ones."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.config import check_config
from softgym_envs.envs.plant import play
from softgym_envs.errors import DataError
from softgym_envs.extensions.design.calibration import calibrate, fitted_units, predicted
from softgym_envs.extensions.design.config import CalibrationConfig
from softgym_envs.extensions.design.fit_page import Page, Picture, Table, drawn, parameter_table, residual_picture
from softgym_envs.extensions.design.measurements import Measurements
from softgym_envs.extensions.design.plots import BASELINE, WINNER
from softgym_envs.extensions.measured.comparison import SOURCES, Comparison, Line, files_in, left_out
from softgym_envs.extensions.measured.recordings import read_table
from softgym_envs.extensions.measured.tendon_rod import VERSIONS

SERVOS = {"v6": (1, 20, 23, 9, 6, 11, 24, 2, 3), "v4": (4, 3, 9, 5, 2, 8, 6, 1, 7)}
"""Servos of each robot in the order of its tendons."""
TENDONS = tuple(f"tendon_{segment}{place}" for segment in (1, 2, 3) for place in (1, 2, 3))
SINGLE = "tendon"
"""Part of the label of poses in which one tendon is pulled while the others hang 10 mm slack."""
STILL = 3e-4
"""Largest pull of a pose at rest [m]."""
PARTS = 9
"""Parts of the poses at rest, of which each is predicted from the others."""
PLAYS = (1e-3, 2e-3, 4e-3)
"""Widths of play with which friction is looked for [m]."""
CONFIG: dict[str, Any] = {
    "name": "tendon_rod",
    "robot": "tendon_rod",
    "backend": "fem",
    "fit": ["twist"],
    "nuisances": {
        "stretch": {
            "kind": "compliance",
            "columns": [f"{name}_displacement" for name in TENDONS],
            "bounds": [0.0, 5e-3],
            "start": 5e-4,
            "unit": "m/N",
        },
        "turn": {"kind": "frame", "part": "turn_z", "bounds": [-0.5, 0.5], "start": 0.0, "unit": "rad"},
        **{
            f"zero_{name[-2:]}": {
                "kind": "offset",
                "column": f"{name}_displacement",
                "bounds": [-4e-3, 4e-3],
                "start": 0.0,
                "unit": "m",
            }
            for name in TENDONS
        },
        **{f"shift_{a}": {"kind": "frame", "part": f"shift_{a}", "bounds": [-0.03, 0.03], "unit": "m"} for a in "xyz"},
    },
    "data": "none",
    "intervals": "linear",
}
"""What is fitted: twelve physical numbers, and where the origin of the cameras is."""


def version_of(path: Path) -> str:
    """Return which robot a file is of, by its servos.

    Raises:
        DataError: if it cannot be read, or has the servos of neither.
    """
    try:
        with open(path, encoding="utf-8-sig") as stream:
            names = stream.readline().strip().split(",")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"recording '{path}' cannot be read: {error}") from None
    for version, servos in SERVOS.items():
        if all(f"servo_{number}_mm" in names for number in servos):
            return version
    raise DataError(f"recording '{path}' has no columns servo_N_mm of one of the robots {', '.join(SERVOS)}")


def read(path: Path) -> Measurements:
    """Return the poses of a file; a trial is what its label names, with or without a hold at the end.

    Positions are in the frame of the robot: that of the cameras is turned by half a turn about the axis.
    """
    servos = [f"servo_{number}_mm" for number in SERVOS[version_of(path)]]
    tip = ["tip_x", "tip_y", "tip_z"]
    table = read_table(path, [*servos, *tip], ["pattern_label"])
    pulls = 1e-3 * np.column_stack([table[name] for name in servos])
    places = 1e-3 * np.column_stack([table[name] for name in tip]) * [-1.0, -1.0, 1.0]
    trial = tuple(str(label).removesuffix("_hold") for label in table["pattern_label"])
    return Measurements("displacement", pulls, np.full_like(pulls, np.nan), places, trial)


def rmse(error: np.ndarray, *, aligned: bool = True) -> float:
    """Return the root mean square distance [mm] of errors [m] (N, 3), without their mean if ``aligned``."""
    if aligned:
        error = error - error.mean(axis=0)
    return 1e3 * float(np.sqrt((error**2).sum(axis=1).mean()))


def compare(folder: Path) -> Comparison:
    """Fit the rod to the training poses and predict the others; see `Source.compare`.

    Other files than ``*train.csv`` are held out. Without any, every second trial of the training poses is.
    """
    source = SOURCES["tendon_rod"]
    path = files_in(folder, "*train.csv", source)[0]
    everything, version = read(path), version_of(path)
    single = np.array([SINGLE in name for name in everything.trial])
    train = everything.part(~single)
    files = [path for path in sorted(folder.glob("*val.csv"))]
    if files:
        held, names = read(files[0]), []
        held = held.part(np.array([SINGLE not in name for name in held.trial]))
        of = f"the poses of {files[0].name}"
    else:
        names = list(train.trials[1::2])
        held = train.split(names)[1]
        of = "every second trial"
    given = {**CONFIG, "robot_options": {"version": version}}
    config = check_config(CalibrationConfig, {**given, "held_out": names}, "the comparison")
    began = time.process_time()
    result = calibrate(config, data=train)
    seconds = time.process_time() - began
    fitted = train.split(names)[0]
    parts = {"fitted": fitted, "held out": held}
    if single.any():
        parts["one tendon pulled, others slack"] = everything.part(single)
    found, pace = {}, 0.0
    for kind, part in parts.items():
        began = time.process_time()
        found[kind] = predicted(config, result, part)
        if kind == "held out":
            pace = 1000.0 * (time.process_time() - began) / len(part)
    error = {kind: found[kind][:, 9:] - part.effector for kind, part in parts.items()}
    count = len(config.fit) + len(config.nuisances) - 3
    nominal_config = check_config(
        CalibrationConfig, {**given, "nuisances": {}, "fit": ["twist"], "level": None}, "the comparison"
    )
    plain = Measurements("displacement", centred_pulls(held), held.effort, held.effector, held.trial)
    textbook = type(result)(**{**vars(result), "design": {**result.design, "twist": 0.0}, "nuisances": {}})
    nominal = predicted(nominal_config, textbook, plain)[:, 9:] - held.effector
    ours, there = f"{rmse(error['held out']):.1f} mm RMSE", f"{rmse(error['fitted']):.1f} mm RMSE"
    lines = [
        Line(f"held-out poses ({of}, {len(held)}), offset aligned", ours, source.others),
        Line("  without alignment", f"{rmse(error['held out'], aligned=False):.1f} mm RMSE", ""),
        Line(f"  fitted poses ({len(fitted)}), offset aligned", there, f"{count} numbers"),
        Line("  held out, textbook values, less the mean pull of each segment", f"{rmse(nominal):.1f} mm RMSE", ""),
        Line("identification", f"{seconds:.0f} CPU s", ""),
        Line("speed", f"{pace:.1f} CPU s for 1,000 poses", ""),
    ]
    lines += left_out(folder, [path, *files[:1]])
    still = np.abs(centred_pulls(train)).max(axis=1) < STILL
    explained = scatter_at_rest(train) if still.sum() > 3 * PARTS else {}
    rows = []
    for kind, part in parts.items():
        away = 1e3 * np.linalg.norm(error[kind], axis=1)
        rows.append(
            [
                kind,
                f"{len(part)}",
                f"{rmse(error[kind]):.1f}",
                f"{np.median(away):.1f}",
                f"{np.percentile(away, 95):.1f}",
            ]
        )
    groups = sorted({name.split("_", 1)[1].rsplit("_", 1)[0] for name in train.trial})
    shown = {group: np.array([f"_{group}_" in name for name in held.trial]) for group in groups}
    for group, mask in shown.items():
        if mask.sum() > 2:
            away = 1e3 * np.linalg.norm(error["held out"][mask], axis=1)
            texts = [f"{rmse(error['held out'][mask], aligned=False):.1f}", f"{np.median(away):.1f}"]
            rows.append([f"  held out, {group}", f"{mask.sum()}", *texts, f"{np.percentile(away, 95):.1f}"])
    rest = "Poses with one tendon pulled against slack ones, outside of the fit, are worst."
    if explained:
        rest = (
            f"What is left: {int(still.sum())} poses with all pulls within {1e3 * STILL:g} mm of their mean lie about "
            f"their own mean, in mm (RMS, predicted from other poses): "
            + ", ".join(f"{value:.1f} {name}" for name, value in explained.items())
            + f". Friction that holds the tendons back would be explained by the last ones. {rest}"
        )

    def draw(axes: list[Any]) -> None:
        computed = found["held out"][:, 9:]
        for axis, across in zip(axes, (0, 1), strict=True):
            for color, symbol, label, values in (
                (BASELINE, "o", "measured", held.effector),
                (WINNER, "x", "computed", computed),
            ):
                axis.plot(1e3 * values[:, across], 1e3 * values[:, 2], symbol, color=color, label=label, ms=4)
            ends = 1e3 * np.stack([held.effector, computed])
            axis.plot(ends[..., across], ends[..., 2], "-", color="0.7", lw=0.6, zorder=0)
            axis.set_xlabel(f"{'xy'[across]} [mm]")
        axes[0].set_ylabel("z [mm]")
        axes[0].legend()

    table, modulus = parameter_table(result, fitted_units(config)), VERSIONS[version].young_modulus
    page = Page(
        "Tendon rod: measured and computed",
        [
            f"{ours} on {len(held)} held-out poses after fitting {count} physical numbers to {len(fitted)} others "
            f"({there} there), offset aligned.",
            f"Recordings: {source.origin}, {source.folder}. Others: {source.others}.",
            "The tendons' stretch is known only in proportion to the rod's flexibility: recordings of positions "
            f"without a force cannot tell them apart. The modulus is the authors' {1e-9 * modulus:g} GPa.",
            rest,
            *result.notes,
        ],
        [
            Picture("Held-out tips", drawn(draw, 2), "From both sides; a line joins measured and computed."),
            Table("Distance of the tip [mm]", ["poses", "number", "RMSE", "median", "95 %"], rows),
            table,
            residual_picture("held-out poses", held, found["held out"]),
        ],
    )
    return Comparison([*lines, Line("rest", rest, "")], [" ".join(row).strip() for row in table.rows], page)


def centred_pulls(data: Measurements) -> np.ndarray:
    """Return the pulls [m] (N, 9) less the mean pull of their segment."""
    pulls = data.displacement.reshape(-1, 3, 3)
    return (pulls - pulls.mean(axis=2, keepdims=True)).reshape(-1, 9)


def scatter_at_rest(data: Measurements) -> dict[str, float]:
    """Return how far poses at rest lie from where linear functions predict them [mm], by what these know.

    Each of `PARTS` parts of the poses is predicted from the others. Tendons that friction holds back lag behind: a play
    as wide as the friction stretches them follows the pulls in the order in which they were recorded.
    """
    pulls = centred_pulls(data).reshape(-1, 3, 3)
    across = (pulls @ np.array([[1.0, 0.0], [-0.5, 0.75**0.5], [-0.5, -(0.75**0.5)]])).reshape(-1, 6)
    still = np.abs(pulls).max(axis=(1, 2)) < STILL
    tips = data.effector[still]

    def left(known: np.ndarray) -> float:
        error, columns = np.zeros_like(tips), np.column_stack([np.ones(len(tips)), known])
        for part in range(PARTS):
            out = np.arange(len(tips)) % PARTS == part
            error[out] = tips[out] - columns[out] @ np.linalg.lstsq(columns[~out], tips[~out], rcond=None)[0]
        return rmse(error, aligned=False)

    found = {"in themselves": left(np.empty((len(tips), 0))), "knowing the present pulls": left(across[still])}
    for width in PLAYS:
        behind, lag = across[0], np.empty_like(across)
        for k, now in enumerate(across):
            behind = play(now, behind, np.full(6, width))
            lag[k] = now - behind
        found[f"and a play of {1e3 * width:g} mm"] = left(np.hstack([across, lag])[still])
    return found
