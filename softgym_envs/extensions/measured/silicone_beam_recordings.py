"""The silicone beam against its recordings: every load, element and mesh with the authors' material."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.extensions.design.fit_page import Page, Picture, Table, drawn
from softgym_envs.extensions.design.plots import BASELINE, WINNER
from softgym_envs.extensions.measured.comparison import SOURCES, Comparison, Line, files_in, left_out, numbers
from softgym_envs.extensions.measured.recordings import read_c3d, rigid_motion
from softgym_envs.extensions.measured.silicone_beam import MESHES, SiliconeBeam
from softgym_envs.mechanics.locking import locking_accepted
from softgym_envs.mechanics.solvers.statics import Statics

LOADS = {"gravity": 0.0, "load52": 0.51012, "load101": 1.00062}
"""Weight at the tip [N], by a word in the name of the file."""
PLACES = np.array(
    [
        [0.0, 0.015, 0.036],
        [0.0, -0.006, 0.024],
        [0.0, 0.036, 0.006],
        [-0.094, -0.010, -0.001],
        [-0.094, 0.040, 0.0275],
        [-0.094, 0.040, 0.0],
    ]
)
"""The markers on the straight beam [m] as in the authors' code: three at the tip and three at the base."""
ELEMENTS = ("quadratic", "averaged", "linear")


def measured_motion(path: Path) -> tuple[np.ndarray, float]:
    """Return how far the tip's markers move from the held, straight beam to rest [m] (3, 3), and the misfit [m] there.

    The markers of the held beam are laid on their places by a rigid motion; the misfit is its root mean square.
    """
    recording = read_c3d(path)
    held = recording.still()
    turn, shift = rigid_motion(held, PLACES)
    misfit = float(np.sqrt(((held @ turn.T + shift - PLACES) ** 2).sum(axis=1).mean()))
    return ((recording.end() - held) @ turn.T)[:3], misfit


def compare(folder: Path) -> Comparison:
    """Compare all recordings in a folder; see `Source.compare`."""
    source = SOURCES["silicone_beam"]
    files = {word: files_in(folder, f"*{word}*.c3d", source) for word in LOADS}
    measured = {word: [measured_motion(path) for path in paths] for word, paths in files.items()}
    rows, best, seconds = [], {}, {}
    for element in ELEMENTS:
        for mesh in MESHES:
            robot = SiliconeBeam(element=element, mesh=mesh)
            began = time.process_time()
            for word, load in LOADS.items():
                with locking_accepted():  # the page shows by how much
                    model = robot.build({"tip_load": load})
                rest = np.concatenate([c.value(model.nodes) for c in model.constraints["e"]])
                state = Statics(model).solve([0.0], "effort")
                best[element, mesh, word] = (state.condensed.delta.e - rest).reshape(3, 3)
            seconds[element, mesh] = time.process_time() - began
            moved = [best[element, mesh, word] for word in LOADS]
            errors = [
                np.mean([np.abs(m[:, 2] - motion[:, 2]) for motion, _ in measured[word]])
                for m, word in zip(moved, LOADS, strict=True)
            ]
            whole = [
                np.mean([np.linalg.norm(m - motion, axis=1) for motion, _ in measured[word]])
                for m, word in zip(moved, LOADS, strict=True)
            ]
            size = f"{len(model.nodes)}"
            texts = [f"{1e3 * value:.2f}" for value in (*errors, *whole)]
            rows.append([element, mesh, size, *texts, f"{seconds[element, mesh]:.1f}"])
    shown = ("quadratic", "fine")
    drops = {word: 1e3 * np.array([motion[:, 2] for motion, _ in measured[word]]) for word in LOADS}
    computed = {word: 1e3 * best[*shown, word][:, 2] for word in LOADS}
    vertical = {word: np.abs(computed[word] - drops[word].mean(axis=0)) for word in LOADS}
    largest = max(float(error.max()) for error in vertical.values())
    single = max(float(np.abs(computed[word] - drops[word]).max()) for word in LOADS)
    apart = max(float(np.ptp(drops[word], axis=0).max()) for word in LOADS)
    lines = [
        Line("vertical error, largest of all markers and loads", f"{largest:.2f} mm", source.others),
        Line(
            "  against a single recording", f"{single:.2f} mm", f"recordings of one load differ by up to {apart:.2f} mm"
        ),
    ]
    for word, load in LOADS.items():
        away = f"{numbers(vertical[word])} mm of {-drops[word].mean():.1f} mm"
        lines.append(Line(f"  {load:.2f} N at the tip, each marker, mean of {len(files[word])} recordings", away, ""))

    def draw(axes: list[Any]) -> None:
        for axis, (word, load) in zip(axes, LOADS.items(), strict=True):
            for color, symbol, name, motions in (
                (BASELINE, "o", "measured", [motion for motion, _ in measured[word]]),
                (WINNER, "x", "computed", [best[*shown, word]]),
            ):
                for k, motion in enumerate(motions):
                    at = 1e3 * (PLACES[:3] + motion)
                    axis.plot(at[:, 0], at[:, 2], symbol, color=color, label=name if k == 0 else None, ms=9)
            rest = 1e3 * PLACES[:3]
            axis.plot(rest[:, 0], rest[:, 2], ".", color="0.6", label="held straight")
            axis.set_title(f"{load:.2f} N")
            axis.set_xlabel("x [mm]")
            axis.set_aspect("equal", adjustable="datalim")
        axes[0].set_ylabel("z [mm]")
        axes[0].legend()

    lines += left_out(folder, [path for paths in files.values() for path in paths])
    misfit = 1e3 * max(value for group in measured.values() for _, value in group)
    columns = ["element", "mesh", "nodes"]
    columns += [f"vertical, {load:.2f} N [mm]" for load in LOADS.values()]
    columns += [f"distance, {load:.2f} N [mm]" for load in LOADS.values()]
    page = Page(
        "Silicone beam: measured and computed",
        [
            "Nothing is fitted here: Poisson's ratio 0.499 and density 1070 kg/m3 are those of the authors' code, and "
            "the modulus of 263,824 Pa is what they fitted themselves. "
            f"The largest vertical error is {largest:.2f} mm against the mean recording of a load, and {single:.2f} mm "
            f"against a single one; recordings of one load differ by up to {apart:.2f} mm.",
            f"Recordings: {source.origin}, {source.folder}. Others: {source.others}.",
            f"Held straight, the markers lie within {misfit:.1f} mm (root mean square) of where the authors say.",
        ],
        [
            Picture(
                "Markers at the tip",
                drawn(draw, 3, width=3.8),
                "From the side, on the fine mesh of quadratic elements.",
            ),
            Table(
                "Error by load, element and mesh (mean over markers and recordings)",
                [*columns, "CPU [s]"],
                rows,
                "Linear elements lock: they are too stiff in bending.",
            ),
        ],
    )
    return Comparison(lines, [], page)
