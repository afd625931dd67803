"""A continuum arm: a steel rod of 300 mm with discs, bent in two segments by three tendons each."""

import numpy as np

from softgym_envs import DesignSpace, DesignVariable
from softgym_envs.extensions.beams import Section, add_rod
from softgym_envs.mechanics import ModelBuilder
from softgym_envs.robots import Actuator, Robot


class TendonArm(Robot):
    """Near tendons end at the middle of the rod, far ones at its tip."""

    name = "tendon_arm"
    effectors = ("tip",)
    size = 0.3
    effector_rest = (0.0, 0.0, 0.3)
    effort_scale = (10.0,) * 6  # N
    design_space = DesignSpace(
        DesignVariable("middle", 0.3, 0.7, 0.5, "1", "where the near tendons end, over the length"),
        DesignVariable("radius", 0.0006, 0.0012, 0.0009, "m", "radius of the rod"),
        DesignVariable("offset", 0.005, 0.010, 0.008, "m", "distance of the tendons from the axis"),
    )
    near, far = ("near_1", "near_2", "near_3"), ("far_1", "far_2", "far_3")
    actuators = tuple(Actuator(name, -0.008, 0.008, 0.0005) for name in near + far)
    antagonists = (near, far)  # what one pulls, the others let out

    def assemble(self, design):
        """Clamp the rod at its base, put 20 discs along it, and thread the tendons through them."""
        length, share = 0.3, design["middle"]
        discs = length * np.concatenate([np.linspace(0, share, 11), np.linspace(share, 1, 11)[1:]])
        builder = ModelBuilder(gravity=self.gravity)
        section = Section.circle(design["radius"])
        path = [[0, 0, 0], [0, 0, length]]
        rod = add_rod(builder, path, section=section, elements=discs, young_modulus=6e10, density=6450)
        model = builder.build()
        for k, name in enumerate(self.near + self.far):
            angle = 2.0 * np.pi / 3.0 * k + (np.pi / 3.0 if name in self.far else 0.0)
            offset = design["offset"] * np.array([np.cos(angle), np.sin(angle)])
            rod.add_tendon(model, name, discs[1:11] if name in self.near else discs[1:], offset)
        model.add_effector("tip", rod.points(length, (0.0, 0.0), model.nodes))
        return model
