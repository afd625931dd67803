"""Condensed models of chains with the openings of contacts as rows, for controllers that make and break contact."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from softgym_envs.extensions.beams.contact_law import gap_of
from softgym_envs.extensions.grasping.chain.contact import ChainBatch
from softgym_envs.extensions.grasping.chain.equilibrium import drive_direction
from softgym_envs.extensions.grasping.chain.kernels import assemble, skin_point, touch, turns
from softgym_envs.mechanics.compilation import njit


class ContactRows(NamedTuple):
    """Compliance of a chain in contact between the servo, the tip's x, y and z, and the gaps of its o obstacles.

    Attributes:
        W: without the contacts; the compliance of the barrier is part of the diagonal; shape (4 + o, 4 + o).
        opening: zero of obstacles that are pressed, else the gap less the distance of contact [m], shape (o,).
        force: sum of the normal forces on each obstacle [N], shape (o,).
    """

    W: np.ndarray
    opening: np.ndarray
    force: np.ndarray


@njit(cache=True, error_model="numpy")
def _skin_gaps(q, skin, obstacle, edges, law, gaps, pressing, stiffness, jacobian):
    """Fill gaps [m] (P,) to an obstacle, normal forces [N] (P,), their derivatives [N/m] (P,), and those of the gaps.

    ``jacobian`` (P, N, 3) is by the coordinates of all nodes.
    """
    nodes, shares, arms, heights, areas = skin
    p, arm, far, pull, tangent = np.empty(3), np.empty(2), np.empty(2), np.empty(2), np.empty((2, 2))
    normal, curvature = np.empty(3), np.empty((3, 3))
    jacobian[:, :, :] = 0.0
    turned = turns(q)
    for k in range(len(areas)):
        skin_point(q, turned, nodes[k, 0], nodes[k, 1], shares[k], arms[k, :2], arms[k, 2:], heights[k], p, arm, far)
        gaps[k] = gap_of(p, obstacle, edges, normal, curvature)
        _, _, pressing[k], _ = touch(p, areas[k], obstacle, edges, p, law, True, pull, tangent)
        planar = normal[0] ** 2 + normal[1] ** 2
        stiffness[k] = (tangent[0, 0] + tangent[1, 1]) / planar if planar > 0.0 else 0.0
        for end in range(2):
            node = nodes[k, end]
            part, lever = (shares[k], far) if end else (1.0 - shares[k], arm)
            jacobian[k, node, 0] += part * normal[0]
            jacobian[k, node, 1] += part * normal[1]
            jacobian[k, node, 2] += part * (normal[1] * lever[0] - normal[0] * lever[1])


def contact_rows(batch: ChainBatch, row: int) -> ContactRows | None:
    """Return the condensed model of one body of a batch at its present state; None if it needs its contacts to stand.

    Each obstacle has one gap: the mean over the points that press, weighted with their forces, or that of the point
    that the servo brings there first. Friction is left out.
    """
    prepared, memory = batch.prepared, batch.memory
    slot, q, angle = batch.slot[row], memory.q[row], memory.angle[row]
    _, length, along, stiffness = (part[slot] for part in prepared.segments)
    nodes, shares, arms, heights, areas = prepared.skin
    skin = (nodes, shares, arms[slot], heights, areas[slot])
    table, edges, law = batch.scene(row)
    table[:, 1] = 0.0  # no friction
    count = len(q)
    gradient, diagonal = np.empty((count, 3)), np.empty((count, 3, 3))
    upper, lower = np.empty((count - 1, 3, 3)), np.empty((count - 1, 3, 3))
    anchors = memory.anchors[row]
    assemble(
        q, length, along, stiffness, skin, table, edges, anchors, law, False, gradient, diagonal, upper, lower,
        np.empty(anchors.shape[:2]),
    )  # fmt: skip
    tangent = np.zeros((count, 3, count, 3))
    each, pairs = np.arange(count), np.arange(count - 1)
    tangent[each, :, each], tangent[pairs, :, pairs + 1], tangent[pairs + 1, :, pairs] = diagonal, upper, lower
    full = tangent.reshape(3 * count, 3 * count)
    # The first node moves with the angle, the last one not at all.
    drive = prepared.bodies.drive[slot]
    direction, points = drive_direction(drive, angle), len(heights)
    reduce = np.zeros((3 * count, 3 * count - 5))
    reduce[:3, 0] = direction
    reduce[3:-3, 1:] = np.eye(3 * count - 6)
    K = reduce.T @ full @ reduce
    K[0, 0] -= (q[0, :2] - drive[:2]) @ gradient[0, :2]

    rows = [np.eye(len(K))[0], *_tip_rows(batch, row, reduce)]
    opening, force, compliance = np.zeros(len(table)), np.zeros(len(table)), np.zeros(4 + len(table))
    found = []
    gaps, pressing, slopes = np.empty(points), np.empty(points), np.empty(points)
    jacobian = np.empty((points, count, 3))
    for obstacle, lines in zip(table, edges, strict=True):
        _skin_gaps(q, skin, obstacle, lines, law, gaps, pressing, slopes, jacobian)
        motions = jacobian.reshape(points, -1) @ reduce
        near = pressing > 0.0
        K -= motions[near].T @ (slopes[near, None] * motions[near])
        found.append((gaps.copy(), pressing.copy(), slopes.copy(), motions))
    try:
        np.linalg.cholesky(K)
    except np.linalg.LinAlgError:
        return None
    with_servo = np.linalg.solve(K, rows[0])
    for o, (gap, pressing, slopes, motions) in enumerate(found):
        near = pressing > 0.0
        if near.any():
            share = pressing[near] / pressing.sum()
            rows.append(share @ motions[near])
            force[o] = pressing.sum()
            compliance[4 + o] = (share**2 / slopes[near]).sum()
        else:
            way = gap - law[0]
            rate = -motions @ with_servo
            first = np.argmin(np.where(rate > 0.0, way / np.where(rate > 0.0, rate, 1.0), np.inf))
            first = first if (rate > 0.0).any() else np.argmin(way)
            rows.append(motions[first])
            opening[o] = way[first]
    H = np.array(rows)
    W = np.zeros((4 + len(table), 4 + len(table)))
    planar = np.delete(np.arange(len(W)), 3)
    W[np.ix_(planar, planar)] = H @ np.linalg.solve(K, H.T)
    W[3, 3] = prepared.depth[slot]
    W += np.diag(compliance)
    relative = prepared.relative[slot]
    return ContactRows(0.5 * (W + W.T) / relative, opening, force * relative)


def _tip_rows(batch: ChainBatch, row: int, reduce: np.ndarray) -> np.ndarray:
    """Return the derivatives of the tip's x and y by the angle and the free coordinates, shape (2, 3 N - 5)."""
    chain, slot, q = batch.prepared.chain, batch.slot[row], batch.memory.q[row]
    (node,) = chain.effectors
    x, y = batch.prepared.bodies.effector_arms[slot, 0]
    c, s = np.cos(q[node, 2]), np.sin(q[node, 2])
    full = np.zeros((2, 3 * len(q)))
    full[:, 3 * node : 3 * node + 3] = [[1.0, 0.0, -(s * x + c * y)], [0.0, 1.0, c * x - s * y]]
    return full @ reduce
