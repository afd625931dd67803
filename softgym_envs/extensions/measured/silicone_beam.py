"""Clamped silicone beam with a load at its tip (Dubied et al. 2022).

Dimensions, material, positions of the markers and loads are those of the authors' code and data: Dubied, Michelis,
Spielberg, Katzschmann, "Sim-to-Real for Soft Robots Using Differentiable FEM", IEEE RA-L 7(2), 2022;
github.com/srl-ethz/diffPD_sim2real (MIT), python/realbeam_experiments. The beam is clamped at x = -100 mm and ends at
x = 0, as in their frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import permutations
from typing import Any

import numpy as np

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.actuator import Actuator
from softgym_envs.robots.base import Robot
from softgym_envs.robots.capabilities import Learning
from softgym_envs.robots.mesh_tiers import choose_mesh

LENGTH, WIDTH, HEIGHT = 0.100, 0.030, 0.030
"""Size of the beam [m]."""
GRAVITY = (0.0, 0.0, -9.80709)
"""As in the authors' code [m/s2]."""
MARKERS = {"top": (0.0, 0.015, 0.030), "left": (0.0, 0.0, 0.024), "right": (0.0, 0.030, 0.006)}
"""Where the three markers of the tip are glued on [m]. They stand off by 6 mm; as the authors do, their motion is
compared with that of the nearest point of the surface."""
MESHES = {"coarse": (12, 4, 4), "fine": (16, 5, 5)}
"""Cells along the beam, across and upwards, by name of the mesh; each is six tetrahedra."""


class SiliconeBeam(Robot):
    """Beam of silicone that bends under its weight and a load on the upper edge of its tip.

    A thread pulls the tip down, for environments; the recordings have the load alone.

    Args:
        element: ``"quadratic"``, ``"averaged"`` or ``"linear"``.
        mesh: a name in `MESHES`.
        gravity: acceleration [m/s2].
        **options: options of `Robot`.
    """

    name = "silicone_beam"
    effectors = tuple(MARKERS)
    size = LENGTH
    learning = Learning(loads=("tip_load",))

    def __init__(
        self,
        *,
        element: str = "quadratic",
        mesh: str = "coarse",
        gravity: tuple[float, float, float] = GRAVITY,
        **options: Any,
    ) -> None:
        super().__init__(gravity=gravity, **options)
        self.element = element
        self.cells = choose_mesh(MESHES, mesh)
        self.design_space = DesignSpace(
            DesignVariable("young_modulus", 1e5, 1e6, 263824.0, "Pa", "stiffness of the silicone", log=True),
            DesignVariable("poisson_ratio", 0.3, 0.4995, 0.499, "1", "0.5 is incompressible"),
            DesignVariable("density", 900.0, 1300.0, 1070.0, "kg/m3", "density of the silicone"),
            DesignVariable("tip_load", 0.0, 1.5, 0.0, "N", "weight on the upper edge of the tip"),
        )
        self.effector_rest = np.array(MARKERS["top"])
        self.effort_scale = np.array([1.0])
        self.actuators = (Actuator("thread", 0.0, 0.03, 0.002),)

    def assemble(self, design: Mapping[str, float]) -> MechanicalModel:
        """Mesh the box, clamp its far end, load the edge, put effectors where the markers are."""
        nodes, tetrahedra = box_of_tetrahedra(self.cells)
        model = MechanicalModel.from_mesh(
            nodes * [LENGTH, WIDTH, HEIGHT] - [LENGTH, 0.0, 0.0],
            tetrahedra,
            fixed=lambda x: x[:, 0] < -LENGTH + 1e-6,
            element=self.element,
            young_modulus=design["young_modulus"],
            poisson_ratio=design["poisson_ratio"],
            density=design["density"],
            gravity=self.gravity,
        )

        def edge(x: np.ndarray) -> np.ndarray:
            return (x[:, 0] > -1e-6) & (x[:, 2] > HEIGHT - 1e-6)

        model.add_load("tip edge", [0.0, 0.0, -design["tip_load"]], edge)
        model.add_cable("thread", [[0.0, 0.5 * WIDTH, 0.0]], pull_point=[0.0, 0.5 * WIDTH, -0.1])
        for name, place in MARKERS.items():
            model.add_effector(name, place)
        return model


def box_of_tetrahedra(cells: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Divide the unit cube into cells of six tetrahedra each, which fit together (Kuhn 1960).

    Returns:
        Nodes (n, 3) and corners (m, 4).
    """
    counts = np.array(cells) + 1
    grid = np.stack(np.meshgrid(*(np.linspace(0.0, 1.0, c) for c in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    steps = np.array([counts[1] * counts[2], counts[2], 1])
    corners = np.stack(np.meshgrid(*(np.arange(c) for c in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    first = (corners @ steps)[:, None]
    parts = []
    for order in permutations(range(3)):
        walk = np.concatenate([[0], np.cumsum(steps[list(order)])])
        even = order in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
        parts.append(first + (walk if even else walk[[0, 2, 1, 3]]))
    return grid, np.concatenate(parts)
