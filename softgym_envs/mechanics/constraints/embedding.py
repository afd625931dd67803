"""Material points as linear combinations of rows: in tetrahedra by barycentric coordinates, or in a frame."""

from __future__ import annotations

import numpy as np


class EmbeddedPoints:
    """Points that move with a tetrahedral mesh.

    A point outside the mesh is extrapolated from the element where its smallest barycentric coordinate is
    largest (the "nearest" element).

    Args:
        points: reference positions [m], shape (p, 3).
        nodes: mesh nodes at rest [m], shape (n, 3).
        tetrahedra: corner indices, shape (m, 4).
        hint: elements from which points outside the mesh are extrapolated, shape (p,). The nearest element can
            change abruptly when a mesh of the same topology is moved; a fixed one keeps the point's motion smooth.
        gradients: those of the last three barycentric coordinates [1/m], shape (m, 3, 3), if already known.

    Attributes:
        points: reference positions [m], shape (p, 3).
        elements: element of each point, shape (p,).
        weights: barycentric coordinates, shape (p, 4); other kinds of points have other numbers of columns.
        node_ids: corner nodes, shape (p, 4).
    """

    def __init__(
        self,
        points: np.ndarray,
        nodes: np.ndarray,
        tetrahedra: np.ndarray,
        hint: np.ndarray | None = None,
        *,
        gradients: np.ndarray | None = None,
    ) -> None:
        points = np.atleast_2d(np.asarray(points, dtype=float))
        if not np.isfinite(points).all():
            raise ValueError(f"embedded points must be finite, got {points.tolist()}")
        self.points = points
        corners = nodes[tetrahedra]
        if gradients is None:
            gradients = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
        self.elements = np.empty(len(points), dtype=np.int64)
        self.weights = np.empty((len(points), 4))
        for i, point in enumerate(points):
            tail = np.einsum("mij,mj->mi", gradients, point - corners[:, 0])
            barycentric = np.column_stack([1.0 - tail.sum(axis=1), tail])
            score = barycentric.min(axis=1)
            best = int(np.argmax(score))
            if hint is not None and score[best] < -1e-9:
                best = int(hint[i])
            self.elements[i] = best
            self.weights[i] = barycentric[best]
        self.node_ids = np.asarray(tetrahedra)[self.elements]

    @classmethod
    def from_weights(cls, node_ids: np.ndarray, weights: np.ndarray, nodes: np.ndarray) -> EmbeddedPoints:
        """Return points that are given as linear combinations of rows: ids (p, k) and weights (p, k)."""
        points = cls.__new__(cls)
        points.node_ids = np.atleast_2d(np.asarray(node_ids, dtype=np.int64))
        points.weights = np.atleast_2d(np.asarray(weights, dtype=float))
        points.elements = np.full(len(points.node_ids), -1, dtype=np.int64)
        points.points = points.positions(nodes)
        return points

    @classmethod
    def in_frame(cls, row: int, local: np.ndarray, nodes: np.ndarray) -> EmbeddedPoints:
        """Return points of a rigid part at coordinates [m] (p, 3) along the directors of the frame at a row."""
        local = np.atleast_2d(np.asarray(local, dtype=float))
        ids = np.tile(row + np.arange(4), (len(local), 1))
        return cls.from_weights(ids, np.column_stack([np.ones(len(local)), local]), nodes)

    def positions(self, x: np.ndarray) -> np.ndarray:
        """Return the points [m], shape (p, 3), at node positions ``x``, shape (n, 3)."""
        return np.einsum("pk,pkd->pd", self.weights, x[self.node_ids])
