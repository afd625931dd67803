"""Readers of recordings: motion capture as C3D, tables of markers as CSV, and which marker is which."""

from __future__ import annotations

import csv
import struct
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from softgym_envs.errors import DataError, unknown_name
from softgym_envs.extras import require


@dataclass(frozen=True)
class Recording:
    """Markers over time.

    Attributes:
        markers: positions [m], shape (frames, markers, 3); NaN where a marker was not seen.
        labels: names of the markers; empty if they have none.
        rate: frames per second.
    """

    markers: np.ndarray
    labels: tuple[str, ...]
    rate: float

    def still(self, frames: int = 20, slowest: float = 0.01, release: float = 0.04) -> np.ndarray:
        """Return the mean positions [m] (markers, 3) of the last still frames before the body is released.

        Speeds are the largest of any marker over five frames, so that noise does not count.

        Args:
            frames: how many still frames at most.
            slowest: speed below which a frame is still [m/s].
            release: speed that shows that the body has been released [m/s].

        Raises:
            DataError: if no frame before that is still.
        """
        speed = np.linalg.norm(self.markers[5:] - self.markers[:-5], axis=2).max(axis=1) * self.rate / 5.0
        released = np.flatnonzero(speed > release)
        before = speed[: released[0]] if len(released) else speed
        still = np.flatnonzero(before < slowest)
        if not len(still):
            raise DataError(f"no frame before the body is released is still, slower than {slowest:g} m/s")
        return np.nanmean(self.markers[still[-frames:]], axis=0)

    def end(self, frames: int = 20) -> np.ndarray:
        """Return the mean positions [m] (markers, 3) of the last frames."""
        return np.nanmean(self.markers[-frames:], axis=0)


def read_c3d(path: str | Path) -> Recording:
    """Read the markers of a C3D file in metres or millimetres.

    Raises:
        DataError: if the file cannot be read, or its unit is another one.
        MissingExtra: without the extra ``measured``.
    """
    require("measured")
    import c3d

    try:
        with open(path, "rb") as stream, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the library warns of analog parameters that a file lacks
            reader = c3d.Reader(stream)
            frames = np.stack([points[:, :4].copy() for _, points, _ in reader.read_frames()])
            labels = tuple(label.strip() for label in reader.point_labels)
            unit = reader.get("POINT:UNITS")
            rate = float(reader.point_rate)
    except (OSError, ValueError, AssertionError, KeyError, IndexError, EOFError, struct.error) as error:
        raise DataError(f"recording '{path}' cannot be read as C3D: {error}") from None
    scales = {"m": 1.0, "mm": 1e-3, "cm": 1e-2}
    name = unit.string_value.strip() if unit is not None else "mm"
    if name not in scales:
        raise DataError(f"recording '{path}': {unknown_name('unit', name, scales)}")
    markers = frames[:, :, :3] * scales[name]
    markers[frames[:, :, 3] < 0.0] = np.nan  # a negative residual: the marker was not seen
    return Recording(markers, labels, rate)


def read_marker_table(path: str | Path) -> Recording:
    """Read a CSV file without a header: number of the frame, time [s], x, y and z of each marker [m].

    Raises:
        DataError: if the file cannot be read, or is no such table.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as stream:
            rows = np.array([[float(entry) for entry in row] for row in csv.reader(stream) if row])
    except (OSError, ValueError, UnicodeDecodeError) as error:
        raise DataError(f"recording '{path}' cannot be read as a table of markers: {error}") from None
    if rows.ndim != 2 or len(rows) < 2 or rows.shape[1] < 5 or (rows.shape[1] - 2) % 3:
        raise DataError(f"recording '{path}' must have rows of frame, time, and x, y, z of each marker: {rows.shape}")
    duration = max(rows[-1, 1] - rows[0, 1], 1e-12)
    return Recording(rows[:, 2:].reshape(len(rows), -1, 3), (), float((len(rows) - 1) / duration))


def rigid_motion(points: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation (3, 3) and shift [m] (3,) that bring points (p, 3) nearest to places (p, 3) (Kabsch 1976)."""
    middle, goal = points.mean(axis=0), places.mean(axis=0)
    left, _, right = np.linalg.svd((places - goal).T @ (points - middle))
    turn = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    return turn, goal - turn @ middle


def matched(points: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Return which of the points (p, 3) is each expected marker (k, 3): the assignment of least squared distance."""
    from scipy.optimize import linear_sum_assignment

    squared = ((points[None] - expected[:, None]) ** 2).sum(axis=-1)
    return np.asarray(linear_sum_assignment(squared)[1])


def read_table(path: str | Path, columns: Sequence[str], text: Sequence[str]) -> dict[str, np.ndarray]:
    """Read columns of a CSV file with a header, as numbers or as text.

    Raises:
        DataError: if the file or a column is missing, or a number is none.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as stream:
            rows = list(csv.DictReader(stream))
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"recording '{path}' cannot be read: {error}") from None
    if not rows:
        raise DataError(f"recording '{path}' has no rows")
    for name in (*columns, *text):
        if name not in rows[0]:
            raise DataError(f"recording '{path}': {unknown_name('column', name, list(rows[0]))}")
    try:
        found = {name: np.array([float(row[name]) for row in rows]) for name in columns}
    except (TypeError, ValueError) as error:
        raise DataError(f"recording '{path}': {error}") from None
    return found | {name: np.array([row[name] for row in rows]) for name in text}
