"""Equilibria and implicit Euler steps of bodies of beams in one compiled call.

The solutions are those of `Statics` and `Dynamics`, to their tolerance; only what surrounds the arithmetic is saved.
Newton's method keeps its factor while it converges fast. Anything unusual (no convergence, in statics a tangent that is
not positive definite) ends the compiled call before that step, and the general solver takes over. In dynamics tangents
may be indefinite, because a body can be stable only as its actuators hold it. Where whole Newton steps do not converge
fast, as when a leg snaps, a time step is solved as `Statics` and `Dynamics` do: with parts of them, in increments, and
in halves.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import types
from numba.extending import overload

from softgym_envs.extensions.beams.solver.block_cholesky import SIZE, copy_values
from softgym_envs.extensions.beams.solver.body import beam_body, reason_for_general
from softgym_envs.extensions.beams.solver.contact import (
    Slides,
    commit,
    forget_near,
    free_part,
    has_failed,
    touching,
)
from softgym_envs.extensions.beams.solver.equations import (
    Step,
    add_constraints,
    assemble,
    drag_work,
    multiply_mass,
    point_strains,
    strain_work,
)
from softgym_envs.extensions.beams.solver.frames import motion_of, move, orthonormalise
from softgym_envs.extensions.beams.solver.newton import (
    Drive,
    approach,
    factorise_tangent,
    invert_driven,
    make_system,
    solve,
)
from softgym_envs.extensions.beams.solver.points import ContactPoints
from softgym_envs.extensions.beams.solver.touching import solve_touching
from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.contact.obstacles import MeshObstacle
from softgym_envs.mechanics.solvers.compiled import CompiledSolver, MarchedSteps
from softgym_envs.mechanics.solvers.equilibrium import SATURATED

if TYPE_CHECKING:  # kernels do not depend on them, see `compilation`
    from softgym_envs.mechanics.assembly import MassMatrix
    from softgym_envs.mechanics.contact.contact import Contact, ContactMemory, Contacts
    from softgym_envs.mechanics.model import MechanicalModel
    from softgym_envs.robots.base import Robot

INCREMENTS = 4
"""In statics, a step that is too long for Newton's method is divided once into this number of increments."""


class BeamState(NamedTuple):
    """What a step changes.

    Attributes:
        x: rows [m], shape (n, 3).
        velocity: of the rows [m/s], shape (n, 3).
        effort: of all constraint rows, shape (size,).
        delta: their values, shape (size,).
        anchors: of friction springs [m], shape (o, p, 3); None for a body that touches nothing.
        totals: kinetic and stored energy, work, dissipation, the iterations of the last time step, the number of
            negative eigenvalues of the tangent at its end, and the number of its parts, shape (7,).
    """

    x: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    delta: np.ndarray
    anchors: np.ndarray | None
    totals: np.ndarray


class Stepping(NamedTuple):
    """How time steps are taken.

    Attributes:
        loads: dead loads [N], shape (n, 3).
        h: duration of a step [s]; infinite for equilibria.
        mass_damping: Rayleigh's alpha [1/s].
        stiffness_damping: Rayleigh's beta [s].
        tolerance: largest remaining correction of any row [m].
        cuts: how often a time step that cannot be solved is halved, along with the way to its target.
    """

    loads: np.ndarray
    h: float
    mass_damping: float
    stiffness_damping: float
    tolerance: float
    cuts: int


def _copied(array):
    """Return a copy of an array, or None."""
    return None if array is None else array.copy()


@overload(_copied)
def _compiled_copied(array):
    """Choose when a kernel is compiled: what might be None or an array would have everything compiled again."""
    if isinstance(array, types.NoneType):
        return lambda array: None
    return lambda array: array.copy()


@njit(cache=True, error_model="numpy")
def _put_back(array, kept):
    """Give an array its former values; None has none."""
    if array is None:
        return
    array[:] = kept


@njit(cache=True, error_model="numpy")
def copy_state(state):
    """Return a copy of a state."""
    return BeamState(
        state.x.copy(),
        state.velocity.copy(),
        state.effort.copy(),
        state.delta.copy(),
        _copied(state.anchors),
        state.totals.copy(),
    )


@njit(cache=True, error_model="numpy")
def restore_state(state, kept):
    """Give a state the values of its copy."""
    state.x[:] = kept.x
    state.velocity[:] = kept.velocity
    state.effort[:] = kept.effort
    state.delta[:] = kept.delta
    _put_back(state.anchors, kept.anchors)
    state.totals[:] = kept.totals


