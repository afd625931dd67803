"""Many bodies of beams, each in a state of its own, that one compiled call moves one after the other."""

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
from softgym_envs.mechanics.solvers.beam_equations import make_equations
from softgym_envs.mechanics.solvers.beam_motion import drive
from softgym_envs.mechanics.solvers.beam_newton import make_factor
from softgym_envs.mechanics.solvers.block_cholesky import BlockPattern


@dataclass(frozen=True)
class BeamStates:
    """States of B bodies, which a batch changes in place.

    Attributes:
        x: rows [m], shape (B, n, 3).
        velocity: of the rows [m/s], shape (B, n, 3).
        effort: of all constraint rows, shape (B, size).
        delta: their values, shape (B, size).
        compliance: ``W`` at the end of the last step, shape (B, size, size).
    """

    x: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    delta: np.ndarray
    compliance: np.ndarray

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
    for k in range(numbers.shape[0]):
        x, velocity, effort = xs[k].copy(), velocities[k].copy(), efforts[k].copy()
        taken = drive(
            _body(bodies, numbers[k]),
            equations,
            factor,
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
        )
        if taken == targets.shape[1]:
            solved[k], stable[k] = True, totals[5] == 0.0
            xs[k] = x
            velocities[k] = velocity
            efforts[k] = effort
            deltas[k] = equations.delta
            compliances[k] = factor.compliance
