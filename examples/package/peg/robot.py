"""The robot. Its weights are in the folder ``weights`` beside this file."""

from itertools import permutations

import numpy as np

from softgym_envs import DesignSpace, DesignVariable
from softgym_envs.mechanics import MechanicalModel
from softgym_envs.robots import Actuator, Robot

CORNERS = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1).astype(float)
PATHS = [np.cumsum([np.zeros(3, int), *steps], axis=0) for steps in permutations(np.eye(3, dtype=int))]
TETRAHEDRA = np.array([[np.ravel_multi_index(tuple(corner), (2, 2, 2)) for corner in path] for path in PATHS])


class Peg(Robot):
    """A block that stands on z = 0 and is bent by a cable."""

    name = "peg"
    effectors = ("tip",)
    size = 0.05
    effector_rest = np.array([0.0, 0.0, 0.05])
    effort_scale = np.array([1.0])
    design_space = DesignSpace(
        DesignVariable("length", 0.04, 0.06, 0.05, "m", "height of the block"),
        DesignVariable("width", 0.010, 0.015, 0.012, "m", "side of its square section"),
    )
    actuators = (Actuator("cable", low=0.0, high=0.002, rate=0.0005),)

    def assemble(self, design):
        """Scale the mesh, clamp its base, add the cable and the effector."""
        size = [design["width"], design["width"], design["length"]]
        nodes = (CORNERS - [0.5, 0.5, 0.0]) * size
        model = MechanicalModel.from_mesh(nodes, TETRAHEDRA, fixed=nodes[:, 2] == 0.0, young_modulus=3e5)
        side = 0.4 * design["width"]
        model.add_cable("cable", np.array([[side, 0.0, design["length"]]]), pull_point=np.array([side, 0.0, 0.0]))
        model.add_effector("tip", np.array([0.0, 0.0, design["length"]]))
        return model
