"""Symmetric bodies from a mesh of one part.

Mesh generators do not preserve symmetry: of two identical legs, one becomes stiffer. A body that is mirrored from one
part responds as symmetrically as its shape, up to round-off.
"""

from __future__ import annotations

import numpy as np

from softgym_envs.robots.geometry.meshing import BodyMesh


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
