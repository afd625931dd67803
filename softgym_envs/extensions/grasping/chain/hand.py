"""Compiled mechanics of hands: two chains that hold a free box over a table.

Everything happens in one plane. The box has a pose (x, z, turn from x to z) in the frame of the hand; the table is at
z = -h, where h is the height by which the hand was raised. Each chain is described in the frame of the box, so that the
box is an obstacle at rest for `kernels.assemble`, and the pose moves the ends of the chains: the driven one and the one
that is held. A Newton step eliminates both chains, block by block, onto the three coordinates of the pose.

The finger with number 0 stands at negative x, number 1 is its mirror image. Both hang down: the y axis of a finger
points to -z, its x axis towards the box.
"""

from __future__ import annotations

import math

import numpy as np

from softgym_envs.extensions.grasping.chain.equilibrium import TOLERANCE, commit, drive_direction, place_drive
from softgym_envs.extensions.grasping.chain.kernels import (
    MAX_ITERATIONS,
    MAX_STEP,
    MAX_TURN,
    assemble,
    energy_of,
    factorise,
    substitute,
    touch,
)
from softgym_envs.mechanics.compilation import njit

FINGERS = 2


@njit(cache=True, error_model="numpy")
def pose_of(box, place, finger, pose):
    """Fill the pose (x, y, turn) of the box in the frame of a finger; return the signs of its derivatives, (3,).

    ``place`` holds the distance of the feet from the middle of the hand and their height above the table [m].
    """
    side = 1.0 - 2.0 * finger
    pose[0], pose[1], pose[2] = place[0] + side * box[0], place[1] - box[1], -side * box[2]
    return np.array([side, -1.0, -side])


@njit(cache=True, error_model="numpy")
def place_end(r, pose, u):
    """Fill the coordinates (3,) in the frame of the box of a node with coordinates ``r`` in that of the finger."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = r[0] - pose[0], r[1] - pose[1]
    u[0], u[1], u[2] = c * x + s * y, c * y - s * x, r[2] - pose[2]


@njit(cache=True, error_model="numpy")
def place_ends(q, held, drive, angle, pose):
    """Put the driven and the held node of a chain where the hand has them, in the frame of the box."""
    r = np.empty((1, 3))
    place_drive(r, drive, angle)
    place_end(r[0], pose, q[0])
    place_end(held, pose, q[-1])


@njit(cache=True, error_model="numpy")
def end_derivative(u, pose, signs, by_pose):
    """Fill the derivative (3, 3) of the coordinates of a node of the hand by the pose of the box."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    by_pose[0, 0], by_pose[0, 1], by_pose[0, 2] = -c, -s, u[1]
    by_pose[1, 0], by_pose[1, 1], by_pose[1, 2] = s, -c, -u[0]
    by_pose[2, 0], by_pose[2, 1], by_pose[2, 2] = 0.0, 0.0, -1.0
    by_pose *= signs


