"""Bodies of superelements for the tests that every element passes."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from softgym_envs.extensions.modules.closed_superelement import add_superelement
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.model import MechanicalModel


class QuarticEnergy:
    """Energy of a superelement with coupled strains that stiffens: quadratic and quartic."""

    stiffness = np.diag([2e4, 3e4, 9e4, 0.4, 0.6, 0.9])
    stiffness[0, 4] = stiffness[4, 0] = 30.0
    stiffness[2, 3] = stiffness[3, 2] = -60.0
    direction = np.array([3.0, -2.0, 5.0, 0.3, 0.4, -0.2])

    def evaluate(self, strains: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return energy, gradient and Hessian."""
        s = self.direction @ strains
        gradient = self.stiffness @ strains + 4.0 * s**3 * self.direction
        hessian = self.stiffness + 12.0 * s**2 * np.outer(self.direction, self.direction)
        return float(0.5 * strains @ self.stiffness @ strains + s**4), gradient, hessian

    def knows(self, strains: np.ndarray) -> bool:
        """Its energy is known everywhere."""
        return True


def clamped_superelements() -> MechanicalModel:
    """Return two superelements in a row, the second one turned and shifted against its frames, clamped at one end."""
    builder = ModelBuilder()
    turned = Rotation.from_rotvec([0.3, -0.5, 0.4])
    start = np.array([0.002, -0.001, 0.031])
    frames = [
        builder.add_frame(np.zeros(3), fixed=True, fixed_spin=True),
        builder.add_frame([0.0, 0.0, 0.030], Rotation.from_rotvec([0.0, 0.2, 0.1]).as_matrix()),
        builder.add_frame(start + turned.apply([0.0, 0.0, 0.022])),
    ]
    height = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    inertia = 0.01 * (np.diag([0.3, 1e-4, 1e-4, 1e-5] * 2) + 0.1 * np.outer(height, np.roll(height, 4)))
    inertia = 0.5 * (inertia + inertia.T)
    add_superelement(builder, frames[0], frames[1], QuarticEnergy(), length=0.030, inertia=inertia)
    add_superelement(
        builder,
        frames[1],
        frames[2],
        QuarticEnergy(),
        length=0.020,
        origin=start,
        rotation=turned.as_matrix(),
        inertia=inertia,
    )
    return builder.build()
