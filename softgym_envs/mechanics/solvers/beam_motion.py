"""Equilibria and implicit Euler steps of bodies of beams in one compiled call.

The solutions are those of `Statics` and `Dynamics`, to their tolerance; only what surrounds the arithmetic is saved.
Newton's method keeps its factor while it converges fast. Anything unusual (no convergence, in statics a tangent that is
not positive definite) ends the compiled call before that step, and the general solver takes over. In dynamics tangents
may be indefinite, because a body can be stable only as its actuators hold it. Where whole Newton steps do not converge
fast, as when a leg snaps, a time step is solved as `Statics` and `Dynamics` do: with parts of them, in increments, and
in halves.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from softgym_envs.mechanics.assembly import MassMatrix
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.beam_body import beam_body, is_beam_body
from softgym_envs.mechanics.solvers.beam_equations import (
    Step,
    add_constraints,
    assemble,
    drag_work,
    make_equations,
    motion_of,
    move,
    multiply_mass,
    point_strains,
)
from softgym_envs.mechanics.solvers.block_cholesky import SIZE, factorise, solve_lower, solve_upper
from softgym_envs.mechanics.solvers.complementarity import solve_row
from softgym_envs.mechanics.solvers.equilibrium import CAUTIOUS, SATURATED

MAX_ITERATIONS, MAX_SEARCHES = 20, 30
"""Newton iterations with whole steps, and with shortened ones, after which they fail."""
SHORTEST, SMALLEST_INCREMENT = 1e-3, 0.25
"""Smallest part of a step of Newton's method, and of the way to a target within one time step."""
SLOW, STEEP = 0.1, 0.75
"""A step longer than this part of the last one calls for a new factor; or in dynamics for shorter steps."""
LONG, TOO_LONG = 0.01, 1.0
"""Steps that turn a frame by more [rad], or move it as far, call for a new factor in statics; or the general solver."""
INCREMENTS = 4
"""In statics, a step that is too long for Newton's method is divided once into this number of increments."""
REMAINING, SMALLEST = 0.01, 1e-13
"""The next step must be shorter than this part of the tolerance, or than this length [m], which is near rounding.
Errors of a time step act on the next one through the velocities."""


class Factor(NamedTuple):
    """A factorised tangent with what follows from it, and work arrays.

    Attributes:
        half: ``L^-1 H``, shape (size, b, 6).
        compliance: ``W``, shape (size, size).
        driven: inverse of its part of the driven rows, shape (d, d).
        signs: of the pivots, shape (b, 6).
        step: of the equations, shape (b, 6).
        efforts: step of the efforts, shape (size,).
        turned: work array of `move`, shape (3, 3).
    """

    half: np.ndarray
    compliance: np.ndarray
    driven: np.ndarray
    signs: np.ndarray
    step: np.ndarray
    efforts: np.ndarray
    turned: np.ndarray


def make_factor(blocks: int, size: int) -> Factor:
    """Return arrays for a body with ``blocks`` movable frames and ``size`` constraint rows."""
    return Factor(
        half=np.zeros((size, blocks, SIZE)),
        compliance=np.zeros((size, size)),
        driven=np.zeros((size, size)),
        signs=np.ones((blocks, SIZE)),
        step=np.zeros((blocks, SIZE)),
        efforts=np.zeros(size),
        turned=np.zeros((3, 3)),
    )


class MarchedSteps(NamedTuple):
    """Time steps, or increments towards an equilibrium, that were taken in one call.

    Attributes:
        taken: how many of them were taken.
        solved: whether all were.
        x: rows at the end [m], shape (n, 3).
        velocity: of the rows [m/s], shape (n, 3).
        effort: of all constraint rows, shape (size,).
        delta: their values, shape (size,).
        compliance: ``W`` at the end, shape (size, size).
        kinetic: kinetic energy at the end [J].
        elastic: elastic energy at the end [J].
        work: done by efforts on these steps [J].
        dissipated: by damping on these steps [J].
        iterations: Newton iterations of the last time step.
        stable: whether the tangent at the end is positive definite.
        parts: of the last time step.
    """

    taken: int
    solved: bool
    x: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    delta: np.ndarray
    compliance: np.ndarray
    kinetic: float
    elastic: float
    work: float
    dissipated: float
    iterations: int
    stable: bool
    parts: int


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _dot(a, b, signs):
    """Return the sum of the products of two vectors with signs, all of shape (b, 6)."""
    value = 0.0
    for k in range(a.shape[0]):
        for i in range(SIZE):
            value += signs[k, i] * a[k, i] * b[k, i]
    return value


