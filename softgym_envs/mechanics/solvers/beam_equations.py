"""The compiled equations of a body of beams, for an equilibrium or an implicit Euler step, and their derivative.

Arrays are those of `BeamBody`. The sums are those of the general assembly (`Assembly`); the equations are those of
frames, six for each, of which some may be held. Tests compare both.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from softgym_envs.mechanics.elements.beam_kernels import (
    add_forces,
    add_geometric,
    add_turned,
    interpolate,
    pull_back,
    strain_columns,
    strains,
)
from softgym_envs.mechanics.solvers.beam_body import DIRECTOR, FIXED, MOUNTED, ORIGIN, BeamBody
from softgym_envs.mechanics.solvers.block_cholesky import SIZE


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
    """

    x: np.ndarray
    velocity: np.ndarray
    strains: np.ndarray
    loads: np.ndarray
    h: float
    mass_damping: float
    stiffness_damping: float


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
        element: tangent of an element over the motions of its frames, shape (18, 18).
        columns: derivatives of the strains, shape (18, 12).
    """

    gradient: np.ndarray
    momentum: np.ndarray
    residual: np.ndarray
    tangent: np.ndarray
    delta: np.ndarray
    H: np.ndarray
    energy: np.ndarray
    element: np.ndarray
    columns: np.ndarray


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
        element=np.zeros((18, 18)),
        columns=np.zeros((18, 12)),
    )


@njit(cache=True, error_model="numpy")
def point_strains(elements, x, out):
    """Fill ``out`` (m, 2, 6) with the strains at the Gauss points, those at rest included, at rows ``x`` (n, 3)."""
    z = np.empty((7, 3))
    for e in range(elements.frames.shape[0]):
        for q in range(2):
            interpolate(x, elements.frames[e], elements.shape[q], elements.slope[e, q], z)
            strains(z, out[e, q])


@njit(cache=True, error_model="numpy")
def drag_work(elements, x, step):
    """Return the work [J] that the stiffness damping takes on the way to rows ``x`` (n, 3)."""
    z, end = np.empty((7, 3)), np.empty(6)
    work = 0.0
    for e in range(elements.frames.shape[0]):
        for q in range(2):
            interpolate(x, elements.frames[e], elements.shape[q], elements.slope[e, q], z)
            strains(z, end)
            for s in range(6):
                change = end[s] - step.strains[e, q, s]
                work += step.stiffness_damping / step.h * elements.stiffness[e, q, s] * change**2
    return work


@njit(cache=True, error_model="numpy")
def _add_arm(rows, arm, a):
    """Let frame ``a`` of an element's matrix (18, 18) follow another one, from whose origin it is ``arm`` away."""
    u, w = 6 * a, 6 * a + 3
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for c in range(18):
            rows[w + i, c] += arm[j] * rows[u + k, c] - arm[k] * rows[u + j, c]
    for c in range(18):
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            rows[c, w + i] += arm[j] * rows[c, u + k] - arm[k] * rows[c, u + j]


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _fill_gram(columns, out):
    """Fill ``out`` (18, 18) with ``C C^T`` for an array ``C`` (18, 12)."""
    for i in range(18):
        for j in range(i + 1):
            value = 0.0
            for r in range(12):
                value += columns[i, r] * columns[j, r]
            out[i, j] = value
            out[j, i] = value


