"""A body from any mesh file: here a bar that is first written to disk, then bent by a cable and by its weight."""

import tempfile
from pathlib import Path

import meshio
import numpy as np
from scipy.spatial import Delaunay

from softgym_envs.mechanics import MechanicalModel, Statics

# A bar of 100 x 20 x 20 mm, in millimetres as most programs write it.
axes = np.linspace(0, 100, 11), np.linspace(0, 20, 4), np.linspace(0, 20, 4)
points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
points += np.random.default_rng(0).uniform(-0.3, 0.3, points.shape) * (points > 0)
path = Path(tempfile.mkdtemp()) / "bar.vtk"
meshio.Mesh(points, [("tetra", Delaunay(points).simplices)]).write(path)

model = MechanicalModel.from_file(
    path,
    unit="mm",
    fixed_box=(-0.001, 0.001, -1, 1, -1, 1),  # x, y and z of the clamped nodes [m]
    young_modulus=lambda centroids: np.where(centroids[:, 0] < 0.05, 8e5, 4e5),  # stiffer near the clamp
    poisson_ratio=0.45,
    material="stable_neo_hookean",
    density=1100.0,
    gravity=(0.0, 0.0, -9.81),
)
guides = np.column_stack([np.linspace(0.005, 0.095, 10), np.full(10, 0.010), np.full(10, 0.017)])
# A guide acts on the part of its channel within a radius: a single point would cut through a fine mesh.
model.add_cable("cable", guides, pull_point=[-0.005, 0.010, 0.017], radius=2e-3)
model.add_effector("tip", [0.099, 0.010, 0.010])

statics = Statics(model)
for millimetres in (0.0, 2.0, 4.0, 6.0):
    state = statics.solve([1e-3 * millimetres])
    tip, tension = 1e3 * state.condensed.delta.e, state.effort[0]
    slack = " (slack)" if state.slack[0] else ""
    print(f"cable {millimetres:.0f} mm: tip at z = {tip[2]:6.2f} mm, tension {tension:.2f} N{slack}")
