"""Outlines in the x-z plane, meshed in layers along y: how the flat modules with one wall are drawn."""

from __future__ import annotations

import math

PLATE = 3.0e-3
"""Thickness of the plates at both ports [m]."""

FINER = 8.0
"""By how much edges are shorter at corners that point into a body that is meshed in layers."""

FIRST = 0.5
"""Thickness of its first and last layer over that of the others."""


def add_layers(outline: list[tuple[float, float]], width: float) -> None:
    """Add the prism over a closed outline (x, z), meshed as its side view in layers along y, with gmsh, in mm.

    Stresses are largest at corners that point into the body and, in torsion, at the faces that are normal to y.
    Elements are smaller there, because long ones make the body too stiff. Layers let bodies of nearly the same
    dimensions have nearly the same error.

    Args:
        outline: corners, counter-clockwise with x to the right and z up.
        width: along y; the middle is at y = 0.
    """
    import gmsh

    occ, size, field = gmsh.model.occ, gmsh.option.getNumber("Mesh.MeshSizeMax"), gmsh.model.mesh.field
    points = [occ.addPoint(x, -width / 2, z) for x, z in outline]
    lines = [occ.addLine(a, b) for a, b in zip(points, points[1:] + points[:1], strict=True)]
    face = occ.addPlaneSurface([occ.addCurveLoop(lines)])
    between = max(math.ceil(width / size - 2.0 * FIRST), 1)
    thin = FIRST / (between + 2.0 * FIRST)
    tops = [thin, *(thin + k * (1.0 - 2.0 * thin) / between for k in range(1, between + 1)), 1.0]
    occ.extrude([(2, face)], 0.0, width, 0.0, numElements=[1] * len(tops), heights=tops)
    inward = []
    corners = zip(points, outline[-1:] + outline[:-1], outline, outline[1:] + outline[:1], strict=True)
    for point, (x0, z0), (x1, z1), (x2, z2) in corners:
        if (x1 - x0) * (z2 - z1) < (z1 - z0) * (x2 - x1):
            inward.append(point)
    distance, edges = field.add("Distance"), field.add("Threshold")
    field.setNumbers(distance, "PointsList", inward)
    values = {"InField": distance, "SizeMin": size / FINER, "SizeMax": size, "DistMin": 0.0, "DistMax": size}
    for name, value in values.items():
        field.setNumber(edges, name, value)
    field.setAsBackgroundMesh(edges)
    gmsh.option.setNumber("Mesh.MeshSizeMin", 0.0)
