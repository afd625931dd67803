"""Shape of the contact-aided finger: two legs and a top wall, an outline in the plane that is extruded.

The outline is that of the public model of the thesis (section 3.4.3, figure 3.16). All lengths are in millimetres.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from softgym_envs.errors import InfeasibleDesign

FOOT_HEIGHT = 6.0
LEFT_FOOT = 8.0
RIGHT_FOOT = 4.0
"""Height of both feet below y = 0, and their widths."""


def zigzag_outline(
    e1: float, e2: float, e3: float, distances: Sequence[float], *, length: float, width: float
) -> np.ndarray:
    """Return the corners of the finger's outline, shape (2 n + 12, 2), clockwise from the left foot's outer corner.

    The left leg stands on the servo, the right leg is the zigzag that faces the object.

    Args:
        e1: thickness of the left leg at its top; at its foot it is 8.
        e2: thickness of the top wall.
        e3: horizontal thickness of the right leg.
        distances: from the left leg's inner side at its top to the inner side of the right leg, at n points from
            top to bottom.
        length: height of the finger above its feet.
        width: distance between the outer sides of the feet.
    """
    n = len(distances)
    heights = (length - e2) * (1.0 - np.arange(1, n + 1) / (n + 1))
    inner = np.column_stack([e1 + np.asarray(distances), heights])
    foot = width - RIGHT_FOOT
    return np.array(
        [
            *((0.0, -FOOT_HEIGHT), (0.0, length), (width, length), (width, length - e2)),
            *(inner + [e3, 0.0]),
            *((width, 0.0), (width, -FOOT_HEIGHT), (foot, -FOOT_HEIGHT), (foot, 0.0)),
            *inner[::-1],
            *((width - e3, length - e2), (e1, length - e2), (LEFT_FOOT, 0.0), (LEFT_FOOT, -FOOT_HEIGHT)),
        ]
    )


def check_outline(corners: np.ndarray) -> None:
    """Check that a closed polygon (k, 2) does not cross or touch itself.

    Raises:
        InfeasibleDesign: naming the first place where it does.
    """
    edges = list(zip(corners, np.roll(corners, -1, axis=0), strict=True))
    for (i, first), (j, second) in combinations(enumerate(edges), 2):
        neighbours = j - i in (1, len(edges) - 1)
        if not neighbours and _meet(*first, *second):
            x, y = 0.25 * (sum(first) + sum(second))
            raise InfeasibleDesign(f"the outline of the finger crosses itself near x = {x:.3g} mm, y = {y:.3g} mm")


def _meet(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> bool:
    """Whether the segments from a to b and from c to d have a point in common."""
    apart = (np.maximum(a, b) < np.minimum(c, d)) | (np.maximum(c, d) < np.minimum(a, b))
    crossing = _turn(a, b, c) * _turn(a, b, d) <= 0.0 and _turn(c, d, a) * _turn(c, d, b) <= 0.0
    return crossing and not apart.any()


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    """Twice the signed area of a triangle, counter-clockwise positive."""
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def draw_extrusion(low: float, high: float, **corners: float) -> None:
    """Draw a closed polygon in the plane of x and y with gmsh, extruded along z.

    Args:
        low: z at one end [mm].
        high: z at the other end [mm].
        **corners: ``x0, y0, x1, y1, ...`` [mm].
    """
    import gmsh

    occ = gmsh.model.occ
    points = [occ.addPoint(corners[f"x{k}"], corners[f"y{k}"], low) for k in range(len(corners) // 2)]
    lines = [occ.addLine(a, b) for a, b in zip(points, points[1:] + points[:1], strict=True)]
    face = occ.addPlaneSurface([occ.addCurveLoop(lines)])
    occ.extrude([(2, face)], 0.0, 0.0, high - low)


def draw_published(low: float, high: float, size: float, **corners: float) -> None:
    """Draw the same for a mesh as of the public model: gmsh's own settings, with edges of length ``size`` [mm].

    The mesh is coarser, by a tenth of its nodes, and its elements are worse than with the settings of this suite.
    """
    import gmsh

    draw_extrusion(low, high, **corners)
    gmsh.model.occ.synchronize()
    gmsh.model.mesh.setSize(gmsh.model.getEntities(0), size)
    usual = {"MeshSizeExtendFromBoundary": 1, "MeshSizeFromPoints": 1, "MeshSizeMin": 0.0, "MeshSizeMax": 1e22}
    for option, value in (usual | {"OptimizeNetgen": 0, "RandomSeed": 1}).items():
        gmsh.option.setNumber(f"Mesh.{option}", value)