@njit(cache=True, error_model="numpy")
def _factorise(body, equations, factor, rows):
    """Factorise the tangent and fill ``half`` and ``W`` of constraint rows; the number of its negative eigenvalues.

    Returns -1 if there is no factor.
    """
    negative = factorise(equations.tangent, body.pattern.pointers, body.pattern.targets, factor.signs)
    if negative < 0:
        return -1
    for i in range(rows.shape[0]):
        half = factor.half[rows[i]]
        half[:] = equations.H[rows[i]]
        solve_lower(equations.tangent, body.pattern.pointers, body.pattern.columns, half)
        for j in range(i + 1):
            value = _dot(half, factor.half[rows[j]], factor.signs)
            factor.compliance[rows[i], rows[j]] = value
            factor.compliance[rows[j], rows[i]] = value
    return negative


@njit(cache=True, error_model="numpy")
def _correct(body, equations, factor, effort, target, driven, forced, one_way):
    """Solve the linearised equations for the steps of the motions and of the efforts, as `Statics` does.

    Returns the largest displacement of the step; NaN if no set of taut actuators is consistent.
    """
    step, change, W = factor.step, factor.efforts, factor.compliance
    step[:] = equations.residual
    solve_lower(equations.tangent, body.pattern.pointers, body.pattern.columns, step)
    for i in range(forced.shape[0]):
        change[forced[i]] = target[forced[i]] - effort[forced[i]]
    count = driven.shape[0]
    gap = np.empty(count)
    for i in range(count):
        row = driven[i]
        gap[i] = equations.delta[row] - target[row] - _dot(factor.half[row], step, factor.signs)
        for j in range(forced.shape[0]):
            gap[i] += W[row, forced[j]] * change[forced[j]]
    if one_way.any():
        among = np.empty((count, count))
        for i in range(count):
            for j in range(count):
                among[i, j] = W[driven[i], driven[j]]
                gap[i] -= among[i, j] * effort[driven[j]]
        total = np.empty(count)
        if not solve_row(among, gap, one_way, total, np.empty((count, count + 1)), np.empty(count, dtype=np.int64)):
            return np.nan
        for i in range(count):
            change[driven[i]] = total[i] - effort[driven[i]]
    else:
        for i in range(count):
            value = 0.0
            for j in range(count):
                value -= factor.driven[i, j] * gap[j]
            change[driven[i]] = value
    for k in range(step.shape[0]):
        for i in range(SIZE):
            step[k, i] = -step[k, i]
    for c in range(change.shape[0]):
        if change[c] != 0.0:
            half = factor.half[c]
            for k in range(step.shape[0]):
                for i in range(SIZE):
                    step[k, i] += change[c] * half[k, i]
    for k in range(step.shape[0]):
        for i in range(SIZE):
            step[k, i] *= factor.signs[k, i]
    solve_upper(equations.tangent, body.pattern.pointers, body.pattern.columns, step)
    largest, scale = 0.0, body.components.scale
    for k in range(step.shape[0]):
        for i in range(SIZE):
            largest = max(largest, abs(step[k, i]) * scale[k, i])
    return largest


@njit(cache=True, error_model="numpy")
def _linearise(body, x, effort, step, equations, factor, driven, rows, one_way, definite):
    """Assemble and factorise at rows ``x``; the number of negative eigenvalues, or -1 if there is no factor.

    Only positive definite tangents count if ``definite``, or if there are ``one_way`` rows, whose complementarity needs
    them.
    """
    assemble(body, x, effort, step, equations, True)
    negative = _factorise(body, equations, factor, rows)
    if negative < 0 or (negative and (definite or one_way.any())):
        return -1
    if not one_way.any():
        count = driven.shape[0]
        among = np.empty((count, count))
        for i in range(count):
            for j in range(count):
                among[i, j] = factor.compliance[driven[i], driven[j]]
        factor.driven[:count, :count] = np.linalg.inv(among)
    return negative


