"""Time steps of bodies of beams that may touch obstacles, compiled.

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

from softgym_envs.extensions.beams.contact_law import add_friction, quick_gap, touch_point
from softgym_envs.extensions.beams.solver.block_cholesky import SIZE, copy_values
from softgym_envs.extensions.beams.solver.contact import (
    find_near,
    free_part,
    has_failed,
    point_at,
)
from softgym_envs.extensions.beams.solver.equations import assemble_parts
from softgym_envs.extensions.beams.solver.frames import move
from softgym_envs.extensions.beams.solver.newton import (
    LONG_IN_TIME,
    REMAINING,
    SHORTEST,
    SMALLEST,
    STEEP,
    correct,
    factorise_tangent,
    invert_driven,
)
from softgym_envs.extensions.beams.solver.response import (
    frames_moved,
    newton_step,
    points_follow,
    points_moved,
    soften,
)
from softgym_envs.mechanics.compilation import njit

MAX_ITERATIONS = 30
"""Largest number of steps of the whole body."""
MAX_LOCAL, MAX_HELD = 40, 40
"""Largest numbers of Newton steps of the forces of contact, and of limits of friction that are held in turn."""
LONGEST, SLOW = 0.3, 0.2
"""Longest step, as the largest turn of a frame [rad]; length of a step over that of the last one, above which the
factor is renewed after it, and above `STEEP` in its place."""
STIFF = 1e6
"""Stiffness of springs that hold points, over that of the body."""
EXACT = 0.1
"""Error of the forces of contact, as motions of their points, over that of a step."""


@njit(cache=True, error_model="numpy", _nrt=False)
def _pulls(system, drive, anchors, held):
    """Fill what the present forces move, and what `_pulls_at` does there, which it returns."""
    local = system.equations.slides.local
    for i in range(3 * local.number[0]):
        local.spare[i] = local.force[i] - local.start[i]
    points_moved(system, drive, local.spare, local.moved)
    return _pulls_at(system.body.contact, system.equations.slides.touch, local, anchors, held)


@njit(cache=True, error_model="numpy", _nrt=False, forceinline=False)
def _pulls_at(contact, touch, local, anchors, held):
    """Fill pulls and tangents of contact at the points where ``local.moved`` leads; the energy, or inf inside.

    Limits of friction are ``local.limit`` if ``held``; otherwise they follow the normal forces, and are stored there.
    """
    count, p, smooth, distance, energy = local.number[0], local.p, local.smooth, contact.law[0], 0.0
    for i in range(count):
        k = local.points[i]
        for d in range(3):
            p[d] = local.place[i, d] + local.free[3 * i + d] + local.moved[3 * i + d]
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
                    copy_values(obstacle, smooth)
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


@njit(cache=True, error_model="numpy", _nrt=False)
def _add(touch, pull, tangent, sliding):
    """Add what an obstacle does to a point."""
    for d in range(3):
        pull[d] += touch.pull[d]
        for e in range(3):
            tangent[d, e] += touch.tangent[d, e]
            if sliding:
                tangent[d, e] += touch.direction[d] * touch.loading[e]


@njit(cache=True, error_model="numpy", _nrt=False, forceinline=True)
def _open(system, drive):
    """Fill the residual of the forces and what it would move; return the largest of these motions, and their work."""
    local, largest, work = system.equations.slides.local, 0.0, 0.0
    for i in range(3 * local.number[0]):
        local.residual[i] = local.force[i] + local.pull[i]
    points_moved(system, drive, local.residual, local.motion)
    for i in range(3 * local.number[0]):
        largest = max(largest, abs(local.motion[i]))
        work += local.motion[i] * local.residual[i]
    return largest, abs(work)


@njit(cache=True, error_model="numpy", _nrt=False, forceinline=True)
def _spring(system, drive):
    """Return the energy that the forces store in the linearised body [J]."""
    local, energy = system.equations.slides.local, 0.0
    points_moved(system, drive, local.force, local.spare)
    for i in range(3 * local.number[0]):
        energy += 0.5 * local.force[i] * local.spare[i]
    return energy


@njit(cache=True, error_model="numpy", _nrt=False)
def _descend(system, drive, anchors, exact, held, energy):
    """Take Newton steps of the forces of contact until they move points by less than ``exact``; whether they do.

    The pulls of the present forces are known, and ``energy`` is theirs. Steps are shortened until they reduce the
    energy if limits are ``held``, and otherwise the work of the residual.
    """
    contact, touch, local = system.body.contact, system.equations.slides.touch, system.equations.slides.local
    size, step, kept, before, reach = 3 * local.number[0], local.step, local.kept, local.before, local.reach
    if energy == np.inf:
        return False
    largest, work = _open(system, drive)
    for _ in range(MAX_LOCAL):
        if largest <= exact:
            return True
        if held:
            energy += _spring(system, drive)
        if not newton_step(system, drive, local.residual, step):
            return False
        slope = 0.0
        for i in range(size):
            kept[i], before[i] = local.force[i], local.moved[i]
            slope -= local.motion[i] * step[i]
            if not abs(step[i]) < np.inf:
                return False
        points_moved(system, drive, step, reach)
        part = 1.0
        while True:
            for i in range(size):
                local.force[i] = kept[i] - part * step[i]
                local.moved[i] = before[i] - part * reach[i]
            new = _pulls_at(contact, touch, local, anchors, held)
            if new < np.inf:
                far, left = _open(system, drive)
                if held:
                    if new + _spring(system, drive) <= energy + 1e-4 * part * slope + 1e-14 * abs(energy):
                        break
                elif largest < 10.0 * exact or np.sqrt(left) <= (1.0 - 0.1 * part) * np.sqrt(work):
                    break
            part *= 0.5
            if part < 1e-5:
                return False
        energy, largest, work = new, far, left
    return False


@njit(cache=True, error_model="numpy", _nrt=False)
def _hold_points(system, drive):
    """Let stiff springs pull the chosen points, moved by the present forces, back to their places; whether they can."""
    local = system.equations.slides.local
    count, square, product = local.number[0], 0.0, 0.0
    for i in range(3 * count):
        local.residual[i] = local.free[i] + local.moved[i]
    points_moved(system, drive, local.residual, local.motion)
    for i in range(3 * count):
        square += local.residual[i] * local.residual[i]
        product += local.residual[i] * local.motion[i]
    stiffness = STIFF * square / product
    for i in range(count):
        for d in range(3):
            local.residual[3 * i + d] *= stiffness
            for e in range(3):
                local.tangent[i, d, e] = stiffness if d == e else 0.0
    if not newton_step(system, drive, local.residual, local.step):
        return False
    for i in range(3 * count):
        local.force[i] -= local.step[i]
    return True


@njit(cache=True, error_model="numpy")
def _find_forces(system, drive, anchors, exact):
    """Solve for the forces of contact on the linearised body, near those given; 1 if found, 0 if nearly, -1 if not."""
    local = system.equations.slides.local
    size, count, force = 3 * local.number[0], local.number[0], local.force
    held, follow = exact > 0.0, not exact > 0.0  # no literals, for each of which everything would be compiled again
    energy = _pulls(system, drive, anchors, follow)
    if energy == np.inf:
        force[:size] = local.start[:size]
        energy = _pulls(system, drive, anchors, follow)
    for _ in range(MAX_HELD):
        if energy < np.inf:
            break
        # Points are inside. Each time, springs take away most of what is left; stiffer ones would lose digits.
        if not _hold_points(system, drive):
            return -1
        energy = _pulls(system, drive, anchors, follow)
    if energy == np.inf:
        return -1
    first, limit, before = force[:size].copy(), local.limit[:count].copy(), np.inf
    if _descend(system, drive, anchors, exact, follow, energy):
        return 1
    force[:size] = first
    local.limit[:count] = limit
    share = 1.0
    for turn in range(MAX_HELD):
        limit[:] = local.limit[:count]
        energy = _pulls(system, drive, anchors, held)
        _descend(system, drive, anchors, exact, held, energy)
        first[:] = force[:size]
        change = 0.0
        energy = _pulls(system, drive, anchors, follow)  # fills the limits that follow
        if energy == np.inf:
            return -1
        for i in range(count):
            for o in range(limit.shape[1]):
                change = max(change, abs(local.limit[i, o] - limit[i, o]))
                limit[i, o] += share * (local.limit[i, o] - limit[i, o])
        if turn % 3 == 2 and _descend(system, drive, anchors, exact, follow, energy):
            return 1
        force[:size] = first
        local.limit[:count] = limit
        if change > 0.8 * before:
            share = max(0.5 * share, 0.1)
        before = change
    return 0


@njit(cache=True, error_model="numpy")
def _press(system, x, step, drive, exact, first):
    """Add to a step of the body what the forces of contact change on it; what `_find_forces` returns.

    They are looked for near those at the start of the time step if this is its ``first`` step, otherwise near those at
    rows ``x``.
    """
    body, equations, factor = system
    contact, local = body.contact, equations.slides.local
    size = 3 * local.number[0]
    local.free[:size] = 0.0
    local.moved[:size] = 0.0
    for rows in (step.x, x):
        if rows is x or first:
            for i in range(local.number[0]):
                point_at(contact, local.group[i], local.points[i], rows, local.place[i])
            if _pulls_at(contact, equations.slides.touch, local, step.anchors, not exact > 0.0) == np.inf:
                return -1
            local.force[:size] = local.start[:size]
            for i in range(size):
                local.start[i] = -local.pull[i]
    if not first:
        local.force[:size] = local.start[:size]
    points_follow(system, x, factor.step, local.free)
    found = _find_forces(system, drive, step.anchors, exact)
    if found < 0:
        return found
    for i in range(size):
        local.spare[i] = local.force[i] - local.start[i]
    frames_moved(system, drive, local.spare, local.wrench)
    for j in range(drive.driven.shape[0]):
        factor.efforts[drive.driven[j]] += local.change[j]
    for b in range(factor.step.shape[0]):
        for i in range(SIZE):
            factor.step[b, i] += local.wrench[b, i]
    return found


@njit(cache=True, error_model="numpy", _nrt=False)
def _take(frames, factor, kept, x, stride, part):
    """Move rows ``x`` by a part of a step from those ``kept``."""
    copy_values(kept, x)
    for k in range(stride.shape[0]):
        for i in range(SIZE):
            factor.step[k, i] = part * stride[k, i]
    move(frames, x, factor.step, factor.turned)


@njit(cache=True, error_model="numpy", _nrt=False)
def _choose(contact, slides, x, moved, renewed):
    """Choose the points that are near an obstacle at one of two states; whether there are others.

    Those of the last choice stay, unless ``renewed``.
    """
    local, near, p, distance = slides.local, slides.near, slides.p, contact.law[0]
    count = 0 if renewed else local.number[0]
    kept = count
    find_near(contact, slides, x, moved)
    for n in range(near.number[0]):
        k, g, o = near.point[n], near.group[n], near.obstacle[n]
        obstacle, edges = contact.obstacles[o], contact.edges[o]
        point_at(contact, g, k, x, p)
        if not quick_gap(p, obstacle, edges) < distance:
            point_at(contact, g, k, moved, p)
            if not quick_gap(p, obstacle, edges) < distance:
                continue
        i = 0
        while i < count and local.points[i] != k:
            i += 1
        if i < count:
            continue
        first = -1
        for f in range(contact.blocks.shape[1]):
            b = contact.blocks[g, f]
            if b >= 0 and (first < 0 or b < first):
                first = b
        local.points[count], local.group[count], local.first[count] = k, g, first
        count += 1
    local.number[0] = count
    return renewed or count > kept


@njit(cache=True, error_model="numpy")
def solve_touching(system, x, effort, target, drive, step, tolerance, fresh):
    """Solve the equations of a time step in place as `newton.solve`, where points may touch; the iterations or -1.

    Rows ``x`` must lie outside the obstacles. Steps end where points would enter an obstacle.
    """
    body, equations, factor = system
    contact, slides = body.contact, equations.slides
    rows, one_way = np.concatenate((drive.driven, drive.forced)), drive.one_way.any()
    scale, free = body.components.scale, 1.0
    radian = scale[:, 3:].max()
    long = LONG_IN_TIME * radian
    before, taken, renewed = np.inf, 0, True
    enough = min(tolerance, max(REMAINING * tolerance, SMALLEST))
    stride, kept, moved = factor.step.copy(), x.copy(), x.copy()
    without = not tolerance > 0.0  # no literal, for which everything would be compiled again
    for iteration in range(1, MAX_ITERATIONS + 1):
        assemble_parts(body, x, effort, step, equations, fresh, without, not without)
        if has_failed(slides):
            return -1
        if fresh:
            slides.local.bare[:] = equations.tangent
            negative, taken, renewed = factorise_tangent(system, rows), 0, True
            if negative:
                assemble_parts(body, x, effort, step, equations, fresh, without, without)
                slides.local.bare[:] = equations.tangent
                negative = factorise_tangent(system, rows)
            if negative < 0 or (negative and one_way):
                return -1
            if not one_way:
                invert_driven(factor, drive.driven)
        length = correct(system, effort, target, drive)
        if not length < np.inf:  # also true for NaN
            return -1
        # Without the stiffness of contact, a body may be nearly unstable and its step far too long.
        stride[:] = factor.step
        _take(body.frames, factor, x, moved, stride, min(1.0, LONGEST * radian / max(length, 1e-300)))
        factor.step[:] = stride
        others = _choose(contact, slides, x, moved, renewed)
        renewed = False
        found = 1
        if slides.local.number[0]:
            if others or one_way:
                soften(system, x, effort, drive)
            # Far from the solution, the linearised body may have no consistent state: what is nearly one leads on.
            found = _press(system, x, step, drive, max(EXACT * enough, 1e-13), iteration == 1)
            if found < 0:
                return -1
            length = 0.0
            for b in range(scale.shape[0]):
                for i in range(SIZE):
                    length = max(length, abs(factor.step[b, i]) * scale[b, i])
            if not length < np.inf:
                return -1
        ratio = length / before if before < np.inf else 1.0
        if not fresh and before < np.inf and ratio > STEEP and length > enough:
            fresh = True  # this step is not taken
            continue
        for c in range(effort.shape[0]):
            effort[c] += factor.efforts[c]
        stride[:] = factor.step
        kept[:] = x
        part, free = min(1.0, LONGEST * radian / max(length, 1e-300)), 0.0
        while free < 1.0:
            _take(body.frames, factor, kept, x, stride, part)
            free = free_part(contact, slides, kept, x)
            part *= free  # the way bends, so it is tested again
            if part < SHORTEST:
                return -1
        taken += 1
        if part == 1.0 and found > 0 and (length <= enough or (taken > 1 and 2.0 * length * ratio <= enough)):
            return iteration
        fresh = part < 1.0 or length > long or (before < np.inf and ratio > SLOW)
        before = length if part == 1.0 and found > 0 else np.inf
    return -1
