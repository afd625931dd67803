"""Derivatives of recorded motions by the design of the body.

The equations of each recorded step are evaluated, without their tangents, for bodies built at designs on both sides of
the recorded one. Rows cannot be compared between bodies: the same motion of the frames moves what is mounted on them
otherwise. So frames that can move are kept where they are, and all other rows follow from the body. The difference of
the equations, weighted by the adjoint, is the derivative: elasticity, inertia, damping, chambers, loads, contact and
the shape at the start are all in it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.extensions.beams.contact_law import quick_gap
from softgym_envs.extensions.beams.solver.batch import body_of, stacked
from softgym_envs.extensions.beams.solver.body import FIXED, BeamBody, beam_body, reason_for_general
from softgym_envs.extensions.beams.solver.contact import catch_up, has_failed, point_at
from softgym_envs.extensions.beams.solver.equations import Step, assemble, point_strains
from softgym_envs.mechanics.compilation import njit

if TYPE_CHECKING:  # kernels do not depend on it, see `compilation`
    from softgym_envs.mechanics.model import MechanicalModel


@dataclass(frozen=True)
class Neighbours:
    """Bodies on both sides of a design, two for each variable: the larger and the smaller value.

    Attributes:
        bodies: their arrays, with an axis of 2 d bodies in front.
        loads: dead loads [N], shape (2 d, n, 3).
        nodes: rest rows [m], shape (2 d, n, 3).
        spans: distance of the two values of each variable, shape (d,).
    """

    bodies: BeamBody
    loads: np.ndarray
    nodes: np.ndarray
    spans: np.ndarray

    @classmethod
    def of(
        cls,
        build: Callable[[np.ndarray], MechanicalModel],
        values: Sequence[float] | np.ndarray,
        steps: Sequence[float] | np.ndarray,
        *,
        bounds: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> Neighbours:
        """Build the bodies.

        Args:
            build: returns the model of design variables (d,).
            values: of the design, shape (d,).
            steps: distances of the neighbours, shape (d,); 1e-5 of a variable's range serves: round-off and the
                curvature of contact then count alike, in the seventh digit or so.
            bounds: smallest and largest values, shapes (d,), which are not exceeded.

        Raises:
            ValueError: for steps that are not positive, or bodies of different layouts.
        """
        start, sizes = np.asarray(values, dtype=float), np.asarray(steps, dtype=float)
        if start.ndim != 1 or sizes.shape != start.shape or not (np.isfinite(start).all() and (sizes > 0.0).all()):
            raise ValueError(f"values {start.tolist()} and steps {sizes.tolist()} must be as many, finite and positive")
        bodies, loads, nodes, spans = [], [], [], []
        for k, size in enumerate(sizes):
            pair = np.tile(start, (2, 1))
            pair[:, k] += [size, -size]
            if bounds is not None:
                pair[:, k] = np.clip(pair[:, k], bounds[0][k], bounds[1][k])
            spans.append(pair[0, k] - pair[1, k])
            for design in pair:
                model = build(design)
                if (reason := reason_for_general(model)) is not None:
                    raise ValueError(f"gradients need bodies that compiled code can solve: {reason}")
                bodies.append(beam_body(model, model.assembly.mass_matrix()))
                loads.append(model.loads)
                nodes.append(model.nodes)
        try:
            return cls(stacked(bodies), np.array(loads), np.array(nodes), np.array(spans))
        except ValueError:
            raise ValueError(
                "designs of different layouts have no derivative: frames, elements or rows differ"
            ) from None

    def check_like(self, body: BeamBody) -> None:
        """Raise a ValueError unless the bodies have the layout of another one."""
        for mine, other in zip(_flat(self.bodies), _flat(body), strict=True):
            if mine is not None and mine.shape[1:] != other.shape:
                raise ValueError("the neighbours have other frames, elements or rows than the body that moved")


def _flat(parts: Any) -> list[Any]:
    """Return the arrays in nested named tuples, with None where there is none."""
    return sum((_flat(part) for part in parts), []) if isinstance(parts, tuple) else [parts]


@njit(cache=True, error_model="numpy", _nrt=False)
def _placed(body, x, nodes, own, out):
    """Fill ``out`` (n, 3) with the rows of another body whose movable frames are where rows ``x`` (n, 3) have them.

    ``nodes`` and ``own`` are the rest rows of the other body, and those of the body that has moved. Components that are
    held lie where the other body has them.
    """
    free = body.components.free
    for row in range(x.shape[0]):
        fixed = body.rows.kind[row] == FIXED
        for d in range(3):
            out[row, d] = nodes[row, d] if fixed else x[row, d]
    for f in range(body.frames.rows.shape[0]):
        row, b = body.frames.rows[f], body.frames.block[f]
        for d in range(3):
            if free[b, d] == 0.0:
                out[row, d] += nodes[row, d] - own[row, d]
        if free[b, 3] and free[b, 4] and free[b, 5]:
            continue
        # Turned as before, from other directors at rest.
        for k in range(1, 4):
            for d in range(3):
                value = 0.0
                for m in range(1, 4):
                    along = 0.0
                    for i in range(3):
                        along += nodes[row + k, i] * own[row + m, i]
                    value += along * x[row + m, d]
                out[row + k, d] = value
    _follow(body.frames, out)


@njit(cache=True, error_model="numpy", _nrt=False)
def _follow(frames, rows):
    """Let rows of places or velocities (n, 3) that follow a frame do so."""
    for c in range(frames.mounted.shape[0]):
        row, origin, arm = frames.mounted[c], frames.owner[c], frames.arm[c]
        for d in range(3):
            value = frames.moves[c] * rows[origin, d]
            for k in range(3):
                value += arm[k] * rows[origin + 1 + k, d]
            rows[row, d] = value


@njit(cache=True, error_model="numpy")
def _anchor_work(contact, slides, x, anchors, by_anchors):
    """Return the product of ``by_anchors`` with how anchors move in a step that ends at rows ``x``, from ``anchors``.

    Nearly all of ``by_anchors`` is zero: those of points that do not touch in the next step.
    """
    value = 0.0
    if contact is None:
        return value
    p, q, law, unused = slides.p, slides.q, contact.law, np.zeros(7)
    for g in range(contact.frames.shape[0]):
        for k in range(contact.groups[g], contact.groups[g + 1]):
            for o in range(contact.obstacles.shape[0]):
                by = by_anchors[o, k]
                if by[0] == 0.0 and by[1] == 0.0 and by[2] == 0.0:
                    continue
                obstacle, edges = contact.obstacles[o], contact.edges[o]
                point_at(contact, g, k, x, p)
                q[:] = p
                if quick_gap(p, obstacle, edges) < law[0]:
                    q[:] = anchors[o, k]
                    catch_up(p, contact.area[k], obstacle, edges, q, law, slides.touch, unused)
                for d in range(3):
                    value += (q[d] - anchors[o, k, d]) * by[d]
    return value


@njit(cache=True, error_model="numpy", _nrt=False)
def _start_work(contact, slides, x, by_anchors):
    """Return the product of ``by_anchors`` with relaxed anchors at rows ``x``."""
    value = 0.0
    if contact is None:
        return value
    for g in range(contact.frames.shape[0]):
        for k in range(contact.groups[g], contact.groups[g + 1]):
            point_at(contact, g, k, x, slides.p)
            for o in range(contact.obstacles.shape[0]):
                for d in range(3):
                    value += slides.p[d] * by_anchors[o, k, d]
    return value


@njit(cache=True, error_model="numpy")
def _anchors_of(anchors, s):
    """Return the anchors of record ``s``, or None."""
    if anchors is None:
        return None
    return anchors[s]


@njit(cache=True, error_model="numpy")
def by_bodies(bodies, loads, nodes, own, equations, strains, tape, count, drive, stepping, adjoint, given, start, out):
    """Fill ``out`` (2 d,) with what a scalar, and the weighted equations of all steps, are for other bodies.

    Their differences are the derivatives. Returns whether they could be evaluated.

    Args:
        bodies: see `Neighbours`.
        loads: as there.
        nodes: as there.
        own: rest rows of the body that has moved, shape (n, 3).
        equations: work arrays.
        strains: work array.
        tape: the record.
        count: number of records.
        drive: how rows are commanded.
        stepping: as in the record.
        adjoint: arrays of `Adjoint`.
        given: derivatives of the scalar by rows and by velocities after each command, shapes (k, n, 3).
        start: derivatives by the rows (n, 3) and the anchors (o, p, 3) at the start; and 1 if the motion starts with
            the rest rows of each body, 0 if its frames start where they are.
        out: see above.
    """
    by_x, by_velocity = given
    by_rows, by_anchors, at_rest = start
    before, now, velocity = np.empty_like(own), np.empty_like(own), np.empty_like(own)
    for k in range(loads.shape[0]):
        body, total = body_of(bodies, k), 0.0
        _placed(body, tape.x[0], nodes[k], own, before)
        velocity[:] = tape.velocity[0]
        _follow(body.frames, velocity)
        if at_rest > 0.0:
            for row in range(own.shape[0]):
                for d in range(3):
                    total += by_rows[row, d] * (nodes[k, row, d] - before[row, d])
            total += _start_work(body.contact, equations.slides, nodes[k], by_anchors)
        for s in range(count):
            h, held = tape.h[s], _anchors_of(tape.anchors, s)
            _placed(body, tape.x[s + 1], nodes[k], own, now)
            point_strains(body.elements, before, strains)
            step = Step(before, velocity, strains, loads[k], h, stepping.mass_damping, stepping.stiffness_damping, held)
            assemble(body, now, tape.effort[s + 1], step, equations, not step.h > 0.0)
            if has_failed(equations.slides):
                return False
            for b in range(equations.residual.shape[0]):
                for i in range(6):
                    total -= adjoint.motion[s, b, i] * equations.residual[b, i]
            for i in range(drive.driven.shape[0]):
                total -= adjoint.value[s, drive.driven[i]] * equations.delta[drive.driven[i]]
            total += _anchor_work(body.contact, equations.slides, now, held, _anchors_of(adjoint.anchors, s))
            for row in range(own.shape[0]):
                for d in range(3):
                    velocity[row, d] = (now[row, d] - before[row, d]) / h
            if tape.last[s]:
                c = tape.number[s]
                for row in range(own.shape[0]):
                    for d in range(3):
                        moved = now[row, d] - tape.x[s + 1, row, d]  # small numbers have small errors
                        total += by_x[c, row, d] * moved + by_velocity[c, row, d] * velocity[row, d]
            before[:] = now
        out[k] = total
    return True