@njit(cache=True, error_model="numpy")
def _solve(body, x, effort, target, driven, forced, one_way, step, equations, factor, tolerance, fresh):
    """Solve the equations in place, starting at the predicted rows ``x``; the iterations, or -1 on failure.

    It starts with the factor of the last solution unless ``fresh``, and fails where a step with a new factor is longer
    than the last of them; in dynamics, where any step is not much shorter than the last one. ``one_way`` (d,) are
    driven rows that cannot push.
    """
    rows = np.concatenate((driven, forced))
    definite = step.h == np.inf
    before = last = np.inf
    kept = not fresh
    radian = body.components.scale[:, 3:].max()
    long = LONG * radian if step.h == np.inf else np.inf
    enough = min(tolerance, max(REMAINING * tolerance, SMALLEST))
    for iteration in range(1, MAX_ITERATIONS + 1):
        if not fresh:
            assemble(body, x, effort, step, equations, False)
        elif _linearise(body, x, effort, step, equations, factor, driven, rows, one_way, definite) < 0:
            return -1
        length = _correct(body, equations, factor, effort, target, driven, forced, one_way)
        if not length <= TOO_LONG * radian:  # also true for NaN
            return -1
        ratio = length / before
        if step.h < np.inf and ratio > STEEP and length > tolerance:
            return -1
        if fresh:
            if length > last:
                return -1
            last = length
        elif ratio > 1.0:
            fresh = True  # this step is not taken
            continue
        move(body.frames, x, factor.step, factor.turned)
        for c in range(effort.shape[0]):
            effort[c] += factor.efforts[c]
        # Two steps in a row with one factor, or the last new factor, tell how much shorter the next step will be.
        known = iteration > 1 and (fresh or kept)
        if length <= enough or (known and length * ratio <= enough):
            return iteration
        kept = not fresh
        fresh = length > long or (iteration > 1 and ratio > SLOW)
        before = length
    return -1


@njit(cache=True, error_model="numpy")
def _search(body, x, effort, target, driven, forced, one_way, step, equations, factor, tolerance, definite):
    """Do in place what `Statics` does at one load level; the iterations, or -1 on failure.

    Steps are shortened until the next one with the same factor would be shorter. The equations are linearised at rows
    ``x``, and at those of the solution on success.
    """
    rows = np.concatenate((driven, forced))
    begin, begin_effort, stride, pull = x.copy(), effort.copy(), factor.step.copy(), factor.efforts.copy()
    norm = _correct(body, equations, factor, effort, target, driven, forced, one_way)
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
            assemble(body, x, effort, step, equations, False)
            remaining = _correct(body, equations, factor, effort, target, driven, forced, one_way)
            if remaining <= (1.0 - 0.25 * part) * norm or remaining <= tolerance:
                break
            part *= 0.5
            if part < SHORTEST:
                return -1
        if part == 1.0 and remaining > tolerance and norm > 0.0 and remaining * remaining / norm <= 0.1 * tolerance:
            move(body.frames, x, factor.step, factor.turned)
            for c in range(effort.shape[0]):
                effort[c] += factor.efforts[c]
        if _linearise(body, x, effort, step, equations, factor, driven, rows, one_way, definite) < 0:
            return -1
        norm = _correct(body, equations, factor, effort, target, driven, forced, one_way)
        if part == 1.0 and norm <= tolerance:
            return iteration
        part = min(1.0, 2.0 * part)
    return -1


@njit(cache=True, error_model="numpy")
def _approach(body, x, effort, target, driven, forced, one_way, step, equations, factor, tolerance):
    """Solve the equations in place in increments, as `Statics` does; the iterations, or -1 on failure."""
    rows = np.concatenate((driven, forced))
    negative = _linearise(body, x, effort, step, equations, factor, driven, rows, one_way, False)
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
        found = _search(body, x, effort, goal, driven, forced, one_way, step, equations, factor, tolerance, definite)
        if found < 0:
            x[:] = kept
            effort[:] = kept_effort
            size = 0.5 * (level - done)
            if size < SMALLEST_INCREMENT:
                return -1
            negative = _linearise(body, x, effort, step, equations, factor, driven, rows, one_way, False)
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


