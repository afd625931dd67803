"""Skins that bend with frames."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softgym_envs.extensions.beams.skins import bridge_skin

AXES = Rotation.from_euler("z", 0.4).as_matrix()
LENGTH, HALF = 0.03, (0.002, 0.005)


STILL = (Rotation.identity(), Rotation.identity())


def frames(*places, turns=STILL):
    """Rows of two frames, shape (8, 3): the place and the directors of each."""
    return np.concatenate([np.vstack([place, turn.as_matrix().T]) for place, turn in zip(places, turns, strict=True)])


def volume(points, triangles):
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    return float(np.einsum("ti,ti->", a, np.cross(b, c)) / 6.0)


@pytest.fixture
def rest():
    return frames([0.01, 0.0, 0.0], [0.01, 0.0, LENGTH])


def test_a_bar_between_frames_is_closed_and_faces_outwards(rest):
    skin = bridge_skin(0, 4, HALF, AXES, rest)
    edges = np.concatenate([skin.triangles[:, [i, (i + 1) % 3]] for i in range(3)])
    assert sorted(map(tuple, edges)) == sorted(map(tuple, edges[:, ::-1]))
    assert volume(skin.points.points, skin.triangles) == pytest.approx(4.0 * HALF[0] * HALF[1] * LENGTH)


def test_a_bar_moves_rigidly_with_its_frames(rest):
    skin = bridge_skin(0, 4, HALF, AXES, rest)
    turn, shift = Rotation.from_euler("xyz", [0.5, -0.8, 0.3]), np.array([0.02, -0.01, 0.04])
    moved = frames(*(turn.apply(rest[[0, 4]]) + shift), turns=[turn, turn])
    np.testing.assert_allclose(skin.points.positions(moved), turn.apply(skin.points.points) + shift, atol=1e-12)


def test_a_bar_follows_the_axis_of_a_beam(rest):
    # The middle of a cubic with the slopes of an arc lies within 1 % of the arc's rise at these angles.
    skin = bridge_skin(0, 4, HALF, AXES, rest)
    radius, angle = LENGTH / 0.5, 0.5
    end = [0.01 + radius * (1.0 - np.cos(angle)), 0.0, radius * np.sin(angle)]
    bent = frames([0.01, 0.0, 0.0], end, turns=[Rotation.identity(), Rotation.from_euler("y", angle)])
    outlines = skin.points.positions(bent).reshape(-1, 4, 3)
    middle = outlines.mean(axis=1)[len(outlines) // 2]
    expected = np.array([0.01 + radius * (1.0 - np.cos(angle / 2)), 0.0, radius * np.sin(angle / 2)])
    np.testing.assert_allclose(middle, expected, atol=0.01 * radius * (1.0 - np.cos(angle)))