@njit(cache=True, error_model="numpy")
def _add_elements(elements, x, step, equations, full):
    """Add the forces of the elements and, if ``full``, their tangents."""
    gradient, tangent = equations.gradient, equations.tangent
    matrix, columns = equations.element, equations.columns
    frames_of, shapes, slopes = elements.frames, elements.shape, elements.slope
    stiffnesses, rests, places = elements.stiffness, elements.rest, elements.place
    z, pull = np.empty((7, 3)), np.empty((7, 3))
    stress, scale = np.empty((2, 6)), np.empty(6)
    arm = np.empty(3)
    rate = step.stiffness_damping / step.h
    elastic = 0.0
    for e in range(frames_of.shape[0]):
        frames = frames_of[e]
        for q in range(2):
            shape, slope, stiffness, rest = shapes[q], slopes[e, q], stiffnesses[e, q], rests[e, q]
            tension, start = stress[q], step.strains[e, q]
            interpolate(x, frames, shape, slope, z)
            strains(z, tension)
            for s in range(6):
                strain, change = tension[s] - rest[s], tension[s] - start[s]
                elastic += 0.5 * stiffness[s] * strain**2
                tension[s] = stiffness[s] * (strain + rate * change)
            for v in range(7):
                for d in range(3):
                    pull[v, d] = 0.0
            pull_back(z, tension, pull)
            add_forces(pull, frames, shape, slope, gradient)
            if full:
                for s in range(6):
                    scale[s] = np.sqrt((1.0 + rate) * stiffness[s])
                strain_columns(x, frames, shape, slope, z, scale, columns[:, 6 * q : 6 * q + 6])
        if not full:
            continue
        _fill_gram(columns, matrix)
        for q in range(2):
            add_geometric(x, frames, shapes[q], slopes[e, q], stress[q], matrix)
        for a in range(3):
            if elements.mount[e, a] >= 0:
                for d in range(3):
                    arm[d] = x[frames[a], d] - x[elements.mount[e, a], d]
                _add_arm(matrix, arm, a)
        for a in range(3):
            for b in range(3):
                place = places[e, a, b]
                if place >= 0:
                    block = tangent[place]
                    for i in range(6):
                        for j in range(6):
                            block[i, j] += matrix[6 * a + i, 6 * b + j]
    equations.energy[0] = elastic


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def _vector(rows, x, row, out):
    """Fill ``out`` (3,) with the part of a row that turns with its frame; return whether the origin moves the row."""
    kind = rows.kind[row]
    for d in range(3):
        out[d] = x[row, d] if kind == DIRECTOR else x[row, d] - x[rows.origin[row], d]
    return kind != DIRECTOR


@njit(cache=True, error_model="numpy")
def _add_inertia(masses, rows, x, step, equations, full):
    """Add the forces of inertia and of mass damping and, if ``full``, their tangents."""
    factor = (1.0 / step.h + step.mass_damping) / step.h
    start, velocity, momentum = step.x, step.velocity, equations.momentum
    for row in range(x.shape[0]):
        for d in range(3):
            # M ((v' - v) / h + alpha v') with v' = (x - x_n) / h
            momentum[row, d] = factor * (x[row, d] - start[row, d]) - velocity[row, d] / step.h
    multiply_mass(masses, momentum, equations.gradient)
    if not full or factor == 0.0:
        return
    r, s = np.empty(3), np.empty(3)
    tangent, pairs, entries = equations.tangent, masses.pairs, masses.entries
    for k in range(pairs.shape[0]):
        first, second = pairs[k, 0], pairs[k, 1]
        block, m = tangent[pairs[k, 2]], factor * entries[k]
        moves, follows = _vector(rows, x, first, r), _vector(rows, x, second, s)
        twice = first != second and rows.block[first] == rows.block[second]
        for half in range(2 if twice else 1):
            if half == 1:
                r, s = s, r
                moves, follows = follows, moves
            if moves and follows:
                for d in range(3):
                    block[d, d] += m
            if rows.kind[first] != ORIGIN or rows.kind[second] != ORIGIN:
                add_turned(r, s, m, block, 3, 3)
                for i in range(3):
                    j, n = (i + 1) % 3, (i + 2) % 3
                    if moves:  # u . (w x s)
                        block[i, 3 + j] += m * s[n]
                        block[i, 3 + n] -= m * s[j]
                    if follows:  # (w x r) . u
                        block[3 + j, i] += m * r[n]
                        block[3 + n, i] -= m * r[j]


