"""A notch hinge: a block with two round notches that leave a thin neck, which turns about y."""

from __future__ import annotations

from collections.abc import Mapping

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.robots.base import Drawing
from softgym_envs.robots.modules.base import MATERIAL, Module
from softgym_envs.robots.modules.plates import PLATE


def draw_notched(*, width: float, neck: float, radius: float, length: float) -> None:
    """Draw a block without two cylinders along y that leave a neck between them, in mm."""
    import gmsh

    occ = gmsh.model.occ
    depth = neck + 2.0 * radius
    block = occ.addBox(-depth / 2, -width / 2, 0.0, depth, width, length)
    notches = [
        (3, occ.addCylinder(side * (neck / 2 + radius), -width, length / 2, 0.0, 2.0 * width, 0.0, radius))
        for side in (-1.0, 1.0)
    ]
    occ.cut([(3, block)], notches)


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
