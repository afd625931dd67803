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

from softgym_envs.mechanics.assembly import MassMatrix
from softgym_envs.mechanics.compilation import njit
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
    orthonormalise,
    point_strains,
)
from softgym_envs.mechanics.solvers.beam_newton import approach, factorise_tangent, invert_driven, make_factor, solve
from softgym_envs.mechanics.solvers.equilibrium import SATURATED

INCREMENTS = 4
"""In statics, a step that is too long for Newton's method is divided once into this number of increments."""


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
        iterations = solve(body, x, effort, target, *system, fresh)
        if iterations < 0 and h < np.inf and not fresh:
            x[:] = predicted
            effort[:] = kept_effort
            iterations = solve(body, x, effort, target, *system, True)
    if iterations < 0 and thorough:
        x[:] = predicted
        effort[:] = kept_effort
        iterations = approach(body, x, effort, target, driven, forced, one_way, step, equations, factor, tolerance)
    if iterations < 0:
        return False
    # At the end of the step: all compliances where they are asked for, else values and energies alone.
    if finish:
        assemble(body, x, effort, step, equations, True)
        negative = factorise_tangent(body, equations, factor, np.arange(size))
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
    known,
):
    """Take time steps in place until one fails or exceeds a limit, which is undone; the number of steps taken.

    A time step that fails is halved up to ``cuts`` times, along with the way to its target. ``totals`` (7,) receives
    kinetic and elastic energy, work, dissipation, the iterations of the last step, the number of negative eigenvalues
    of the tangent at its end, and the number of its parts. Only if ``finish``, this one and the compliances are those
    at the end of the last step. ``known`` says that ``factor`` is that of the tangent at the start, with ``W`` of all
    rows and for the same ``h``.
    """
    kept, kept_velocity, kept_effort, kept_totals = x.copy(), velocity.copy(), effort.copy(), totals.copy()
    first, goal = np.empty(effort.shape[0]), np.empty(effort.shape[0])
    orthonormalise(body.frames, x)
    add_constraints(body, x, effort, equations, False)
    delta[:] = equations.delta
    kept_delta = delta.copy()
    fresh = not known
    if known:
        invert_driven(factor, driven)
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
    known,
):
    """Take time steps as `_march`, in which driven actuators stop at their largest effort ``limit`` (l,).

    An actuator that would exceed its limit is driven by that effort instead, until its command asks for less than it
    has reached. Returns the number of steps taken, all of them only with the factor of the tangent at the end.
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
                known and taken == 0 and not one_way.any(),
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
                False,
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
            False,  # what follows from a state must not depend on what was computed before
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