@njit(cache=True, error_model="numpy")
def _advance(
    body,
    equations,
    factor,
    start,
    x,
    velocity,
    effort,
    delta,
    target,
    driven,
    forced,
    one_way,
    loads,
    h,
    alpha,
    beta,
    tolerance,
    totals,
    fresh,
    easy,
    thorough,
    finish,
):
    """Take one time step in place; whether that succeeds.

    It is tried with the factor of the last step unless ``fresh``, with whole steps if ``easy``, and then with shortened
    ones if ``thorough``. For the other arguments see `_march`.
    """
    size = effort.shape[0]
    kept, kept_velocity, kept_effort = x.copy(), velocity.copy(), effort.copy()
    point_strains(body.elements, x, start)
    step = Step(kept, kept_velocity, start, loads, h, alpha, beta)
    if h < np.inf:  # start from where the current velocity leads
        motion_of(body.frames, body.components.free, x, velocity, h, factor.step)
        move(body.frames, x, factor.step, factor.turned)
    predicted = x.copy()
    iterations = -1
    if easy:
        system = (driven, forced, one_way, step, equations, factor, tolerance)
        iterations = _solve(body, x, effort, target, *system, fresh)
        if iterations < 0 and h < np.inf and not fresh:
            x[:] = predicted
            effort[:] = kept_effort
            iterations = _solve(body, x, effort, target, *system, True)
    if iterations < 0 and thorough:
        x[:] = predicted
        effort[:] = kept_effort
        iterations = _approach(body, x, effort, target, driven, forced, one_way, step, equations, factor, tolerance)
    if iterations < 0:
        return False
    # At the end of the step: all compliances where they are asked for, else values and energies alone.
    if finish:
        assemble(body, x, effort, step, equations, True)
        negative = _factorise(body, equations, factor, np.arange(size))
        totals[5] = negative
        if negative < 0 or (negative and h == np.inf):
            return False
    else:
        add_constraints(body, x, effort, equations, False)
    totals[1], totals[4] = equations.energy[0], iterations
    if h == np.inf:
        return True
    for i in range(x.shape[0]):
        for d in range(3):
            velocity[i, d] = (x[i, d] - kept[i, d]) / h
    for c in range(size):
        totals[2] += 0.5 * (kept_effort[c] + effort[c]) * (equations.delta[c] - delta[c])
    delta[:] = equations.delta
    momentum = equations.momentum
    momentum[:] = 0.0
    multiply_mass(body.masses, velocity, momentum)
    kinetic = 0.0
    for i in range(x.shape[0]):
        for d in range(3):
            kinetic += 0.5 * velocity[i, d] * momentum[i, d]
    totals[0] = kinetic
    totals[3] += drag_work(body.elements, x, step) + 2.0 * alpha * h * kinetic
    return True


@njit(cache=True, error_model="numpy")
def _march(
    body,
    equations,
    factor,
    start,
    x,
    velocity,
    effort,
    delta,
    targets,
    driven,
    forced,
    one_way,
    limit,
    loads,
    h,
    alpha,
    beta,
    tolerance,
    cuts,
    totals,
    finish,
):
    """Take time steps in place until one fails or exceeds a limit, which is undone; the number of steps taken.

    A time step that fails is halved up to ``cuts`` times, along with the way to its target. ``totals`` (7,) receives
    kinetic and elastic energy, work, dissipation, the iterations of the last step, the number of negative eigenvalues
    of the tangent at its end, and the number of its parts. Only if ``finish``, this one and the compliances are those
    at the end of the last step.
    """
    kept, kept_velocity, kept_effort, kept_totals = x.copy(), velocity.copy(), effort.copy(), totals.copy()
    first, goal = np.empty(effort.shape[0]), np.empty(effort.shape[0])
    add_constraints(body, x, effort, equations, False)
    delta[:] = equations.delta
    kept_delta = delta.copy()
    fresh = True
    for k in range(targets.shape[0]):
        kept[:] = x
        kept_effort[:] = effort
        kept_velocity[:] = velocity
        kept_delta[:] = delta
        kept_totals[:] = totals
        first[:] = effort
        for i in range(driven.shape[0]):
            first[driven[i]] = delta[driven[i]]
        parts, good = 1, False
        for cut in range(cuts + 1):
            parts = 2**cut
            for j in range(parts):
                for c in range(goal.shape[0]):
                    goal[c] = targets[k, c]
                    if j < parts - 1:
                        goal[c] = first[c] + (j + 1) / parts * (goal[c] - first[c])
                good = _advance(
                    body,
                    equations,
                    factor,
                    start,
                    x,
                    velocity,
                    effort,
                    delta,
                    goal,
                    driven,
                    forced,
                    one_way,
                    loads,
                    h / parts,
                    alpha,
                    beta,
                    tolerance,
                    totals,
                    fresh,
                    parts == 1,
                    cuts > 0,
                    finish and k == targets.shape[0] - 1 and j == parts - 1,
                )
                fresh = False
                if not good:
                    break
            if good:
                break
            fresh = True  # the duration changes
            x[:] = kept
            effort[:] = kept_effort
            velocity[:] = kept_velocity
            delta[:] = kept_delta
            totals[:] = kept_totals
        fresh = fresh or parts > 1
        totals[6] = parts
        for i in range(limit.shape[0]):
            good = good and abs(effort[i]) <= limit[i]
        if not good:
            x[:] = kept
            effort[:] = kept_effort
            velocity[:] = kept_velocity
            totals[:] = kept_totals
            return k
    return targets.shape[0]


