"""Move a finger to a rod across its way and press on it with 1 N: inverse control that makes contact."""

import numpy as np

from softgym_envs import make_robot
from softgym_envs.backends import make_backend
from softgym_envs.extensions.grasping import ContactControl, ContactQP, ForceGoal

rod = {"kind": "cylinder", "name": "rod", "point": [0.0, 0.055, -0.1], "axis": [1.0, 0.0, 0.0], "radius": 0.01}
robot = make_robot("finger", obstacles=[{**rod, "friction": 0.3}])
fem = make_backend("fem", robot)
controller = ContactQP.for_robot(robot, rates=np.full(2, 0.004))  # at most 4 mm of cable per step
loop = ContactControl(fem, controller)
for _ in range(10):
    state = loop.step(None, forces=[ForceGoal({"rod": 1.0}, 1.0)])
    print(f"cables {np.round(1e3 * state.command, 2)} mm, normal force {state.contacts.pressing.sum():.4f} N")
