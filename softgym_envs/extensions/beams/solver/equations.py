"""The compiled equations of a body of beams, for an equilibrium or an implicit Euler step, and their derivative.

Arrays are those of `BeamBody`. The sums are those of the general assembly (`Assembly`); the equations are those of
frames, six for each, of which some may be held. Tests compare both.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from softgym_envs.extensions.beams.beam_kernels import (
    Work,
    add_forces,
    add_turned,
    displacement_by_spin,
    interpolate,
    make_work,
    pull_back,
    spin_by_spin,
    spin_columns,
    strains,
)
from softgym_envs.extensions.beams.solver.block_cholesky import SIZE
from softgym_envs.extensions.beams.solver.body import DIRECTOR, FIXED, ORIGIN, BeamBody
from softgym_envs.extensions.beams.solver.contact import Slides, add_contact, forget_near, hold_slides, make_slides
from softgym_envs.extensions.beams.solver.frames import add_curvature, reduce_forces
from softgym_envs.mechanics.compilation import FAST, njit


class Step(NamedTuple):
    """What one time step starts from, and its constants.

    Attributes:
        x: rows at the start [m], shape (n, 3).
        velocity: of the rows [m/s], shape (n, 3).
        strains: at the Gauss points at the start, those at rest included, shape (m, 2, 6).
        loads: dead loads [N], shape (n, 3).
        h: duration [s]; infinite for an equilibrium.
        mass_damping: Rayleigh's alpha [1/s].
        stiffness_damping: Rayleigh's beta [s].
        anchors: of the friction springs [m], shape (o, p, 3); None for a body that touches nothing.
    """

    x: np.ndarray
    velocity: np.ndarray
    strains: np.ndarray
    loads: np.ndarray
    h: float
    mass_damping: float
    stiffness_damping: float
    anchors: np.ndarray | None


class Equations(NamedTuple):
    """Results of the assembly, and its work arrays.

    Attributes:
        gradient: derivative of the energy by the rows, shape (n, 3).
        momentum: what the mass matrix multiplies, shape (n, 3).
        residual: of the equations, shape (b, 6).
        tangent: its derivative, shape (blocks, 6, 6).
        delta: values of the constraints, shape (size,).
        H: their gradients, shape (size, b, 6).
        energy: elastic energy [J], shape (1,).
        slides: terms of sliding points; None for a body that touches nothing.
        work: work arrays.
    """

    gradient: np.ndarray
    momentum: np.ndarray
    residual: np.ndarray
    tangent: np.ndarray
    delta: np.ndarray
    H: np.ndarray
    energy: np.ndarray
    slides: Slides | None
    work: Work


def make_equations(body: BeamBody, size: int) -> Equations:
    """Return arrays for a body with ``size`` constraint rows."""
    count, n = len(body.components.free), len(body.rows.kind)
    return Equations(
        gradient=np.zeros((n, 3)),
        momentum=np.zeros((n, 3)),
        residual=np.zeros((count, SIZE)),
        tangent=np.zeros((body.pattern.blocks, SIZE, SIZE)),
        delta=np.zeros(size),
        H=np.zeros((size, count, SIZE)),
        energy=np.zeros(1),
        slides=make_slides(body.contact, count, size, n, body.pattern.blocks),
        work=make_work(),
    )


@njit(cache=True, error_model="numpy")
def point_strains(elements, x, out):
    """Fill ``out`` (m, 2, 6) with the strains at the Gauss points, those at rest included, at rows ``x`` (n, 3)."""
    _fill_strains(elements, x, out, np.empty((7, 3)))


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _fill_strains(elements, x, out, z):
    """Do what `point_strains` says; ``z`` is a work array."""
    for e in range(elements.frames.shape[0]):
        for q in range(2):
            interpolate(x, elements.frames[e], elements.shape[q], elements.slope[e, q], z)
            strains(z, out[e, q])


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def strain_work(elements, x, step, arrays):
    """Return the elastic energy at rows ``x`` (n, 3), and the work that damping takes on the way there [J]."""
    z, end = arrays.z[0], arrays.stress[0]
    elastic, work = 0.0, 0.0
    for e in range(elements.frames.shape[0]):
        for q in range(2):
            interpolate(x, elements.frames[e], elements.shape[q], elements.slope[e, q], z)
            strains(z, end)
            for s in range(6):
                stiffness = elements.stiffness[e, q, s]
                elastic += 0.5 * stiffness * (end[s] - elements.rest[e, q, s]) ** 2
                work += stiffness * (end[s] - step.strains[e, q, s]) ** 2
    return elastic, step.stiffness_damping / step.h * work


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def resistance(elements, e, q, x, out):
    """Fill ``out`` (3, 3) with the resistance of the fluid at a Gauss point [N s/m] at rows ``x`` (n, 3).

    Along the axis it is less than across: ``c_n + (c_t - c_n) t t^T`` with the tangent ``t``.
    """
    i, j, k = elements.frames[e]
    a, b, c = elements.slope[e, q]
    along, across = elements.drag[e, q]
    p = a * x[i, 0] + b * x[j, 0] + c * x[k, 0]
    r = a * x[i, 1] + b * x[j, 1] + c * x[k, 1]
    s = a * x[i, 2] + b * x[j, 2] + c * x[k, 2]
    factor = (along - across) / (p * p + r * r + s * s)
    out[0, 0], out[0, 1], out[0, 2] = across + factor * p * p, factor * p * r, factor * p * s
    out[1, 0], out[1, 1], out[1, 2] = out[0, 1], across + factor * r * r, factor * r * s
    out[2, 0], out[2, 1], out[2, 2] = out[0, 2], out[1, 2], across + factor * s * s


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def between(elements, e, q, start, end, out):
    """Fill ``out`` (3,) with the way of the axis at a Gauss point between rows ``start`` and ``end`` (n, 3) [m]."""
    i, j, k = elements.frames[e]
    a, b, c = elements.shape[q]
    for d in range(3):
        out[d] = a * (end[i, d] - start[i, d]) + b * (end[j, d] - start[j, d]) + c * (end[k, d] - start[k, d])


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def drag_work(elements, x, step, arrays):
    """Return the work [J] that the fluid takes on the way from the start of a step to rows ``x`` (n, 3)."""
    D, way, work = arrays.matrix, arrays.way, 0.0
    for e in range(elements.drag.shape[0]):
        for q in range(2):
            resistance(elements, e, q, step.x, D)
            between(elements, e, q, step.x, x, way)
            for i in range(3):
                for j in range(3):
                    work += way[i] * D[i, j] * way[j]
    return work / step.h


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _add_drag(elements, x, step, equations, full):
    """Add the resistance of the fluid to the motion from the start of the step, with the axis as it was there."""
    rate = 1.0 / step.h
    if rate == 0.0 or elements.drag.shape[0] == 0:
        return
    D, way, block = equations.work.matrix, equations.work.way, equations.work.block
    for e in range(elements.drag.shape[0]):
        frames, mount, place = elements.frames[e], elements.mount[e], elements.place[e]
        for q in range(2):
            shape = elements.shape[q]
            resistance(elements, e, q, step.x, D)
            between(elements, e, q, step.x, x, way)
            for i in range(3):
                pull = rate * (D[i, 0] * way[0] + D[i, 1] * way[1] + D[i, 2] * way[2])
                for a in range(3):
                    equations.gradient[frames[a], i] += shape[a] * pull
            if not full:
                continue
            for a in range(3):
                for b in range(3):
                    if place[a, b] < 0:
                        continue
                    block[:] = 0.0
                    for i in range(3):
                        for j in range(3):
                            block[i, j] = rate * shape[a] * shape[b] * D[i, j]
                    if mount[a] >= 0:
                        _add_arms(x, frames[a], mount[a], block, False)
                    if mount[b] >= 0:
                        _add_arms(x, frames[b], mount[b], block, True)
                    target = equations.tangent[place[a, b]]
                    for i in range(6):
                        for j in range(6):
                            target[i, j] += block[i, j]


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _add_arms(x, own, mounted, block, transposed):
    """Let the first frame of a block (6, 6) of the tangent follow the frame on which it is mounted, or the second one.

    ``own`` is the first row of the frame, ``mounted`` that of the frame that it follows.
    """
    p, q, r = x[own, 0] - x[mounted, 0], x[own, 1] - x[mounted, 1], x[own, 2] - x[mounted, 2]
    for c in range(6):
        if transposed:
            u, v, w = block[c, 0], block[c, 1], block[c, 2]
            block[c, 3] += q * w - r * v
            block[c, 4] += r * u - p * w
            block[c, 5] += p * v - q * u
        else:
            u, v, w = block[0, c], block[1, c], block[2, c]
            block[3, c] += q * w - r * v
            block[4, c] += r * u - p * w
            block[5, c] += p * v - q * u


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _add_tangent(elements, e, x, rate, work, tangent):
    """Add the tangent of an element to its blocks.

    Terms of single frames, the curvature of their rotation, are left out: all forces on a frame contribute to them.
    ``work`` holds what is known at its Gauss points.
    """
    z, stress, stiffness, spins, crossed = work.z, work.stress, work.stiffness, work.spins, work.crossed
    straight, moments, block = work.straight, work.moments, work.block
    frames, shapes, slopes = elements.frames[e], elements.shape, elements.slope[e]
    mount, place = elements.mount[e], elements.place[e]
    for q in range(2):
        for s in range(6):
            stiffness[q, s] = (1.0 + rate) * elements.stiffness[e, q, s]
        k = stiffness[q]
        for d in range(3):
            a, b, c = k[0] * z[q, 1, d], k[1] * z[q, 2, d], k[2] * z[q, 3, d]
            for f in range(3):
                straight[q, d, f] = a * z[q, 1, f] + b * z[q, 2, f] + c * z[q, 3, f]
        for a in range(3):
            spin_columns(x, frames[a], shapes[q, a], slopes[q, a], z[q], spins[a, q])
            displacement_by_spin(z[q], k, spins[a, q], frames[a], shapes[q, a], stress[q], x, crossed[a, q])
    for a in range(3):
        for b in range(a, 3):
            if place[a, b] < 0 and place[b, a] < 0:
                continue
            g, h = slopes[0, a], slopes[1, a]
            k, m = slopes[0, b], slopes[1, b]
            for i in range(3):
                for j in range(3):
                    block[i, j] = g * k * straight[0, i, j] + h * m * straight[1, i, j]
                    block[i, 3 + j] = g * crossed[b, 0, i, j] + h * crossed[b, 1, i, j]
                    block[3 + i, j] = k * crossed[a, 0, j, i] + m * crossed[a, 1, j, i]
            spin_by_spin(spins[a], spins[b], stiffness, block)
            if a != b:
                # The strain 3 + i is (d_k . d_j' - d_j . d_k') / 2, bilinear in the directors of two frames.
                g = 0.5 * (shapes[0, a] * k - g * shapes[0, b])
                h = 0.5 * (shapes[1, a] * m - h * shapes[1, b])
                for i in range(3):
                    j, k = (i + 1) % 3, (i + 2) % 3
                    moment = g * stress[0, 3 + i] + h * stress[1, 3 + i]
                    moments[k, j], moments[j, k] = moment, -moment
                add_turned(x, frames[a], frames[b], moments, block)
            if mount[a] >= 0:
                _add_arms(x, frames[a], mount[a], block, False)
            if mount[b] >= 0:
                _add_arms(x, frames[b], mount[b], block, True)
            if place[a, b] >= 0:
                target = tangent[place[a, b]]
                for i in range(6):
                    for j in range(6):
                        target[i, j] += block[i, j]
            if a != b and place[b, a] >= 0:
                target = tangent[place[b, a]]
                for i in range(6):
                    for j in range(6):
                        target[i, j] += block[j, i]


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _add_elements(elements, x, step, equations, full):
    """Add the forces of the elements and, if ``full``, their tangents."""
    frames_of, shapes, slopes = elements.frames, elements.shape, elements.slope
    work = equations.work
    z, pull, stress = work.z, work.pull, work.stress
    rate = step.stiffness_damping / step.h
    elastic = 0.0
    for e in range(frames_of.shape[0]):
        frames = frames_of[e]
        for q in range(2):
            stiffness, rest, tension, start = (
                elements.stiffness[e, q],
                elements.rest[e, q],
                stress[q],
                step.strains[e, q],
            )
            interpolate(x, frames, shapes[q], slopes[e, q], z[q])
            strains(z[q], tension)
            for s in range(6):
                strain, change = tension[s] - rest[s], tension[s] - start[s]
                elastic += 0.5 * stiffness[s] * strain**2
                tension[s] = stiffness[s] * (strain + rate * change)
            for v in range(7):
                for d in range(3):
                    pull[v, d] = 0.0
            pull_back(z[q], tension, pull)
            add_forces(pull, frames, shapes[q], slopes[e, q], equations.gradient)
        if full:
            _add_tangent(elements, e, x, rate, work, equations.tangent)
    equations.energy[0] = elastic


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def multiply_mass(masses, rows, out):
    """Add ``M rows`` to ``out``, both (n, 3)."""
    pointers, columns, values = masses.pointers, masses.columns, masses.values
    for i in range(rows.shape[0]):
        a, b, c = 0.0, 0.0, 0.0
        for p in range(pointers[i], pointers[i + 1]):
            j, m = columns[p], values[p]
            a += m * rows[j, 0]
            b += m * rows[j, 1]
            c += m * rows[j, 2]
        out[i, 0] += a
        out[i, 1] += b
        out[i, 2] += c


@njit(cache=True, error_model="numpy", _nrt=False)
def _vector(rows, x, row, out):
    """Fill ``out`` (3,) with the part of a row that turns with its frame; return whether the origin moves the row."""
    kind = rows.kind[row]
    for d in range(3):
        out[d] = x[row, d] if kind == DIRECTOR else x[row, d] - x[rows.origin[row], d]
    return kind != DIRECTOR


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _add_inertia(masses, x, step, equations, full):
    """Add the forces of inertia and of mass damping and, if ``full``, their tangents."""
    rate = 1.0 / step.h
    factor = (rate + step.mass_damping) * rate
    start, velocity, momentum = step.x, step.velocity, equations.momentum
    for row in range(x.shape[0]):
        for d in range(3):
            # M ((v' - v) / h + alpha v') with v' = (x - x_n) / h
            momentum[row, d] = factor * (x[row, d] - start[row, d]) - rate * velocity[row, d]
    multiply_mass(masses, momentum, equations.gradient)
    if not full or factor == 0.0:
        return
    m = equations.work.matrix
    for k in range(masses.pairs.shape[0]):
        one, other, block = masses.pairs[k, 0], masses.pairs[k, 1], equations.tangent[masses.pairs[k, 2]]
        entries = masses.entries[k]
        for i in range(3):
            block[i, i] += factor * entries[0, 0]
            for j in range(3):
                m[i, j] = factor * entries[1 + i, 1 + j]
        add_turned(x, one, other, m, block)
        for i in range(3):
            j, n = (i + 1) % 3, (i + 2) % 3
            r, s = 0.0, 0.0
            for a in range(1, 4):
                r += entries[a, 0] * x[one + a, i]
                s += entries[0, a] * x[other + a, i]
            # u . (w x s) and (w x r) . u, component i of s and r
            block[j, 3 + n] += factor * s
            block[n, 3 + j] -= factor * s
            block[3 + n, j] += factor * r
            block[3 + j, n] -= factor * r


@njit(cache=True, error_model="numpy", _nrt=False)
def add_constraints(body, x, effort, equations, full):
    """Fill the values of the constraints, and subtract the forces of their efforts; if ``full``, fill ``H``, too."""
    servos, points, rows = body.servos, body.points, body.rows
    gradient, H, delta, tangent = equations.gradient, equations.H, equations.delta, equations.tangent
    slope, curved = equations.work.slope, equations.work.way
    if full:
        H[:] = 0.0
    _add_chambers(body.chambers, rows, x, effort, equations, full)
    for s in range(servos.row.shape[0]):
        row, c = servos.row[s], servos.number[s]
        a, b = servos.directions[s, 0], servos.directions[s, 1]
        p, q = 0.0, 0.0
        for d in range(3):
            p += a[d] * x[row, d]
            q += b[d] * x[row, d]
        square = p * p + q * q
        delta[c] = np.arctan2(q, p)
        for d in range(3):
            slope[d] = (p * b[d] - q * a[d]) / square
            gradient[row, d] -= effort[c] * slope[d]
        if not full or rows.kind[row] == FIXED:
            continue
        director, block, column = x[row], tangent[rows.block[row]], H[c, rows.block[row]]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            column[3 + i] += director[j] * slope[k] - director[k] * slope[j]
        # The second derivative of the angle is (2 p q (a a^T - b b^T) + (q^2 - p^2) (a b^T + b a^T)) / square^2.
        same, mixed = -2.0 * effort[c] * p * q / square**2, -effort[c] * (q * q - p * p) / square**2
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            # e_i x d has the components -d_k and d_j along e_j and e_k.
            along, across = a[k] * director[j] - a[j] * director[k], b[k] * director[j] - b[j] * director[k]
            for d in range(3):
                curved[d] = same * (a[d] * along - b[d] * across) + mixed * (a[d] * across + b[d] * along)
            block[3, 3 + i] += director[1] * curved[2] - director[2] * curved[1]
            block[4, 3 + i] += director[2] * curved[0] - director[0] * curved[2]
            block[5, 3 + i] += director[0] * curved[1] - director[1] * curved[0]
    for t in range(points.number.shape[0]):
        c = points.number[t]
        for d in range(3):
            delta[c + d] = 0.0
        for a in range(4):
            row, weight = points.rows[t, a], points.weights[t, a]
            for d in range(3):
                delta[c + d] += weight * x[row, d]
                gradient[row, d] -= effort[c + d] * weight
            if not full or rows.kind[row] == FIXED or weight == 0.0:
                continue
            moves = _vector(rows, x, row, slope)
            for d in range(3):
                column = H[c + d, rows.block[row]]
                if moves:
                    column[d] += weight
                if rows.kind[row] != ORIGIN:
                    # r x e_d has the components r_k and -r_j along e_j and e_k.
                    j, k = (d + 1) % 3, (d + 2) % 3
                    column[3 + j] += weight * slope[k]
                    column[3 + k] -= weight * slope[j]


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _add_norm(scale, share, arm, pulled, other_share, other_arm, other_pulled, block):
    """Add ``scale (1 - t t^T)``, on the motion of a vector with direction ``t``, to the block of two frames.

    A frame moves the vector by ``share u + w x arm``, and its length by ``pulled`` (6,).
    """
    p, q, r = scale * arm[0], scale * arm[1], scale * arm[2]
    u, v, w = other_arm[0], other_arm[1], other_arm[2]
    for i in range(6):
        value = scale * pulled[i]
        for j in range(6):
            block[i, j] -= value * other_pulled[j]
    both, along = scale * share * other_share, p * u + q * v + r * w
    for i in range(3):
        block[i, i] += both
        block[3 + i, 3 + i] += along
    # u . (w x other_arm), (w x arm) . u and (w x arm) . (v x other_arm)
    f, g, h = scale * share * u, scale * share * v, scale * share * w
    block[0, 4] += h
    block[0, 5] -= g
    block[1, 5] += f
    block[1, 3] -= h
    block[2, 3] += g
    block[2, 4] -= f
    f, g, h = other_share * p, other_share * q, other_share * r
    block[4, 0] += h
    block[5, 0] -= g
    block[5, 1] += f
    block[3, 1] -= h
    block[3, 2] += g
    block[4, 2] -= f
    block[3, 3] -= u * p
    block[3, 4] -= u * q
    block[3, 5] -= u * r
    block[4, 3] -= v * p
    block[4, 4] -= v * q
    block[4, 5] -= v * r
    block[5, 3] -= w * p
    block[5, 4] -= w * q
    block[5, 5] -= w * r


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _add_chambers(chambers, rows, x, effort, equations, full):
    """Do for chambers what `add_constraints` does for the others."""
    gradient, H, delta, tangent = equations.gradient, equations.H, equations.delta, equations.tangent
    t, pulled, arms = equations.work.way, equations.work.pulled, equations.work.arms
    for c in range(chambers.number.shape[0]):
        delta[chambers.number[c]] = -chambers.rest[c]
    for q in range(chambers.chamber.shape[0]):
        c, area, frames, weights = chambers.chamber[q], chambers.area[q], chambers.frames[q], chambers.weights[q]
        u, v, w = 0.0, 0.0, 0.0
        for a in range(3):
            for k in range(4):
                row, share = frames[a] + k, weights[a, k]
                u += share * x[row, 0]
                v += share * x[row, 1]
                w += share * x[row, 2]
        norm = np.sqrt(u * u + v * v + w * w)
        delta[c] += area * norm
        t[0], t[1], t[2] = u / norm, v / norm, w / norm
        pull = effort[c] * area
        u, v, w = pull * t[0], pull * t[1], pull * t[2]
        for a in range(3):
            for k in range(4):
                row, share = frames[a] + k, weights[a, k]
                gradient[row, 0] -= share * u
                gradient[row, 1] -= share * v
                gradient[row, 2] -= share * w
        if not full:
            continue
        # Frame a, or the one on which it is mounted, moves the tangent by weights[a, 0] u + w x arm.
        for a in range(3):
            mount = chambers.mount[q, a]
            for d in range(3):
                p = 0.0
                for k in range(1, 4):
                    p += weights[a, k] * x[frames[a] + k, d]
                if mount >= 0:
                    p += weights[a, 0] * (x[frames[a], d] - x[mount, d])
                arms[a, d] = p
            arm, part = arms[a], pulled[a]
            part[0], part[1], part[2] = weights[a, 0] * t[0], weights[a, 0] * t[1], weights[a, 0] * t[2]
            part[3], part[4] = arm[1] * t[2] - arm[2] * t[1], arm[2] * t[0] - arm[0] * t[2]
            part[5] = arm[0] * t[1] - arm[1] * t[0]
            b = rows.block[frames[a]]
            if b >= 0:
                for i in range(6):
                    H[c, b, i] += area * part[i]
        # Second derivative of the norm: (1 - t t^T) / norm on the motion of the tangent.
        scale = -pull / norm
        for a in range(3):
            for b in range(3):
                place, share, other = chambers.place[q, a, b], weights[a, 0], weights[b, 0]
                if place >= 0:
                    _add_norm(scale, share, arms[a], pulled[a], other, arms[b], pulled[b], tangent[place])


@njit(cache=True, error_model="numpy", _nrt=False)
def _hold(pattern, components, equations):
    """Replace the equations of components that are held by uncoupled ones."""
    tangent, H, free = equations.tangent, equations.H, components.free
    count = free.shape[0]
    for k in range(count):
        for i in range(6):
            if free[k, i] == 0.0:
                for j in range(6):
                    tangent[k, i, j] = 0.0
                    tangent[k, j, i] = 0.0
                tangent[k, i, i] = 1.0
                for c in range(H.shape[0]):
                    H[c, k, i] = 0.0
        for p in range(pattern.pointers[k], pattern.pointers[k + 1]):
            block, other = tangent[count + p], pattern.columns[p]
            if components.whole[k] and components.whole[other]:
                continue
            for i in range(6):
                for j in range(6):
                    block[i, j] *= free[k, i] * free[other, j]


@njit(cache=True, error_model="numpy", _nrt=False)
def assemble(body, x, effort, step, equations, full):
    """Fill the equations at rows ``x`` (n, 3) and efforts (size,); tangent and ``H`` only if ``full``."""
    forget_near(equations.slides)
    assemble_parts(body, x, effort, step, equations, full, full, full)


@njit(cache=True, error_model="numpy", _nrt=False)
def assemble_parts(body, x, effort, step, equations, full, touching, pressing):
    """Fill the equations as `assemble`, the stiffness of contact only if ``touching``.

    The forces of contact turn with the frames; the tangent has that only if ``pressing``, without which pressed bodies
    may be unstable if they lack the stiffness of what presses on them.
    """
    gradient = equations.gradient
    for row in range(x.shape[0]):
        for d in range(3):
            gradient[row, d] = -step.loads[row, d]
    if full:
        equations.tangent[:] = 0.0
    _add_elements(body.elements, x, step, equations, full)
    _add_drag(body.elements, x, step, equations, full)
    _add_inertia(body.masses, x, step, equations, full)
    add_constraints(body, x, effort, equations, full)
    if full and not pressing:
        add_curvature(body.frames, x, gradient, equations.tangent)
    add_contact(body.contact, equations.slides, x, step.anchors, equations, touching)
    reduce_forces(body.frames, x, gradient, equations.residual)
    free, residual = body.components.free, equations.residual
    for k in range(free.shape[0]):
        for i in range(6):
            residual[k, i] *= free[k, i]
    if full:
        if pressing:
            add_curvature(body.frames, x, gradient, equations.tangent)
        _hold(body.pattern, body.components, equations)
        hold_slides(equations.slides, free)
