"""A round bellows, closed by two plates: its cavity takes a pressure, which makes it longer."""

from __future__ import annotations

import math
from collections.abc import Mapping

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.modules.base import MATERIAL, Module
from softgym_envs.extensions.modules.plates import PLATE
from softgym_envs.robots.base import Drawing


def draw_bellows(
    *, radius: float, amplitude: float, thickness: float, pitch: float, folds: float, plate: float
) -> None:
    """Draw a wall in zigzag that is turned about the z axis, between two plates, in mm."""
    import gmsh

    occ = gmsh.model.occ
    count = round(folds)
    length = count * pitch + 2.0 * plate
    half = 0.5 * thickness * math.hypot(1.0, 4.0 * amplitude / pitch)  # along the radius, of a wall that leans
    middle = [(radius - amplitude, plate)]
    for k in range(count):
        start = plate + k * pitch
        middle += [(radius + amplitude, start + 0.5 * pitch), (radius - amplitude, start + pitch)]
    outside = [(r + half, z) for r, z in middle]
    inside = [(r - half, z) for r, z in reversed(middle)]
    ends = [(0.0, 0.0), (outside[0][0], 0.0), *outside, (outside[-1][0], length), (0.0, length), (0.0, length - plate)]
    outline = [*ends, *inside, (0.0, plate)]
    points = [occ.addPoint(r, 0.0, z) for r, z in outline]
    lines = [occ.addLine(a, b) for a, b in zip(points, points[1:] + points[:1], strict=True)]
    section = occ.addPlaneSurface([occ.addCurveLoop(lines)])
    occ.revolve([(2, section)], 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0 * math.pi)


class Bellows(Module):
    """A folded tube, closed by plates; under pressure it becomes longer, and it bends both ways."""

    name = "bellows"
    closed = True
    design_space = DesignSpace(
        DesignVariable("folds", 1, 4, 2, "1", "number of folds; rounded"),
        DesignVariable("pitch", 0.006, 0.012, 0.008, "m", "length of a fold along z"),
        DesignVariable("radius", 0.006, 0.014, 0.008, "m", "mean radius of the wall"),
        DesignVariable("amplitude", 0.001, 0.004, 0.002, "m", "half of the depth of a fold"),
        DesignVariable("thickness", 0.001, 0.002, 0.0012, "m", "of the wall"),
        *MATERIAL,
    )

    def drawing(self, design: Mapping[str, float]) -> Drawing:
        lengths = {name: 1e3 * design[name] for name in ("radius", "amplitude", "thickness", "pitch")}
        return draw_bellows, lengths | {"folds": round(design["folds"]), "plate": 1e3 * PLATE}

    def length(self, design: Mapping[str, float]) -> float:
        return round(design["folds"]) * design["pitch"] + 2.0 * PLATE

    def thinnest(self, design: Mapping[str, float]) -> float:
        return design["thickness"]
