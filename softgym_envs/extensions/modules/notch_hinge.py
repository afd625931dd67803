"""A notch hinge: a block with two round notches that leave a thin neck, which turns about y."""

from __future__ import annotations

import math
from collections.abc import Mapping

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.modules.base import MATERIAL, Module
from softgym_envs.extensions.modules.plates import PLATE
from softgym_envs.robots.base import Drawing

FINER = 3.0
"""By how much edges are shorter at the neck, in the plane in which it bends."""


def draw_notched(*, width: float, neck: float, radius: float, length: float) -> None:
    """Draw a block with two half-round notches that leave a neck between them, in mm.

    The mesh is one of the side view in layers along y. Its edges are shorter at the neck, because straight edges
    between points of a notch leave a thicker neck, which is stiffer by the third power.
    """
    import gmsh

    occ, size, field = gmsh.model.occ, gmsh.option.getNumber("Mesh.MeshSizeMax"), gmsh.model.mesh.field
    far, middle = neck / 2 + radius, length / 2
    outline, notches = [], []
    for side in (1, -1):
        corners = [(far, 0.0), (far, middle - radius), (neck / 2, middle), (far, middle + radius), (far, length)]
        points = [occ.addPoint(side * x, -width / 2, z) for x, z in corners[::side]]
        centre = occ.addPoint(side * far, -width / 2, middle)
        outline += points
        notches += [occ.addLine(*points[:2]), occ.addCircleArc(points[1], centre, points[2])]
        notches += [occ.addCircleArc(points[2], centre, points[3]), occ.addLine(*points[3:])]
    top, bottom = occ.addLine(outline[4], outline[5]), occ.addLine(outline[9], outline[0])
    edges = [*notches[:4], top, *notches[4:], bottom]
    face = occ.addPlaneSurface([occ.addCurveLoop(edges)])
    occ.extrude([(2, face)], 0.0, width, 0.0, numElements=[math.ceil(width / size)])
    box = field.add("Box")
    values = {"VIn": size / FINER, "VOut": size, "Thickness": radius / 2, "XMin": -far, "XMax": far}
    values |= {"YMin": -width, "YMax": width, "ZMin": middle - radius / 2, "ZMax": middle + radius / 2}
    for name, value in values.items():
        field.setNumber(box, name, value)
    field.setAsBackgroundMesh(box)
    gmsh.option.setNumber("Mesh.MeshSizeMin", 0.0)


class NotchHinge(Module):
    """A neck between two half-round notches."""

    name = "notch_hinge"
    design_space = DesignSpace(
        DesignVariable("radius", 0.003, 0.010, 0.005, "m", "of the notches"),
        DesignVariable("neck", 0.0008, 0.004, 0.0015, "m", "thickness of the neck"),
        DesignVariable("width", 0.005, 0.030, 0.015, "m", "along y"),
        *MATERIAL,
    )

    def drawing(self, design: Mapping[str, float]) -> Drawing:
        lengths = {name: 1e3 * design[name] for name in ("width", "neck", "radius")}
        return draw_notched, lengths | {"length": 1e3 * self.length(design)}

    def length(self, design: Mapping[str, float]) -> float:
        return 2.0 * design["radius"] + 2.0 * PLATE

    def thinnest(self, design: Mapping[str, float]) -> float:
        return 0.5 * design["neck"]
