"""How the points of a linearised body that may touch something move under forces on them, compiled.

Few points have a dense compliance ``G``. For many points it would be singular and large, and forces act through the
frames: ``G = J P J^T`` with the motion ``J`` of the points by that of the frames, and the response ``P`` of the frames
while the values of driven constraints are held. With the stiffness ``K`` of contact, Newton's method needs

    (1 + K G)^-1 = 1 - K J (S + J^T K J)^-1 J^T,

where the equations of the frames are sparse.
"""

from __future__ import annotations

import numpy as np

from softgym_envs.extensions.beams.solver.block_cholesky import SIZE, copy_values, solve_lower, solve_upper
from softgym_envs.extensions.beams.solver.block_elimination import eliminate_blocks, solve_blocks
from softgym_envs.extensions.beams.solver.contact import add_block, add_wrench, fill_arms
from softgym_envs.extensions.beams.solver.newton import dot
from softgym_envs.mechanics.compilation import FAST, njit


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST, forceinline=False)
def _gather(contact, local, motion, out):
    """Fill ``out`` (3 k,) with the motion of the chosen points by that of the frames (b, 6)."""
    for i in range(local.number[0]):
        k, g = local.points[i], local.group[i]
        for d in range(3):
            out[3 * i + d] = 0.0
        for f in range(contact.frames.shape[1]):
            b = contact.blocks[g, f]
            if b < 0:
                continue
            share, arm, step = contact.weights[k, f, 0], local.arms[i, f], motion[b]
            for d in range(3):
                e, c = (d + 1) % 3, (d + 2) % 3
                out[3 * i + d] += share * step[d] + step[3 + e] * arm[c] - step[3 + c] * arm[e]


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _scatter(contact, local, force, free, out):
    """Fill ``out`` (b, 6) with what forces (3 k,) on the chosen points do to the frames."""
    out[:] = 0.0
    for i in range(local.number[0]):
        if force[3 * i] == 0.0 and force[3 * i + 1] == 0.0 and force[3 * i + 2] == 0.0:
            continue
        k, g = local.points[i], local.group[i]
        for f in range(contact.frames.shape[1]):
            b = contact.blocks[g, f]
            if b >= 0:
                add_wrench(force[3 * i : 3 * i + 3], local.arms[i, f], contact.weights[k, f, 0], out[b])
    for b in range(free.shape[0]):
        for d in range(SIZE):
            out[b, d] *= free[b, d]


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _product(a, b):
    """Return the sum of the products of two vectors (b, 6)."""
    first, second, value = a.flat, b.flat, 0.0
    for i in range(a.size):
        value += first[i] * second[i]
    return value


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST, forceinline=False)
def frames_moved(system, drive, force, motion):
    """Fill ``motion`` (b, 6) with that of the frames by forces (3 k,), and ``local.pull`` (size,) with the efforts."""
    body, equations, factor = system
    local, driven, size = equations.slides.local, drive.driven, motion.size
    flat, signs = motion.flat, factor.signs.flat
    _scatter(body.contact, local, force, body.components.free, motion)
    solve_lower(equations.tangent, body.pattern.pointers, body.pattern.columns, motion)
    for j in range(driven.shape[0]):
        local.row[j] = 0.0 if local.slack[j] else dot(factor.half[driven[j]], motion, factor.signs)
    for j in range(driven.shape[0]):
        value = 0.0
        for m in range(driven.shape[0]):
            value -= local.among[j, m] * local.row[m]
        local.change[j] = value
    for j in range(driven.shape[0]):
        value, half = local.change[j], factor.half[driven[j]].flat
        for c in range(size):
            flat[c] = flat[c] + value * half[c]
    for c in range(size):
        flat[c] = flat[c] * signs[c]
    solve_upper(equations.tangent, body.pattern.pointers, body.pattern.columns, motion)


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST, forceinline=True)
def points_moved(system, drive, force, out):
    """Fill ``out`` (3 k,) with the motion of the chosen points by forces (3 k,) on them."""
    local = system.equations.slides.local
    size = 3 * local.number[0]
    if 3 * local.number[0] > local.compliance.shape[0]:
        frames_moved(system, drive, force, local.wrench)
        _gather(system.body.contact, local, local.wrench, out)
        return
    for i in range(size):
        out[i] = 0.0
    for j in range(size):
        value, column = force[j], local.compliance[j]
        if value != 0.0:
            for i in range(size):
                out[i] += column[i] * value


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def points_follow(system, x, motion, out):
    """Fill ``out`` (3 k,) with the motion of the chosen points by that of the frames (b, 6) at rows ``x`` (n, 3)."""
    contact, local = system.body.contact, system.equations.slides.local
    for i in range(local.number[0]):
        fill_arms(contact, local.group[i], local.points[i], x, local.arms[i])
    _gather(contact, local, motion, out)


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _dot_from(a, b, signs, k, pattern):
    """Return the sum of the products of two vectors (b, 6) with signs, of which one begins at block ``k``.

    It is a solution ``L^-1 f`` for a force on that block, and so zero except where the elimination of ``k`` leads.
    """
    value = 0.0
    while True:
        for i in range(SIZE):
            value += signs[k, i] * a[k, i] * b[k, i]
        if pattern.pointers[k] == pattern.pointers[k + 1]:
            return value
        k = pattern.columns[pattern.pointers[k]]


