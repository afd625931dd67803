"""Compiled equilibria of chains: Newton's method along a motion of the drive, batches, and condensed models."""

from __future__ import annotations

import math

import numpy as np

from softgym_envs.extensions.beams.contact_law import gap_of
from softgym_envs.extensions.grasping.chain.kernels import (
    MAX_ITERATIONS,
    MAX_STEP,
    MAX_TURN,
    assemble,
    energy_of,
    factorise,
    skin_point,
    substitute,
    touch,
    turns,
)
from softgym_envs.mechanics.compilation import njit

TOLERANCE = 1e-9
"""A search ends when its last step moves no node further than this [m]."""
DEEPEST = 3e-3
"""Distance [m] up to which a corner on the wrong side of an edge has gone through it."""
MAX_HALVINGS = 6
"""An increment that fails is cut in halves this many times."""


@njit(cache=True, error_model="numpy")
def place_drive(q, drive, angle):
    """Put the driven node where an angle [rad] of the servo carries it.

    ``drive`` holds the axis (2,) and the place of the node from it at rest (2,) [m].
    """
    c, s = math.cos(angle), math.sin(angle)
    q[0, 0] = drive[0] + c * drive[2] + s * drive[3]
    q[0, 1] = drive[1] - s * drive[2] + c * drive[3]
    q[0, 2] = -angle


