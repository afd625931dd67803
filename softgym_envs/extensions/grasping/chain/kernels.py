"""Compiled mechanics of chains of segments: energy, contact with friction, and equilibria by Newton's method.

A chain has N nodes with the coordinates (x, y, rotation). The first node is driven, the last one is held, and every
segment joins a node to the next one. The tangent is therefore block tridiagonal, with blocks of 3 by 3, and a Newton
step costs a few microseconds. Friction makes the tangent unsymmetric.

Points of the skin lie between two neighbouring nodes, or on one node. Where an obstacle presses on a point, it adds the
barrier and the friction of `softgym_envs.mechanics.contact.law`.
"""

from __future__ import annotations

import math

import numpy as np

from softgym_envs.extensions.beams.contact_law import gap_of, make_touch, quick_gap, touch_point
from softgym_envs.mechanics.compilation import njit

MAX_STEP = 0.004
"""Largest displacement of a node in one Newton step [m]; half of the thinnest allowed obstacle."""
MAX_TURN = 0.25
"""Largest rotation of a node in one Newton step [rad]."""
MAX_ITERATIONS = 60


@njit(cache=True, error_model="numpy")
def bow(length, first, last):
    """Return by how much a beam is longer than the line between its ends, if they turn against it by angles [rad].

    This is half the integral of the squared slope of a cubic deflection. It carries the softening of a bent beam under
    pressure: without it, thick segments of the left leg are about 2 % too stiff at 30 degrees.
    """
    return length / 30.0 * (2.0 * first * first - first * last + 2.0 * last * last)


@njit(cache=True, error_model="numpy")
def segment(a, b, length, along, stiffness, convex, gradient, hessian):
    """Return the energy of a segment; fill its derivatives by the coordinates of its ends, (6,) and (6, 6).

    The elongation is that of the bent segment, which is longer than the line between its ends: see `bow`.

    Args:
        a: coordinates of its first node, shape (3,).
        b: of its second node.
        length: at rest [m].
        along: its direction at rest, shape (2,).
        stiffness: of elongation [N/m] and of the two end rotations [N m], shape (3, 3).
        convex: leave out the terms that can make the Hessian indefinite.
        gradient: work array.
        hessian: work array.
    """
    dx, dy = b[0] - a[0], b[1] - a[1]
    now = math.sqrt(dx * dx + dy * dy)
    c, s = dx / now, dy / now
    turn = math.atan2(along[0] * dy - along[1] * dx, along[0] * dx + along[1] * dy)
    e1, e2 = a[2] - turn, b[2] - turn
    e0 = now - length + bow(length, e1, e2)
    t0 = stiffness[0, 0] * e0 + stiffness[0, 1] * e1 + stiffness[0, 2] * e2
    t1 = stiffness[1, 0] * e0 + stiffness[1, 1] * e1 + stiffness[1, 2] * e2
    t2 = stiffness[2, 0] * e0 + stiffness[2, 1] * e1 + stiffness[2, 2] * e2
    # Derivatives of the distance of the ends, and of its direction times that distance.
    r = (-c, -s, 0.0, c, s, 0.0)
    z = (s, -c, 0.0, -s, c, 0.0)
    bow_first, bow_last = length / 30.0 * (4.0 * e1 - e2), length / 30.0 * (4.0 * e2 - e1)
    bend = -(t1 + t2 + t0 * (bow_first + bow_last))
    for i in range(6):
        b1 = (1.0 if i == 2 else 0.0) - z[i] / now
        b2 = (1.0 if i == 5 else 0.0) - z[i] / now
        b0 = r[i] + bow_first * b1 + bow_last * b2
        gradient[i] = t0 * b0 + t1 * b1 + t2 * b2
        k0 = stiffness[0, 0] * b0 + stiffness[0, 1] * b1 + stiffness[0, 2] * b2
        k1 = stiffness[1, 0] * b0 + stiffness[1, 1] * b1 + stiffness[1, 2] * b2
        k2 = stiffness[2, 0] * b0 + stiffness[2, 1] * b1 + stiffness[2, 2] * b2
        for j in range(6):
            c1 = (1.0 if j == 2 else 0.0) - z[j] / now
            c2 = (1.0 if j == 5 else 0.0) - z[j] / now
            value = k0 * (r[j] + bow_first * c1 + bow_last * c2) + k1 * c1 + k2 * c2
            if not convex:
                value += t0 * length / 30.0 * (b1 * (4.0 * c1 - c2) + b2 * (4.0 * c2 - c1))
                value += t0 * z[i] * z[j] / now - bend * (r[i] * z[j] + z[i] * r[j]) / now**2
            hessian[i, j] = value
    return 0.5 * (t0 * e0 + t1 * e1 + t2 * e2)


