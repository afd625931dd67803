"""Recordings that are made here."""

from __future__ import annotations

import warnings

import c3d
import numpy as np
import pytest


def write(path, frames, unit="m", hidden=()):
    """Write markers (frames, markers, 3) [unit] as a C3D file; ``hidden`` are (frame, marker) that were not seen."""
    writer = c3d.Writer(point_rate=100.0, point_units=unit, point_scale=-1.0)
    writer.set_point_labels([f"marker {k}" for k in range(frames.shape[1])])
    for i, frame in enumerate(frames):
        points = np.zeros((frames.shape[1], 5), dtype=np.float32)
        points[:, :3] = frame
        for k in range(frames.shape[1]):
            if (i, k) in hidden:
                points[k, 3:] = -1.0
        writer.add_frames([(points, np.zeros((0, 1), dtype=np.float32))])
    with open(path, "wb") as stream, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the library warns that there are no analog data
        writer.write(stream)


@pytest.fixture
def write_c3d():
    """The function `write`."""
    return write
