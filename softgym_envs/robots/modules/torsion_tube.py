"""A round tube: stiff against bending and tension for its softness in torsion, the more the thinner its wall."""

from __future__ import annotations

from collections.abc import Mapping

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.robots.base import Drawing
from softgym_envs.robots.modules.base import MATERIAL, Module


def draw_tube(*, radius: float, wall: float, length: float) -> None:
    """Draw a tube about the z axis, in mm."""
    import gmsh

    occ = gmsh.model.occ
    outside = occ.addCylinder(0.0, 0.0, 0.0, 0.0, 0.0, length, radius)
    inside = occ.addCylinder(0.0, 0.0, -1.0, 0.0, 0.0, length + 2.0, radius - wall)
    occ.cut([(3, outside)], [(3, inside)])


class TorsionTube(Module):
    """A tube of constant wall between the ports."""

    name = "torsion_tube"
    design_space = DesignSpace(
        DesignVariable("length", 0.010, 0.060, 0.030, "m", "distance between the ports"),
        DesignVariable("radius", 0.005, 0.015, 0.008, "m", "outer radius"),
        DesignVariable("wall", 0.001, 0.004, 0.002, "m", "thickness of the wall"),
        *MATERIAL,
    )

    def drawing(self, design: Mapping[str, float]) -> Drawing:
        return draw_tube, {name: 1e3 * design[name] for name in ("radius", "wall", "length")}

    def length(self, design: Mapping[str, float]) -> float:
        return design["length"]

    def thinnest(self, design: Mapping[str, float]) -> float:
        return design["wall"]