@njit(cache=True, error_model="numpy")
def add_end_curvature(u, pose, signs, gradient, stiffness):
    """Add the second derivatives of a node's coordinates by the pose, times its gradient (3,), to (3, 3)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    by_x = signs[0] * signs[2] * (gradient[0] * s + gradient[1] * c)
    by_y = signs[1] * signs[2] * (gradient[1] * s - gradient[0] * c)
    stiffness[0, 2] += by_x
    stiffness[2, 0] += by_x
    stiffness[1, 2] += by_y
    stiffness[2, 1] += by_y
    stiffness[2, 2] -= gradient[0] * u[0] + gradient[1] * u[1]


@njit(cache=True, error_model="numpy")
def table_point(box, height, offset, p, arm):
    """Fill a point of the box (3,) in the frame of the table, and its arm (2,) from the middle of the box."""
    c, s = math.cos(box[2]), math.sin(box[2])
    arm[0], arm[1] = c * offset[0] - s * offset[1], s * offset[0] + c * offset[1]
    p[0], p[1], p[2] = box[0] + arm[0], box[1] + height + arm[1], 0.0


@njit(cache=True, error_model="numpy")
def add_table(box, height, table, convex, gradient, stiffness, limits):
    """Return the energy of the table's contact; add its derivatives by the pose and by the height, (4,) and (4, 4).

    ``table`` holds the points (T, 2) of the box, their areas (T,), anchors (T, 3), the plane (17,) and the law (3,).
    """
    points, areas, anchors, plane, law = table
    p, arm, pull, tangent = np.empty(3), np.empty(2), np.empty(2), np.empty((2, 2))
    edges = np.empty((1, 7))
    energy = 0.0
    for k in range(len(areas)):
        table_point(box, height, points[k], p, arm)
        part, gap, pressing, sliding = touch(p, areas[k], plane, edges, anchors[k], law, convex, pull, tangent)
        energy += part
        limits[k] = plane[1] * pressing
        if pressing == 0.0:
            continue
        by_x, by_z = (1.0, 0.0, -arm[1], 0.0), (0.0, 1.0, arm[0], 1.0)
        for i in range(4):
            gradient[i] += by_x[i] * pull[0] + by_z[i] * pull[1]
            x = by_x[i] * tangent[0, 0] + by_z[i] * tangent[1, 0]
            z = by_x[i] * tangent[0, 1] + by_z[i] * tangent[1, 1]
            for j in range(4):
                stiffness[i, j] += x * by_x[j] + z * by_z[j]
        if not convex:
            stiffness[2, 2] -= arm[0] * pull[0] + arm[1] * pull[1]
    return energy


@njit(cache=True, error_model="numpy")
def table_energy(box, height, table, limits):
    """Return the energy of the table's contact with held limits of friction (T,); inf if a point is below it."""
    points, areas, anchors, plane, law = table
    p, arm = np.empty(3), np.empty(2)
    energy = 0.0
    for k in range(len(areas)):
        table_point(box, height, points[k], p, arm)
        if not p[1] > 0.0:
            return np.inf
        if p[1] < law[0]:
            s = (p[1] / law[0]) ** 2
            energy -= law[1] * areas[k] * law[0] * (s - 1.0) ** 2 * math.log(s)
        if limits[k] > 0.0:
            size, spring = abs(p[0] - anchors[k, 0]), law[2] * areas[k]
            if spring * size > limits[k]:
                energy += limits[k] * size - 0.5 * limits[k] ** 2 / spring
            else:
                energy += 0.5 * spring * size * size
    return energy


@njit(cache=True, error_model="numpy")
def inertia_energy(box, body):
    """Return the potential and the inertial energy of the box of a time step.

    ``body`` holds the masses of the coordinates over the square of the time step (3,), the pose that the box would
    reach without forces (3,), and the weight of the box [N].
    """
    masses, free, weight = body
    energy = weight * box[1]
    for i in range(3):
        energy += 0.5 * masses[i] * (box[i] - free[i]) ** 2
    return energy


@njit(cache=True, error_model="numpy")
def add_weights(q, pose, signs, weights, gradient, curvature, coupling, by_pose):
    """Return the potential of the weight of a finger, which pulls along its y axis; add its derivatives.

    ``weights`` (N,) [N] act on the nodes. ``gradient`` (N, 3) is by the nodes, ``coupling`` (N, 3, 3) its derivative by
    the pose of the box; ``by_pose`` (3,) and ``curvature`` (3, 3) are by the pose.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    energy = 0.0
    for k in range(1, len(q) - 1):
        w, x, y = weights[k], q[k, 0], q[k, 1]
        energy -= w * (pose[1] + s * x + c * y)
        gradient[k, 0] -= w * s
        gradient[k, 1] -= w * c
        by_pose[1] -= signs[1] * w
        by_pose[2] -= signs[2] * w * (c * x - s * y)
        coupling[k, 0, 2] -= signs[2] * w * c
        coupling[k, 1, 2] += signs[2] * w * s
        curvature[2, 2] += w * (s * x + c * y)
    return energy


@njit(cache=True, error_model="numpy")
def weight_energy(q, pose, weights):
    """Return the potential of the weight of a finger."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    energy = 0.0
    for k in range(1, len(q) - 1):
        energy -= weights[k] * (pose[1] + s * q[k, 0] + c * q[k, 1])
    return energy