@njit(cache=True, error_model="numpy")
def drive(
    body,
    equations,
    factor,
    start,
    x,
    velocity,
    effort,
    delta,
    targets,
    is_driven,
    unilateral,
    limit,
    loads,
    h,
    alpha,
    beta,
    tolerance,
    cuts,
    totals,
):
    """Take time steps as `_march`, in which driven actuators stop at their largest effort ``limit`` (l,).

    An actuator that would exceed its limit is driven by that effort instead, until its command asks for less than it
    has reached. Returns the number of steps taken.
    """
    count, steps = limit.shape[0], targets.shape[0]
    driven, forced = np.flatnonzero(is_driven), np.flatnonzero(~is_driven)
    one_way = np.zeros(driven.shape[0], dtype=np.bool_)
    for i in range(driven.shape[0]):
        one_way[i] = unilateral[driven[i]]
    bound = np.full(count, np.inf)
    for i in range(count):
        if is_driven[i]:
            bound[i] = limit[i]
    free, sign = is_driven.copy(), np.zeros(count)
    kept, kept_velocity, kept_effort, kept_totals = x.copy(), velocity.copy(), effort.copy(), totals.copy()
    taken = 0
    while taken < steps:
        saturated = False
        for i in range(count):
            sign[i] = np.sign(effort[i])
            free[i] = is_driven[i] and abs(effort[i]) < SATURATED * bound[i]
            saturated = saturated or free[i] != is_driven[i]
        if not saturated:
            done = _march(
                body,
                equations,
                factor,
                start,
                x,
                velocity,
                effort,
                delta,
                targets[taken:],
                driven,
                forced,
                one_way,
                bound,
                loads,
                h,
                alpha,
                beta,
                tolerance,
                cuts,
                totals,
                True,
            )
            taken += done
            if done or count == 0:
                if done == 0:
                    return taken
                continue
        # One step, with the set of saturated actuators that is consistent.
        kept[:] = x
        kept_velocity[:] = velocity
        kept_effort[:] = effort
        kept_totals[:] = totals
        consistent = False
        for attempt in range(2 * count + 2):
            target = targets[taken : taken + 1].copy()
            for i in range(count):
                if is_driven[i] and not free[i]:
                    target[0, i] = sign[i] * bound[i]
            among = np.flatnonzero(free)
            way = np.zeros(among.shape[0], dtype=np.bool_)
            for i in range(among.shape[0]):
                way[i] = unilateral[among[i]]
            done = _march(
                body,
                equations,
                factor,
                start,
                x,
                velocity,
                effort,
                delta,
                target,
                among,
                np.flatnonzero(~free),
                way,
                np.zeros(0),
                loads,
                h,
                alpha,
                beta,
                tolerance,
                cuts,
                totals,
                taken == steps - 1,
            )
            if not done:
                break
            consistent = True
            for i in range(count):
                if free[i] and abs(effort[i]) > bound[i]:
                    free[i], sign[i], consistent = False, np.sign(effort[i]), False
                elif is_driven[i] and not free[i]:
                    # Stop releasing actuators after a while, so that the loop terminates.
                    behind = sign[i] * (targets[taken, i] - equations.delta[i]) < 0.0
                    if behind and attempt <= count:
                        free[i], consistent = True, False
            if consistent:
                break
            x[:] = kept
            velocity[:] = kept_velocity
            effort[:] = kept_effort
            totals[:] = kept_totals
        if not consistent:
            x[:] = kept
            velocity[:] = kept_velocity
            effort[:] = kept_effort
            totals[:] = kept_totals
            return taken
        taken += 1
    return taken


