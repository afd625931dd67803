"""Derivatives through implicit Euler steps of bodies of beams, compiled: adjoints of steps that were recorded.

One step solves ``R(y; x, v, a) = 0`` with the values of driven rows commanded; rows then are at ``y``, have the
velocity ``(y - x) / h``, and the anchors of friction have moved from ``a``. Backwards, a step needs one solve with the
transposed tangent at its end and the partial derivatives of its residual by what it starts from: inertia, damping of
strains, and friction. So a gradient costs about as much as the steps themselves.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types
from numba.extending import overload

from softgym_envs.extensions.beams.beam_kernels import add_forces, interpolate, pull_back
from softgym_envs.extensions.beams.contact_law import quick_gap, stretch_of, touch_point
from softgym_envs.extensions.beams.solver.block_cholesky import solve_lower, solve_upper
from softgym_envs.extensions.beams.solver.contact import has_failed, point_at, spread_of
from softgym_envs.extensions.beams.solver.equations import (
    Step,
    assemble,
    between,
    multiply_mass,
    point_strains,
    resistance,
)
from softgym_envs.extensions.beams.solver.frames import reduce_forces, rows_moved
from softgym_envs.extensions.beams.solver.motion import Stepping, copy_state, march_rows, restore_state
from softgym_envs.extensions.beams.solver.newton import factorise_tangent, invert_driven
from softgym_envs.mechanics.compilation import FAST, njit


class Adjoint(NamedTuple):
    """What multiplies the equations of recorded steps; no steps, s = 0, where it is not asked for.

    Attributes:
        motion: multipliers of the equations of each step, shape (s, b, 6).
        value: of the values of driven rows, shape (s, size).
        anchors: derivatives by the anchors after each step, shape (s, o, p, 3); None for a body that touches nothing.
    """

    motion: np.ndarray
    value: np.ndarray
    anchors: np.ndarray | None


class Tape(NamedTuple):
    """Time steps that were taken, some of which are parts of others.

    Attributes:
        x: rows at the start of each and at the end [m], shape (s + 1, n, 3).
        velocity: of the rows [m/s], shape (s + 1, n, 3).
        effort: of all constraint rows, shape (s + 1, size).
        anchors: of friction springs [m], shape (s + 1, o, p, 3); None for a body that touches nothing.
        h: duration of each [s], shape (s,).
        number: the command that each leads to, shape (s,).
        share: the part of the way to it that is done at its end, shape (s,).
        last: whether a command is reached at its end, shape (s,).
    """

    x: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    anchors: np.ndarray | None
    h: np.ndarray
    number: np.ndarray
    share: np.ndarray
    last: np.ndarray


@njit(cache=True, error_model="numpy")
def _keep(all_anchors, s, anchors):
    """Record anchors; None for a body that touches nothing."""
    if all_anchors is None:
        return
    all_anchors[s] = anchors


def _anchors_at(all_anchors, s):
    """Return the anchors at the start of a step."""
    return None if all_anchors is None else all_anchors[s]


@overload(_anchors_at)
def _compiled_anchors_at(all_anchors, s):
    """Choose when a kernel is compiled: what might be None or an array would have everything compiled again."""
    if isinstance(all_anchors, types.NoneType):
        return lambda all_anchors, s: None
    return lambda all_anchors, s: all_anchors[s]


@njit(cache=True, error_model="numpy")
def record(system, strains, state, targets, drive, stepping, tape):
    """Take time steps in place and record them; the number of records, or -1 if one fails or there is no more room."""
    room, count, limit = tape.h.shape[0], 0, np.zeros(0)
    no = room < 0  # False; for a literal everything would be compiled again
    tape.x[0] = state.x
    tape.velocity[0] = state.velocity
    tape.effort[0] = state.effort
    _keep(tape.anchors, 0, state.anchors)
    first = state.effort.copy()
    for k in range(targets.shape[0]):
        kept = copy_state(state)
        if not march_rows(system, strains, state, targets[k : k + 1], drive, limit, stepping, no, no):
            return -1
        parts = int(state.totals[6])
        if count + parts > room:
            return -1
        if parts > 1:
            restore_state(state, kept)
        short = Stepping(
            stepping.loads,
            stepping.h / parts,
            stepping.mass_damping,
            stepping.stiffness_damping,
            stepping.tolerance,
            min(stepping.cuts, 1),  # no literal, for which everything would be compiled again
        )
        if parts > 1:
            first[:] = kept.effort
            for i in range(drive.driven.shape[0]):
                first[drive.driven[i]] = targets[k - 1, drive.driven[i]] if k else kept.delta[drive.driven[i]]
        for j in range(parts):
            share = (j + 1) / parts
            if parts > 1:
                goal = targets[k : k + 1].copy()
                if j < parts - 1:
                    goal[0] = first + share * (goal[0] - first)
                if not march_rows(system, strains, state, goal, drive, limit, short, no, no):
                    return -1
                if state.totals[6] > 1.0:
                    return -1
            tape.h[count], tape.number[count], tape.share[count] = short.h, k, share
            tape.last[count] = j == parts - 1
            count += 1
            tape.x[count] = state.x
            tape.velocity[count] = state.velocity
            tape.effort[count] = state.effort
            _keep(tape.anchors, count, state.anchors)
    return count


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _strains_along(z, w, out):
    """Fill ``out`` (6,) with the derivative of the strains at a state ``z`` along ``w``, both (7, 3)."""
    a, b, c, p, q, r = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for d in range(3):
        a += z[0, d] * w[1, d] + w[0, d] * z[1, d]
        b += z[0, d] * w[2, d] + w[0, d] * z[2, d]
        c += z[0, d] * w[3, d] + w[0, d] * z[3, d]
        p += z[3, d] * w[5, d] + w[3, d] * z[5, d] - z[2, d] * w[6, d] - w[2, d] * z[6, d]
        q += z[1, d] * w[6, d] + w[1, d] * z[6, d] - z[3, d] * w[4, d] - w[3, d] * z[4, d]
        r += z[2, d] * w[4, d] + w[2, d] * z[4, d] - z[1, d] * w[5, d] - w[1, d] * z[5, d]
    out[0], out[1], out[2], out[3], out[4], out[5] = a, b, c, 0.5 * p, 0.5 * q, 0.5 * r


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _add_damping(elements, x, y, moved, rate, out):
    """Subtract from ``out`` (n, 3) the product of ``moved`` (n, 3) with the derivative of damping forces by ``x``."""
    z, w, along, pull = np.empty((7, 3)), np.empty((7, 3)), np.empty(6), np.empty((7, 3))
    for e in range(elements.frames.shape[0]):
        frames = elements.frames[e]
        for q in range(2):
            shape, slope = elements.shape[q], elements.slope[e, q]
            interpolate(y, frames, shape, slope, z)
            interpolate(moved, frames, shape, slope, w)
            _strains_along(z, w, along)
            for s in range(6):
                along[s] *= rate * elements.stiffness[e, q, s]
            interpolate(x, frames, shape, slope, z)
            pull[:] = 0.0
            pull_back(z, along, pull)
            add_forces(pull, frames, shape, slope, out)


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _add_resistance(elements, x, y, moved, rate, out):
    """Subtract from ``out`` (n, 3) the product of ``moved`` (n, 3) with the derivative of drag by rows ``x`` (n, 3)."""
    D, t, u, m, still = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3), np.zeros_like(moved)
    for e in range(elements.drag.shape[0]):
        frames = elements.frames[e]
        for q in range(2):
            shape, slope = elements.shape[q], elements.slope[e, q]
            resistance(elements, e, q, x, D)
            between(elements, e, q, x, y, u)
            between(elements, e, q, still, moved, m)
            square, a, b = 0.0, 0.0, 0.0
            for i in range(3):
                t[i] = slope[0] * x[frames[0], i] + slope[1] * x[frames[1], i] + slope[2] * x[frames[2], i]
                square += t[i] * t[i]
                a += t[i] * u[i]
                b += t[i] * m[i]
            turning = rate * (elements.drag[e, q, 0] - elements.drag[e, q, 1]) / square
            for i in range(3):
                back = rate * (D[i, 0] * m[0] + D[i, 1] * m[1] + D[i, 2] * m[2])
                turned = turning * (a * m[i] + b * u[i] - 2.0 * a * b / square * t[i])
                for k in range(3):
                    out[frames[k], i] += shape[k] * back - slope[k] * turned


@njit(cache=True, error_model="numpy", _nrt=False)
def _friction_derivatives(p, area, obstacle, edges, anchor, law, touch, by_point, by_anchor):
    """Fill the derivatives (3, 3) of minus the friction force on a touching point by the point and by its anchor."""
    _, _, _, pressing, sliding = touch_point(p, area, obstacle, edges, anchor, law, True, touch)
    d, n, factor = touch.direction, touch.place, law[2] * area
    if sliding:
        size = stretch_of(p, obstacle, edges, anchor, touch)
        factor = obstacle[1] * pressing / size
        for i in range(3):
            d[i] /= size
    across = 0.0
    for i in range(3):
        across += n[i] * (p[i] - anchor[i])
    for j in range(3):
        # How the stretch along the surface changes with the anchor, whose normal turns where the surface is curved.
        turned = 0.0
        for i in range(3):
            turned += touch.spare[i, j] * (p[i] - anchor[i])
        along = 0.0
        for i in range(3):
            by_anchor[i, j] = n[i] * n[j] - touch.spare[i, j] * across - n[i] * turned
            if i == j:
                by_anchor[i, j] -= 1.0
            along += d[i] * by_anchor[i, j]
        for i in range(3):
            value = -n[i] * n[j]
            if i == j:
                value += 1.0
            if sliding:
                value -= d[i] * d[j]
                by_anchor[i, j] -= d[i] * along
            by_point[i, j] = factor * value
            by_anchor[i, j] *= factor
            if sliding:
                by_point[i, j] += d[i] * touch.loading[j]


@njit(cache=True, error_model="numpy")
def _commit_back(contact, slides, y, anchors, by_anchors, by_rows):
    """Pull derivatives by the anchors after a step, ``by_anchors``, back to those before it, and to rows ``y``."""
    if contact is None:
        return
    p, law, back, before = slides.p, contact.law, np.empty(3), np.empty(3)
    by_point, by_anchor = np.empty((3, 3)), np.empty((3, 3))
    for g in range(contact.frames.shape[0]):
        far = law[0] + spread_of(contact, g, y)
        for o in range(contact.obstacles.shape[0]):
            obstacle, edges = contact.obstacles[o], contact.edges[o]
            near = quick_gap(y[contact.frames[g, 0]], obstacle, edges) < far and obstacle[1] > 0.0
            for k in range(contact.groups[g], contact.groups[g + 1]):
                by = by_anchors[o, k]
                if by[0] == 0.0 and by[1] == 0.0 and by[2] == 0.0:
                    continue
                point_at(contact, g, k, y, p)
                for i in range(3):
                    back[i], before[i] = by[i], 0.0
                if near and quick_gap(p, obstacle, edges) < law[0]:
                    area = contact.area[k]
                    _friction_derivatives(
                        p, area, obstacle, edges, anchors[o, k], law, slides.touch, by_point, by_anchor
                    )
                    for i in range(3):
                        for j in range(3):
                            back[i] -= by_point[j, i] * by[j] / (law[2] * area)
                            before[i] -= by_anchor[j, i] * by[j] / (law[2] * area)
                for f in range(contact.frames.shape[1]):
                    row, w = contact.frames[g, f], contact.weights[k, f]
                    for m in range(4):
                        for i in range(3):
                            by_rows[row + m, i] += w[m] * back[i]
                for i in range(3):
                    by[i] = before[i]


@njit(cache=True, error_model="numpy")
def _friction_back(contact, slides, y, anchors, moved, by_anchors):
    """Subtract from ``by_anchors`` the product of ``moved`` (n, 3) with the derivative of the forces by the anchors."""
    if contact is None:
        return
    p, q, law = slides.p, slides.q, contact.law
    by_point, by_anchor = np.empty((3, 3)), np.empty((3, 3))
    for g in range(contact.frames.shape[0]):
        far = law[0] + spread_of(contact, g, y)
        for o in range(contact.obstacles.shape[0]):
            obstacle, edges = contact.obstacles[o], contact.edges[o]
            if obstacle[1] == 0.0 or quick_gap(y[contact.frames[g, 0]], obstacle, edges) >= far:
                continue
            for k in range(contact.groups[g], contact.groups[g + 1]):
                point_at(contact, g, k, y, p)
                if quick_gap(p, obstacle, edges) >= law[0]:
                    continue
                area = contact.area[k]
                _friction_derivatives(p, area, obstacle, edges, anchors[o, k], law, slides.touch, by_point, by_anchor)
                point_at(contact, g, k, moved, q)
                for i in range(3):
                    for j in range(3):
                        by_anchors[o, k, i] -= by_anchor[j, i] * q[j]


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _slide_back(slides, y, signs):
    """Do for the transposed tangent what `contact.slide` does for the tangent."""
    if slides is None:
        return
    count, size = slides.number[0], y.size
    flat, sign = y.reshape(size), signs.reshape(size)
    for s in range(count):
        direction, value = slides.direction[s].reshape(size), 0.0
        for i in range(size):
            value += direction[i] * sign[i] * flat[i]
        slides.slip[s] = value
    for s in range(count):
        value, loading = 0.0, slides.loading[s].reshape(size)
        for t in range(count):
            value += slides.core[t, s] * slides.slip[t]
        for i in range(size):
            flat[i] -= value * loading[i]


@njit(cache=True, error_model="numpy")
def _solve_back(system, drive, right, by_effort, by_target):
    """Solve ``A^T p + H^T m = right`` with ``H p = -by_effort`` of driven rows; ``right`` (b, 6) becomes ``p``.

    Fills ``by_target`` (size,) with ``m`` in driven rows and with ``H p`` and ``by_effort`` in the others.
    """
    body, equations, factor = system
    pattern, signs, size = body.pattern, factor.signs, right.size
    driven, count = drive.driven, drive.driven.shape[0]
    solve_lower(equations.tangent, pattern.pointers, pattern.columns, right)
    _slide_back(equations.slides, right, signs)
    flat, sign = right.reshape(size), signs.reshape(size)
    along = np.empty(count)
    for i in range(count):
        half, value = factor.half[driven[i]].reshape(size), by_effort[driven[i]]
        for d in range(size):
            value += half[d] * sign[d] * flat[d]
        along[i] = value
    pull = np.empty_like(right)
    for i in range(count):
        value = 0.0
        for j in range(count):
            value += factor.driven[j, i] * along[j]
        by_target[driven[i]] = value
        pull[:] = factor.half[driven[i]]
        _slide_back(equations.slides, pull, signs)
        other = pull.reshape(size)
        for d in range(size):
            flat[d] -= value * other[d]
    for d in range(size):
        flat[d] *= sign[d]
    solve_upper(equations.tangent, pattern.pointers, pattern.columns, right)
    for j in range(drive.forced.shape[0]):
        row, value = drive.forced[j], 0.0
        along_row = equations.H[row].reshape(size)
        for d in range(size):
            value += along_row[d] * flat[d]
        by_target[row] = value + by_effort[row]


@njit(cache=True, error_model="numpy")
def go_back(system, strains, tape, count, drive, stepping, by_x, by_velocity, by_effort, by_targets, start, adjoint):
    """Pull the derivatives of a scalar by states back through recorded steps; whether all tangents were regular.

    Args:
        system: body, equations and factor.
        strains: work array.
        tape: the record.
        count: number of records.
        drive: how rows are commanded.
        stepping: as in the record.
        by_x: derivatives by the rows after each command, shape (k, n, 3).
        by_velocity: by the velocities of the rows, shape (k, n, 3).
        by_effort: by the efforts, shape (k, size).
        by_targets: is filled with those by the commands, shape (k, size).
        start: derivatives by the rows, the velocities and the anchors at the start, which are filled.
        adjoint: arrays of `Adjoint`, which are filled if they have steps.
    """
    body, equations, factor = system
    xs, velocities, anchors = start
    xs[:] = 0.0
    velocities[:] = 0.0
    by_targets[:] = 0.0
    rows, by_target = np.arange(tape.effort.shape[1]), np.zeros(tape.effort.shape[1])
    right, free = np.zeros_like(factor.step), body.components.free
    moved, forces, efforts = np.zeros_like(xs), np.zeros_like(xs), np.zeros(by_target.shape[0])
    for s in range(count - 1, -1, -1):
        h, k, x, y = tape.h[s], tape.number[s], tape.x[s], tape.x[s + 1]
        efforts[:] = 0.0
        if tape.last[s]:
            xs += by_x[k]
            velocities += by_velocity[k]
            efforts += by_effort[k]
        held = _anchors_at(tape.anchors, s)
        keeps = adjoint.motion.shape[0] > 0
        if keeps:
            _keep(adjoint.anchors, s, anchors)
        # Rows and velocities at the end, and anchors that have followed the points.
        _commit_back(body.contact, equations.slides, y, held, anchors, xs)
        for row in range(xs.shape[0]):
            for d in range(3):
                forces[row, d] = xs[row, d] + velocities[row, d] / h
                xs[row, d] = -velocities[row, d] / h
        reduce_forces(body.frames, y, forces, right)
        for b in range(right.shape[0]):
            for i in range(right.shape[1]):
                right[b, i] *= free[b, i]
        point_strains(body.elements, x, strains)
        step = Step(
            x,
            tape.velocity[s],
            strains,
            stepping.loads,
            h,
            stepping.mass_damping,
            stepping.stiffness_damping,
            held,
        )
        assemble(body, y, tape.effort[s + 1], step, equations, h > 0.0)  # True; a literal would compile all again
        if has_failed(equations.slides) or factorise_tangent(system, rows) < 0:
            return False
        invert_driven(factor, drive.driven)
        _solve_back(system, drive, right, efforts, by_target)
        if keeps:
            adjoint.motion[s] = right
            adjoint.value[s] = by_target
        share, before = tape.share[s], k > 0 and tape.share[s] < 1.0
        for c in range(by_target.shape[0]):
            by_targets[k, c] += share * by_target[c]
            if before:
                by_targets[k - 1, c] += (1.0 - share) * by_target[c]
        rows_moved(body.frames, y, right, moved)
        rate = 1.0 / h
        forces[:] = 0.0
        multiply_mass(body.masses, moved, forces)
        for row in range(xs.shape[0]):
            for d in range(3):
                xs[row, d] += (rate + stepping.mass_damping) * rate * forces[row, d]
                velocities[row, d] = rate * forces[row, d]
        _add_damping(body.elements, x, y, moved, stepping.stiffness_damping * rate, xs)
        _add_resistance(body.elements, x, y, moved, rate, xs)
        _friction_back(body.contact, equations.slides, y, held, moved, anchors)
    return True
