"""Time steps of bodies of beams that touch obstacles, where Newton's method for the whole body fails, compiled.

The stiffness of contact changes within a step as points land, stick and slide; that of everything else hardly does. So
the tangent is factorised without contact, and the forces of contact are found exactly for the linearised body: with the
compliance ``G`` of the points that may touch, they solve ``f = -pull(p + u + G (f - f0))``, which has three equations
for each of these few points. With them the whole body takes its step.

These small equations are solved by Newton's method. Where it ends at a kink, between sticking and sliding, their limits
of friction are held, which makes the forces those of a minimum of energy, and follow the normal forces from one minimum
to the next (a fixed point, which exists for any coefficient of friction). Then Newton's method goes on from there.
"""

from __future__ import annotations

import numpy as np

from softgym_envs.extensions.beams.solver.block_cholesky import SIZE, solve_lower, solve_upper
from softgym_envs.extensions.beams.solver.contact import (
    add_wrench,
    fill_arms,
    free_part,
    has_failed,
    point_at,
    spread_of,
)
from softgym_envs.extensions.beams.solver.equations import assemble_parts
from softgym_envs.extensions.beams.solver.newton import (
    LONGEST,
    REMAINING,
    SHORTEST,
    SMALLEST,
    correct,
    factorise_tangent,
    invert_driven,
    solve_in_contact,
    take,
)
from softgym_envs.mechanics.compilation import FAST, njit
from softgym_envs.mechanics.contact.compiled import add_friction, quick_gap, touch_point

MAX_ITERATIONS = 30
"""Largest number of steps of the whole body."""
MAX_LOCAL, MAX_HELD = 40, 40
"""Largest numbers of Newton steps of the forces of contact, and of limits of friction that are held in turn."""
SLOW = 0.25
"""Length of a step over that of the last one, above which the factor is renewed in place of the step."""
EXACT = 0.1
"""Error of the forces of contact, as motions of their points, over that of a step."""


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _add_motion(column, force, out, size):
    """Add what one component of the forces moves."""
    if force != 0.0:
        for i in range(size):
            out[i] += column[i] * force


@njit(cache=True, error_model="numpy")
def _pulls(contact, anchors, local, touch, held):
    """Fill pulls and tangents of contact at the points moved by the present forces; the energy, or inf inside.

    Limits of friction are ``local.limit`` if ``held``; otherwise they follow the normal forces, and are stored there.
    """
    count, p = local.number[0], local.p
    smooth, distance, energy = local.smooth, contact.law[0], 0.0
    for i in range(3 * count):
        local.motion[i] = local.free[i]
    for j in range(3 * count):
        _add_motion(local.compliance[j], local.force[j] - local.start[j], local.motion, 3 * count)
    for i in range(count):
        k = local.points[i]
        for d in range(3):
            p[d] = local.place[i, d] + local.motion[3 * i + d]
            local.pull[3 * i + d] = 0.0
            for e in range(3):
                local.tangent[i, d, e] = 0.0
        for o in range(contact.obstacles.shape[0]):
            obstacle, edges, anchor = contact.obstacles[o], contact.edges[o], anchors[o, k]
            gap = quick_gap(p, obstacle, edges)
            if not gap > 0.0:
                return np.inf
            near = gap < distance
            if held:
                touch.pull[:] = 0.0
                touch.tangent[:] = 0.0
                if near:
                    smooth[:] = obstacle
                    smooth[1] = 0.0
                    energy += touch_point(p, contact.area[k], smooth, edges, anchor, contact.law, False, touch)[0]
                if local.limit[i, o] > 0.0:
                    stick = contact.law[2] * contact.area[k]
                    energy += add_friction(p, obstacle, edges, anchor, stick, local.limit[i, o], touch)[0]
                _add(touch, local.pull[3 * i : 3 * i + 3], local.tangent[i], not held)
            elif near:
                found = touch_point(p, contact.area[k], obstacle, edges, anchor, contact.law, False, touch)
                _add(touch, local.pull[3 * i : 3 * i + 3], local.tangent[i], found[4])
                local.limit[i, o] = obstacle[1] * found[3]
            else:
                local.limit[i, o] = 0.0
    return energy


@njit(cache=True, error_model="numpy")
def _add(touch, pull, tangent, sliding):
    """Add what an obstacle does to a point."""
    for d in range(3):
        pull[d] += touch.pull[d]
        for e in range(3):
            tangent[d, e] += touch.tangent[d, e]
            if sliding:
                tangent[d, e] += touch.direction[d] * touch.loading[e]


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _open(local):
    """Fill the residual of the forces and what it would move; return the largest of these motions, and their work."""
    size = 3 * local.number[0]
    largest, work = 0.0, 0.0
    for i in range(size):
        local.residual[i], local.motion[i] = local.force[i] + local.pull[i], 0.0
    for j in range(size):
        _add_motion(local.compliance[j], local.residual[j], local.motion, size)
    for i in range(size):
        largest = max(largest, abs(local.motion[i]))
        work += local.motion[i] * local.residual[i]
    return largest, abs(work)


