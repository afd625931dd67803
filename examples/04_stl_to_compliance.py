"""From an STL file to the compliance of a soft finger with two cables and an air chamber."""

from pathlib import Path

import numpy as np

from softgym_envs.mechanics import MechanicalModel, Statics

path = Path(__file__).with_name("hollow_finger.stl")  # 60 x 20 x 20 mm, with a closed cavity inside
model = MechanicalModel.from_file(path, unit="mm", fixed=lambda x: x[:, 0] < 1e-6, young_modulus=5e5, total_mass=0.025)
for name, z in (("upper", 0.017), ("lower", 0.003)):
    guides = np.column_stack([np.linspace(0.005, 0.055, 6), np.full(6, 0.010), np.full(6, z)])
    model.add_cable(name, guides, pull_point=[0.0, 0.010, z])
model.add_cavity("air", inside=[0.030, 0.010, 0.011])
model.add_effector("tip", [0.060, 0.010, 0.010])
state = Statics(model).solve([0.002, 0.0, 3e3], ["displacement", "displacement", "effort"])  # 2 mm, 0 mm, 3 kPa
print(state.condensed.W)
