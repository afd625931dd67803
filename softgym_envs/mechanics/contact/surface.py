"""The surface of a model, as points that depend linearly on its rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, identity, kron, vstack

from softgym_envs.mechanics.contact.obstacles import MeshObstacle
from softgym_envs.mechanics.elements.block import ElementBlock
from softgym_envs.mechanics.elements.quadratic import QuadraticTetrahedra, split_triangles
from softgym_envs.mechanics.elements.tetrahedra import SolidBlock, boundary_triangles
from softgym_envs.mechanics.kinematics import Kinematics
from softgym_envs.mechanics.skins import Skin


@dataclass(frozen=True)
class Surface:
    """Triangles whose vertices are linear combinations of the rows of a model.

    Attributes:
        weights: vertices as combinations of the rows, sparse matrix of shape (v, n).
        triangles: vertex indices, shape (t, 3), seen counter-clockwise from outside.
        body: number of the part that each vertex belongs to, shape (v,).
        rest: vertices at rest [m], shape (v, 3).
    """

    weights: csr_matrix
    triangles: np.ndarray
    body: np.ndarray
    rest: np.ndarray

    @cached_property
    def points(self) -> tuple[csr_matrix, np.ndarray]:
        """Points at which obstacles are tested, as combinations of the rows (p, n), and their areas [m2] (p,).

        The points are the vertices and the middles of the triangles. The areas integrate quadratic functions over a
        triangle exactly: 1/12 of it for each vertex, 3/4 for its middle.
        """
        corners = self.rest[self.triangles]
        area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        count = len(self.triangles)
        middle = coo_matrix(
            (np.full(3 * count, 1.0 / 3.0), (np.repeat(np.arange(count), 3), self.triangles.ravel())),
            shape=(count, len(self.rest)),
        ).tocsr()
        vertex_area = np.bincount(self.triangles.ravel(), np.repeat(area / 12.0, 3), minlength=len(self.rest))
        return vstack([self.weights, middle @ self.weights]).tocsr(), np.concatenate([vertex_area, 0.75 * area])


def surface_of(
    nodes: np.ndarray,
    blocks: Sequence[ElementBlock],
    skins: Sequence[Skin],
    excluded: Sequence[int] | np.ndarray = (),
) -> Surface:
    """Return the surface of all parts of a model: solids, and the skins of beams and rigid parts.

    Args:
        nodes: rest rows [m], shape (n, 3).
        blocks: element blocks, of which solids have a surface.
        skins: surfaces of the other parts.
        excluded: rows whose triangles are left out, e.g. nodes that are clamped inside something that is not modelled.
    """
    n = len(nodes)
    left_out = np.zeros(n, dtype=bool)
    left_out[np.asarray(excluded, dtype=np.int64)] = True
    weights, triangles, body, start = [], [], [], 0
    solids = [block for block in blocks if isinstance(block, SolidBlock)]
    for number, block in enumerate(solids):
        faces = boundary_triangles(block.corners)
        if isinstance(block, QuadraticTetrahedra):
            faces = split_triangles(faces, block.connectivity)
        faces = faces[~left_out[faces].any(axis=1)]
        rows, local = np.unique(faces, return_inverse=True)
        weights.append(csr_matrix((np.ones(len(rows)), rows, np.arange(len(rows) + 1)), shape=(len(rows), n)))
        triangles.append(local.reshape(-1, 3) + start)
        body.append(np.full(len(rows), number))
        start += len(rows)
    for number, skin in enumerate(skins, start=len(solids)):
        ids, factors = skin.points.node_ids, skin.points.weights
        count = len(ids)
        weights.append(
            coo_matrix(
                (factors.ravel(), (np.repeat(np.arange(count), ids.shape[1]), ids.ravel())), shape=(count, n)
            ).tocsr()
        )
        triangles.append(skin.triangles + start)
        body.append(np.full(count, number))
        start += count
    if not start:
        return Surface(
            csr_matrix((0, n)), np.empty((0, 3), dtype=np.int64), np.empty(0, dtype=np.int64), np.empty((0, 3))
        )
    stacked = vstack(weights).tocsr()
    return Surface(stacked, np.concatenate(triangles), np.concatenate(body), stacked @ nodes)


@dataclass(frozen=True)
class SurfaceSet:
    """The surface of a model and its meshed obstacles, whose vertices follow in order.

    Attributes:
        weights: vertices as combinations of the rows, sparse matrix of shape (v, n); zero if they stand still.
        offset: places of vertices that stand still [m], zero for others, shape (v, 3).
        triangles: vertex indices, shape (t, 3).
        groups: vertices of one group do not touch each other; those with -1 touch all; shape (v,).
        friction: coefficient of friction of the obstacle that a vertex belongs to, NaN for the model; shape (v,).
        owner: number of that obstacle, -1 for the model; shape (v,).
    """

    weights: csr_matrix
    offset: np.ndarray
    triangles: np.ndarray
    groups: np.ndarray
    friction: np.ndarray
    owner: np.ndarray

    def places(self, x: np.ndarray) -> np.ndarray:
        """Return the vertices [m] (v, 3) at rows ``x`` (n, 3)."""
        return self.weights @ x + self.offset


def surface_set(
    surface: Surface, obstacles: Sequence[MeshObstacle], self_contact: bool, represented: Sequence[int] = ()
) -> SurfaceSet:
    """Return the surface of a model together with meshed obstacles.

    Obstacles that stand still do not touch each other, nor do those on one frame. A meshed obstacle stands for the
    skin of its frame.

    Args:
        surface: of the model.
        obstacles: the meshed obstacles.
        self_contact: whether the surface of the model touches itself.
        represented: first rows of frames with other obstacles, which stand for the skins of these frames in contact of
            the model with itself.
    """
    n = surface.weights.shape[1]
    kept = np.ones(len(surface.rest), dtype=bool)
    frames = sorted({each.frame for each in obstacles if each.frame is not None})
    for frame in [*frames, *(represented if self_contact else ())]:
        kept &= np.diff(surface.weights[:, frame : frame + 4].tocsr().indptr) == 0
    own = surface.weights[np.flatnonzero(kept)]
    faces = (np.cumsum(kept) - 1)[surface.triangles[kept[surface.triangles].all(axis=1)]]
    count = own.shape[0]
    weights, offset, triangles = [own], [np.zeros((count, 3))], [faces]
    friction, owner = [np.full(count, np.nan)], [np.full(count, -1)]
    groups = [np.full(count, -1 if self_contact else 0)]
    start = count
    for number, each in enumerate(obstacles):
        vertices, faces = each.skin()
        m = len(vertices)
        if each.frame is None:
            weights.append(csr_matrix((m, n)))
            offset.append(vertices)
            groups.append(np.full(m, 1))
        else:
            arms = np.column_stack([np.ones(m), vertices])
            rows, columns = np.repeat(np.arange(m), 4), np.tile(each.frame + np.arange(4), m)
            weights.append(csr_matrix((arms.ravel(), (rows, columns)), shape=(m, n)))
            offset.append(np.zeros((m, 3)))
            groups.append(np.full(m, 2 + frames.index(each.frame)))
        triangles.append(faces + start)
        friction.append(np.full(m, each.friction))
        owner.append(np.full(m, number))
        start += m
    return SurfaceSet(
        vstack(weights).tocsr(),
        np.concatenate(offset),
        np.concatenate(triangles),
        np.concatenate(groups),
        np.concatenate(friction),
        np.concatenate(owner),
    )


class Mapping:
    """Derivatives with respect to points, mapped to the equations of a model.

    Args:
        weights: the points as combinations of the rows, shape (p, n).
        kinematics: degrees of freedom of the model.
    """

    def __init__(self, weights: csr_matrix, kinematics: Kinematics) -> None:
        self._map = kinematics.map
        self._equations = kinematics.equations
        known = np.flatnonzero(kinematics.number >= 0)
        numbering = csr_matrix(
            (np.ones(len(known)), (known, kinematics.number[known])),
            shape=(len(kinematics.number), kinematics.total),
        )
        self._components = (kron(weights, identity(3), format="csr") @ numbering).tocsr()

    def jacobian(self, points: np.ndarray) -> csr_matrix:
        """Return the derivatives of the components of points (k,), shape (3 k, N), with frames where they are now."""
        components = (3 * points[:, None] + np.arange(3)).ravel()
        return self._to_equations(self._components[components])

    @property
    def all(self) -> csr_matrix:
        """The derivatives of all points, shape (3 p, N)."""
        return self._to_equations(self._components)

    def _to_equations(self, components: csr_matrix) -> csr_matrix:
        if self._map is None:
            return components
        direct, carried = components[:, : self._equations], components[:, self._equations :]
        return (direct + carried @ self._map.matrix).tocsr() if carried.nnz else direct
