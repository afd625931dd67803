"""A solid block: the stiff piece between mechanisms, or a soft cushion."""

from __future__ import annotations

from collections.abc import Mapping

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.modules.base import MATERIAL, Module
from softgym_envs.robots.base import Drawing


def draw_block(*, depth: float, width: float, length: float) -> None:
    """Draw a block that is centred on the z axis, in mm."""
    import gmsh

    gmsh.model.occ.addBox(-depth / 2, -width / 2, 0.0, depth, width, length)


class SolidBlock(Module):
    """A block; as long and slender as a beam, it obeys beam theory."""

    name = "solid_block"
    design_space = DesignSpace(
        DesignVariable("length", 0.005, 0.060, 0.020, "m", "distance between the ports"),
        DesignVariable("width", 0.005, 0.030, 0.020, "m", "along y"),
        DesignVariable("depth", 0.005, 0.030, 0.020, "m", "along x"),
        *MATERIAL,
    )

    def drawing(self, design: Mapping[str, float]) -> Drawing:
        return draw_block, {name: 1e3 * design[name] for name in ("depth", "width", "length")}

    def length(self, design: Mapping[str, float]) -> float:
        return design["length"]

    def thinnest(self, design: Mapping[str, float]) -> float:
        return 0.25 * min(design["depth"], design["width"], design["length"])
