"""What a comparison with recordings consists of, and which there are."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from softgym_envs.errors import DataError, unknown_name
from softgym_envs.extensions.design.fit_page import Page


@dataclass(frozen=True)
class Line:
    """One result beside that of others.

    Attributes:
        what: that was compared.
        ours: in words, with its unit.
        others: what other codes publish for it.
    """

    what: str
    ours: str
    others: str


@dataclass(frozen=True)
class Comparison:
    """Results, what was fitted, and the page about both."""

    lines: Sequence[Line]
    fitted: Sequence[str]
    page: Page


@dataclass(frozen=True)
class Source:
    """Where the public recordings of a robot are.

    Attributes:
        robot: name of the robot.
        origin: repository, commit and licence.
        folder: there.
        files: which to copy.
        others: what other codes publish.
    """

    robot: str
    origin: str
    folder: str
    files: str
    others: str

    def compare(self, folder: Path) -> Comparison:
        """Compare the robot with the recordings in a folder.

        Raises:
            DataError: if the folder lacks files, or they are malformed.
        """
        module = import_module(f"softgym_envs.extensions.measured.{self.robot}_recordings")
        run: Callable[[Path], Comparison] = module.compare
        return run(folder)


SOURCES = {
    source.robot: source
    for source in (
        Source(
            "silicone_beam",
            "github.com/srl-ethz/diffPD_sim2real, commit 825e7b7, MIT licence",
            "python/realbeam_experiments/Measurement_data",
            "beam_gravity_V2_*.c3d, beam_load52_V2_*.c3d, beam_load101_V2_*.c3d",
            "the authors find COMSOL equal to it with the same modulus; SORS needs a Poisson's ratio of 0.316",
        ),
        Source(
            "tendon_cone",
            "github.com/tud-phi/soromox, commit 4f03054, MIT licence",
            "paper_results/secVa_system_identification/data",
            "m1_u*.csv, m2_u*.csv",
            "SoRoMoX: 21.1 mm mean over the eight recordings after fitting three numbers to all of them",
        ),
        Source(
            "tendon_rod",
            "github.com/ContinuumRoboticsLab/opencr-mujoco, commit 17fff8b, MIT licence",
            "data/sysid/ftdcr_v6/tdcrv6_sysid_20260406-181730_analysis",
            "*train.csv and, for poses that the authors held out, *val.csv",
            "the authors publish no error",
        ),
    )
}
"""All comparisons by name of the robot."""


def find_source(robot: str) -> Source:
    """Return the recordings of a robot.

    Raises:
        ValueError: for a robot without any.
    """
    if robot not in SOURCES:
        raise ValueError(unknown_name("robot", robot, SOURCES))
    return SOURCES[robot]


def files_in(folder: Path, pattern: str, source: Source) -> list[Path]:
    """Return the files of a folder that match a pattern.

    Raises:
        DataError: if there is none; it says where they are.
    """
    found = sorted(folder.glob(pattern))
    if not found:
        raise DataError(
            f"folder '{folder}' has no {pattern}; copy {source.files} there from {source.folder} of {source.origin}"
        )
    return found


def left_out(folder: Path, used: Iterable[Path]) -> list[Line]:
    """Return a line that names the recordings of a folder (C3D, CSV) that a comparison does not use, if any."""
    kept = {path.name for path in used}
    names = sorted(path.name for path in folder.iterdir() if path.suffix.lower() in (".c3d", ".csv"))
    others = [name for name in names if name not in kept]
    if not others:
        return []
    more = f" and {len(others) - 5} more" if len(others) > 5 else ""
    return [Line("recordings that are left out", ", ".join(others[:5]) + more, "")]


def numbers(values: Any, digits: int = 2) -> str:
    """Return numbers as text, with commas."""
    return ", ".join(f"{value:.{digits}f}" for value in values)