@njit(cache=True, error_model="numpy", _nrt=False)
def _predict(contact, slides, body, factor, start, x):
    """Move rows ``x`` as far along the step of ``factor`` as no point enters an obstacle."""
    move(body.frames, x, factor.step, factor.turned)
    if contact is None:
        return
    while True:
        part = free_part(contact, slides, start, x)
        if part == 1.0:
            return
        for k in range(factor.step.shape[0]):
            for i in range(SIZE):
                factor.step[k, i] *= part
        copy_values(start, x)
        move(body.frames, x, factor.step, factor.turned)


@njit(cache=True, error_model="numpy")
def _find_free(system, x, effort, target, drive, step, stepping, fresh, easy):
    """Solve the equations of a time step of a body that touches nothing; the iterations, or -1 on failure."""
    h, tolerance = step.h, stepping.tolerance
    predicted, kept_effort = x.copy(), effort.copy()
    iterations = -1
    if easy:
        iterations = solve(system, x, effort, target, drive, step, tolerance, fresh)
        if iterations < 0 and h < np.inf and not fresh:
            x[:] = predicted
            effort[:] = kept_effort
            iterations = solve(system, x, effort, target, drive, step, tolerance, True)
    if iterations < 0 and stepping.cuts > 0:
        x[:] = predicted
        effort[:] = kept_effort
        iterations = approach(system, x, effort, target, drive, step, tolerance)
    return iterations


def _find(system, x, effort, target, drive, step, stepping, fresh, easy):
    """Solve the equations of one time step from the predicted rows; the iterations, or -1 on failure."""
    if system.body.contact is None:
        return _find_free(system, x, effort, target, drive, step, stepping, fresh, easy)
    return solve_touching(system, x, effort, target, drive, step, stepping.tolerance, fresh)


@overload(_find, inline="always")
def _compiled_find(system, x, effort, target, drive, step, stepping, fresh, easy):
    """Choose when a kernel is compiled: with contact, the other method would double the time of compilation."""
    if isinstance(system.types[0].types[system.types[0].fields.index("contact")], types.NoneType):
        return lambda system, x, effort, target, drive, step, stepping, fresh, easy: _find_free(
            system, x, effort, target, drive, step, stepping, fresh, easy
        )
    return lambda system, x, effort, target, drive, step, stepping, fresh, easy: solve_touching(
        system, x, effort, target, drive, step, stepping.tolerance, fresh
    )


@njit(cache=True, error_model="numpy")
def _advance(system, strains, state, target, drive, stepping, h, fresh, easy, finish):
    """Take one time step of duration ``h`` in place; whether that succeeds.

    It is tried with the factor of the last step unless ``fresh``, with whole steps if ``easy``, and then with shortened
    ones if time steps may be halved. For the other arguments see `march_rows`.
    """
    body, equations, factor = system
    x, velocity, effort, delta, totals = state.x, state.velocity, state.effort, state.delta, state.totals
    alpha, size = stepping.mass_damping, effort.shape[0]
    start, kept_effort = x.copy(), effort.copy()
    point_strains(body.elements, x, strains)
    step = Step(start, velocity.copy(), strains, stepping.loads, h, alpha, stepping.stiffness_damping, state.anchors)
    if h < np.inf:  # start from where the current velocity leads
        motion_of(body.frames, body.components.free, x, velocity, h, factor.step)
        _predict(body.contact, equations.slides, body, factor, start, x)
    iterations = _find(system, x, effort, target, drive, step, stepping, fresh, easy)
    if iterations < 0:
        return False
    # At the end of the step: all compliances where they are asked for, else values and energies alone.
    # With a literal in place of ``finish``, everything would be compiled again.
    if finish:
        assemble(body, x, effort, step, equations, finish)
        if has_failed(equations.slides):
            return False
        negative = factorise_tangent(system, np.arange(size))
        totals[5] = negative
        if negative < 0 or (negative and h == np.inf):
            return False
    else:
        add_constraints(body, x, effort, equations, finish)
    totals[1], totals[4] = equations.energy[0], iterations
    if h == np.inf:
        return True
    for i in range(x.shape[0]):
        for d in range(3):
            velocity[i, d] = (x[i, d] - start[i, d]) / h
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
    totals[1], drag = strain_work(body.elements, x, step, equations.work)
    totals[3] += drag + drag_work(body.elements, x, step, equations.work) + 2.0 * alpha * h * kinetic
    commit(body.contact, equations.slides, x, state.anchors, totals)
    return True


