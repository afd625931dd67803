"""Readers of recordings, and which marker is which, on small files made here."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs.errors import DataError
from softgym_envs.extensions.measured.recordings import (
    Recording,
    matched,
    read_c3d,
    read_marker_table,
    read_table,
    rigid_motion,
)
from softgym_envs.mechanics.frames import rotation_vector_matrix

PLACES = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.05, 0.3]])


@pytest.mark.parametrize("unit, scale", [("m", 1.0), ("mm", 1e-3)])
def test_c3d_in_metres_and_millimetres(tmp_path, write_c3d, unit, scale):
    frames = np.stack([PLACES + 0.001 * k for k in range(10)]) / scale
    write_c3d(tmp_path / "made.c3d", frames, unit, hidden={(3, 1)})
    found = read_c3d(tmp_path / "made.c3d")
    assert found.rate == 100.0 and found.labels == tuple(f"marker {k}" for k in range(4))
    expected = frames * scale
    assert np.isnan(found.markers[3, 1]).all()
    expected[3, 1] = np.nan
    np.testing.assert_allclose(found.markers, expected, atol=1e-6)


def test_what_is_no_c3d(tmp_path):
    (tmp_path / "text.c3d").write_text("frame,time\n")
    with pytest.raises(DataError, match="cannot be read as C3D"):
        read_c3d(tmp_path / "text.c3d")


def test_a_table_of_markers(tmp_path):
    path = tmp_path / "made.csv"
    rows = [[k, 0.005 * k, *(PLACES + 0.001 * k).ravel()] for k in range(5)]
    path.write_text("\n".join(",".join(map(str, row)) for row in rows))
    found = read_marker_table(path)
    assert found.rate == pytest.approx(200.0)
    np.testing.assert_allclose(found.markers[4], PLACES + 0.004)
    path.write_text("0,0.0,1.0\n1,0.005,1.0\n")
    with pytest.raises(DataError, match="rows of frame, time, and x, y, z of each marker"):
        read_marker_table(path)
    path.write_text("frame,time,x,y,z\n")
    with pytest.raises(DataError, match="cannot be read as a table of markers"):
        read_marker_table(path)


def test_a_table_with_a_header(tmp_path):
    path = tmp_path / "made.csv"
    path.write_text("label,x,y\na,1,2\nb,3,4\n")
    found = read_table(path, ["y"], ["label"])
    np.testing.assert_array_equal(found["y"], [2.0, 4.0])
    assert found["label"].tolist() == ["a", "b"]
    with pytest.raises(DataError, match="unknown column 'z'"):
        read_table(path, ["z"], [])


def test_still_frames_before_a_release():
    """Set down, still, released: the still frames between count."""
    frames = np.repeat(PLACES[None], 100, axis=0)
    frames[:10, :, 2] += np.linspace(0.002, 0.0, 10)[:, None]  # still being set down
    frames[60:, :, 2] -= 0.05 * np.minimum(np.arange(40) / 20.0, 1.0)[:, None]
    recording = Recording(frames, (), 100.0)
    np.testing.assert_allclose(recording.still(), PLACES, atol=1e-12)
    np.testing.assert_allclose(recording.end()[:, 2], PLACES[:, 2] - 0.05, atol=1e-12)
    with pytest.raises(DataError, match="no frame before the body is released is still"):
        Recording(frames[60:80], (), 100.0).still()


def test_a_rigid_motion_is_found():
    turn = rotation_vector_matrix(np.array([0.4, -1.1, 2.0]))
    shift = np.array([0.3, -0.2, 0.1])
    found_turn, found_shift = rigid_motion((PLACES - shift) @ turn, PLACES)
    np.testing.assert_allclose(found_turn, turn, atol=1e-12)
    np.testing.assert_allclose(found_shift, shift, atol=1e-12)


def test_markers_are_told_apart_by_where_they_are_expected(rng):
    order = rng.permutation(4)
    found = matched(PLACES[order] + rng.normal(0.0, 0.01, (4, 3)), PLACES[[2, 0, 3]])
    np.testing.assert_array_equal(order[found], [2, 0, 3])
