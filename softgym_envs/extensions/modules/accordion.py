"""An accordion: folded walls that are soft along z and stiffer across (thesis, fig. 5.5 A)."""

from __future__ import annotations

import math
from collections.abc import Mapping

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.modules.base import MATERIAL, Module
from softgym_envs.extensions.modules.plates import PLATE, add_layers
from softgym_envs.robots.base import Drawing


def draw_folds(
    *, depth: float, width: float, thickness: float, amplitude: float, pitch: float, folds: float, plate: float
) -> None:
    """Draw two plates and a zigzag wall between them, in mm. The wall begins and ends on the z axis."""
    count = round(folds)
    length, edge = count * pitch + 2.0 * plate, depth / 2
    half = 0.5 * thickness * math.hypot(1.0, amplitude / (0.25 * pitch))  # along x, of a wall that leans
    right = [(edge, 0.0), (edge, plate), (half, plate)]
    for k in range(count):
        start = plate + k * pitch
        right += [(half + amplitude, start + 0.25 * pitch), (half - amplitude, start + 0.75 * pitch)]
    right += [(half, length - plate), (edge, length - plate), (edge, length)]
    # Half a turn about y maps the body onto itself.
    add_layers(right + [(-x, length - z) for x, z in right], width)


class Accordion(Module):
    """A wall in zigzag between two plates; it stretches along z and bends about y."""

    name = "accordion"
    helpers = (add_layers,)
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