@njit(cache=True, error_model="numpy")
def _descend(contact, anchors, local, touch, exact, held):
    """Take Newton steps of the forces of contact until they move points by less than ``exact``; whether they do.

    They are shortened until they reduce the energy if limits are ``held``, and otherwise the work of the residual.
    """
    count = local.number[0]
    size = 3 * count
    step, kept, active = np.zeros(size), np.empty(size), np.empty(size, dtype=np.int64)
    energy = _pulls(contact, anchors, local, touch, held)
    if energy == np.inf:
        return False
    for _ in range(MAX_LOCAL):
        largest, work = _open(local)
        if largest <= exact:
            return True
        if held:
            energy += _spring(local)
        number = 0  # of components at points that press; forces on all others are zero and stay so
        for i in range(count):
            presses = False
            for d in range(3):
                presses = presses or local.force[3 * i + d] != 0.0 or local.tangent[i, d, d] != 0.0
                step[3 * i + d] = 0.0
            for d in range(3):
                if presses:
                    active[number] = 3 * i + d
                    number += 1
        matrix, right = np.empty((number, number)), np.empty(number)
        for a in range(number):
            i, d = active[a] // 3, active[a] % 3
            right[a] = local.residual[active[a]]
            for b in range(number):
                value = 1.0 if a == b else 0.0
                for e in range(3):
                    value += local.tangent[i, d, e] * local.compliance[3 * i + e, active[b]]
                matrix[a, b] = value
        found = np.linalg.solve(matrix, right)
        for a in range(number):
            step[active[a]] = found[a]
        slope = 0.0
        for i in range(size):
            kept[i] = local.force[i]
            slope -= local.motion[i] * step[i]
            if not abs(step[i]) < np.inf:
                return False
        part = 1.0
        while True:
            for i in range(size):
                local.force[i] = kept[i] - part * step[i]
            new = _pulls(contact, anchors, local, touch, held)
            if new < np.inf:
                if held:
                    if new + _spring(local) <= energy + 1e-4 * part * slope + 1e-14 * abs(energy):
                        break
                elif largest < 10.0 * exact or np.sqrt(_open(local)[1]) <= (1.0 - 0.1 * part) * np.sqrt(work):
                    break
            part *= 0.5
            if part < 1e-5:
                return False
        energy = new
    return False


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _spring(local):
    """Return the energy that the forces store in the linearised body [J]."""
    size, energy = 3 * local.number[0], 0.0
    for i in range(size):
        if local.force[i] != 0.0:
            for j in range(size):
                energy += 0.5 * local.force[i] * local.compliance[i, j] * local.force[j]
    return energy


@njit(cache=True, error_model="numpy")
def _find_forces(contact, anchors, local, touch, exact):
    """Solve for the forces of contact on the linearised body; whether they are found."""
    size = 3 * local.number[0]
    force, start = local.force, local.start
    held, follow = exact > 0.0, not exact > 0.0  # no literals, for each of which everything would be compiled again
    force[:size] = start[:size]
    if _pulls(contact, anchors, local, touch, follow) == np.inf:
        # Forces that hold all points in place, where they are outside.
        trace = 0.0
        for i in range(size):
            trace += local.compliance[i, i]
        matrix = local.compliance[:size, :size].copy()
        for i in range(size):
            matrix[i, i] += 1e-9 * trace / size
        force[:size] -= np.linalg.solve(matrix, local.free[:size])
        if _pulls(contact, anchors, local, touch, follow) == np.inf:
            return False
    first, limit, before = force[:size].copy(), local.limit.copy(), np.inf
    if _descend(contact, anchors, local, touch, exact, follow):
        return True
    force[:size] = first
    local.limit[:] = limit
    share = 1.0
    for turn in range(MAX_HELD):
        limit[:] = local.limit
        _descend(contact, anchors, local, touch, exact, held)
        first[:] = force[:size]
        change = 0.0
        if _pulls(contact, anchors, local, touch, follow) == np.inf:  # fills the limits that follow
            return False
        for i in range(local.number[0]):
            for o in range(limit.shape[1]):
                change = max(change, abs(local.limit[i, o] - limit[i, o]))
                limit[i, o] += share * (local.limit[i, o] - limit[i, o])
        if turn % 3 == 2 and _descend(contact, anchors, local, touch, exact, follow):
            return True
        force[:size] = first
        local.limit[:] = limit
        if change > 0.8 * before:
            share = max(0.5 * share, 0.1)
        before = change
    return False


