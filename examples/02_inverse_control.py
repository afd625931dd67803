"""Bring the tip to a goal on the finite elements with the inverse QP, and look at the condensed model."""

import numpy as np

from softgym_envs import make_robot
from softgym_envs.backends import make_backend
from softgym_envs.control import InverseQP

robot = make_robot("finger")
fem = make_backend("fem", robot, design={"joint_height": 0.007})
goal = fem.probe(np.array([0.012, 0.010])).effector  # somewhere it can reach [m]

controller = InverseQP.for_robot(robot)
state = fem.state
for _ in range(20):
    state = fem.step(controller.solve(state.condensed, goal, state.command, state.slack))

print("compliance W_aa [mm/N]:\n", np.round(1e3 * state.condensed.W.aa, 3))
print(f"tensions {np.round(state.effort, 2)} N, {1e3 * np.linalg.norm(state.effector - goal):.4f} mm from the goal")
