"""A backend: finite elements whose drives move in whole steps."""

import numpy as np

from softgym_envs.backends.fem import FEMBackend


class RoundedBackend(FEMBackend):
    """Finite elements whose commands are rounded to multiples of a step of the drives.

    Args:
        robot: as for `FEMBackend`.
        design: as for `FEMBackend`.
        resolution: step of the drives [m].
        **options: as for `FEMBackend`.
    """

    def __init__(self, robot, design=None, resolution: float = 1e-4, **options):
        super().__init__(robot, design, **options)
        self.resolution = resolution

    def step(self, command, mode="displacement", **options):
        """Go to the equilibrium under the rounded command."""
        if mode == "displacement":
            command = self.resolution * np.round(np.asarray(command) / self.resolution)
        return super().step(command, mode, **options)