@njit(cache=True, error_model="numpy")
def turns(q):
    """Return cosine and sine of the rotations of nodes (N, 3), shape (N, 2)."""
    found = np.empty((len(q), 2))
    for k in range(len(q)):
        found[k, 0], found[k, 1] = math.cos(q[k, 2]), math.sin(q[k, 2])
    return found


@njit(cache=True, error_model="numpy")
def skin_point(q, turned, node, other, share, arm, far, height, p, arm_now, far_now):
    """Fill a point of the skin [m] (3,) and the turned arms (2,) of its two nodes; ``turned`` is `turns` of ``q``."""
    c, s = turned[node]
    arm_now[0], arm_now[1] = c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]
    c, s = turned[other]
    far_now[0], far_now[1] = c * far[0] - s * far[1], s * far[0] + c * far[1]
    for i in range(2):
        p[i] = (1.0 - share) * (q[node, i] + arm_now[i]) + share * (q[other, i] + far_now[i])
    p[2] = height


@njit(cache=True, error_model="numpy")
def points_near(q, turned, skin, obstacles, edges, distance):
    """Return which points of the skin can be nearer to an obstacle than a distance [m], shape (P,).

    The points of one edge of the outline follow each other. All of them are far from an obstacle if the middle of the
    edge is farther away than half its length.
    """
    nodes, shares, arms, heights, areas = skin
    found = np.zeros(len(areas), dtype=np.bool_)
    p, arm, far = np.empty(3), np.empty(2), np.empty(2)
    begin = 0
    while begin < len(areas):
        node, other = nodes[begin]
        end = begin + 1
        while end < len(areas) and nodes[end, 0] == node and nodes[end, 1] == other:
            end += 1
        skin_point(q, turned, node, other, 0.5, arms[begin, :2], arms[begin, 2:], 0.0, p, arm, far)
        x, y = q[other, 0] + far[0] - q[node, 0] - arm[0], q[other, 1] + far[1] - q[node, 1] - arm[1]
        reach = distance + math.sqrt(0.25 * (x * x + y * y) + heights[begin] ** 2)
        for o in range(len(obstacles)):
            if quick_gap(p, obstacles[o], edges[o]) < reach:
                found[begin:end] = True
                break
        begin = end
    return found


@njit(cache=True, error_model="numpy")
def touch(p, area, obstacle, edges, anchor, law, convex, pull, tangent):
    """Return what one obstacle does to one point: energy with friction limits held, gap, pressing, sliding.

    Args:
        p: point [m], shape (3,).
        area: [m2].
        obstacle: parameters.
        edges: of a prism.
        anchor: of the friction spring [m], shape (3,).
        law: distance of contact [m], stiffness [Pa], stick [Pa/m].
        convex: leave out what can make the tangent indefinite, and what makes it unsymmetric.
        pull: minus the force on the point in the plane, shape (2,), is filled.
        tangent: its derivative by the point, shape (2, 2), is filled.
    """
    pull[0] = pull[1] = 0.0
    tangent[0, 0] = tangent[0, 1] = tangent[1, 0] = tangent[1, 1] = 0.0
    gap = quick_gap(p, obstacle, edges)
    if gap >= law[0]:
        return 0.0, gap, 0.0, False
    if not gap > 0.0:
        return np.inf, gap, 0.0, False
    found = make_touch()
    energy, rub, _, pressing, sliding = touch_point(p, area, obstacle, edges, anchor, law, convex, found)
    for i in range(2):
        pull[i] = found.pull[i]
        for j in range(2):
            tangent[i, j] = found.tangent[i, j]
            if sliding and not convex:
                tangent[i, j] += found.direction[i] * found.loading[j]
    return energy + rub, gap, pressing, sliding


