"""A pneumatic bender: two chambers side by side and a tendon along the floor, cast in silicone."""

import gmsh
import numpy as np

from softgym_envs import DesignSpace, DesignVariable
from softgym_envs.robots import Actuator, GmshRobot, Learning


class PneuNet(GmshRobot):
    """A bar of 24 mm x 16 mm along z with a chamber on either side; both together bend it towards -y."""

    name = "pneunet"
    effectors = ("tip",)
    size = 0.08
    effector_rest = (0.0, 0.0, 0.08)
    effort_scale = (1e4, 1e4, 2.0)  # typical pressures [Pa] and tension [N]
    mesh_size = 0.006
    learning = Learning(stiffness_variable="young_modulus")
    design_space = DesignSpace(
        DesignVariable("length", 0.07, 0.09, 0.08, "m", "length of the bar"),
        DesignVariable("wall", 0.0015, 0.003, 0.002, "m", "thickness of the walls of the chambers"),
        DesignVariable("floor", 0.003, 0.006, 0.004, "m", "thickness of the floor, which hardly stretches"),
        DesignVariable("young_modulus", 1e5, 6e5, 2e5, "Pa", "stiffness of the silicone", log=True),
    )
    actuators = (
        Actuator("left", 0.0, 4e-6, 4e-7, unit="m3"),
        Actuator("right", 0.0, 4e-6, 4e-7, unit="m3"),
        Actuator("tendon", 0.0, 0.008, 0.0008),
    )

    def draw(self, design):
        """Cut two chambers out of a bar, and name the faces that matter."""
        length, wall, floor = design["length"], design["wall"], design["floor"]
        bar = gmsh.model.occ.addBox(-0.012, 0, 0, 0.024, 0.016, length)
        size = (0.012 - 1.5 * wall, 0.016 - floor - wall, length - 0.010)
        chambers = [(3, gmsh.model.occ.addBox(x, floor, 0.005, *size)) for x in (-0.012 + wall, 0.5 * wall)]
        gmsh.model.occ.cut([(3, bar)], chambers)
        self.name_faces("fixed", z=0.0)
        self.name_faces("left", x=(-0.012 + wall, -0.5 * wall), y=(floor, 0.016 - wall), z=(0.005, length - 0.005))
        self.name_faces("right", x=(0.5 * wall, 0.012 - wall), y=(floor, 0.016 - wall), z=(0.005, length - 0.005))

    def equip(self, model, design):
        """Thread the tendon along the floor, and put the effector at the middle of the tip."""
        middle = [0.0, 0.5 * design["floor"]]
        guides = [[*middle, z] for z in np.linspace(0.05, 0.95, 8) * design["length"]]
        model.add_cable("tendon", guides, pull_point=[*middle, 0.0], radius=0.002)
        model.add_effector("tip", [0.0, 0.0, design["length"]], radius=0.003)
