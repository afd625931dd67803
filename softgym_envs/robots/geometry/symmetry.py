"""Symmetries of a robot, and symmetric bodies from a mesh of one part.

Mesh generators do not preserve symmetry: of two identical legs, one becomes stiffer. A body that is mirrored from one
part responds as symmetrically as its shape, up to round-off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from softgym_envs.robots.geometry.meshing import BodyMesh


@dataclass(frozen=True, eq=False)
class Symmetry:
    """A reflection or rotation that maps each body of a robot, and its mesh, to itself.

    The image of an equilibrium is then an equilibrium too.

    Attributes:
        matrix: orthogonal; maps forces, and positions about the centre, shape (3, 3). Every effector is its own image
            at rest.
        order: actuator ``k`` of the image does what actuator ``order[k]`` does, shape (n_a,).
        centre: a point that is its own image [m], shape (3,).
    """

    matrix: np.ndarray
    order: np.ndarray
    centre: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def rows(self, effectors: int) -> np.ndarray:
        """Return the map of the coordinates of several effectors, shape (3 effectors, 3 effectors)."""
        return np.kron(np.eye(effectors), self.matrix)

    def positions(self, effectors: np.ndarray) -> np.ndarray:
        """Return the images of effectors [m], shape (..., 3 effectors)."""
        points = effectors.reshape(*effectors.shape[:-1], -1, 3) - self.centre
        return (points @ self.matrix.T + self.centre).reshape(effectors.shape)


def left_right(order: Sequence[int]) -> tuple[Symmetry, ...]:
    """Return the reflection in the plane x = 0, which exchanges actuators in this ``order``."""
    return (Symmetry(np.diag([-1.0, 1.0, 1.0]), np.array(order)),)


def square_symmetries(rings: int = 1) -> tuple[Symmetry, ...]:
    """Return the seven rotations and reflections of a square about the z axis, without the identity.

    Args:
        rings: number of groups of four actuators in the directions +y, -x, -y and +x.
    """
    directions = np.array([(0, 1, 0), (-1, 0, 0), (0, -1, 0), (1, 0, 0)])
    quarter, plane = np.array([(0, -1, 0), (1, 0, 0), (0, 0, 1)]), np.diag([-1, 1, 1])
    turns = [np.linalg.matrix_power(quarter, k) for k in range(4)]
    found = []
    for matrix in (*turns[1:], *(turn @ plane for turn in turns)):
        # An actuator of the image comes from where the inverse takes it.
        order = [int((directions == matrix.T @ direction).all(axis=1).argmax()) for direction in directions]
        whole = np.concatenate([4 * ring + np.array(order) for ring in range(rings)])
        found.append(Symmetry(matrix.astype(float), whole))
    return tuple(found)


def mirrored(part: BodyMesh, normal: tuple[float, float, float]) -> BodyMesh:
    """Return a part joined to its mirror image at the plane through the origin with a ``normal`` of any length.

    Nodes on the plane are shared. Boundary triangles in the plane are removed, because they lie inside the whole body.

    Args:
        part: a mesh on one side of the plane.
        normal: of the plane.

    Raises:
        ValueError: if the part crosses the plane.
    """
    unit = np.asarray(normal) / np.linalg.norm(normal)
    nodes = part.nodes.copy()
    distance = nodes @ unit
    shared = np.abs(distance) < 1e-9
    if (distance[~shared] > 0.0).any() and (distance[~shared] < 0.0).any():
        raise ValueError(f"the mesh lies on both sides of the plane with normal {normal}")
    nodes[shared] -= distance[shared, None] * unit  # exactly onto the plane
    count = len(nodes)
    image = np.arange(count)
    image[~shared] = count + np.arange(np.count_nonzero(~shared))
    reflected = nodes[~shared] - 2.0 * distance[~shared, None] * unit
    outside = ~shared[part.triangles].all(axis=1)
    triangles, surfaces = part.triangles[outside], part.surfaces[outside]
    # A reflection inverts elements; exchanging two corners restores their orientation.
    return BodyMesh(
        nodes=np.concatenate([nodes, reflected]),
        tetrahedra=np.concatenate([part.tetrahedra, image[part.tetrahedra][:, [0, 2, 1, 3]]]),
        triangles=np.concatenate([triangles, image[triangles][:, [0, 2, 1]]]),
        surfaces=np.concatenate([surfaces, surfaces + surfaces.max()]),
        origin=part.origin,
    )
