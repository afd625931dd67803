"""Newton's method for bodies of beams, compiled: equations are linearised, factorised and solved for one time step.

`solve` takes whole steps and keeps its factor while it converges fast. `approach` shortens steps and divides the way to
the target into increments, as `Statics` does. `touching` solves for bodies that may touch something.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from softgym_envs.extensions.beams.solver.block_cholesky import SIZE, copy_values, factorise, solve_lower, solve_upper
from softgym_envs.extensions.beams.solver.body import BeamBody
from softgym_envs.extensions.beams.solver.contact import has_failed, slide
from softgym_envs.extensions.beams.solver.equations import (
    Equations,
    assemble,
    make_equations,
)
from softgym_envs.extensions.beams.solver.frames import move
from softgym_envs.mechanics.compilation import FAST, njit
from softgym_envs.mechanics.solvers.complementarity import solve_row
from softgym_envs.mechanics.solvers.equilibrium import CAUTIOUS

MAX_ITERATIONS, MAX_SEARCHES = 20, 30
"""Largest numbers of Newton iterations with whole steps, and with shortened ones in an increment."""
SHORTEST, SMALLEST_INCREMENT = 1e-3, 0.25
"""Smallest part of a Newton step, and of the way to a target within one time step."""
SLOW, STEEP = 0.1, 0.75
"""Length of a step over that of the last one. Above ``SLOW`` the factor is renewed after the step; above ``STEEP``, in
dynamics, it is renewed in place of the step."""
LONG, LONG_IN_TIME, TOO_LONG = 0.01, 0.002, 1.0
"""Length of a step: the largest turn of a frame [rad], or a motion as long. Above ``LONG``, in dynamics above
``LONG_IN_TIME``, the factor is renewed after the step; above ``TOO_LONG`` the general solver takes over."""
REMAINING, SMALLEST = 0.01, 1e-13
"""A solution is found when the next step will be shorter than this part of the tolerance, or than this length [m],
which is near rounding. Errors of a time step act on the next one through the velocities."""


class Factor(NamedTuple):
    """A factorised tangent with what follows from it, and work arrays.

    Attributes:
        half: ``L^-1 H``, shape (size, b, 6).
        drive: the same as efforts act while points slide, shape (size, b, 6); ``half`` itself for bodies that touch
            nothing.
        compliance: ``W``, shape (size, size).
        driven: inverse of its part of the driven rows, shape (d, d).
        signs: of the pivots, shape (b, 6).
        step: of the equations, shape (b, 6).
        efforts: step of the efforts, shape (size,).
        gap: of the driven rows, shape (size,).
        turned: work array of `move`, shape (3, 3).
    """

    half: np.ndarray
    drive: np.ndarray
    compliance: np.ndarray
    driven: np.ndarray
    signs: np.ndarray
    step: np.ndarray
    efforts: np.ndarray
    gap: np.ndarray
    turned: np.ndarray


class System(NamedTuple):
    """A body with its equations and their factor."""

    body: BeamBody
    equations: Equations
    factor: Factor


class Drive(NamedTuple):
    """How constraint rows are commanded.

    Attributes:
        driven: rows whose values are commanded, shape (d,).
        forced: rows whose efforts are commanded, shape (f,).
        one_way: which of the driven rows cannot push, shape (d,).
    """

    driven: np.ndarray
    forced: np.ndarray
    one_way: np.ndarray


def make_system(body: BeamBody, size: int) -> System:
    """Return a body with ``size`` constraint rows and arrays for its equations."""
    blocks = len(body.components.free)
    half = np.zeros((size, blocks, SIZE))
    factor = Factor(
        half=half,
        drive=half if body.contact is None else np.zeros_like(half),
        compliance=np.zeros((size, size)),
        driven=np.zeros((size, size)),
        signs=np.ones((blocks, SIZE)),
        step=np.zeros((blocks, SIZE)),
        efforts=np.zeros(size),
        gap=np.zeros(size),
        turned=np.zeros((3, 3)),
    )
    return System(body, make_equations(body, size), factor)


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def dot(a, b, signs):
    """Return the sum of the products of two vectors with signs, all of shape (b, 6)."""
    first, second, sign, value = a.flat, b.flat, signs.flat, 0.0
    for i in range(a.size):
        value += sign[i] * first[i] * second[i]
    return value


@njit(cache=True, error_model="numpy", _nrt=False)
def factorise_tangent(system, rows):
    """Factorise the tangent and fill ``half`` and ``W`` of constraint rows; the number of its negative eigenvalues.

    Returns -1 if there is no factor. The eigenvalues are those of the symmetric part.
    """
    body, equations, factor = system
    negative = factorise(equations.tangent, body.pattern.pointers, body.pattern.targets, factor.signs)
    if negative < 0:
        return -1
    for i in range(rows.shape[0]):
        half = factor.half[rows[i]]
        copy_values(equations.H[rows[i]], half)
        solve_lower(equations.tangent, body.pattern.pointers, body.pattern.columns, half)
        for j in range(i + 1):
            value = dot(half, factor.half[rows[j]], factor.signs)
            factor.compliance[rows[i], rows[j]] = value
            factor.compliance[rows[j], rows[i]] = value
    _factorise_slides(equations.slides, body.pattern, equations.tangent, factor, rows)
    return negative


@njit(cache=True, error_model="numpy", _nrt=True)
def _factorise_slides(slides, pattern, tangent, factor, rows):
    """Let sliding points change what follows from a factor of the symmetric part of the tangent."""
    if slides is None:
        return
    count, signs = slides.number[0], factor.signs
    for s in range(count):
        solve_lower(tangent, pattern.pointers, pattern.columns, slides.direction[s])
        solve_lower(tangent, pattern.pointers, pattern.columns, slides.loading[s])
    if count > 0:
        core = np.eye(count)
        for s in range(count):
            for t in range(count):
                core[s, t] += dot(slides.loading[s], slides.direction[t], signs)
        slides.core[:count, :count] = np.linalg.inv(core)
    for i in range(rows.shape[0]):
        drive = factor.drive[rows[i]]
        drive[:] = factor.half[rows[i]]
        slide(slides, drive, signs)
    if count > 0:
        for i in range(rows.shape[0]):
            for j in range(rows.shape[0]):
                factor.compliance[rows[i], rows[j]] = dot(factor.half[rows[i]], factor.drive[rows[j]], signs)


@njit(cache=True, error_model="numpy")
def invert_driven(factor, driven):
    """Fill the inverse of the part of ``W`` that belongs to driven rows (d,)."""
    count = driven.shape[0]
    among = np.empty((count, count))
    for i in range(count):
        for j in range(count):
            among[i, j] = factor.compliance[driven[i], driven[j]]
    factor.driven[:count, :count] = np.linalg.inv(among)


@njit(cache=True, error_model="numpy")
def correct(system, effort, target, drive):
    """Solve the linearised equations for the steps of the motions and of the efforts, as `Statics` does.

    Returns the largest displacement of the step; NaN if no set of taut actuators is consistent.
    """
    n = drive.driven.shape[0]
    total, index, is_one_way = np.empty(n), np.empty(n, dtype=np.int64), drive.one_way.any()
    return _correct(system, effort, target, drive, is_one_way, np.empty((n, n)), np.empty((n, n + 1)), total, index)


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _correct(system, effort, target, drive, is_one_way, among, a, total, index):
    """Do what `correct` says; the last four are work arrays, as in `solve_row`."""
    body, equations, factor = system
    driven, forced, one_way = drive
    step, change, W = factor.step, factor.efforts, factor.compliance
    copy_values(equations.residual, step)
    solve_lower(equations.tangent, body.pattern.pointers, body.pattern.columns, step)
    slide(equations.slides, step, factor.signs)
    for i in range(forced.shape[0]):
        change[forced[i]] = target[forced[i]] - effort[forced[i]]
    count = driven.shape[0]
    gap = factor.gap
    for i in range(count):
        row = driven[i]
        gap[i] = equations.delta[row] - target[row] - dot(factor.half[row], step, factor.signs)
        for j in range(forced.shape[0]):
            gap[i] += W[row, forced[j]] * change[forced[j]]
    if is_one_way:
        for i in range(count):
            for j in range(count):
                among[i, j] = W[driven[i], driven[j]]
                gap[i] -= among[i, j] * effort[driven[j]]
        if not solve_row(among, gap[:count], one_way, total, a, index):
            return np.nan
        for i in range(count):
            change[driven[i]] = total[i] - effort[driven[i]]
    else:
        for i in range(count):
            value = 0.0
            for j in range(count):
                value -= factor.driven[i, j] * gap[j]
            change[driven[i]] = value
    size = step.size
    flat, signs, scale = step.flat, factor.signs.flat, body.components.scale.flat
    for i in range(size):
        flat[i] = -signs[i] * flat[i]
    for c in range(change.shape[0]):
        if change[c] != 0.0:
            value, along = change[c], factor.drive[c].flat
            for i in range(size):
                flat[i] = flat[i] + value * signs[i] * along[i]
    solve_upper(equations.tangent, body.pattern.pointers, body.pattern.columns, step)
    largest = 0.0
    for i in range(size):
        largest = max(largest, abs(flat[i]) * scale[i])
        if flat[i] != flat[i]:  # NaN
            return np.nan
    return largest


@njit(cache=True, error_model="numpy", inline="always")
def _linearise(system, x, effort, step, drive, rows, definite):
    """Assemble and factorise at rows ``x``; the number of negative eigenvalues, or -1 if there is no factor.

    Only positive definite tangents count if ``definite``, or if there are ``one_way`` rows, whose complementarity needs
    them.
    """
    assemble(system.body, x, effort, step, system.equations, step.h > 0.0)  # True; a literal would compile all again
    if has_failed(system.equations.slides):
        return -1
    negative, one_way = factorise_tangent(system, rows), drive.one_way.any()
    if negative < 0 or (negative and (definite or one_way)):
        return -1
    if not one_way:
        invert_driven(system.factor, drive.driven)
    return negative


@njit(cache=True, error_model="numpy")
def solve(system, x, effort, target, drive, step, tolerance, fresh):
    """Solve the equations in place, starting at the predicted rows ``x``; the iterations, or -1 on failure.

    It starts with the factor of the last solution unless ``fresh``. It fails where a step with a new factor is longer
    than the last of them, and in dynamics where the first step with a factor is not followed by a shorter one: such
    steps are too long.
    """
    body, equations, factor = system
    rows = np.concatenate((drive.driven, drive.forced))
    static = step.h == np.inf
    before = last = np.inf
    taken = 0  # with the present factor, in this solution
    radian = body.components.scale[:, 3:].max()
    long = (LONG if static else LONG_IN_TIME) * radian
    enough = min(tolerance, max(REMAINING * tolerance, SMALLEST))
    for iteration in range(1, MAX_ITERATIONS + 1):
        if not fresh:
            assemble(body, x, effort, step, equations, fresh)
        elif _linearise(system, x, effort, step, drive, rows, static) < 0:
            return -1
        else:
            taken = 0
        length = correct(system, effort, target, drive)
        if not length <= TOO_LONG * radian:  # also true for NaN
            return -1
        ratio = length / before if iteration > 1 else 1.0
        if fresh:
            if length > last:
                return -1
            last = length
        elif iteration > 1 and ratio > (1.0 if static else STEEP) and (static or length > tolerance):
            if taken == 1 and not static:
                return -1
            fresh = True  # this step is not taken
            continue
        move(body.frames, x, factor.step, factor.turned)
        for c in range(effort.shape[0]):
            effort[c] += factor.efforts[c]
        taken += 1
        # The next step with the same factor will be shorter by about this ratio again. Where the last step was the
        # first one with it, Newton's own, by up to twice the ratio. In statics that tells nothing: the first step of a
        # slender body bends it, and what is left is stretch, for which the old factor is wrong by much more.
        known = taken != 2 or not static
        next_ratio = 2.0 * ratio if taken == 2 else ratio
        if length <= enough or (known and length * next_ratio <= enough):
            return iteration
        # In dynamics a second step with each new factor tells whether the first one was too long.
        fresh = length > long and (static or not fresh) or (iteration > 1 and not fresh and ratio > SLOW)
        before = length
    return -1


@njit(cache=True, error_model="numpy")
def _search(system, x, effort, target, drive, step, tolerance, definite):
    """Do in place what `Statics` does at one load level; the iterations, or -1 on failure.

    Steps are shortened until the next one with the same factor would be shorter. The equations are linearised at rows
    ``x``, and at those of the solution on success.
    """
    body, equations, factor = system
    rows = np.concatenate((drive.driven, drive.forced))
    begin, begin_effort, stride, pull = x.copy(), effort.copy(), factor.step.copy(), factor.efforts.copy()
    norm = correct(system, effort, target, drive)
    part = 1.0
    for iteration in range(1, MAX_SEARCHES + 1):
        if not np.isfinite(norm):
            return -1
        begin[:] = x
        begin_effort[:] = effort
        stride[:] = factor.step
        pull[:] = factor.efforts
        while True:
            x[:] = begin
            for k in range(stride.shape[0]):
                for i in range(SIZE):
                    factor.step[k, i] = part * stride[k, i]
            move(body.frames, x, factor.step, factor.turned)
            for c in range(effort.shape[0]):
                effort[c] = begin_effort[c] + part * pull[c]
            assemble(body, x, effort, step, equations, not step.h > 0.0)
            remaining = correct(system, effort, target, drive)
            if remaining <= (1.0 - 0.25 * part) * norm or remaining <= tolerance:
                break
            part *= 0.5
            if part < SHORTEST:
                return -1
        if part == 1.0 and remaining > tolerance and norm > 0.0 and remaining * remaining / norm <= 0.1 * tolerance:
            move(body.frames, x, factor.step, factor.turned)
            for c in range(effort.shape[0]):
                effort[c] += factor.efforts[c]
        if _linearise(system, x, effort, step, drive, rows, definite) < 0:
            return -1
        norm = correct(system, effort, target, drive)
        if part == 1.0 and norm <= tolerance:
            return iteration
        part = min(1.0, 2.0 * part)
    return -1


@njit(cache=True, error_model="numpy")
def approach(system, x, effort, target, drive, step, tolerance):
    """Solve the equations in place in increments, as `Statics` does; the iterations, or -1 on failure."""
    body, equations, factor = system
    driven = drive.driven
    rows = np.concatenate((driven, drive.forced))
    negative = _linearise(system, x, effort, step, drive, rows, False)
    if negative < 0:
        return -1
    held = driven.shape[0] == body.servos.number.shape[0] + body.chambers.number.shape[0]
    start, goal = effort.copy(), np.empty(effort.shape[0])
    for i in range(driven.shape[0]):
        start[driven[i]] = equations.delta[driven[i]]
    kept, kept_effort = x.copy(), effort.copy()
    done, size, iterations = 0.0, 1.0, 0
    while done < 1.0:
        level = min(1.0, done + size)
        for c in range(goal.shape[0]):
            goal[c] = start[c] + level * (target[c] - start[c])
        kept[:] = x
        kept_effort[:] = effort
        definite = held and level - done > CAUTIOUS and negative == 0
        found = _search(system, x, effort, goal, drive, step, tolerance, definite)
        if found < 0:
            x[:] = kept
            effort[:] = kept_effort
            size = 0.5 * (level - done)
            if size < SMALLEST_INCREMENT:
                return -1
            negative = _linearise(system, x, effort, step, drive, rows, False)
            if negative < 0:
                return -1
            continue
        iterations += found
        negative = 0
        for k in range(factor.signs.shape[0]):
            for i in range(SIZE):
                negative += factor.signs[k, i] < 0.0
        done = level
        size *= 1.5
    return iterations
