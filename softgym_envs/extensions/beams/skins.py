"""Surfaces of beams and rigid parts, for pictures, export and contact."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from softgym_envs.extensions.beams.beam import Beam
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.skins import Skin

BRIDGE_SECTIONS = 9
"""Outlines along a bar between two frames."""


def tube_skin(beam: Beam, nodes: np.ndarray, outline: np.ndarray) -> Skin:
    """Sweep a convex outline along a beam.

    Args:
        beam: the beam.
        nodes: rest rows [m], shape (n, 3).
        outline: corners [m] along d_2 and d_3, counter-clockwise, shape (k, 2), or (c, k, 2) for one outline per frame.
    """
    count = len(beam.chain)
    corners = np.broadcast_to(np.asarray(outline, dtype=float), (count, *np.shape(outline)[-2:]))
    k = corners.shape[1]
    local = np.concatenate([np.zeros((count, k, 1)), corners], axis=2).reshape(-1, 3)
    ids = np.repeat(beam.chain, k)[:, None] + np.arange(4)
    points = EmbeddedPoints.from_weights(ids, np.column_stack([np.ones(len(local)), local]), nodes)
    # d_1 points along the beam: the outline is seen counter-clockwise from its far end.
    return Skin(points, swept_triangles(count, k))


def swept_triangles(count: int, k: int) -> np.ndarray:
    """Return the sides and flat ends of ``count`` outlines of ``k`` corners, counter-clockwise from the far end."""
    a = (k * np.arange(count - 1)[:, None] + np.arange(k)).ravel()
    b = (k * np.arange(count - 1)[:, None] + (np.arange(k) + 1) % k).ravel()
    sides = np.concatenate([np.column_stack([a, b, b + k]), np.column_stack([a, b + k, a + k])])
    fan = np.column_stack([np.zeros(k - 2, dtype=np.int64), np.arange(1, k - 1), np.arange(2, k)])
    return np.concatenate([sides, fan[:, ::-1], fan + k * (count - 1)])


def bridge_skin(first: int, second: int, half_widths: Sequence[float], axes: np.ndarray, nodes: np.ndarray) -> Skin:
    """Return a bar between two frames, to be drawn, which bends with them as a beam does: tangent to both.

    Args:
        first: first row of the frame where it begins, with the third director along the bar.
        second: first row of the frame where it ends.
        half_widths: of its section along the first two axes [m].
        axes: of the bar, as columns, in the frames at rest, shape (3, 3).
        nodes: rest rows [m], shape (n, 3).
    """
    s = np.linspace(0.0, 1.0, BRIDGE_SECTIONS)[:, None]
    length = float(np.linalg.norm(nodes[second] - nodes[first]))
    signs = np.array([(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)])
    k = len(signs)
    x, y = (axes[:2, :2] @ (signs * half_widths).T)[:, None]
    ends = np.ones((len(s), k))
    near, far = (1.0 - s) ** 2 * (1.0 + 2.0 * s), s**2 * (3.0 - 2.0 * s)
    rise, fall = length * s * (1.0 - s) ** 2, length * s**2 * (s - 1.0)
    columns = (near * ends, (1.0 - s) * x, (1.0 - s) * y, rise * ends, far * ends, s * x, s * y, fall * ends)
    weights = np.stack([np.broadcast_to(c, ends.shape).ravel() for c in columns], axis=1)
    ids = np.tile(np.concatenate([first + np.arange(4), second + np.arange(4)]), (len(weights), 1))
    return Skin(EmbeddedPoints.from_weights(ids, weights, nodes), swept_triangles(len(s), k), touches=False)


def box_skin(row: int, half_extents: Sequence[float], nodes: np.ndarray, *, divisions: int = 1) -> Skin:
    """Return a box about the origin of a frame.

    Args:
        row: first row of the frame.
        half_extents: along its directors [m].
        nodes: rest rows [m], shape (n, 3).
        divisions: of each edge; obstacles touch the box at the vertices and the middles of its triangles.
    """
    steps = np.linspace(-1.0, 1.0, divisions + 1)
    u, v = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    first = (np.arange(divisions)[:, None] * (divisions + 1) + np.arange(divisions)).ravel()
    a, b, c, d = first, first + divisions + 1, first + divisions + 2, first + 1
    face = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    corners, triangles = [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            corners.append(np.roll(np.column_stack([np.full(len(u), side), u, v]), axis, axis=1))
            triangles.append((face if side > 0.0 else face[:, ::-1]) + (len(corners) - 1) * len(u))
    signs, places = np.unique(np.concatenate(corners), axis=0, return_inverse=True)
    points = EmbeddedPoints.in_frame(row, signs * np.asarray(half_extents), nodes)
    return Skin(points, places.ravel()[np.concatenate(triangles)], rigid=True)


def revolved_skin(row: int, profile: Sequence[tuple[float, float]], nodes: np.ndarray, *, sides: int) -> Skin:
    """Return a polygon that is swept upwards about the third director of a frame, with flat ends.

    Args:
        row: first row of the frame.
        profile: distance of the corners from the axis and height [m], from below, shape (k, 2).
        nodes: rest rows [m], shape (n, 3).
        sides: number of corners of the polygon; two of its sides are across the first director if it is a multiple of 2
            but not of 4.
    """
    angles = 2.0 * np.pi * (np.arange(sides) + 0.5) / sides
    rings = [[(r * np.cos(t), r * np.sin(t), z) for t in angles] for r, z in profile]
    ends = [[(0.0, 0.0, profile[0][1]), (0.0, 0.0, profile[-1][1])]]
    corners = np.array(sum(rings + ends, []))
    a = (sides * np.arange(len(profile) - 1)[:, None] + np.arange(sides)).ravel()
    b = (sides * np.arange(len(profile) - 1)[:, None] + (np.arange(sides) + 1) % sides).ravel()
    triangles = [np.column_stack([a, b, b + sides]), np.column_stack([a, b + sides, a + sides])]
    around, top = np.arange(sides), sides * (len(profile) - 1)
    after = (around + 1) % sides
    triangles.append(np.column_stack([np.full(sides, len(corners) - 2), after, around]))
    triangles.append(np.column_stack([np.full(sides, len(corners) - 1), top + around, top + after]))
    return Skin(EmbeddedPoints.in_frame(row, corners, nodes), np.concatenate(triangles), rigid=True)