class BeamMotion:
    """Time steps and equilibria of a body of beams.

    Args:
        model: a model for which `is_beam_body` holds.
        mass: its mass matrix.
    """

    def __init__(self, model: MechanicalModel, mass: MassMatrix) -> None:
        self.body = beam_body(model, mass)
        self.elasticity_version = model.elasticity_version
        size, count = model.assembly.size, len(self.body.components.free)
        self.equations = make_equations(self.body, size)
        self._factor = make_factor(count, size)
        self._strains = np.zeros((len(self.body.elements.frames), 2, 6))

    @classmethod
    def of(cls, model: MechanicalModel, mass: MassMatrix) -> BeamMotion | None:
        """Return the compiled time steps of a model, or None for a model that needs the general solver."""
        return cls(model, mass) if is_beam_body(model) else None

    def march(
        self,
        x: np.ndarray,
        velocity: np.ndarray,
        effort: np.ndarray,
        targets: np.ndarray,
        is_driven: np.ndarray,
        unilateral: np.ndarray,
        *,
        limit: np.ndarray,
        loads: np.ndarray,
        step: float,
        mass_damping: float,
        stiffness_damping: float,
        tolerance: float,
        cuts: int = 0,
    ) -> MarchedSteps:
        """Take time steps until one cannot be solved; driven actuators stop at their largest effort.

        Args:
            x: rows at the start [m], shape (n, 3).
            velocity: of the rows [m/s], shape (n, 3).
            effort: of all constraint rows, shape (size,).
            targets: values of driven rows and efforts of all others at the end of each step, shape (k, size).
            is_driven: rows whose values are commanded, mask of shape (size,).
            unilateral: first rows, of the actuators, that cannot push, mask of shape (n_a,).
            limit: largest efforts of the first rows where their values are commanded, shape (l,).
            loads: dead loads [N], shape (n, 3).
            step: duration of one time step [s].
            mass_damping: Rayleigh's alpha [1/s].
            stiffness_damping: Rayleigh's beta [s].
            tolerance: largest remaining correction of any row [m].
            cuts: how often a time step that cannot be solved is halved.
        """
        x, velocity, effort, delta = x.copy(), velocity.copy(), effort.copy(), np.empty(len(effort))
        totals = np.zeros(7)
        count = drive(
            self.body,
            self.equations,
            self._factor,
            self._strains,
            x,
            velocity,
            effort,
            delta,
            targets,
            is_driven,
            unilateral,
            limit,
            loads,
            step,
            mass_damping,
            stiffness_damping,
            tolerance,
            cuts,
            totals,
        )
        kinetic, elastic, work, dissipated, iterations, negative, parts = totals.tolist()
        delta = self.equations.delta.copy() if count else delta
        return MarchedSteps(
            count,
            count == len(targets),
            x,
            velocity,
            effort,
            delta,
            self._factor.compliance.copy(),
            kinetic,
            elastic,
            work,
            dissipated,
            int(iterations),
            negative == 0,
            int(parts),
        )

    def balance(
        self,
        x: np.ndarray,
        effort: np.ndarray,
        target: np.ndarray,
        driven: np.ndarray,
        unilateral: np.ndarray,
        *,
        loads: np.ndarray,
        tolerance: float,
    ) -> MarchedSteps:
        """Find the equilibrium near a state; no step is taken if Newton's method fails, or if it is not stable.

        Args:
            x: rows at the start [m], shape (n, 3).
            effort: of all constraint rows, shape (size,).
            target: values of driven rows and efforts of all others, shape (size,).
            driven: rows whose values are commanded, shape (d,).
            unilateral: first rows, of the actuators, that cannot push, mask of shape (n_a,).
            loads: dead loads [N], shape (n, 3).
            tolerance: largest remaining correction of any row [m].
        """
        is_driven = np.zeros(len(effort), dtype=bool)
        is_driven[driven] = True
        still = np.zeros_like(x)
        targets = target[None]
        for _ in range(2):
            found = self.march(
                x,
                still,
                effort,
                targets,
                is_driven,
                unilateral,
                limit=np.zeros(0),
                loads=loads,
                step=np.inf,  # without inertia and damping
                mass_damping=0.0,
                stiffness_damping=0.0,
                tolerance=tolerance,
            )
            if found.solved:
                break
            add_constraints(self.body, x, effort, self.equations, False)
            start = np.where(is_driven, self.equations.delta, effort)
            targets = start + np.arange(1, INCREMENTS + 1)[:, None] / INCREMENTS * (target - start)
            targets[-1] = target
        return found