@njit(cache=True, error_model="numpy")
def eliminate(
    q, box, angles, height, finger, table, body, convex, limits, table_limits, reduced, gradient, solved, ends
):
    """Assemble a hand and eliminate the chains; return its energy and whether what was eliminated is definite.

    The coordinates that stay are the angles of both servos, the height of the hand and the pose of the box. Filled are
    the reduced gradient (6,) and tangent ``reduced`` (6, 6), ``solved`` (2, N, 3, 5), sensitivity of the nodes
    to the pose (3 columns), to the angle and, with the opposite sign, to the forces on them, and the derivatives
    ``ends`` (2, 3) of the driven nodes by their angles, in the frame of the box.
    """
    place, held, drive, length, along, stiffness, weights, skin, obstacles, edges, anchors, law = finger
    count = q.shape[1]
    diagonal, pivots = np.empty((count, 3, 3)), np.empty((count, 3, 3))
    upper, lower = np.empty((count - 1, 3, 3)), np.empty((count - 1, 3, 3))
    by_nodes = np.empty((count, 3))
    pose, first, last = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    at_pose, at_table, table_gradient = np.zeros((3, 3)), np.zeros((4, 4)), np.zeros(4)
    reduced[:, :] = 0.0
    gradient[:] = 0.0
    energy = inertia_energy(box, body)
    for i in range(3):
        gradient[3 + i] = body[0][i] * (box[i] - body[1][i])
        reduced[3 + i, 3 + i] = body[0][i]
    gradient[4] += body[2]
    energy += add_table(box, height, table, convex, table_gradient, at_table, table_limits)
    rows = (3, 4, 5, 2)
    for i in range(4):
        gradient[rows[i]] += table_gradient[i]
        for j in range(4):
            reduced[rows[i], rows[j]] += at_table[i, j]
    for f in range(FINGERS):
        energy += assemble(
            q[f], length, along, stiffness, skin, obstacles, edges, anchors[f], law, convex, by_nodes, diagonal, upper,
            lower, limits[f],
        )  # fmt: skip
        if not energy < np.inf:
            return energy, False
        signs = pose_of(box, place, f, pose)
        c, s = math.cos(pose[2]), math.sin(pose[2])
        local = drive_direction(drive, angles[f])
        w = ends[f]
        w[0], w[1], w[2] = c * local[0] + s * local[1], c * local[1] - s * local[0], local[2]
        end_derivative(q[f, 0], pose, signs, first)
        end_derivative(q[f, count - 1], pose, signs, last)
        forward, back = np.zeros((count, 3, 3)), np.zeros((count, 3, 3))
        at_pose[:, :] = 0.0
        of_weight = np.zeros(3)
        energy += add_weights(q[f], pose, signs, weights, by_nodes, at_pose, forward, of_weight)
        back[:] = forward
        if convex:
            at_pose[:, :] = 0.0
            forward[:, :, :] = 0.0
            back[:, :, :] = 0.0
        else:
            add_end_curvature(q[f, 0], pose, signs, by_nodes[0], at_pose)
            add_end_curvature(q[f, count - 1], pose, signs, by_nodes[count - 1], at_pose)
        at_pose += first.T @ diagonal[0] @ first + last.T @ diagonal[count - 1] @ last
        forward[1] += lower[0] @ first
        forward[count - 2] += upper[count - 2] @ last
        back[1] += upper[0].T @ first
        back[count - 2] += lower[count - 2].T @ last
        for i in range(3):
            gradient[3 + i] += of_weight[i]
            for j in range(3):
                gradient[3 + i] += first[j, i] * by_nodes[0, j] + last[j, i] * by_nodes[count - 1, j]
        gradient[f] += w @ by_nodes[0]
        # The driven node, by its angle: a circle about the axis.
        x, y = q[f, 0, 0], q[f, 0, 1]
        axis = np.array([drive[0], drive[1], 0.0])
        centre = np.empty(3)
        place_end(axis, pose, centre)
        by_angle = w @ diagonal[0] @ w
        across, along_it = first.T @ (diagonal[0] @ w), first.T @ (diagonal[0].T @ w)
        if not convex:
            by_angle -= (x - centre[0]) * by_nodes[0, 0] + (y - centre[1]) * by_nodes[0, 1]
            turning = signs[2] * (w[1] * by_nodes[0, 0] - w[0] * by_nodes[0, 1])
            across[2] += turning
            along_it[2] += turning
        if not factorise(diagonal, upper, lower, pivots):
            return energy, False
        values = solved[f]
        values[:, :, :3] = forward
        values[:, :, 3:] = 0.0
        values[1, :, 3] = lower[0] @ w
        values[:, :, 4] = -by_nodes
        substitute(upper, lower, pivots, values)
        pull = upper[0].T @ w
        for i in range(3):
            across_sum, along_sum = across[i], along_it[i]
            for k in range(1, count - 1):
                for a in range(3):
                    across_sum -= back[k, a, i] * values[k, a, 3]
            for a in range(3):
                along_sum -= pull[a] * values[1, a, i]
            reduced[3 + i, f] += across_sum
            reduced[f, 3 + i] += along_sum
            for j in range(3):
                total = at_pose[i, j]
                for k in range(1, count - 1):
                    for a in range(3):
                        total -= back[k, a, i] * values[k, a, j]
                reduced[3 + i, 3 + j] += total
            for k in range(1, count - 1):
                for a in range(3):
                    gradient[3 + i] += back[k, a, i] * values[k, a, 4]
        for a in range(3):
            by_angle -= pull[a] * values[1, a, 3]
            gradient[f] += pull[a] * values[1, a, 4]
        reduced[f, f] += by_angle
    # The pose must have a minimum.
    m = 0.5 * (reduced[3:, 3:] + reduced[3:, 3:].T)
    minor = m[0, 0] * m[1, 1] - m[0, 1] ** 2
    whole = (
        m[2, 2] * minor
        - m[0, 0] * m[1, 2] ** 2
        - m[1, 1] * m[0, 2] ** 2
        + 2.0 * m[0, 1] * m[1, 2] * m[0, 2]
    )  # fmt: skip
    return energy, m[0, 0] > 0.0 and minor > 0.0 and whole > 0.0


