"""A printed block: walls of a lattice inside, as slicers fill bodies, seen as a homogeneous orthotropic material."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.modules.homogenisation import homogenise, lattice
from softgym_envs.extensions.modules.orthotropic import Orthotropic
from softgym_envs.extensions.modules.solid_block import SolidBlock
from softgym_envs.mechanics.elements.tetrahedra import SolidOptions


@lru_cache(maxsize=256)
def _stiffness(wall_x: float, wall_y: float, poisson_ratio: float) -> np.ndarray:
    """Return the stiffness (6, 6) of a lattice over Young's modulus of its walls."""
    return homogenise(lattice(wall_x, wall_y), poisson_ratio=poisson_ratio)


class PrintedBlock(SolidBlock):
    """A block printed along z with crossing walls inside, and no skin around them.

    The lattice is not resolved: it must be several times finer than the block (`python -m tests.verification infill`
    shows what that costs), and strains must be so small that no wall buckles. What a printer makes of it must be
    measured.
    """

    name = "printed_block"
    symmetry = ("z", "xy")
    design_space = DesignSpace(
        *SolidBlock.design_space,
        DesignVariable("wall_x", 0.1, 1.0, 0.3, "1", "thickness of the walls across x over their distance"),
        DesignVariable("wall_y", 0.1, 1.0, 0.3, "1", "thickness of the walls across y over their distance"),
        DesignVariable("angle", 0.0, np.pi / 2, 0.0, "rad", "rotation of the lattice about z"),
    )

    def elasticity(self, design: Mapping[str, float], rotation: np.ndarray) -> SolidOptions:
        c, s = np.cos(design["angle"]), np.sin(design["angle"])
        axes = rotation @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        stiffness = _stiffness(design["wall_x"], design["wall_y"], design["poisson_ratio"])
        return {**super().elasticity(design, rotation), "material": Orthotropic(stiffness, axes)}