@njit(cache=True, error_model="numpy")
def assemble(
    q, length, along, stiffness, skin, obstacles, edges, anchors, law, convex, gradient, diagonal, upper, lower, limits
):
    """Return the energy of a chain in contact; fill its gradient (N, 3) and the blocks of its tangent.

    ``skin`` holds nodes (P, 2), shares (P,), arms (P, 4), heights (P,) and areas (P,). The energy is inf if a point is
    inside an obstacle. Blocks: diagonal (N, 3, 3), upper and lower (N - 1, 3, 3). The limits of friction [N] (O, P) are
    filled too.
    """
    nodes, shares, arms, heights, areas = skin
    count = len(q)
    gradient[:, :] = 0.0
    diagonal[:, :, :] = 0.0
    upper[:, :, :] = 0.0
    lower[:, :, :] = 0.0
    limits[:, :] = 0.0
    g, h = np.empty(6), np.empty((6, 6))
    energy = 0.0
    for k in range(count - 1):
        energy += segment(q[k], q[k + 1], length[k], along[k], stiffness[k], convex, g, h)
        for i in range(3):
            gradient[k, i] += g[i]
            gradient[k + 1, i] += g[3 + i]
            for j in range(3):
                diagonal[k, i, j] += h[i, j]
                diagonal[k + 1, i, j] += h[3 + i, 3 + j]
                upper[k, i, j] += h[i, 3 + j]
                lower[k, i, j] += h[3 + i, j]
    if len(obstacles) == 0:
        return energy
    p, arm, far = np.empty(3), np.empty(2), np.empty(2)
    pull, tangent = np.empty(2), np.empty((2, 2))
    turned = turns(q)
    near_points = points_near(q, turned, skin, obstacles, edges, law[0])
    for k in range(len(areas)):
        if not near_points[k]:
            continue
        node, other, share = nodes[k, 0], nodes[k, 1], shares[k]
        skin_point(q, turned, node, other, share, arms[k, :2], arms[k, 2:], heights[k], p, arm, far)
        for o in range(len(obstacles)):
            part, gap, pressing, sliding = touch(
                p, areas[k], obstacles[o], edges[o], anchors[o, k], law, convex, pull, tangent
            )
            energy += part
            if pressing == 0.0:
                continue
            limits[o, k] = obstacles[o, 1] * pressing
            # Derivatives of the point by (x, y, rotation) of both nodes.
            near = 1.0 - share
            by_x = (near, 0.0, -near * arm[1], share, 0.0, -share * far[1])
            by_y = (0.0, near, near * arm[0], 0.0, share, share * far[0])
            for i in range(6):
                g[i] = by_x[i] * pull[0] + by_y[i] * pull[1]
                x = by_x[i] * tangent[0, 0] + by_y[i] * tangent[1, 0]
                y = by_x[i] * tangent[0, 1] + by_y[i] * tangent[1, 1]
                for j in range(6):
                    h[i, j] = x * by_x[j] + y * by_y[j]
            if not convex:
                h[2, 2] -= near * (arm[0] * pull[0] + arm[1] * pull[1])
                h[5, 5] -= share * (far[0] * pull[0] + far[1] * pull[1])
            for i in range(3):
                gradient[node, i] += g[i]
                gradient[other, i] += g[3 + i]
                for j in range(3):
                    diagonal[node, i, j] += h[i, j]
                    diagonal[other, i, j] += h[3 + i, 3 + j]
                    if node == other:
                        diagonal[node, i, j] += h[i, 3 + j] + h[3 + i, j]
                    else:
                        upper[node, i, j] += h[i, 3 + j]
                        lower[node, i, j] += h[3 + i, j]
    return energy