@njit(cache=True, error_model="numpy")
def hand_energy(q, box, height, finger, table, body, limits, table_limits):
    """Return the energy of a hand with held limits of friction; inf where a point is inside an obstacle."""
    place, held, drive, length, along, stiffness, weights, skin, obstacles, edges, anchors, law = finger
    energy = inertia_energy(box, body) + table_energy(box, height, table, table_limits)
    pose = np.empty(3)
    for f in range(FINGERS):
        if not energy < np.inf:
            return energy
        pose_of(box, place, f, pose)
        energy += weight_energy(q[f], pose, weights)
        energy += energy_of(q[f], length, along, stiffness, skin, obstacles, edges, anchors[f], limits[f], law)
    return energy


@njit(cache=True, error_model="numpy")
def find_hand(q, box, drives, targets, finger, table, body, efforts):
    """Move a hand from drives (3,) (both angles [rad], height [m]) to targets, in place, from fixed anchors.

    Returns whether an equilibrium of the time step was found; ``efforts`` (3,) are filled.
    """
    place, held, drive = finger[0], finger[1], finger[2]
    count = q.shape[1]
    anchors = finger[10]
    limits, table_limits = np.zeros((FINGERS, anchors.shape[1], anchors.shape[2])), np.zeros(len(table[1]))
    reduced, gradient = np.empty((6, 6)), np.empty(6)
    solved, ends = np.empty((FINGERS, count, 3, 5)), np.empty((FINGERS, 3))
    trial, step, pose, placed = np.empty_like(q), np.empty_like(q), np.empty(3), np.empty(3)
    drives = drives.copy()
    for _ in range(MAX_ITERATIONS):
        left = targets - drives
        moving = np.abs(left).max() > 0.0
        energy = np.inf
        move = np.zeros(3)
        for convex in (False, True):
            energy, definite = eliminate(
                q, box, drives[:2], drives[2], finger, table, body, convex, limits, table_limits, reduced, gradient,
                solved, ends,
            )  # fmt: skip
            if not energy < np.inf:
                return False
            if not definite:
                if convex:
                    return False
                continue
            right = -gradient[3:]
            for i in range(3):
                for j in range(3):
                    right[i] -= reduced[3 + i, j] * left[j]
            move[:] = np.linalg.solve(np.ascontiguousarray(reduced[3:, 3:]), right)
            for f in range(FINGERS):
                step[f] = solved[f, :, :, 4] - solved[f, :, :, 3] * left[f]
                for i in range(3):
                    step[f] -= solved[f, :, :, i] * move[i]
            # While a drive moves, the energy may grow; afterwards every step must go down.
            if moving or convex or gradient[3] * move[0] + gradient[4] * move[1] + gradient[5] * move[2] <= 0.0:
                break
        far, turn = max(abs(move[0]), abs(move[1])), abs(move[2])
        for f in range(FINGERS):
            for k in range(1, count - 1):
                far = max(far, max(abs(step[f, k, 0]), abs(step[f, k, 1])))
                turn = max(turn, abs(step[f, k, 2]))
        if not (far < np.inf and turn < np.inf):
            return False
        done = not moving and far <= TOLERANCE and turn <= 100.0 * TOLERANCE
        part = min(1.0, min(MAX_STEP / max(far, 1e-30), MAX_TURN / max(turn, 1e-30)))
        if moving:
            part = min(part, min(MAX_TURN / max(np.abs(left[:2]).max(), 1e-30), MAX_STEP / max(abs(left[2]), 1e-30)))
        accepted = False
        for _ in range(30):
            placed[:] = box + part * move
            now = targets if part == 1.0 else drives + part * left
            for f in range(FINGERS):
                trial[f] = q[f] + part * step[f]
                pose_of(placed, place, f, pose)
                place_ends(trial[f], held, drive, now[f], pose)
            value = hand_energy(trial, placed, now[2], finger, table, body, limits, table_limits)
            # Near the solution the change of energy is lost in rounding.
            if value < np.inf and (moving or done or value <= energy + 1e-12 * abs(energy) + 1e-15):
                accepted = True
                break
            part *= 0.5
        if not accepted:
            return False
        q[:] = trial
        box[:] = placed
        drives[:] = now
        if done:
            eliminate(
                q, box, drives[:2], drives[2], finger, table, body, False, limits, table_limits, reduced, gradient,
                solved, ends,
            )  # fmt: skip
            efforts[:] = gradient[:3]
            return True
    return False