@njit(cache=True, error_model="numpy")
def march_rows(system, strains, state, targets, drive, limit, stepping, finish, known):
    """Take time steps in place until one fails or exceeds a limit, which is undone; the number of steps taken.

    Only if ``finish``, the compliances and the number of negative eigenvalues are those at the end of the last step.
    ``known`` says that the factor is that of the tangent at the start, with ``W`` of all rows and for the same duration
    of a step.
    """
    kept, effort = copy_state(state), state.effort
    first, goal = np.empty(effort.shape[0]), np.empty(effort.shape[0])
    orthonormalise(system.body.frames, state.x)
    forget_near(system.equations.slides)
    without = not stepping.h > 0.0  # no literal, for which everything would be compiled again
    add_constraints(system.body, state.x, effort, system.equations, without)
    state.delta[:] = system.equations.delta
    fresh = not known
    if known:
        invert_driven(system.factor, drive.driven)
    for k in range(targets.shape[0]):
        restore_state(kept, state)
        first[:] = effort
        for i in range(drive.driven.shape[0]):
            first[drive.driven[i]] = state.delta[drive.driven[i]]
        parts, good = 1, False
        for cut in range(stepping.cuts + 1):
            parts = 2**cut
            for j in range(parts):
                for c in range(goal.shape[0]):
                    goal[c] = targets[k, c]
                    if j < parts - 1:
                        goal[c] = first[c] + (j + 1) / parts * (goal[c] - first[c])
                last = finish and k == targets.shape[0] - 1 and j == parts - 1
                h = stepping.h / parts
                good = _advance(system, strains, state, goal, drive, stepping, h, fresh, parts == 1, last)
                fresh = False
                if not good:
                    break
            if good:
                break
            fresh = True  # the duration changes
            restore_state(state, kept)
        fresh = fresh or parts > 1
        state.totals[6] = parts
        for i in range(limit.shape[0]):
            good = good and abs(effort[i]) <= limit[i]
        if not good:
            restore_state(state, kept)
            return k
    return targets.shape[0]


@njit(cache=True, error_model="numpy")
def drive_rows(is_driven, unilateral):
    """Return how rows are commanded, given which are driven, shape (size,), and which cannot push, shape (n_a,)."""
    driven = np.flatnonzero(is_driven)
    one_way = np.zeros(driven.shape[0], dtype=np.bool_)
    for i in range(driven.shape[0]):
        one_way[i] = driven[i] < unilateral.shape[0] and unilateral[driven[i]]
    return Drive(driven, np.flatnonzero(~is_driven), one_way)


@njit(cache=True, error_model="numpy")
def march(system, strains, state, targets, is_driven, unilateral, limit, stepping, known):
    """Take time steps as `march_rows`, in which driven actuators stop at their largest effort ``limit`` (l,).

    An actuator that would exceed its limit is driven by that effort instead, until its command asks for less than it
    has reached. Returns the number of steps taken, all of them only with the factor of the tangent at the end.
    """
    count, steps, effort = limit.shape[0], targets.shape[0], state.effort
    drive = drive_rows(is_driven, unilateral)
    bound = np.full(count, np.inf)
    for i in range(count):
        if is_driven[i]:
            bound[i] = limit[i]
    free, sign, kept = is_driven.copy(), np.zeros(count), copy_state(state)
    taken = 0
    while taken < steps:
        saturated = False
        for i in range(count):
            sign[i] = np.sign(effort[i])
            free[i] = is_driven[i] and abs(effort[i]) < SATURATED * bound[i]
            saturated = saturated or free[i] != is_driven[i]
        if not saturated:
            follows = known and taken == 0 and not drive.one_way.any()
            done = march_rows(system, strains, state, targets[taken:], drive, bound, stepping, not saturated, follows)
            taken += done
            if done or count == 0:
                if done == 0:
                    return taken
                continue
        # One step, with the set of saturated actuators that is consistent.
        restore_state(kept, state)
        consistent = False
        for attempt in range(2 * count + 2):
            target = targets[taken : taken + 1].copy()
            for i in range(count):
                if is_driven[i] and not free[i]:
                    target[0, i] = sign[i] * bound[i]
            among, last = drive_rows(free, unilateral), taken == steps - 1
            if not march_rows(system, strains, state, target, among, np.zeros(0), stepping, last, not saturated):
                break
            consistent = True
            for i in range(count):
                if free[i] and abs(effort[i]) > bound[i]:
                    free[i], sign[i], consistent = False, np.sign(effort[i]), False
                elif is_driven[i] and not free[i]:
                    # Stop releasing actuators after a while, so that the loop terminates.
                    behind = sign[i] * (targets[taken, i] - system.equations.delta[i]) < 0.0
                    if behind and attempt <= count:
                        free[i], consistent = True, False
            if consistent:
                break
            restore_state(state, kept)
        if not consistent:
            restore_state(state, kept)
            return taken
        taken += 1
    return taken


