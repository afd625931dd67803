"""A crossed leaf hinge: leaves that cross at their middles turn about the axis where they cross."""

from __future__ import annotations

import math
from collections.abc import Mapping

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.modules.base import MATERIAL, Module
from softgym_envs.extensions.modules.plates import PLATE
from softgym_envs.robots.base import Drawing


def add_strip(
    start: tuple[float, float], end: tuple[float, float], thickness: float, low: float, high: float
) -> tuple[int, int]:
    """Add a flat strip with gmsh, in mm, and return its entity.

    Args:
        start: where its middle plane begins (x, z).
        end: where its middle plane ends.
        thickness: of the strip.
        low: where it begins along y.
        high: where it ends along y.
    """
    import gmsh

    occ = gmsh.model.occ
    along = (end[0] - start[0], end[1] - start[1])
    scale = 0.5 * thickness / math.hypot(*along)
    x, z = -along[1] * scale, along[0] * scale
    corners = [
        (start[0] + x, start[1] + z),
        (end[0] + x, end[1] + z),
        (end[0] - x, end[1] - z),
        (start[0] - x, start[1] - z),
    ]
    points = [occ.addPoint(x, low, z) for x, z in corners]
    lines = [occ.addLine(a, b) for a, b in zip(points, points[1:] + points[:1], strict=True)]
    face = occ.addPlaneSurface([occ.addCurveLoop(lines)])
    return next(entity for entity in occ.extrude([(2, face)], 0.0, high - low, 0.0) if entity[0] == 3)


def draw_crossed(*, depth: float, width: float, thickness: float, reach: float, length: float, plate: float) -> None:
    """Draw two plates, a wide leaf in the middle and one of half its width on each side that cross it, in mm."""
    import gmsh

    occ = gmsh.model.occ
    first, last = ((3, occ.addBox(-depth / 2, -width / 2, z, depth, width, plate)) for z in (0.0, length - plate))
    inside = 0.3 * plate  # leaves end within the plates, so that they overlap
    low, high = plate - inside, length - plate + inside
    tip = reach * (1.0 + 2.0 * inside / (length - 2.0 * plate)) / 2.0
    gap = thickness / 2.0
    sides = (
        (1.0, -width / 2, -width / 4 - gap),
        (-1.0, -width / 4 + gap, width / 4 - gap),
        (1.0, width / 4 + gap, width / 2),
    )
    leaves = [add_strip((-side * tip, low), (side * tip, high), thickness, y, end) for side, y, end in sides]
    occ.fuse([first], [*leaves, last])


class CrossedLeaves(Module):
    """Three leaves at 45 degrees between two plates: one in the middle, and one of half its width on each side."""

    name = "crossed_leaves"
    helpers = (add_strip,)
    symmetry = ("y", "xz")
    design_space = DesignSpace(
        DesignVariable("leaf_length", 0.012, 0.040, 0.025, "m", "free length of the leaves"),
        DesignVariable("width", 0.012, 0.030, 0.020, "m", "along y"),
        DesignVariable("thickness", 0.0008, 0.002, 0.001, "m", "of the leaves"),
        *MATERIAL,
    )

    def drawing(self, design: Mapping[str, float]) -> Drawing:
        reach = design["leaf_length"] * math.sqrt(0.5)
        return draw_crossed, {
            "depth": 1e3 * (reach + 2.0 * PLATE),
            "width": 1e3 * design["width"],
            "thickness": 1e3 * design["thickness"],
            "reach": 1e3 * reach,
            "length": 1e3 * self.length(design),
            "plate": 1e3 * PLATE,
        }

    def length(self, design: Mapping[str, float]) -> float:
        return design["leaf_length"] * math.sqrt(0.5) + 2.0 * PLATE

    def thinnest(self, design: Mapping[str, float]) -> float:
        return design["thickness"]
