"""A single leaf spring: soft in bending about y and in torsion about z, stiff otherwise (thesis, fig. 5.5 B)."""

from __future__ import annotations

from collections.abc import Mapping

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.modules.base import MATERIAL, Module
from softgym_envs.extensions.modules.plates import PLATE, add_layers
from softgym_envs.robots.base import Drawing


def draw_leaf(*, depth: float, width: float, thickness: float, length: float, plate: float) -> None:
    """Draw two plates and the leaf between them, in mm."""
    half, edge, top = thickness / 2, depth / 2, length - plate
    right = [(edge, 0.0), (edge, plate), (half, plate), (half, top), (edge, top), (edge, length)]
    add_layers(right + [(-x, z) for x, z in reversed(right)], width)


class LeafSpring(Module):
    """A leaf between two plates; it bends about y."""

    name = "leaf_spring"
    helpers = (add_layers,)
    design_space = DesignSpace(
        DesignVariable("leaf_length", 0.010, 0.040, 0.020, "m", "free length of the leaf"),
        DesignVariable("width", 0.005, 0.030, 0.020, "m", "along y"),
        DesignVariable("thickness", 0.0008, 0.004, 0.0015, "m", "of the leaf, along x"),
        *MATERIAL,
    )
    #: Size of the plates along x [m].
    depth = 0.010

    def drawing(self, design: Mapping[str, float]) -> Drawing:
        lengths = {"depth": self.depth, "length": self.length(design), "plate": PLATE}
        lengths |= {name: design[name] for name in ("width", "thickness")}
        return draw_leaf, {name: 1e3 * value for name, value in lengths.items()}

    def length(self, design: Mapping[str, float]) -> float:
        return design["leaf_length"] + 2.0 * PLATE

    def thinnest(self, design: Mapping[str, float]) -> float:
        return design["thickness"]