class BeamMotion(CompiledSolver):
    """Time steps and equilibria of a body of beams.

    Args:
        model: a model for which `is_beam_body` holds.
        mass: its mass matrix.
    """

    def __init__(self, model: MechanicalModel, mass: MassMatrix) -> None:
        self.system = make_system(beam_body(model, mass), model.assembly.size)
        self.body, self.equations = self.system.body, self.system.equations
        self.elasticity_version = model.elasticity_version
        self._contact = model.contact
        self.strains = np.zeros((len(self.body.elements.frames), 2, 6))

    @classmethod
    def reason_against(cls, model: MechanicalModel, *, moving: bool) -> str | None:
        return reason_for_general(model, moving=moving)

    @classmethod
    def batch_class(cls, robot: Robot, options: Mapping[str, object]) -> str | None:
        if not robot.made_of_beams or robot.self_contact or options.get("scheme", "euler") != "euler":
            return None
        if robot.may_touch and not options.get("dynamics", False):
            return None
        if any(isinstance(obstacle, MeshObstacle) or obstacle.frame is not None for obstacle in robot.obstacles):
            return None  # compiled contact knows neither
        return "softgym_envs.extensions.beams.fem_batch:FEMBatch"

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
        memory: ContactMemory | None = None,
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
            memory: what friction remembers at the start; needed by a body that touches.
        """
        contact, anchors = self.body.contact, None
        if contact is not None:
            assert memory is not None
            anchors = anchors_of(contact, memory)
        state = BeamState(x.copy(), velocity.copy(), effort.copy(), np.empty(len(effort)), anchors, np.zeros(7))
        count = march(
            self.system,
            self.strains,
            state,
            targets,
            is_driven,
            unilateral,
            limit,
            Stepping(loads, step, mass_damping, stiffness_damping, tolerance, cuts),
            False,  # what follows from a state must not depend on what was computed before
        )
        kinetic, stored, work, dissipated, iterations, negative, parts = state.totals.tolist()
        equations, slides = self.equations, self.equations.slides
        contacts, remembered = None, None
        if contact is not None and count:
            assert self._contact is not None and slides is not None and memory is not None and anchors is not None
            contacts = contacts_of(self._contact, contact, slides, state.x)
            remembered = memory_of(contact, anchors, memory)
        return MarchedSteps(
            count,
            count == len(targets),
            state.x,
            state.velocity,
            state.effort,
            equations.delta.copy() if count else state.delta,
            self.system.factor.compliance.copy(),
            kinetic,
            stored,
            work,
            dissipated,
            int(iterations),
            negative == 0,
            int(parts),
            slides is not None and slides.number[0] > 0,
            contacts,
            remembered,
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


def anchors_of(contact: ContactPoints, memory: ContactMemory) -> np.ndarray:
    """Return the anchors of compiled points [m], shape (o, p, 3); without friction they are not used."""
    anchors = np.zeros((len(contact.obstacles), len(contact.order), 3))
    for own, kept in zip(anchors, memory.anchors, strict=True):
        if kept is not None:
            own[:] = kept[contact.order]
    return anchors


def memory_of(contact: ContactPoints, anchors: np.ndarray, memory: ContactMemory) -> ContactMemory:
    """Return a memory whose anchors of compiled points are those given, shape (o, p, 3)."""
    found = [None if kept is None else kept.copy() for kept in memory.anchors]
    for own, kept in zip(anchors, found, strict=True):
        if kept is not None:
            kept[contact.order] = own
    return memory._replace(anchors=tuple(found))


def contacts_of(contact: Contact, points: ContactPoints, slides: Slides, x: np.ndarray) -> Contacts:
    """Return where a body touches at rows ``x`` (n, 3) at the end of the last time step."""
    from softgym_envs.mechanics.contact.contact import Contacts

    numbers, values = np.empty((len(points.area), 3), dtype=np.int64), np.empty((len(points.area), 8))
    count = touching(points, slides, x, slides.before, numbers, values)
    numbers, values = numbers[:count], values[:count]
    names = tuple(each.name or f"obstacle {k + 1}" for k, each in enumerate(contact.obstacles))
    return Contacts(
        obstacles=names,
        obstacle=numbers[:, 0],
        point=values[:, :3],
        gap=values[:, 3],
        force=values[:, 4:7],
        pressing=values[:, 7],
        sliding=numbers[:, 2] > 0,
        self_force=0.0,
        mesh_force=np.zeros((len(names), 3)),
        smallest_gap=float(values[:, 3].min(initial=np.inf)),
        number=numbers[:, 1],
    )