@njit(cache=True, error_model="numpy")
def energy_of(q, length, along, stiffness, skin, obstacles, edges, anchors, limits, law):
    """Return the energy of a chain with held limits of friction (O, P); inf if a point is inside an obstacle."""
    nodes, shares, arms, heights, areas = skin
    energy = 0.0
    for k in range(len(q) - 1):
        dx, dy = q[k + 1, 0] - q[k, 0], q[k + 1, 1] - q[k, 1]
        turn = math.atan2(along[k, 0] * dy - along[k, 1] * dx, along[k, 0] * dx + along[k, 1] * dy)
        first, last = q[k, 2] - turn, q[k + 1, 2] - turn
        e = (math.sqrt(dx * dx + dy * dy) - length[k] + bow(length[k], first, last), first, last)
        for i in range(3):
            for j in range(3):
                energy += 0.5 * e[i] * stiffness[k, i, j] * e[j]
    if len(obstacles) == 0:
        return energy
    turned = turns(q)
    p, arm, far = np.empty(3), np.empty(2), np.empty(2)
    normal, curvature = np.empty(3), np.empty((3, 3))
    near_points = points_near(q, turned, skin, obstacles, edges, law[0])
    for k in range(len(areas)):
        # Far points have neither energy nor a limit.
        if not near_points[k]:
            continue
        skin_point(q, turned, nodes[k, 0], nodes[k, 1], shares[k], arms[k, :2], arms[k, 2:], heights[k], p, arm, far)
        for o in range(len(obstacles)):
            gap = quick_gap(p, obstacles[o], edges[o])
            if not gap > 0.0:
                return np.inf
            if gap < law[0]:
                s = (gap / law[0]) ** 2
                energy -= law[1] * areas[k] * law[0] * (s - 1.0) ** 2 * math.log(s)
            if limits[o, k] > 0.0:
                gap_of(anchors[o, k], obstacles[o], edges[o], normal, curvature)
                stretch = p - anchors[o, k]
                along_surface = stretch - normal * (normal @ stretch)
                size, spring = math.sqrt(along_surface @ along_surface), law[2] * areas[k]
                if spring * size > limits[o, k]:
                    energy += limits[o, k] * size - 0.5 * limits[o, k] ** 2 / spring
                else:
                    energy += 0.5 * spring * size * size
    return energy


@njit(cache=True, error_model="numpy")
def multiply(a, b, out):
    """Fill a b for matrices (3, 3) and (3, n). BLAS takes longer to call than this takes to run."""
    for i in range(3):
        for j in range(b.shape[1]):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@njit(cache=True, error_model="numpy")
def subtract(a, b, out):
    """Subtract a b from ``out``, for matrices (3, 3) and (3, n)."""
    for i in range(3):
        for j in range(b.shape[1]):
            out[i, j] -= a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@njit(cache=True, error_model="numpy")
def factorise(diagonal, upper, lower, pivots):
    """Fill the inverses of the block pivots (N, 3, 3) of the free nodes; False if one is not positive definite."""
    count = len(diagonal)
    block, product = np.empty((3, 3)), np.empty((3, 3))
    for k in range(1, count - 1):
        block[:, :] = diagonal[k]
        if k > 1:
            multiply(lower[k - 1], pivots[k - 1], product)
            subtract(product, upper[k - 1], block)
        minor = block[0, 0] * block[1, 1] - block[0, 1] * block[1, 0]
        if not (block[0, 0] > 0.0 and minor > 0.0):
            return False
        out = pivots[k]
        out[0, 0] = block[1, 1] * block[2, 2] - block[1, 2] * block[2, 1]
        out[0, 1] = block[0, 2] * block[2, 1] - block[0, 1] * block[2, 2]
        out[0, 2] = block[0, 1] * block[1, 2] - block[0, 2] * block[1, 1]
        out[1, 0] = block[1, 2] * block[2, 0] - block[1, 0] * block[2, 2]
        out[1, 1] = block[0, 0] * block[2, 2] - block[0, 2] * block[2, 0]
        out[1, 2] = block[0, 2] * block[1, 0] - block[0, 0] * block[1, 2]
        out[2, 0] = block[1, 0] * block[2, 1] - block[1, 1] * block[2, 0]
        out[2, 1] = block[0, 1] * block[2, 0] - block[0, 0] * block[2, 1]
        out[2, 2] = minor
        determinant = block[0, 0] * out[0, 0] + block[0, 1] * out[1, 0] + block[0, 2] * out[2, 0]
        if not determinant > 0.0:
            return False
        for i in range(3):
            for j in range(3):
                out[i, j] /= determinant
    return True


@njit(cache=True, error_model="numpy")
def substitute(upper, lower, pivots, values):
    """Overwrite right-hand sides (N, 3, r) with the solution; rows of the first and last node are zero."""
    count = len(values)
    values[0] = 0.0
    values[count - 1] = 0.0
    work = np.empty((3, values.shape[2]))
    for k in range(2, count - 1):
        multiply(pivots[k - 1], values[k - 1], work)
        subtract(lower[k - 1], work, values[k])
    for k in range(count - 2, 0, -1):
        if k < count - 2:
            subtract(upper[k], values[k + 1], values[k])
        work[:, :] = values[k]
        multiply(pivots[k], work, values[k])