@njit(cache=True, error_model="numpy")
def _choose(contact, slides, x, moved, renewed):
    """Choose the points that are near an obstacle at one of two states; whether others, or -1 if there are too many.

    Those of the last choice stay, unless ``renewed``.
    """
    local, p, distance = slides.local, slides.p, contact.law[0]
    count = 0 if renewed else local.number[0]
    kept = count
    for g in range(contact.frames.shape[0]):
        row = contact.frames[g, 0]
        now, then = distance + spread_of(contact, g, x), distance + spread_of(contact, g, moved)
        for o in range(contact.obstacles.shape[0]):
            obstacle, edges = contact.obstacles[o], contact.edges[o]
            here = quick_gap(x[row], obstacle, edges) < now
            there = quick_gap(moved[row], obstacle, edges) < then
            if not (here or there):
                continue
            for k in range(contact.groups[g], contact.groups[g + 1]):
                near = False
                if here:
                    point_at(contact, g, k, x, p)
                    near = quick_gap(p, obstacle, edges) < distance
                if there and not near:
                    point_at(contact, g, k, moved, p)
                    near = quick_gap(p, obstacle, edges) < distance
                for i in range(count):
                    near = near and local.points[i] != k
                if near:
                    if count == local.points.shape[0]:
                        return -1
                    local.points[count], local.group[count] = k, g
                    count += 1
    local.number[0] = count
    return 1 if renewed or count > kept else 0


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _dots(a, b, signs):
    """Return the sum of the products of two vectors with signs, all flat."""
    value = 0.0
    for i in range(a.shape[0]):
        value += signs[i] * a[i] * b[i]
    return value


@njit(cache=True, error_model="numpy")
def _soften(system, x, effort, drive):
    """Fill the compliance of the chosen points, with the values of driven rows held unless they are slack."""
    body, equations, factor = system
    contact, local, driven = body.contact, equations.slides.local, drive.driven
    size, length = 3 * local.number[0], factor.step.size
    arms, signs = equations.slides.arms, factor.signs.reshape(length)
    for i in range(local.number[0]):
        k, g = local.points[i], local.group[i]
        fill_arms(contact, g, k, x, arms)
        for d in range(3):
            half = local.half[3 * i + d]
            half[:] = 0.0
            for f in range(contact.frames.shape[1]):
                b = contact.blocks[g, f]
                if b >= 0:
                    add_wrench(local.axes[d], arms[f], contact.weights[k, f, 0], half[b])
                    for e in range(SIZE):
                        half[b, e] *= body.components.free[b, e]
            solve_lower(equations.tangent, body.pattern.pointers, body.pattern.columns, half)
    for i in range(size):
        half = local.half[i].reshape(length)
        for j in range(i + 1):
            value = _dots(half, local.half[j].reshape(length), signs)
            local.compliance[i, j] = value
            local.compliance[j, i] = value
    count = driven.shape[0]
    coupling, among = np.zeros((count, size)), np.empty((count, count))
    for j in range(count):
        slack = drive.one_way[j] and effort[driven[j]] + factor.efforts[driven[j]] <= 0.0
        for m in range(count):
            among[j, m] = factor.compliance[driven[j], driven[m]]
        if slack:
            among[j] = 0.0
            among[j, j] = 1.0
            continue
        for i in range(size):
            coupling[j, i] = _dots(local.half[i].reshape(length), factor.half[driven[j]].reshape(length), signs)
    local.relief[:count, :size] = np.linalg.solve(among, coupling)
    for i in range(size):
        for n in range(size):
            value = 0.0
            for j in range(count):
                value += coupling[j, i] * local.relief[j, n]
            local.compliance[i, n] -= value


