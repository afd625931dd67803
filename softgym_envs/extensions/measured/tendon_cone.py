"""Silicone cone that hangs from its base, bent by two tendons (SoRoMoX).

Dimensions, routing of the tendons, places of the markers and the first guess of the material are those of the authors'
code: github.com/tud-phi/soromox (MIT), paper_results/secVa_system_identification, where five markers were recorded
under constant torques of two motors. Here the base is at the origin and the cone hangs along -z; x and y are theirs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.beams.beam import Section
from softgym_envs.extensions.beams.rods import add_rod
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.actuator import Actuator
from softgym_envs.robots.base import Robot
from softgym_envs.robots.capabilities import Learning
from softgym_envs.robots.mesh_tiers import choose_mesh

LONG, SHORT = 0.305, 0.055
"""Lengths of the two parts [m]; the tendons end with the first."""
RADII = (0.01541, 0.00642, 0.00480)
"""Radius at the base, between the parts and at the tip [m]."""
ANGLES = (30.0, 150.0)
"""Where the tendons are about the axis [degrees], from y towards x."""
OFFSET, TAPER = 0.0114, 0.0295
"""Distance of the tendons from the axis at the base [m], and how much it falls along the cone [m/m]."""
DRUM = 0.0325
"""Radius of the drums of the motors [m]."""
MARKERS = {
    "m1": (0.1291, (0.0, 0.025, 0.0)),
    "m2": (0.2195, (0.0, -0.021, 0.0)),
    "m3": (0.2800, (0.0, 0.020, 0.0)),
    "m4": (0.3600, (0.008, 0.0, 0.0)),
}
"""Place of each marker along the axis [m], and its offset along the axis, x and -y there [m]."""
MESHES = {"coarse": (16, 3), "fine": (32, 6)}
"""Beam elements of both parts, by name of the mesh."""


class TendonCone(Robot):
    """Tapered rod with two tendons.

    Args:
        mesh: a name in `MESHES`.
        gravity: acceleration [m/s2].
        **options: options of `Robot`.
    """

    name = "tendon_cone"
    effectors = tuple(MARKERS)
    size = LONG + SHORT
    learning = Learning(convex=False)  # beyond a quarter turn, a tendon shortens faster than its tension grows

    def __init__(
        self, *, mesh: str = "coarse", gravity: tuple[float, float, float] = (0.0, 0.0, -9.81), **options: Any
    ) -> None:
        super().__init__(gravity=gravity, **options)
        self.elements = choose_mesh(MESHES, mesh)
        self.design_space = DesignSpace(
            DesignVariable("young_modulus", 1e5, 1e6, 5.05e5, "Pa", "stiffness of the silicone", log=True),
            DesignVariable("poisson_ratio", 0.4, 0.499, 0.45, "1", "0.5 is incompressible"),
            DesignVariable("density", 600.0, 2000.0, 1500.0, "kg/m3", "density of the silicone"),
        )
        self.effector_rest = np.array([0.0, 0.025, -0.1291])
        self.effort_scale = np.full(2, 5.0)
        self.actuators = tuple(Actuator(f"tendon_{k}", 0.0, 0.040, 0.002) for k in (1, 2))

    def assemble(self, design: Mapping[str, float]) -> MechanicalModel:
        """Hang the cone, thread the tendons through its first part, put effectors where the markers are."""
        long, short = self.elements
        ends = np.concatenate([np.linspace(0.0, LONG, long + 1), LONG + np.linspace(0.0, SHORT, short + 1)[1:]])
        builder = ModelBuilder(gravity=self.gravity)
        rod = add_rod(
            builder,
            [[0.0, 0.0, 0.0], [0.0, 0.0, -LONG - SHORT]],
            section=lambda s: Section.circle(float(np.interp(s, [0.0, LONG, LONG + SHORT], RADII))),
            elements=ends,
            up=[1.0, 0.0, 0.0],  # d_2 along x, so d_3 is along -y
            young_modulus=design["young_modulus"],
            poisson_ratio=design["poisson_ratio"],
            density=design["density"],
        )
        model = builder.build()
        places = np.linspace(0.0, LONG, long + 1)[1:]
        for actuator, angle in zip(self.actuators, np.deg2rad(ANGLES), strict=True):
            x, y = np.sin(angle), np.cos(angle)
            distance = (OFFSET - TAPER * places)[:, None]
            rod.add_tendon(model, actuator.name, places, distance * [x, -y], pull_point=[OFFSET * x, OFFSET * y, 0.0])
        for name, (place, (along, x, y)) in MARKERS.items():
            model.add_effector(name, rod.points(place, (along, x, y), model.nodes))
        return model
