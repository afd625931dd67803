"""Points that move with a small part of a body: the average over a ball instead of the value at one place.

A force on a single point of a solid has no finite displacement: the finer the mesh, the larger it becomes, until no
equilibrium is left. Real actuators act on a small part of the body, for example a cable on the bore that guides it. A
point averaged over a ball of stated radius is a linear map of the displacement field that does not depend on the mesh,
so compliances converge.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints

SAMPLES_PER_RADIUS = 4
"""Spacing of the sample points of a ball: its radius over this number; 257 points in a full ball."""

INSIDE = -1e-5  # smallest barycentric coordinate of a point that counts as inside: rounding of points on the surface
LEAST_SPREAD = 1e-2  # smallest standard deviation of the samples over the radius, in any direction


def ball(radius: float) -> np.ndarray:
    """Return a grid of points [m] (p, 3) that fills the ball of a radius [m] about the origin."""
    steps = np.arange(-SAMPLES_PER_RADIUS, SAMPLES_PER_RADIUS + 1) / SAMPLES_PER_RADIUS
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return radius * grid[(grid**2).sum(axis=1) <= 1.0 + 1e-9]


def averaged_points(
    points: np.ndarray,
    nodes: np.ndarray,
    connectivity: np.ndarray,
    shape: Callable[[np.ndarray], np.ndarray],
    radius: float,
) -> EmbeddedPoints:
    """Return points whose displacement is averaged over the part of a body within a distance of them.

    The average of a displacement field ``u`` is ``sum_k a_k u(P_k)`` over sample points ``P_k``. The factors are linear
    in the position, ``a_k = c + g . P_k``, with ``sum a_k = 1`` and ``sum a_k P_k = p``: they are exact for affine
    fields, so rigid motions and uniform strains move the point ``p`` as a material point. A force on it becomes a load
    on the ball with the same resultant and the same moment.

    Args:
        points: [m], shape (p, 3); on or outside the surface, only the part of the ball in the body counts.
        nodes: of the body at rest [m], shape (n, 3).
        connectivity: of its elements, corners first, shape (m, k).
        shape: shape functions (..., k) of an element at barycentric coordinates (..., 4).
        radius: of the ball [m].

    Raises:
        ValueError: if the radius is not positive, or a ball contains too small a part of the body.
    """
    if not (np.isfinite(radius) and radius > 0.0):
        raise ValueError(f"the radius of an average must be positive and finite, got {radius} m")
    offsets = ball(radius)
    corners = nodes[connectivity[:, :4]]
    low, high = corners.min(axis=1), corners.max(axis=1)
    found = []
    for point in np.atleast_2d(np.asarray(points, dtype=float)):
        near = np.flatnonzero(((low <= point + radius) & (high >= point - radius)).all(axis=1))
        found.append(_weights(point, offsets, corners[near], connectivity[near], shape, radius))
    # Rows of equal length, filled up with weights of zero.
    longest = max(len(ids) for ids, _ in found)
    ids = np.array([np.pad(row, (0, longest - len(row)), mode="edge") for row, _ in found])
    weights = np.array([np.pad(row, (0, longest - len(row))) for _, row in found])
    return EmbeddedPoints.from_weights(ids, weights, nodes)


def _weights(
    point: np.ndarray,
    offsets: np.ndarray,
    corners: np.ndarray,
    connectivity: np.ndarray,
    shape: Callable[[np.ndarray], np.ndarray],
    radius: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes (q,) and weights (q,) of one averaged point, from the elements near it."""
    inverse = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
    tail = np.einsum("mij,pmj->pmi", inverse, point + offsets[:, None] - corners[:, 0])
    barycentric = np.concatenate([1.0 - tail.sum(axis=2, keepdims=True), tail], axis=2)
    depth = barycentric.min(axis=2, initial=np.inf)
    inside = (depth >= INSIDE).any(axis=1)
    away = offsets[inside] - offsets[inside].mean(axis=0) if inside.any() else np.zeros((1, 3))
    moments = away.T @ away / len(away)
    if not np.linalg.eigvalsh(moments)[0] > (LEAST_SPREAD * radius) ** 2:
        raise ValueError(
            f"the average about {point.tolist()} m with a radius of {radius:g} m needs a part of the body: "
            f"{int(inside.sum())} of {len(offsets)} sample points lie in it"
        )
    factors = (1.0 - away @ np.linalg.solve(moments, offsets[inside].mean(axis=0))) / len(away)
    best = depth[inside].argmax(axis=1)
    shares = shape(barycentric[inside, best])
    ids, slot = np.unique(connectivity[best], return_inverse=True)
    return ids, np.bincount(slot.ravel(), weights=(factors[:, None] * shares).ravel(), minlength=len(ids))
