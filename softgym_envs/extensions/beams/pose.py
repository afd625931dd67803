"""One coordinate of the pose of a frame, relative to rest."""

from __future__ import annotations

import numpy as np

from softgym_envs.mechanics.constraints.constraint import Constraint


class Pose(Constraint):
    """One of the six coordinates of a frame: a displacement of its origin, or a component of its rotation.

    The first three are the displacement of the origin [m]; their efforts [N] are a force at it. The last three are the
    components of ``sin(angle) * axis`` [1] of the rotation from rest, the axial vector of the skew part of its matrix
    ``R``:

        s = 1/2 sum_k D_k x d_k,    D_k and d_k the directors at rest and now.

    It is linear in the directors (no second derivative), and unique for rotations of up to 90 degrees. The efforts
    ``h`` [N m] are conjugate to ``s``: their torque is ``(tr(R) I - R)^T h / 2``, which near rest is ``h`` itself.

    Args:
        name: identifier.
        row: first row of the frame.
        component: 0, 1, 2 for x, y, z of the origin; 3, 4, 5 for the rotation about x, y, z.
        nodes: rest rows [m], shape (n, 3).
    """

    size = 1

    def __init__(self, name: str, row: int, component: int, nodes: np.ndarray) -> None:
        if component not in range(6):
            raise ValueError(f"pose '{name}': component = {component!r} is unknown; allowed: 0 to 5")
        self.name = name
        axis = component % 3
        if component < 3:
            self.unit = ("m", "N")
            self.dofs = np.array([3 * row + axis])
            self._jacobian = np.ones((1, 1))
        else:
            self.unit = ("1", "N m")
            # e . (D x d) = (e x D) . d
            across = 0.5 * np.cross(np.eye(3)[axis], nodes[row + 1 : row + 4])
            self.dofs = (3 * (row + np.arange(1, 4))[:, None] + np.arange(3)).ravel()
            self._jacobian = across.reshape(1, 9)
        self._rest = float(self._jacobian[0] @ nodes.ravel()[self.dofs])

    def value(self, x: np.ndarray) -> np.ndarray:
        return self._jacobian @ x.ravel()[self.dofs] - self._rest

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        return self._jacobian
