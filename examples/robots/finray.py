"""A fin-ray finger of TPU that a cable closes around a rod."""

import gmsh
import numpy as np

from softgym_envs import DesignSpace, DesignVariable
from softgym_envs.mechanics import Cylinder
from softgym_envs.robots import Actuator, GmshRobot


class FinRay(GmshRobot):
    """A right-angled triangle of two walls with ribs between them; the front wall x = 0 meets the rod."""

    name = "finray"
    effectors = ("tip",)
    size = 0.09
    effector_rest = (0.002, 0.086, 0.0)
    effort_scale = (10.0,)  # N
    mesh_size = 0.006
    young_modulus, poisson_ratio, density = 12e6, 0.45, 1200.0  # TPU 85A, printed solid
    design_space = DesignSpace(
        DesignVariable("base", 0.028, 0.045, 0.036, "m", "distance of the walls at the base"),
        DesignVariable("wall", 0.0018, 0.003, 0.0022, "m", "thickness of both walls"),
        DesignVariable("rib", 0.0008, 0.002, 0.0012, "m", "thickness of the ribs"),
    )
    actuators = (Actuator("cable", 0.0, 0.003, 0.0002, max_effort=40.0),)

    def draw(self, design):
        """Cut the cells between the ribs out of a prism, 16 mm deep."""
        base, wall, rib = (design[name] for name in ("base", "wall", "rib"))
        thick = wall * np.hypot(base, 0.09) / 0.09  # the back wall, measured along x
        cells = [(y + 0.5 * rib, y + 0.014 - 0.5 * rib) for y in 0.004 + 0.014 * np.arange(5)]
        back = [[base - (base - 0.004) * y / 0.09 - thick for y in ab] for ab in cells]
        quads = [[(wall, a), (c, a), (d, b), (wall, b)] for (a, b), (c, d) in zip(cells, back, strict=True)]
        body = self.prism([(0, 0), (base, 0), (0.004, 0.09), (0, 0.09)])
        gmsh.model.occ.cut([body], [self.prism(quad) for quad in quads])
        self.name_faces("fixed", y=0.0)

    def prism(self, corners, depth=0.016):
        """Extrude a polygon of corners (x, y)."""
        points = [gmsh.model.occ.addPoint(x, y, -0.5 * depth) for x, y in corners]
        lines = [gmsh.model.occ.addLine(a, b) for a, b in zip(points, points[1:] + points[:1], strict=True)]
        face = gmsh.model.occ.addPlaneSurface([gmsh.model.occ.addCurveLoop(lines)])
        return next(entity for entity in gmsh.model.occ.extrude([(2, face)], 0, 0, depth) if entity[0] == 3)

    def equip(self, model, design):
        """Guide the cable through the front wall; the effector is the tip."""
        guides = [[0.5 * design["wall"], y, 0.0] for y in np.linspace(0.008, 0.084, 6)]
        model.add_cable("cable", guides, pull_point=[0.5 * design["wall"], 0.0, 0.0], radius=0.003)
        model.add_effector("tip", [0.002, 0.086, 0.0], radius=0.003)

    def own_obstacles(self, model, design):
        """A rod of 12 mm beside the front wall."""
        return [Cylinder((-0.0066, 0.065, 0.0), (0.0, 0.0, 1.0), 0.006)]
