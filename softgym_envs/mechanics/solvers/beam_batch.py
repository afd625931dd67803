"""Steps many beam robots in one compiled call."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.solvers.beam_body import (
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
from softgym_envs.mechanics.solvers.beam_equations import Equations, make_equations
from softgym_envs.mechanics.solvers.beam_motion import drive
from softgym_envs.mechanics.solvers.beam_newton import Factor, make_factor
from softgym_envs.mechanics.solvers.block_cholesky import SIZE, BlockPattern


@dataclass(frozen=True)
class BeamStates:
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

    @classmethod
    def of(cls, body: BeamBody, size: int, count: int, *, factors: bool) -> BeamStates:
        """Return ``count`` states of a body with ``size`` constraint rows, all zero, which may keep their factors."""
        frames, rows, kept = len(body.components.free), len(body.rows.kind), count if factors else 0
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
        )

    def copy(self) -> BeamStates:
        """Return a copy."""
        return BeamStates(*(array.copy() for array in vars(self).values()))


class BeamBatch:
    """Bodies of the same layout: the same frames, elements and constraints with other dimensions.

    Args:
        bodies: their arrays.
        loads: dead loads of each [N], shape (n, 3).

    Raises:
        ValueError: for bodies of different layouts.
    """

    def __init__(self, bodies: Sequence[BeamBody], loads: Sequence[np.ndarray]) -> None:
        self._bodies = _stacked(bodies)
        self._loads = np.ascontiguousarray(loads)
        body = bodies[0]
        size = len(body.servos.number) + 3 * len(body.points.number) + len(body.chambers.number)
        self._equations, self._factor = make_equations(body, size), make_factor(len(body.components.free), size)
        self._strains = np.zeros((len(body.elements.frames), 2, 6))

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
        _march_all(
            self._bodies,
            self._loads,
            bodies,
            self._equations,
            self._factor,
            self._strains,
            states.x,
            states.velocity,
            states.effort,
            states.delta,
            states.compliance,
            states.tangent,
            states.half,
            states.signs,
            states.is_factored,
            targets,
            is_driven,
            unilateral,
            limit,
            step,
            mass_damping,
            stiffness_damping,
            tolerance,
            cuts,
            solved,
            stable,
        )
        return solved, stable


def _stacked(parts: Sequence[Any]) -> Any:
    """Return named tuples of arrays as one, whose arrays have a further axis in front."""
    first = parts[0]
    if isinstance(first, np.ndarray):
        return np.stack(parts)  # a ValueError for other shapes
    return type(first)(*(_stacked(fields) for fields in zip(*parts, strict=True)))


@njit(cache=True, error_model="numpy")
def _body(all_bodies, k):
    """Return body ``k`` of stacked bodies."""
    e, r, f, m = all_bodies.elements, all_bodies.rows, all_bodies.frames, all_bodies.masses
    b, c, s = all_bodies.pattern, all_bodies.components, all_bodies.servos
    p, h = all_bodies.points, all_bodies.chambers
    return BeamBody(
        Elements(e.frames[k], e.shape[k], e.slope[k], e.stiffness[k], e.rest[k], e.mount[k], e.place[k]),
        Rows(r.kind[k], r.block[k], r.origin[k]),
        MovingFrames(f.rows[k], f.block[k], f.mounted[k], f.owner[k], f.moves[k], f.arm[k]),
        Masses(m.pointers[k], m.columns[k], m.values[k], m.pairs[k], m.entries[k]),
        BlockPattern(b.pointers[k], b.columns[k], b.targets[k]),
        Components(c.free[k], c.whole[k], c.scale[k]),
        Servos(s.number[k], s.row[k], s.directions[k]),
        Points(p.number[k], p.rows[k], p.weights[k]),
        Chambers(h.number[k], h.rest[k], h.chamber[k], h.area[k], h.frames[k], h.weights[k], h.place[k]),
    )


@njit(cache=True, error_model="numpy")
def _march_all(
    bodies,
    loads,
    numbers,
    equations,
    factor,
    strains,
    xs,
    velocities,
    efforts,
    deltas,
    compliances,
    tangents,
    halves,
    signs,
    is_factored,
    targets,
    is_driven,
    unilateral,
    limit,
    h,
    alpha,
    beta,
    tolerance,
    cuts,
    solved,
    stable,
):
    """Do what `BeamBatch.march` says; ``solved`` and ``stable`` (B,) are what it returns."""
    totals, delta = np.zeros(7), np.zeros(efforts.shape[1])
    keeps = tangents.shape[0] > 0
    q, f = equations, factor
    for k in range(numbers.shape[0]):
        if keeps:  # the solver works in the arrays of the state
            q = Equations(
                equations.gradient,
                equations.momentum,
                equations.residual,
                tangents[k],
                equations.delta,
                equations.H,
                equations.energy,
            )
            f = Factor(
                halves[k], factor.compliance, factor.driven, signs[k], factor.step, factor.efforts, factor.turned
            )
            f.compliance[:] = compliances[k]
        x, velocity, effort = xs[k].copy(), velocities[k].copy(), efforts[k].copy()
        taken = drive(
            _body(bodies, numbers[k]),
            q,
            f,
            strains,
            x,
            velocity,
            effort,
            delta,
            targets[k],
            is_driven,
            unilateral,
            limit,
            loads[numbers[k]],
            h,
            alpha,
            beta,
            tolerance,
            cuts,
            totals,
            is_factored[k] and h < np.inf,
        )
        is_factored[k] = keeps and taken == targets.shape[1] and totals[6] == 1.0  # not for a part of a time step
        if taken == targets.shape[1]:
            solved[k], stable[k] = True, totals[5] == 0.0
            xs[k] = x
            velocities[k] = velocity
            efforts[k] = effort
            deltas[k] = equations.delta
            compliances[k] = factor.compliance
