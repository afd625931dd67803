"""Whole bodies from the part of them that is meshed.

A mesh generator knows nothing of symmetry: of two legs that are drawn alike one comes out stiffer. Meshing one part
and mirroring it makes the response of the body as symmetric as its shape, to round-off.
"""

from __future__ import annotations

import numpy as np

from softgym_envs.robots.geometry.meshing import BodyMesh


def mirrored(part: BodyMesh, normal: tuple[float, float, float]) -> BodyMesh:
    """Return a part and its mirror image, joined at the plane through the origin with a ``normal`` of any length.

    Nodes on the plane are shared, and boundary triangles in it vanish: they are inside the whole.

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
    nodes[shared] -= distance[shared, None] * unit  # onto the plane to the last digit
    count = len(nodes)
    image = np.arange(count)
    image[~shared] = count + np.arange(np.count_nonzero(~shared))
    reflected = nodes[~shared] - 2.0 * distance[~shared, None] * unit
    outside = ~shared[part.triangles].all(axis=1)
    triangles, surfaces = part.triangles[outside], part.surfaces[outside]
    # A reflection turns elements inside out; two corners exchanged turn them back.
    return BodyMesh(
        nodes=np.concatenate([nodes, reflected]),
        tetrahedra=np.concatenate([part.tetrahedra, image[part.tetrahedra][:, [0, 2, 1, 3]]]),
        triangles=np.concatenate([triangles, image[triangles][:, [0, 2, 1]]]),
        surfaces=np.concatenate([surfaces, surfaces + surfaces.max()]),
        origin=part.origin,
    )