@njit(cache=True, error_model="numpy")
def _press(system, x, step, drive, exact):
    """Add to a step of the body what the forces of contact change on it; whether they are found."""
    body, equations, factor = system
    contact, slides, local = body.contact, equations.slides, equations.slides.local
    count, size = local.number[0], 3 * local.number[0]
    for i in range(count):
        k, g = local.points[i], local.group[i]
        point_at(contact, g, k, x, local.place[i])
        fill_arms(contact, g, k, x, slides.arms)
        for d in range(3):
            local.free[3 * i + d] = 0.0
            local.force[3 * i + d] = 0.0
            local.start[3 * i + d] = 0.0
    if _pulls(contact, step.anchors, local, slides.touch, not exact > 0.0) == np.inf:
        return False
    for i in range(count):
        k, g = local.points[i], local.group[i]
        fill_arms(contact, g, k, x, slides.arms)
        for d in range(3):
            local.start[3 * i + d] = -local.pull[3 * i + d]
        for f in range(contact.frames.shape[1]):
            b = contact.blocks[g, f]
            if b < 0:
                continue
            share, arm, motion = contact.weights[k, f, 0], slides.arms[f], factor.step[b]
            for d in range(3):
                e, c = (d + 1) % 3, (d + 2) % 3
                local.free[3 * i + d] += share * motion[d] + motion[3 + e] * arm[c] - motion[3 + c] * arm[e]
    if not _find_forces(contact, step.anchors, local, slides.touch, exact):
        return False
    change = np.zeros_like(factor.step)
    flat, signs = change.reshape(change.size), factor.signs.reshape(change.size)
    for i in range(size):
        force, half = local.force[i] - local.start[i], local.half[i].reshape(change.size)
        for c in range(flat.shape[0]):
            flat[c] += force * half[c]
    for j in range(drive.driven.shape[0]):
        pull, half = 0.0, factor.half[drive.driven[j]].reshape(change.size)
        for i in range(size):
            pull -= local.relief[j, i] * (local.force[i] - local.start[i])
        factor.efforts[drive.driven[j]] += pull
        for c in range(flat.shape[0]):
            flat[c] += pull * half[c]
    for c in range(flat.shape[0]):
        flat[c] *= signs[c]
    solve_upper(equations.tangent, body.pattern.pointers, body.pattern.columns, change)
    for b in range(change.shape[0]):
        for i in range(SIZE):
            factor.step[b, i] += change[b, i]
    return True


@njit(cache=True, error_model="numpy")
def _solve_by_forces(system, x, effort, target, drive, step, tolerance, fresh):
    """Solve the equations of a time step in place as `beam_newton.solve`, where points may touch; the iterations or -1.

    Rows ``x`` must lie outside the obstacles. Steps end where points would enter an obstacle.
    """
    body, equations, factor = system
    contact, slides = body.contact, equations.slides
    rows, one_way = np.concatenate((drive.driven, drive.forced)), drive.one_way.any()
    scale, free = body.components.scale, 1.0
    radian = scale[:, 3:].max()
    before, taken = np.inf, 0
    enough = min(tolerance, max(REMAINING * tolerance, SMALLEST))
    stride, kept, moved = factor.step.copy(), x.copy(), x.copy()
    without = not tolerance > 0.0  # no literal, see above
    for iteration in range(1, MAX_ITERATIONS + 1):
        assemble_parts(body, x, effort, step, equations, fresh, without)
        if has_failed(slides):
            return -1
        if fresh:
            negative, taken = factorise_tangent(system, rows), 0
            if negative < 0 or (negative and one_way):
                return -1
            if not one_way:
                invert_driven(factor, drive.driven)
        length = correct(system, effort, target, drive)
        if not length < np.inf:  # also true for NaN
            return -1
        # Without the stiffness of contact, a body may be nearly unstable and its step far too long.
        stride[:] = factor.step
        take(system, x, moved, stride, min(1.0, LONGEST * radian / max(length, 1e-300)))
        factor.step[:] = stride
        others = _choose(contact, slides, x, moved, fresh)
        if others < 0:
            return -1
        if slides.local.number[0]:
            if others or one_way:
                _soften(system, x, effort, drive)
            if not _press(system, x, step, drive, max(EXACT * enough, 1e-13)):
                return -1
            length = 0.0
            for b in range(scale.shape[0]):
                for i in range(SIZE):
                    length = max(length, abs(factor.step[b, i]) * scale[b, i])
            if not length < np.inf:
                return -1
        ratio = length / before if before < np.inf else 1.0
        if not fresh and ratio > SLOW and length > enough:
            fresh = True  # this step is not taken
            continue
        for c in range(effort.shape[0]):
            effort[c] += factor.efforts[c]
        stride[:] = factor.step
        kept[:] = x
        part, free = min(1.0, LONGEST * radian / max(length, 1e-300)), 0.0
        while free < 1.0:
            take(system, kept, x, stride, part)
            free = free_part(contact, slides, kept, x)
            part *= free  # the way bends, so it is tested again
            if part < SHORTEST:
                return -1
        taken += 1
        if part == 1.0 and (length <= enough or (taken > 1 and 2.0 * length * ratio <= enough)):
            return iteration
        fresh = part < 1.0
        before = length if part == 1.0 else np.inf
    return -1


@njit(cache=True, error_model="numpy")
def solve_touching(system, x, effort, target, drive, step, tolerance, fresh):
    """Solve the equations of a time step in place: by `solve_in_contact`, which is faster, or else by the forces.

    Returns the iterations of the method that succeeds, or -1.
    """
    predicted, kept = x.copy(), effort.copy()
    iterations = solve_in_contact(system, x, effort, target, drive, step, tolerance, fresh)
    if iterations < 0:
        x[:] = predicted
        effort[:] = kept
        iterations = _solve_by_forces(system, x, effort, target, drive, step, tolerance, iterations < 0)
    return iterations
