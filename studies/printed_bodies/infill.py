"""Homogenised infill against the resolved geometry: bars of more and more cells in tension, shear and bending.

A bar four times as long as high is clamped at one end; the
other end is a rigid face. Its compliance with all walls resolved is compared with that of a homogeneous bar of the
stiffness that one cell gives, whose walls have the same elements.
"""

from __future__ import annotations

import numpy as np

from softgym_envs.extensions.modules.homogenisation import Cell, homogenise, lattice
from softgym_envs.extensions.modules.orthotropic import Orthotropic
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.pose import Pose
from softgym_envs.mechanics.solvers.statics import Statics

WALLS = {"square, walls of 0.3": (0.3, 0.3), "walls of 0.2 and 0.5": (0.2, 0.5)}
CELLS = (1, 2, 4, 8)
"""Cells over the height of the bar."""
BOXES = 2
HEIGHT, RATIO, YOUNG = 0.02, 4, 1.0e7
POISSON = 0.0
"""The bar is one layer thick to be affordable, the body of the cell infinitely thick: they differ by thickness strains.

At a ratio of 0.35 a thin lattice is 5 % more compliant than a thick one in tension, however many cells it has.
"""
LOADS = {"tension": 0, "shear": 1, "bending": 2}


def bar_compliance(nodes: np.ndarray, tetrahedra: np.ndarray, **elasticity: object) -> np.ndarray:
    """Return what force along x, force along y and torque about z move at the rigid end of a bar, shape (3, 3)."""
    builder, length = ModelBuilder(), float(nodes[:, 0].max())
    start = builder.add_solid(
        nodes, tetrahedra, fixed=lambda x: x[:, 0] < 1e-9, element="quadratic", young_modulus=YOUNG, **elasticity
    )
    face = start + np.flatnonzero(builder.nodes[start:, 0] > length - 1e-9)
    end = builder.add_frame(np.array([length, 0.5 * HEIGHT, 0.5 * float(nodes[:, 2].max())]))
    builder.carry(end, face)
    model = builder.build()
    for name, component in (("x", 0), ("y", 1), ("rz", 5)):
        model.add("a", Pose(name, end, component, model.nodes))
    return Statics(model).solve(np.zeros(3), "effort").condensed.W.aa


def compliances() -> dict[str, object]:
    """Compliance of the homogeneous bar over that of the resolved one, by walls, cells over the height and load."""
    result: dict[str, object] = {}
    for name, walls in WALLS.items():
        cell = lattice(*walls, boxes=BOXES)
        material = Orthotropic(homogenise(cell, poisson_ratio=POISSON))
        for count in CELLS:
            pitch = HEIGHT / count
            resolved = lattice(*walls, pitch=pitch, boxes=BOXES)
            thick = float(resolved.edges[2][-1])
            even = tuple(np.linspace(0.0, side, n + 1) for side, n in ((RATIO * HEIGHT, 16), (HEIGHT, 4), (thick, 1)))
            solid = Cell(even, np.ones((16, 4, 1), dtype=bool))  # type: ignore[arg-type]
            exact = bar_compliance(*resolved.mesh((RATIO * count, count, 1)), poisson_ratio=POISSON)
            found = bar_compliance(*solid.mesh(), poisson_ratio=POISSON, material=material)
            for load, k in LOADS.items():
                result[f"{name}: {count} cells: {load}, compliance over resolved"] = float(found[k, k] / exact[k, k])
    return result
