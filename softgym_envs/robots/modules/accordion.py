"""An accordion: folded walls that are soft along z and stiffer across (thesis, fig. 5.5 A)."""

from __future__ import annotations

import math
from collections.abc import Mapping

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.robots.base import Drawing
from softgym_envs.robots.modules.base import MATERIAL, Module
from softgym_envs.robots.modules.plates import PLATE, add_plates, add_prism


def draw_folds(
    *, depth: float, width: float, thickness: float, amplitude: float, pitch: float, folds: float, plate: float
) -> None:
    """Draw two plates and a zigzag wall between them, in mm. The wall begins and ends on the z axis."""
    import gmsh

    occ = gmsh.model.occ
    count = round(folds)
    length = count * pitch + 2.0 * plate
    # The wall goes on into the plates in its own direction, so that they overlap.
    inside = 0.3 * plate
    lean = amplitude / (0.25 * pitch)
    middle = [(-lean * inside, plate - inside)]
    for k in range(count):
        start = plate + k * pitch
        middle += [(amplitude, start + 0.25 * pitch), (-amplitude, start + 0.75 * pitch)]
    middle.append((lean * inside, length - plate + inside))
    half = 0.5 * thickness * math.hypot(1.0, lean)  # along x, of a wall that leans
    outline = [(x + half, z) for x, z in middle] + [(x - half, z) for x, z in reversed(middle)]
    wall = add_prism(outline, -width / 2, width / 2)
    first, last = add_plates(depth, width, length, plate)
    occ.fuse([first], [wall, last])


class Accordion(Module):
    """A wall in zigzag between two plates; it stretches along z and bends about y."""

    name = "accordion"
    symmetry = ("y", "xz")
    design_space = DesignSpace(
        DesignVariable("folds", 1, 5, 3, "1", "number of folds; rounded"),
        DesignVariable("pitch", 0.006, 0.015, 0.008, "m", "length of a fold along z"),
        DesignVariable("amplitude", 0.002, 0.008, 0.005, "m", "half of the depth of a fold, along x"),
        DesignVariable("width", 0.005, 0.030, 0.020, "m", "along y"),
        DesignVariable("thickness", 0.0008, 0.0015, 0.001, "m", "of the wall"),
        *MATERIAL,
    )

    def drawing(self, design: Mapping[str, float]) -> Drawing:
        lengths = {name: 1e3 * design[name] for name in ("pitch", "amplitude", "width", "thickness")}
        depth = 2e3 * (design["amplitude"] + 2.0 * design["thickness"])
        return draw_folds, lengths | {"folds": round(design["folds"]), "depth": depth, "plate": 1e3 * PLATE}

    def length(self, design: Mapping[str, float]) -> float:
        return round(design["folds"]) * design["pitch"] + 2.0 * PLATE

    def thinnest(self, design: Mapping[str, float]) -> float:
        return design["thickness"]
