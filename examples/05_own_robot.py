"""A robot of your own: one class, then gymnasium.make, inverse control, training and co-design."""

from itertools import permutations

import gymnasium
import numpy as np

from softgym_envs import DesignSpace, DesignVariable
from softgym_envs.control import InverseQP
from softgym_envs.mechanics import MechanicalModel
from softgym_envs.robots import Actuator, Learning, Robot


def bar(layers):
    """Mesh the unit cube: 2 x 2 x layers bricks, each cut into six tetrahedra."""
    shape = (3, 3, layers + 1)
    index = np.arange(np.prod(shape)).reshape(shape)
    nodes = np.stack(np.unravel_index(index.ravel(), shape), axis=1) / (np.array(shape) - 1.0)
    paths = [np.cumsum([np.zeros(3, int), *steps], axis=0) for steps in permutations(np.eye(3, dtype=int))]
    bricks = [[index[a : a + 2, b : b + 2, c : c + layers].ravel() for a, b, c in path] for path in paths]
    return nodes, np.concatenate([np.stack(corners, axis=1) for corners in bricks])


class Arm(Robot):
    """A silicone bar that stands on z = 0 and is bent by three cables."""

    name = "arm"
    effectors = ("tip",)
    size = 0.1
    effector_rest = (0.0, 0.0, 0.1)
    effort_scale = (5.0, 5.0, 5.0)
    learning = Learning(stiffness_variable="young_modulus")
    design_space = DesignSpace(
        DesignVariable("length", 0.08, 0.12, 0.10, "m", "length of the arm"),
        DesignVariable("width", 0.010, 0.016, 0.012, "m", "side of its square section"),
        DesignVariable("young_modulus", 1e5, 1e6, 3e5, "Pa", "stiffness", log=True),
    )
    actuators = tuple(Actuator(f"cable_{k}", low=0.0, high=0.020, rate=0.001) for k in range(3))

    def __init__(self, *, layers: int = 8):
        super().__init__()
        self.nodes, self.tetrahedra = bar(layers)

    def assemble(self, design):
        """Scale the mesh, clamp its base, thread the cables, put the effector at the tip."""
        nodes = (self.nodes - [0.5, 0.5, 0.0]) * [design["width"], design["width"], design["length"]]
        model = MechanicalModel.from_mesh(
            nodes, self.tetrahedra, fixed=nodes[:, 2] == 0.0, young_modulus=design["young_modulus"], poisson_ratio=0.45
        )
        for actuator, angle in zip(self.actuators, 2.0 * np.pi / 3.0 * np.arange(3), strict=True):
            side = 0.4 * design["width"] * np.array([np.cos(angle), np.sin(angle), 0.0])
            guides = side + np.outer(np.linspace(0.1, 0.9, 6) * design["length"], [0.0, 0.0, 1.0])
            model.add_cable(actuator.name, guides, pull_point=side)
        model.add_effector("tip", np.array([0.0, 0.0, design["length"]]))
        return model


if __name__ == "__main__":
    env = gymnasium.make("SoftGym/Reach-v0", robot=Arm, design={"length": 0.11})
    controller = InverseQP.for_robot(env.unwrapped.robot)
    _, info = env.reset(seed=0)
    for _ in range(30):
        state = env.unwrapped.state
        command = controller.solve(state.condensed, info["goal"], state.command, state.slack)
        _, _, _, _, info = env.step(env.unwrapped.spaces.action(command, state.command))
    print(f"{1e3 * info['distance']:.3f} mm from the goal, tensions {np.round(info['effort'], 2)} N")
    assert info["is_success"]
