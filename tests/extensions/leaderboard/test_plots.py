"""Pictures of the benchmark: a view in which two bodies can be told apart."""

import numpy as np

from softgym_envs.extensions.leaderboard.frozen import load_problem
from softgym_envs.extensions.leaderboard.plots import _changes, _Panel, _plane
from softgym_envs.mechanics.elements.tetrahedra import boundary_triangles


def box(*sides):
    """A box as points [m] and triangles."""
    points = np.array([[x, y, z] for x in (0, sides[0]) for y in (0, sides[1]) for z in (0, sides[2])], dtype=float)
    corners = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])
    return points, boundary_triangles(corners)


def test_the_view_shows_the_longest_side_and_the_largest_difference():
    assert _plane([box(0.1, 0.08, 0.09), box(0.1, 0.05, 0.09)]) == [0, 1]  # y differs
    assert _plane([box(0.1, 0.08, 0.09), box(0.1, 0.08, 0.06)]) == [0, 2]  # z differs
    assert _plane([box(0.01, 0.02, 0.2), box(0.01, 0.03, 0.2)]) == [2, 1]  # slender: its length lies to the right


def test_panels_are_as_high_as_their_bodies():
    flat = _Panel([], [box(0.2, 0.02, 0.02), box(0.19, 0.02, 0.02)], [0, 1])
    assert flat.height < 0.2
    assert _Panel([], flat.bodies, [1, 0]).height == 1.0


def test_titles_name_every_variable():
    definition = load_problem("finger-zone-v1", check=False).definition
    best = {"length": 0.038, "height": 0.022, "joint_height": 0.005}
    assert _changes(definition, best) == [
        "length 40.00 → 38.00 mm",
        "height 20.00 → 22.00 mm",
        "joint height 6.00 → 5.00 mm",
    ]
