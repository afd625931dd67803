"""Outlines in the x-z plane, extruded along y: how the flat modules are drawn."""

from __future__ import annotations

import math

PLATE = 3.0e-3
"""Thickness of the plates at both ports of the flat modules [m]."""


def add_prism(corners: list[tuple[float, float]], low: float, high: float) -> tuple[int, int]:
    """Add the prism over a closed outline (x, z) between two values of y with gmsh, in mm, and return its entity."""
    import gmsh

    occ = gmsh.model.occ
    points = [occ.addPoint(x, low, z) for x, z in corners]
    lines = [occ.addLine(a, b) for a, b in zip(points, points[1:] + points[:1], strict=True)]
    face = occ.addPlaneSurface([occ.addCurveLoop(lines)])
    return next(entity for entity in occ.extrude([(2, face)], 0.0, high - low, 0.0) if entity[0] == 3)


def add_plates(depth: float, width: float, length: float, plate: float) -> list[tuple[int, int]]:
    """Add the plates at z = 0 and at z = length with gmsh, in mm, and return their entities."""
    import gmsh

    occ = gmsh.model.occ
    return [(3, occ.addBox(-depth / 2, -width / 2, z, depth, width, plate)) for z in (0.0, length - plate)]


def add_strip(
    start: tuple[float, float], end: tuple[float, float], thickness: float, low: float, high: float
) -> tuple[int, int]:
    """Add a flat strip between two points (x, z) of its middle plane with gmsh, in mm, and return its entity."""
    along = (end[0] - start[0], end[1] - start[1])
    scale = 0.5 * thickness / math.hypot(*along)
    x, z = -along[1] * scale, along[0] * scale
    corners = [
        (start[0] + x, start[1] + z),
        (end[0] + x, end[1] + z),
        (end[0] - x, end[1] - z),
        (start[0] - x, start[1] - z),
    ]
    return add_prism(corners, low, high)