@njit(cache=True, error_model="numpy")
def _reduce(rows, x, forces, out):
    """Fill ``out`` (b, 6) with the forces and moments of ``forces`` (n, 3) on the frames."""
    for k in range(out.shape[0]):
        for i in range(6):
            out[k, i] = 0.0
    r = np.empty(3)
    for row in range(x.shape[0]):
        kind = rows.kind[row]
        if kind == FIXED:
            continue
        target, g = out[rows.block[row]], forces[row]
        if kind != DIRECTOR:
            for d in range(3):
                target[d] += g[d]
        if kind != ORIGIN:
            _vector(rows, x, row, r)
            target[3] += r[1] * g[2] - r[2] * g[1]
            target[4] += r[2] * g[0] - r[0] * g[2]
            target[5] += r[0] * g[1] - r[1] * g[0]


@njit(cache=True, error_model="numpy")
def _add_curvature(rows, x, gradient, tangent):
    """Add the second derivative of rotations, ``(g r^T + r g^T) / 2 - (g . r) 1`` for each row that turns."""
    r = np.empty(3)
    for row in range(x.shape[0]):
        if rows.kind[row] != DIRECTOR and rows.kind[row] != MOUNTED:
            continue
        _vector(rows, x, row, r)
        g, block = gradient[row], tangent[rows.block[row]]
        dot = g[0] * r[0] + g[1] * r[1] + g[2] * r[2]
        for i in range(3):
            for j in range(3):
                block[3 + i, 3 + j] += 0.5 * (g[i] * r[j] + r[i] * g[j])
            block[3 + i, 3 + i] -= dot


@njit(cache=True, error_model="numpy")
def add_constraints(body, x, effort, equations, full):
    """Fill the values of the constraints, and subtract the forces of their efforts; if ``full``, fill ``H``, too."""
    servos, points, rows = body.servos, body.points, body.rows
    gradient, H, delta, tangent = equations.gradient, equations.H, equations.delta, equations.tangent
    slope, curved = np.empty(3), np.empty(3)
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


@njit(cache=True, error_model="numpy")
def _add_chambers(chambers, rows, x, effort, equations, full):
    """Do for chambers what `add_constraints` does for the others."""
    gradient, H, delta, tangent = equations.gradient, equations.H, equations.delta, equations.tangent
    t, motion = np.empty(3), np.empty((3, 18))
    for c in range(chambers.number.shape[0]):
        delta[chambers.number[c]] = -chambers.rest[c]
    for q in range(chambers.chamber.shape[0]):
        c, area, frames, weights = chambers.chamber[q], chambers.area[q], chambers.frames[q], chambers.weights[q]
        t[:] = 0.0
        for a in range(3):
            for k in range(4):
                for d in range(3):
                    t[d] += weights[a, k] * x[frames[a] + k, d]
        norm = np.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
        delta[c] += area * norm
        for d in range(3):
            t[d] /= norm
        pull = effort[c] * area
        for a in range(3):
            for k in range(4):
                for d in range(3):
                    gradient[frames[a] + k, d] -= pull * weights[a, k] * t[d]
        if not full:
            continue
        # The motion of the tangent: frame a moves it by weights[a, 0] u + w x p.
        for a in range(3):
            for d in range(3):
                e, f = (d + 1) % 3, (d + 2) % 3
                p = 0.0
                for k in range(1, 4):
                    p += weights[a, k] * x[frames[a] + k, d]
                for g in range(3):
                    motion[g, 6 * a + d] = weights[a, 0] if g == d else 0.0
                # w x p has the components w_f p_d along e and -w_e p_d along f.
                motion[d, 6 * a + 3 + d] = 0.0
                motion[e, 6 * a + 3 + f] = p
                motion[f, 6 * a + 3 + e] = -p
        for a in range(3):
            block = rows.block[frames[a]]
            if block >= 0:
                for i in range(6):
                    for d in range(3):
                        H[c, block, i] += area * motion[d, 6 * a + i] * t[d]
        # Second derivative of the norm: (1 - t t^T) / norm on the motion of the tangent.
        for i in range(18):
            along = motion[0, i] * t[0] + motion[1, i] * t[1] + motion[2, i] * t[2]
            for d in range(3):
                motion[d, i] -= along * t[d]
        for a in range(3):
            for b in range(3):
                place = chambers.place[q, a, b]
                if place >= 0:
                    block, scale = tangent[place], -pull / norm
                    for i in range(6):
                        for d in range(3):
                            value = scale * motion[d, 6 * a + i]
                            for j in range(6):
                                block[i, j] += value * motion[d, 6 * b + j]


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def assemble(body, x, effort, step, equations, full):
    """Fill the equations at rows ``x`` (n, 3) and efforts (size,); tangent and ``H`` only if ``full``."""
    gradient = equations.gradient
    for row in range(x.shape[0]):
        for d in range(3):
            gradient[row, d] = -step.loads[row, d]
    if full:
        equations.tangent[:] = 0.0
    _add_elements(body.elements, x, step, equations, full)
    _add_inertia(body.masses, body.rows, x, step, equations, full)
    add_constraints(body, x, effort, equations, full)
    _reduce(body.rows, x, gradient, equations.residual)
    free, residual = body.components.free, equations.residual
    for k in range(free.shape[0]):
        for i in range(6):
            residual[k, i] *= free[k, i]
    if full:
        _add_curvature(body.rows, x, gradient, equations.tangent)
        _hold(body.pattern, body.components, equations)


