"""A servo: the angle by which a frame has turned about a fixed axis."""

from __future__ import annotations

import math

import numpy as np

from softgym_envs.mechanics.constraints.constraint import Constraint


class Servo(Constraint):
    """Angle of a frame about an axis fixed in space; delta [rad] is zero at rest, effort [N m] is the torque.

    The angle is that of one director's projection onto the plane normal to the axis, between -pi and pi. The frame's
    other motions must be held (fixed origin and spin); the angle remains defined if the frame tilts out of the plane.

    Args:
        name: identifier.
        row: first row of the frame.
        axis: direction of the axis, shape (3,).
        nodes: rest rows [m], shape (n, 3).

    Attributes:
        directions: directions in which the angle is zero and pi/2, shape (2, 3).
    """

    size = 1
    unit = ("rad", "N m")

    def __init__(self, name: str, row: int, axis: np.ndarray, nodes: np.ndarray) -> None:
        self.name = name
        axis = np.asarray(axis, dtype=float)
        length = float(np.linalg.norm(axis))
        if not length > 0.0:
            raise ValueError(f"servo '{name}': axis {axis.tolist()} has no direction")
        self.axis = axis / length
        directors = nodes[row + 1 : row + 4]
        across = directors - np.outer(directors @ self.axis, self.axis)
        chosen = int(np.argmax(np.linalg.norm(across, axis=1)))
        self.row = row + 1 + chosen
        first = across[chosen] / np.linalg.norm(across[chosen])
        self.directions = np.array([first, np.cross(self.axis, first)])
        self.dofs = 3 * self.row + np.arange(3)
        a, b = self.directions
        self._mixed = np.outer(a, b) + np.outer(b, a)
        self._same = np.outer(a, a) - np.outer(b, b)

    def value(self, x: np.ndarray) -> np.ndarray:
        return self.linearise(x)[0]

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        return self.linearise(x)[1]

    def linearise(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        p, q = (float(value) for value in self.directions @ x[self.row])
        first, second = self.directions
        square = p * p + q * q
        return np.array([math.atan2(q, p)]), ((p / square) * second - (q / square) * first)[None, :]

    def hessian(self, x: np.ndarray, effort: np.ndarray) -> np.ndarray:
        p, q = (float(value) for value in self.directions @ x[self.row])
        scale = float(effort[0]) / (p * p + q * q) ** 2
        return (2.0 * p * q * scale) * self._same + ((q * q - p * p) * scale) * self._mixed
