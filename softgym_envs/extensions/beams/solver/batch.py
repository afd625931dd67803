"""Steps many beam robots in one compiled call."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.extending import overload

from softgym_envs.extensions.beams.solver.block_cholesky import SIZE, BlockPattern
from softgym_envs.extensions.beams.solver.body import (
    BeamBody,
    Chambers,
    Components,
    Elements,
    Masses,
    MovingFrames,
    Points,
    Rows,
    Servos,
)
from softgym_envs.extensions.beams.solver.equations import Equations
from softgym_envs.extensions.beams.solver.motion import BeamState, Stepping, march
from softgym_envs.extensions.beams.solver.newton import Factor, System, make_system
from softgym_envs.extensions.beams.solver.points import ContactPoints
from softgym_envs.mechanics.compilation import njit


class BeamStates(NamedTuple):
    """States of B bodies, which a batch changes in place.

    Attributes:
        x: rows [m], shape (B, n, 3).
        velocity: of the rows [m/s], shape (B, n, 3).
        effort: of all constraint rows, shape (B, size).
        delta: their values, shape (B, size).
        compliance: ``W`` at the end of the last step, shape (B, size, size).
        tangent: factorised tangents at the end of the last step, with which the next one begins, shape (B, blocks, 6,
            6). States without them, shape (0, blocks, 6, 6), factorise anew.
        half: what follows from them, see `Factor`, shape (B, size, b, 6) or (0, size, b, 6).
        signs: of their pivots, shape (B, b, 6) or (0, b, 6).
        is_factored: which states have a tangent, shape (B,). Whoever changes a state must clear it.
        anchors: of friction springs [m], shape (B, o, p, 3); None for bodies that touch nothing.
    """

    x: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    delta: np.ndarray
    compliance: np.ndarray
    tangent: np.ndarray
    half: np.ndarray
    signs: np.ndarray
    is_factored: np.ndarray
    anchors: np.ndarray | None

    @classmethod
    def of(cls, body: BeamBody, size: int, count: int, *, factors: bool) -> BeamStates:
        """Return ``count`` states of a body with ``size`` constraint rows, all zero, which may keep their factors.

        Those of bodies that touch something keep none.
        """
        touches = body.contact is not None
        frames, rows, kept = len(body.components.free), len(body.rows.kind), count if factors and not touches else 0
        return cls(
            x=np.zeros((count, rows, 3)),
            velocity=np.zeros((count, rows, 3)),
            effort=np.zeros((count, size)),
            delta=np.zeros((count, size)),
            compliance=np.zeros((count, size, size)),
            tangent=np.zeros((kept, body.pattern.blocks, SIZE, SIZE)),
            half=np.zeros((kept, size, frames, SIZE)),
            signs=np.zeros((kept, frames, SIZE)),
            is_factored=np.zeros(count, dtype=bool),
            anchors=None
            if body.contact is None
            else np.zeros((count, len(body.contact.obstacles), len(body.contact.area), 3)),
        )

    def copy(self) -> BeamStates:
        """Return a copy."""
        return self._replace(**{name: array.copy() for name, array in self._asdict().items() if array is not None})


def thread_count() -> int:
    """Return ``NUMBA_NUM_THREADS`` where that is set, otherwise 1: cores belong to processes unless a user says so."""
    return int(os.environ.get("NUMBA_NUM_THREADS", 1))


class BeamBatch:
    """Bodies of the same layout: the same frames, elements and constraints with other dimensions.

    Args:
        bodies: their arrays.
        loads: dead loads of each [N], shape (n, 3).
        threads: how many threads share the states of a step; default `thread_count`. Results do not depend on it.

    Raises:
        ValueError: for bodies of different layouts.
    """

    def __init__(self, bodies: Sequence[BeamBody], loads: Sequence[np.ndarray], *, threads: int | None = None) -> None:
        self._bodies = stacked(bodies)
        self._loads = np.ascontiguousarray(loads)
        body = bodies[0]
        size = len(body.servos.number) + 3 * len(body.points.number) + len(body.chambers.number)
        self._work = [
            (make_system(body, size), np.zeros((len(body.elements.frames), 2, 6)))
            for _ in range(threads or thread_count())
        ]

    def march(
        self,
        bodies: np.ndarray,
        states: BeamStates,
        targets: np.ndarray,
        is_driven: np.ndarray,
        unilateral: np.ndarray,
        *,
        limit: np.ndarray,
        step: float,
        mass_damping: float,
        stiffness_damping: float,
        tolerance: float,
        cuts: int = 0,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Take the time steps of `BeamMotion.march` for each of B states, in place.

        Args:
            bodies: number of the body of each state, shape (B,).
            states: the states at the start; those that reach their last target are changed.
            targets: shape (B, k, size).
            is_driven: shape (size,).
            unilateral: shape (n_a,).
            limit: shape (l,).
            step: duration of one time step [s], infinite for equilibria.
            mass_damping: Rayleigh's alpha [1/s].
            stiffness_damping: Rayleigh's beta [s].
            tolerance: largest remaining correction of any row [m].
            cuts: how often a time step that cannot be solved is halved.

        Returns:
            Which states reached their last target, and which of them are stable, shapes (B,).
        """
        solved, stable = np.zeros(len(bodies), dtype=bool), np.zeros(len(bodies), dtype=bool)
        stepping = Stepping(self._loads[0], step, mass_damping, stiffness_damping, tolerance, cuts)

        def run(number: int) -> None:
            """Step the share of the states that belongs to a thread."""
            system, strains = self._work[number]
            part = slice(*(len(bodies) * (number + k) // len(self._work) for k in range(2)))
            _march_all(
                self._bodies,
                self._loads,
                bodies[part],
                system,
                strains,
                BeamStates._make(None if array is None else array[part] for array in states),
                targets[part],
                is_driven,
                unilateral,
                limit,
                stepping,
                solved[part],
                stable[part],
            )

        if len(self._work) == 1:
            run(0)
        else:
            with ThreadPoolExecutor(len(self._work)) as pool:
                list(pool.map(run, range(len(self._work))))
        return solved, stable


def stacked(parts: Sequence[Any]) -> Any:
    """Return named tuples of arrays as one, whose arrays have a further axis in front."""
    first = parts[0]
    if first is None:
        return None
    if isinstance(first, np.ndarray):
        return np.stack(parts)  # a ValueError for other shapes
    return type(first)(*(stacked(fields) for fields in zip(*parts, strict=True)))


@njit(cache=True, error_model="numpy")
def body_of(all_bodies, k):
    """Return body ``k`` of stacked bodies."""
    e, r, f, m = all_bodies.elements, all_bodies.rows, all_bodies.frames, all_bodies.masses
    b, c, s = all_bodies.pattern, all_bodies.components, all_bodies.servos
    p, h = all_bodies.points, all_bodies.chambers
    return BeamBody(
        Elements(e.frames[k], e.shape[k], e.slope[k], e.stiffness[k], e.rest[k], e.mount[k], e.place[k], e.drag[k]),
        Rows(r.kind[k], r.block[k], r.origin[k]),
        MovingFrames(f.rows[k], f.block[k], f.mounted[k], f.owner[k], f.moves[k], f.arm[k]),
        Masses(m.pointers[k], m.columns[k], m.values[k], m.pairs[k], m.entries[k]),
        BlockPattern(b.pointers[k], b.columns[k], b.targets[k]),
        Components(c.free[k], c.whole[k], c.scale[k]),
        Servos(s.number[k], s.row[k], s.directions[k]),
        Points(p.number[k], p.rows[k], p.weights[k]),
        Chambers(h.number[k], h.rest[k], h.chamber[k], h.area[k], h.frames[k], h.weights[k], h.mount[k], h.place[k]),
        _contact(all_bodies.contact, k),
    )


def _contact(c, k):
    """Return the points of body ``k``, or None for bodies that touch nothing."""
    return None if c is None else _points(c, k)


@overload(_contact)
def _compiled_contact(c, k):
    """Choose when a kernel is compiled, as for `_row`."""
    if isinstance(c, types.NoneType):
        return lambda c, k: None
    return lambda c, k: _points(c, k)


@njit(cache=True, error_model="numpy")
def _points(c, k):
    """Return the points of body ``k``."""
    return ContactPoints(
        c.groups[k],
        c.rows[k],
        c.frames[k],
        c.blocks[k],
        c.place[k],
        c.share[k],
        c.reach[k],
        c.weights[k],
        c.area[k],
        c.order[k],
        c.obstacles[k],
        c.edges[k],
        c.law[k],
    )


def _row(array, k):
    """Return a copy of row ``k``, or None."""
    return None if array is None else array[k].copy()


@overload(_row)
def _compiled_row(array, k):
    """Choose when a kernel is compiled: what might be None or an array would have everything compiled again."""
    if isinstance(array, types.NoneType):
        return lambda array, k: None
    return lambda array, k: array[k].copy()


@njit(cache=True, error_model="numpy")
def _put(array, k, row):
    """Replace row ``k``; None has none."""
    if array is None:
        return
    array[k] = row


@njit(cache=True, error_model="numpy", nogil=True)
def _march_all(
    bodies, loads, numbers, system, strains, states, targets, is_driven, unilateral, limit, stepping, solved, stable
):
    """Do what `BeamBatch.march` says; ``solved`` and ``stable`` (B,) are what it returns."""
    keeps, equations, factor = states.tangent.shape[0] > 0, system.equations, system.factor
    q, f = equations, factor
    for k in range(numbers.shape[0]):
        if keeps:  # the solver works in the arrays of the state
            q = Equations(
                equations.gradient,
                equations.momentum,
                equations.residual,
                states.tangent[k],
                equations.delta,
                equations.H,
                equations.energy,
                equations.slides,
                equations.work,
            )
            f = Factor(
                states.half[k],
                states.half[k],
                factor.compliance,
                factor.driven,
                states.signs[k],
                factor.step,
                factor.efforts,
                factor.gap,
                factor.turned,
            )
            f.compliance[:] = states.compliance[k]
        state = BeamState(
            states.x[k].copy(),
            states.velocity[k].copy(),
            states.effort[k].copy(),
            states.delta[k].copy(),
            _row(states.anchors, k),
            np.zeros(7),
        )
        taken = march(
            System(body_of(bodies, numbers[k]), q, f),
            strains,
            state,
            targets[k],
            is_driven,
            unilateral,
            limit,
            Stepping(
                loads[numbers[k]],
                stepping.h,
                stepping.mass_damping,
                stepping.stiffness_damping,
                stepping.tolerance,
                stepping.cuts,
            ),
            states.is_factored[k] and stepping.h < np.inf,
        )
        whole = state.totals[6] == 1.0  # no factor for a part of a time step
        states.is_factored[k] = keeps and taken == targets.shape[1] and whole
        if taken == targets.shape[1]:
            solved[k], stable[k] = True, state.totals[5] == 0.0
            states.x[k] = state.x
            states.velocity[k] = state.velocity
            states.effort[k] = state.effort
            states.delta[k] = equations.delta
            states.compliance[k] = factor.compliance
            _put(states.anchors, k, state.anchors)