@njit(cache=True, error_model="numpy")
def soften(system, x, effort, drive):
    """Let the chosen points yield at rows ``x``, with the values of driven rows held unless they are slack."""
    _, equations, factor = system
    local, driven = equations.slides.local, drive.driven
    count = driven.shape[0]
    if drive.one_way.any():
        among = np.zeros((count, count))
        for j in range(count):
            local.slack[j] = drive.one_way[j] and effort[driven[j]] + factor.efforts[driven[j]] <= 0.0
            for m in range(count):
                among[j, m] = factor.compliance[driven[j], driven[m]]
            if local.slack[j]:
                among[j] = 0.0
                among[j, j] = 1.0
        local.among[:count, :count] = np.linalg.inv(among)
    else:
        local.slack[:] = False
        local.among[:] = factor.driven
    if 3 * local.number[0] <= local.compliance.shape[0]:
        _fill_compliance(system, x, drive)


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _fill_compliance(system, x, drive):
    """Fill the compliance of few points."""
    body, equations, factor = system
    contact, local, driven = body.contact, equations.slides.local, drive.driven
    size, signs, count = 3 * local.number[0], factor.signs, driven.shape[0]
    for i in range(local.number[0]):
        k, g = local.points[i], local.group[i]
        fill_arms(contact, g, k, x, local.arms[i])
        for d in range(3):
            half = local.half[3 * i + d]
            half[:] = 0.0
            for f in range(contact.frames.shape[1]):
                b = contact.blocks[g, f]
                if b >= 0:
                    add_wrench(local.axes[d], local.arms[i, f], contact.weights[k, f, 0], half[b])
                    for e in range(SIZE):
                        half[b, e] *= body.components.free[b, e]
            solve_lower(equations.tangent, body.pattern.pointers, body.pattern.columns, half)
    for i in range(size):
        for j in range(i + 1):
            first = max(local.first[i // 3], local.first[j // 3])
            value = _dot_from(local.half[i], local.half[j], signs, first, body.pattern)
            local.compliance[i, j] = value
            local.compliance[j, i] = value
    for j in range(count):
        for i in range(size):
            coupled = _dot_from(local.half[i], factor.half[driven[j]], signs, local.first[i // 3], body.pattern)
            local.coupling[j, i] = 0.0 if local.slack[j] else coupled
    for j in range(count):
        for i in range(size):
            value = 0.0
            for m in range(count):
                value += local.among[j, m] * local.coupling[m, i]
            local.relief[j, i] = value
    for i in range(size):
        for j in range(count):
            value = local.coupling[j, i]
            if value != 0.0:
                for n in range(size):
                    local.compliance[i, n] -= value * local.relief[j, n]


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST, forceinline=False)
def _eliminate(matrix, right, n):
    """Solve a dense system of n equations in place: ``right`` becomes the solution; whether there is one."""
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(matrix[i, k]) > abs(matrix[best, k]):
                best = i
        if not 0.0 < abs(matrix[best, k]) < np.inf:
            return False
        if best != k:
            for j in range(k, n):
                matrix[k, j], matrix[best, j] = matrix[best, j], matrix[k, j]
            right[k], right[best] = right[best], right[k]
        for i in range(k + 1, n):
            part = matrix[i, k] / matrix[k, k]
            if part != 0.0:
                for j in range(k + 1, n):
                    matrix[i, j] -= part * matrix[k, j]
                right[i] -= part * right[k]
    for k in range(n - 1, -1, -1):
        value = right[k]
        for j in range(k + 1, n):
            value -= matrix[k, j] * right[j]
        right[k] = value / matrix[k, k]
    return True


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST, forceinline=True)
def newton_step(system, drive, residual, out):
    """Fill ``out`` (3 k,) with ``(1 + K G)^-1 residual``, where ``K`` is ``local.tangent``; whether there is one."""
    local = system.equations.slides.local
    if 3 * local.number[0] > local.compliance.shape[0]:
        return _step_of_many(system, drive, residual, out)
    number, active, matrix, right = 0, local.active, local.matrix, local.right
    for i in range(local.number[0]):
        # The forces on points that do not press are zero and stay so.
        presses = False
        for d in range(3):
            presses = presses or residual[3 * i + d] != 0.0 or local.tangent[i, d, d] != 0.0
            out[3 * i + d] = 0.0
        for d in range(3):
            if presses:
                active[number] = 3 * i + d
                number += 1
    for a in range(number):
        i, d = active[a] // 3, active[a] % 3
        right[a] = residual[active[a]]
        for b in range(number):
            value = 1.0 if a == b else 0.0
            for e in range(3):
                value += local.tangent[i, d, e] * local.compliance[3 * i + e, active[b]]
            matrix[a, b] = value
    if not _eliminate(matrix, right, number):
        return False
    for a in range(number):
        out[active[a]] = right[a]
    return True


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _add_stiffness(contact, local, free):
    """Add the stiffness of contact at the chosen points to the equations of the frames."""
    block, count = local.block, free.shape[0]
    for i in range(local.number[0]):
        k, g, K = local.points[i], local.group[i], local.tangent[i]
        if K[0, 0] == 0.0 and K[1, 1] == 0.0 and K[2, 2] == 0.0:
            continue
        for f in range(contact.frames.shape[1]):
            for h in range(contact.frames.shape[1]):
                place = contact.place[g, f, h]
                if place < 0:
                    continue
                one, other = contact.blocks[g, f], contact.blocks[g, h]
                share, far = contact.weights[k, f, 0], contact.weights[k, h, 0]
                block[:] = 0.0
                add_block(K, local.arms[i, f], share, local.arms[i, h], far, block)
                target = local.upper[place]
                for r in range(SIZE):
                    for c in range(SIZE):
                        target[r, c] += free[one, r] * free[other, c] * block[r, c]
                if one == other:
                    continue
                block[:] = 0.0
                add_block(K, local.arms[i, h], far, local.arms[i, f], share, block)
                target = local.lower[place - count]
                for r in range(SIZE):
                    for c in range(SIZE):
                        target[r, c] += free[other, r] * free[one, c] * block[r, c]


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST, forceinline=False)
def _step_of_many(system, drive, residual, out):
    """Do what `newton_step` says by the equations of the frames."""
    body, equations, _ = system
    contact, local, pattern, driven = body.contact, equations.slides.local, body.pattern, drive.driven
    count, free, number = local.wrench.shape[0], body.components.free, driven.shape[0]
    copy_values(local.bare, local.upper)
    for p in range(local.lower.shape[0]):
        for i in range(SIZE):
            for j in range(SIZE):
                local.lower[p, i, j] = local.bare[count + p, j, i]
    _add_stiffness(contact, local, free)
    if not eliminate_blocks(local.upper, local.lower, pattern.pointers, pattern.targets, local.right):
        return False
    y = local.wrench
    _scatter(contact, local, residual, free, y)
    solve_blocks(local.upper, local.lower, pattern.pointers, pattern.columns, y)
    for j in range(number):
        copy_values(equations.H[driven[j]], local.columns[j])
        solve_blocks(local.upper, local.lower, pattern.pointers, pattern.columns, local.columns[j])
    for j in range(number):
        local.row[j] = 0.0 if local.slack[j] else _product(equations.H[driven[j]], y)
        for m in range(number):
            if local.slack[j] or local.slack[m]:
                local.matrix[j, m] = 1.0 if j == m else 0.0
            else:
                local.matrix[j, m] = _product(equations.H[driven[j]], local.columns[m])
    if not _eliminate(local.matrix, local.row, number):
        return False
    for j in range(number):
        for b in range(count):
            for i in range(SIZE):
                y[b, i] -= local.row[j] * local.columns[j, b, i]
    _gather(contact, local, y, out)
    for i in range(local.number[0]):
        a, b, c = out[3 * i], out[3 * i + 1], out[3 * i + 2]
        for d in range(3):
            K = local.tangent[i, d]
            out[3 * i + d] = residual[3 * i + d] - (K[0] * a + K[1] * b + K[2] * c)
    return True