@njit(cache=True, error_model="numpy")
def commit_table(box, height, table):
    """Let the friction springs of the table that slid catch up with the points of the box."""
    points, areas, anchors, plane, law = table
    p, arm, pull, tangent, edges = np.empty(3), np.empty(2), np.empty(2), np.empty((2, 2)), np.empty((1, 7))
    for k in range(len(areas)):
        table_point(box, height, points[k], p, arm)
        pressing = touch(p, areas[k], plane, edges, anchors[k], law, True, pull, tangent)[2]
        if pressing > 0.0 and plane[1] > 0.0:
            stretch = p[0] - anchors[k, 0]
            part = min(1.0, plane[1] * pressing / max(law[2] * areas[k] * abs(stretch), 1e-300))
            anchors[k, 0], anchors[k, 1], anchors[k, 2] = p[0] - part * stretch, p[1], 0.0
        else:
            anchors[k] = p


@njit(cache=True, error_model="numpy")
def commit_hand(q, box, height, finger, table):
    """Let all friction springs that slid catch up."""
    skin, obstacles, edges, anchors, law = finger[7], finger[8], finger[9], finger[10], finger[11]
    for f in range(FINGERS):
        commit(q[f], skin, obstacles, edges, anchors[f], law)
    commit_table(box, height, table)
