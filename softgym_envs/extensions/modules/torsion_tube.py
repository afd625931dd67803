"""A round tube: stiff against bending and tension for its softness in torsion, the more the thinner its wall."""

from __future__ import annotations

import math
from collections.abc import Mapping

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.modules.base import MATERIAL, Module
from softgym_envs.robots.base import Drawing


def draw_tube(*, radius: float, wall: float, length: float) -> None:
    """Draw a tube about the z axis, in mm.

    The mesh is one of the ring in layers along z, with edges half as long around it: so bodies of nearly the same
    dimensions have nearly the same error.
    """
    import gmsh

    occ, size = gmsh.model.occ, gmsh.option.getNumber("Mesh.MeshSizeMax")
    outside, inside = (occ.addDisk(0.0, 0.0, 0.0, r, r) for r in (radius, radius - wall))
    ring, _ = occ.cut([(2, outside)], [(2, inside)])
    occ.extrude(ring, 0.0, 0.0, length, numElements=[math.ceil(length / size)])
    gmsh.option.setNumber("Mesh.MeshSizeFromCurvature", math.ceil(2.0 * math.tau * radius / size))
    gmsh.option.setNumber("Mesh.MeshSizeMin", 0.0)


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