@njit(cache=True, error_model="numpy")
def drive_direction(drive, angle):
    """Return the derivative of the driven node's coordinates by the angle, shape (3,)."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([-s * drive[2] + c * drive[3], -c * drive[2] - s * drive[3], -1.0])


@njit(cache=True, error_model="numpy")
def find(q, angle, target, drive, length, along, stiffness, skin, obstacles, edges, anchors, law):
    """Move a chain from one angle of the drive to another, in place, with friction springs from fixed anchors.

    Returns whether an equilibrium was found, the torque [N m] and the number of Newton steps.
    """
    count = len(q)
    gradient, diagonal = np.empty((count, 3)), np.empty((count, 3, 3))
    upper, lower = np.empty((count - 1, 3, 3)), np.empty((count - 1, 3, 3))
    pivots, step = np.empty((count, 3, 3)), np.empty((count, 3, 1))
    limits = np.zeros(anchors.shape[:2])
    trial = np.empty_like(q)
    system = (length, along, stiffness, skin, obstacles, edges, anchors, law)
    for iteration in range(MAX_ITERATIONS):
        left = target - angle
        direction = drive_direction(drive, angle)
        energy = np.inf
        for convex in (False, True):
            energy = assemble(q, *system, convex, gradient, diagonal, upper, lower, limits)
            if not energy < np.inf:
                return False, 0.0, iteration
            if not factorise(diagonal, upper, lower, pivots):
                if convex:
                    return False, 0.0, iteration
                continue
            step[:, :, 0] = -gradient
            if left != 0.0:
                step[1, :, 0] -= lower[0] @ direction * left
            substitute(upper, lower, pivots, step)
            slope = 0.0
            for k in range(1, count - 1):
                for i in range(3):
                    slope += gradient[k, i] * step[k, i, 0]
            # While the drive moves, the energy may grow; afterwards every step must go down.
            if left != 0.0 or slope <= 0.0 or convex:
                break
        far_step, turn = 0.0, 0.0
        for k in range(1, count - 1):
            far_step = max(far_step, max(abs(step[k, 0, 0]), abs(step[k, 1, 0])))
            turn = max(turn, abs(step[k, 2, 0]))
        if not (far_step < np.inf and turn < np.inf):
            return False, 0.0, iteration
        if left == 0.0 and far_step <= TOLERANCE and turn <= 100.0 * TOLERANCE:
            # The last step is taken without another evaluation.
            q += step[:, :, 0]
            return True, direction @ (gradient[0] + upper[0] @ np.ascontiguousarray(step[1, :, 0])), iteration
        part = min(1.0, min(MAX_STEP / max(far_step, 1e-30), MAX_TURN / max(turn, 1e-30)))
        part = min(part, MAX_TURN / max(abs(left), 1e-30))
        accepted = False
        for _ in range(30):
            trial[:] = q + part * step[:, :, 0]
            place_drive(trial, drive, target if part == 1.0 else angle + part * left)
            value = energy_of(trial, length, along, stiffness, skin, obstacles, edges, anchors, limits, law)
            # Near the solution the change of energy is lost in rounding.
            enough = value <= energy + 1e-4 * part * slope + 1e-12 * abs(energy)
            if value < np.inf and (left != 0.0 or enough):
                accepted = True
                break
            part *= 0.5
        if not accepted:
            return False, 0.0, iteration
        q[:] = trial
        angle = target if part == 1.0 else angle + part * left
    return False, 0.0, MAX_ITERATIONS


@njit(cache=True, error_model="numpy")
def commit(q, skin, obstacles, edges, anchors, law):
    """Let the friction springs that slid catch up with the points, and move the anchors of free points with them."""
    nodes, shares, arms, heights, areas = skin
    p, arm, far, pull, tangent = np.empty(3), np.empty(2), np.empty(2), np.empty(2), np.empty((2, 2))
    normal, curvature = np.empty(3), np.empty((3, 3))
    turned = turns(q)
    for k in range(len(areas)):
        skin_point(q, turned, nodes[k, 0], nodes[k, 1], shares[k], arms[k, :2], arms[k, 2:], heights[k], p, arm, far)
        for o in range(len(obstacles)):
            anchor = anchors[o, k]
            pressing = touch(p, areas[k], obstacles[o], edges[o], anchor, law, True, pull, tangent)[2]
            if pressing > 0.0 and obstacles[o, 1] > 0.0:
                gap_of(anchor, obstacles[o], edges[o], normal, curvature)
                stretch = p - anchor
                along = stretch - normal * (normal @ stretch)
                size, spring = math.sqrt(along @ along), law[2] * areas[k]
                part = min(1.0, obstacles[o, 1] * pressing / max(spring * size, 1e-300))
                for i in range(3):
                    anchor[i] = p[i] - part * along[i]
            else:
                anchor[:] = p


@njit(cache=True, error_model="numpy")
def advance(
    q, angle, target, slot, drive, length, along, stiffness, nodes, shares, arms, heights, areas, obstacles, edges,
    anchors, before, law, torque, found,
):  # fmt: skip
    """Move B chains from angles (B,) to targets (B,), in place; fill torques (B,) and whether they were found (B,).

    Bodies are given by the ``slot`` (B,) of each row; arrays of bodies have leading dimension S. An increment that
    fails is repeated in halves. Rows that fail altogether are left where they began. ``anchors`` (B, O, P, 3) move with
    the points that slide; ``before`` are those from which the last increment began.
    """
    for b in range(len(target)):
        s = slot[b]
        skin = (nodes, shares, arms[s], heights, areas[s])
        start, kept, last = q[b].copy(), anchors[b].copy(), before[b].copy()
        found[b] = False
        for halvings in range(MAX_HALVINGS + 1):
            parts = 1 << halvings
            now = angle[b]
            ok = True
            for part in range(parts):
                goal = target[b] if part == parts - 1 else angle[b] + (part + 1) / parts * (target[b] - angle[b])
                ok, torque[b], _ = find(
                    q[b], now, goal, drive[s], length[s], along[s], stiffness[s], skin, obstacles[b], edges[b],
                    anchors[b], law[b],
                )  # fmt: skip
                if not ok:
                    break
                before[b] = anchors[b]
                commit(q[b], skin, obstacles[b], edges[b], anchors[b], law[b])
                now = goal
            if ok:
                found[b] = True
                break
            q[b], anchors[b], before[b] = start, kept, last


@njit(cache=True, error_model="numpy")
def condense(
    q, angle, slot, drive, length, along, stiffness, nodes, shares, arms, heights, areas, obstacles, edges, anchors,
    law, effectors, effector_arms, torsion, jacobian, back, held, found,
):  # fmt: skip
    """Fill the condensed models of B chains between the drive and e effectors, with contact for the loading direction.

    The chains ``q`` are at equilibrium, with the anchors *before* the increment that led there. ``effectors`` (e,) are
    nodes, and ``effector_arms`` (S, e, 2) lead from them to the effectors at rest. Filled are:

    * ``torsion`` (B,): derivative of the torque by the angle with free effectors [N m/rad];
    * ``jacobian`` (B, 2 e): derivative of the effectors by the angle [m/rad];
    * ``back`` (B, 2 e): minus the derivative of the torque by forces on the effectors; equal to ``jacobian`` unless a
      point slides;
    * ``held`` (B, 2 e, 2 e): derivative of the effectors by forces on them at a fixed angle [m/N];
    * ``found`` (B,): whether the tangent is positive definite.
    """
    count, rows = q.shape[1], 2 * len(effectors)
    gradient, diagonal = np.empty((count, 3)), np.empty((count, 3, 3))
    upper, lower = np.empty((count - 1, 3, 3)), np.empty((count - 1, 3, 3))
    pivots, right = np.empty((count, 3, 3)), np.empty((count, 3, rows + 1))
    limits = np.empty(anchors.shape[1:3])
    for b in range(len(q)):
        s = slot[b]
        skin = (nodes, shares, arms[s], heights, areas[s])
        assemble(
            q[b], length[s], along[s], stiffness[s], skin, obstacles[b], edges[b], anchors[b], law[b], False, gradient,
            diagonal, upper, lower, limits,
        )  # fmt: skip
        found[b] = factorise(diagonal, upper, lower, pivots)
        if not found[b]:
            continue
        direction = drive_direction(drive[s], angle[b])
        right[:, :, :] = 0.0
        for e in range(len(effectors)):
            node = effectors[e]
            c, sn = math.cos(q[b, node, 2]), math.sin(q[b, node, 2])
            x, y = effector_arms[s, e]
            right[node, 0, 2 * e] = right[node, 1, 2 * e + 1] = 1.0
            right[node, 2, 2 * e], right[node, 2, 2 * e + 1] = -(sn * x + c * y), c * x - sn * y
        right[1, :, rows] = lower[0] @ direction
        loads = right.copy()
        substitute(upper, lower, pivots, right)
        for i in range(rows):
            jacobian[b, i] = 0.0
            for j in range(rows):
                held[b, i, j] = 0.0
            for k in range(1, count - 1):
                for a in range(3):
                    load = loads[k, a, i]
                    if load != 0.0:
                        jacobian[b, i] -= load * right[k, a, rows]
                        for j in range(rows):
                            held[b, i, j] += load * right[k, a, j]
        # The driven node turns with the drive: its own coordinates have a second derivative by the angle.
        x, y = q[b, 0, 0] - drive[s, 0], q[b, 0, 1] - drive[s, 1]
        total = direction @ (diagonal[0] @ direction) - (x * gradient[0, 0] + y * gradient[0, 1])
        across = upper[0].T @ direction
        for a in range(3):
            total -= across[a] * right[1, a, rows]
        torsion[b] = total
        for j in range(rows):
            back[b, j] = 0.0
            for a in range(3):
                back[b, j] -= across[a] * right[1, a, j]


@njit(cache=True, error_model="numpy")
def touching(
    q,
    slot,
    nodes,
    shares,
    arms,
    heights,
    areas,
    obstacles,
    edges,
    anchors,
    law,
    points,
    gaps,
    forces,
    pressing,
    sliding,
):
    """Fill what obstacles do to each point of the skin of B chains, with the anchors before the last increment.

    Points [m] (B, P, 3), gaps [m] (B, O, P), forces on the points in the plane [N] (B, O, P, 2), normal forces [N]
    (B, O, P) and whether the friction has reached its limit (B, O, P).
    """
    arm, far, pull, tangent = np.empty(2), np.empty(2), np.empty(2), np.empty((2, 2))
    for b in range(len(q)):
        s = slot[b]
        turned = turns(q[b])
        for k in range(len(heights)):
            p = points[b, k]
            skin_point(
                q[b],
                turned,
                nodes[k, 0],
                nodes[k, 1],
                shares[k],
                arms[s, k, :2],
                arms[s, k, 2:],
                heights[k],
                p,
                arm,
                far,
            )
            for o in range(obstacles.shape[1]):
                _, gap, normal, slides = touch(
                    p, areas[s, k], obstacles[b, o], edges[b, o], anchors[b, o, k], law[b], False, pull, tangent
                )
                gaps[b, o, k], pressing[b, o, k], sliding[b, o, k] = gap, normal, slides
                forces[b, o, k, 0], forces[b, o, k, 1] = -pull[0], -pull[1]


@njit(cache=True, error_model="numpy")
def clearances(q, slot, nodes, arms, folds, sides, found):
    """Fill the smallest distance (B,) [m] between corners and edges of the same body; negative if a corner is through.

    ``nodes`` (c,) carry the corners on ``arms`` (S, c, 2); ``folds`` (f, 3) are corners with both ends of an edge, and
    ``sides`` (S, f) tell on which side of the edge the corner is at rest.
    """
    count = len(nodes)
    p = np.empty((count, 2))
    for b in range(len(q)):
        body = slot[b]
        for k in range(count):
            node = nodes[k]
            x, y = arms[body, k]
            c, s = math.cos(q[b, node, 2]), math.sin(q[b, node, 2])
            p[k, 0], p[k, 1] = q[b, node, 0] + c * x - s * y, q[b, node, 1] + s * x + c * y
        smallest = np.inf
        for f in range(len(folds)):
            k, i, j = folds[f]
            ex, ey = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1]
            dx, dy = p[k, 0] - p[i, 0], p[k, 1] - p[i, 1]
            part = (dx * ex + dy * ey) / (ex * ex + ey * ey)
            near = min(1.0, max(0.0, part))
            gap = math.sqrt((dx - near * ex) ** 2 + (dy - near * ey) ** 2)
            if gap < DEEPEST and part == near and (ex * dy - ey * dx) * sides[body, f] < 0.0:
                gap = -gap
            smallest = min(smallest, gap)
        found[b] = smallest