@njit(cache=True, error_model="numpy")
def move(frames, x, motion, turned):
    """Move the frames in place by ``motion`` (b, 6): displacements of their origins [m], and spins [rad].

    ``turned`` (3, 3) is a work array.
    """
    gram = np.empty((3, 3))
    for f in range(frames.rows.shape[0]):
        row, step = frames.rows[f], motion[frames.block[f]]
        a, b, c = step[3], step[4], step[5]
        square = a * a + b * b + c * c
        if square < 1e-3:  # sin(t) / t and (1 - cos(t)) / t^2 to rounding
            first = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0)))
            second = 0.5 - square / 24.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0 * (1.0 - square / 90.0)))
        else:
            angle = np.sqrt(square)
            half = np.sin(0.5 * angle)
            first, second = np.sin(angle) / angle, 2.0 * half * half / square
        for k in range(3):
            p, q, r = x[row + 1 + k, 0], x[row + 1 + k, 1], x[row + 1 + k, 2]
            u, v, w = b * r - c * q, c * p - a * r, a * q - b * p
            turned[k, 0] = p + first * u + second * (b * w - c * v)
            turned[k, 1] = q + first * v + second * (c * u - a * w)
            turned[k, 2] = r + first * w + second * (a * v - b * u)
        # Orthonormalise, so that round-off does not accumulate over a long motion.
        for k in range(3):
            for m in range(3):
                gram[k, m] = turned[k, 0] * turned[m, 0] + turned[k, 1] * turned[m, 1] + turned[k, 2] * turned[m, 2]
        for k in range(3):
            for d in range(3):
                value = 1.5 * turned[k, d]
                for m in range(3):
                    value -= 0.5 * gram[k, m] * turned[m, d]
                x[row + 1 + k, d] = value
        for d in range(3):
            x[row, d] += step[d]
    for c in range(frames.mounted.shape[0]):
        row, origin = frames.mounted[c], frames.owner[c]
        for d in range(3):
            value = frames.moves[c] * x[origin, d]
            for k in range(3):
                value += frames.arm[c, k] * x[origin + 1 + k, d]
            x[row, d] = value


@njit(cache=True, error_model="numpy")
def motion_of(frames, free, x, velocity, h, out):
    """Fill ``out`` (b, 6) with ``h`` times the motion of the frames at ``x`` (n, 3) with velocities of the rows."""
    for f in range(frames.rows.shape[0]):
        row, block = frames.rows[f], frames.block[f]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            out[block, i] = h * velocity[row, i]
            spin = 0.0
            for m in range(1, 4):
                spin += x[row + m, j] * velocity[row + m, k] - x[row + m, k] * velocity[row + m, j]
            out[block, 3 + i] = 0.5 * h * spin
        for i in range(6):
            out[block, i] *= free[block, i]
