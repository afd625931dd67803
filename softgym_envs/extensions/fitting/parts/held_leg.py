"""Equilibria of a single leg whose ends are held, without dimensions: length 1, bending stiffness in its plane 1."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.extensions.beams.robots.tetrapod import POISSON_RATIO, printed_leg
from softgym_envs.extensions.beams.solver.block_cholesky import factorise, solve_lower, solve_upper
from softgym_envs.extensions.beams.solver.body import beam_body
from softgym_envs.extensions.beams.solver.equations import Step, assemble, make_equations
from softgym_envs.extensions.beams.solver.frames import move, orthonormalise
from softgym_envs.mechanics.assembly import MassMatrix
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.compilation import njit

HOLD = 1e9
"""Stiffness of the springs that hold the tip; the leg's own is of order 1 to 1e5."""
TOLERANCE, MAX_ITERATIONS = 1e-8, 80
"""Length of the last Newton step, and the largest number of steps for one state."""
STRIDE, TURN = 0.05, 0.12
"""How far the tip moves in one iteration, and by how much it turns [rad]."""
FAILED = -1


class HeldStates(NamedTuple):
    """Equilibria of a leg along a path of its tip.

    Attributes:
        wrench: force and moment that hold the tip, in the axes of the root, shape (k, 6).
        energy: elastic energy less the work of the weight, shape (k,).
        middle: place of the middle of mass, shape (k, 3).
        compliance: of the tip's place and spin when it is let go, shape (k, 6, 6); NaN where it cannot be computed.
        negative: number of directions in which the held leg is unstable, `FAILED` where no equilibrium was found.
    """

    wrench: np.ndarray
    energy: np.ndarray
    middle: np.ndarray
    compliance: np.ndarray
    negative: np.ndarray


class HeldLeg:
    """A leg with a held root.

    Args:
        shape: width and thickness over its length, and three printed curvatures times it, shape (5,).
        elements: number of quadratic beam elements.
    """

    def __init__(self, shape: np.ndarray, elements: int) -> None:
        width, thickness, *curvatures = (float(value) for value in shape)
        rows = printed_leg(curvatures, 1.0, 2 * elements + 1)
        builder = ModelBuilder()
        frames = [builder.add_frame(row[0], row[1:].T, fixed=k == 0, fixed_spin=k == 0) for k, row in enumerate(rows)]
        builder.add_element(
            Beam,
            frames,
            section=Section.rectangle(width, thickness),
            young_modulus=12.0 / (width * thickness**3),
            poisson_ratio=POISSON_RATIO,
            density=1.0 / (width * thickness),
            stress_free=rows,
        )
        model = builder.build()
        (beam,) = (block for block in model.blocks if isinstance(block, Beam))
        count = len(model.nodes)
        self._body = beam_body(model, MassMatrix(csr_matrix((count, count)), np.zeros(0)))
        self._equations = make_equations(self._body, 0)
        self._nodes, self._masses = model.nodes, beam.nodal_masses(count)
        self._tip = frames[-1]
        self._block = int(self._body.rows.block[self._tip])
        self._strains = np.zeros((len(self._body.elements.frames), 2, 6))

    def follow(self, targets: np.ndarray, weights: np.ndarray) -> HeldStates:
        """Move the tip of the printed leg along poses and return its equilibria; none after the first that fails.

        Args:
            targets: rows of the tip's frame, shape (k, 4, 3).
            weights: of the leg, shape (k, 3).
        """
        k = len(targets)
        found = HeldStates(
            np.full((k, 6), np.nan),
            np.full(k, np.nan),
            np.full((k, 3), np.nan),
            np.full((k, 6, 6), np.nan),
            np.full(k, FAILED),
        )
        _follow(
            self._body,
            self._equations,
            self._nodes.copy(),
            self._tip,
            self._block,
            self._masses,
            np.ascontiguousarray(targets, dtype=float),
            np.ascontiguousarray(weights, dtype=float),
            self._strains,
            *found,
        )
        return found


@njit(cache=True, error_model="numpy")
def _rotation_vector(target, x, row, out):
    """Fill ``out`` (3,) with the rotation vector from the frame at ``row`` to that in the rows of target."""
    R = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(1, 4):
                R[i, j] += target[k, i] * x[row + k, j]
    angle = np.arccos(min(1.0, max(-1.0, 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0))))
    factor = 0.5 if angle < 1e-6 else 0.5 * angle / np.sin(angle)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i] = factor * (R[k, j] - R[j, k])


@njit(cache=True, error_model="numpy")
def _solve(tangent, pattern, signs, step):
    """Solve in place with the factor of the tangent."""
    solve_lower(tangent, pattern.pointers, pattern.columns, step)
    for a in range(step.shape[0]):
        for b in range(6):
            step[a, b] *= signs[a, b]
    solve_upper(tangent, pattern.pointers, pattern.columns, step)


@njit(cache=True, error_model="numpy")
def _hold(body, equations, x, state, row, tip, target, signs, motion, wrench):
    """Find the equilibrium with the tip at a target pose; return the number of negative pivots, or FAILED."""
    turned, spin, none = np.empty((3, 3)), np.empty(3), np.zeros(0)
    pattern = body.pattern
    for _ in range(MAX_ITERATIONS):
        assemble(body, x, none, state, equations, True)
        residual = equations.residual
        for d in range(6):
            wrench[d] = residual[tip, d]
        _rotation_vector(target, x, row, spin)
        longest = 1.0
        for d in range(3):
            longest = max(longest, abs(target[0, d] - x[row, d]) / STRIDE, abs(spin[d]) / TURN)
        for d in range(3):
            residual[tip, d] = -HOLD * (target[0, d] - x[row, d]) / longest
            residual[tip, 3 + d] = -HOLD * spin[d] / longest
        for d in range(6):
            equations.tangent[tip, d, d] += HOLD
        negative = factorise(equations.tangent, pattern.pointers, pattern.targets, signs)
        if negative < 0:
            return FAILED
        motion[:] = residual
        _solve(equations.tangent, pattern, signs, motion)
        size = np.abs(motion).max()
        if not size < 1e3:
            return FAILED
        motion *= -min(1.0, 0.4 / max(size, 1e-30))
        move(body.frames, x, motion, turned)
        if size < TOLERANCE and longest == 1.0:
            orthonormalise(body.frames, x)
            return negative
    return FAILED


@njit(cache=True, error_model="numpy")
def _follow(
    body, equations, x, row, tip, masses, targets, weights, strains, wrenches, energies, middles, compliances, negatives
):  # fmt: skip
    none, still, loads = np.zeros(0), np.zeros(x.shape), np.zeros(x.shape)
    signs, motion = np.ones(equations.residual.shape), np.zeros(equations.residual.shape)
    pattern = body.pattern
    for k in range(targets.shape[0]):
        for i in range(x.shape[0]):
            for d in range(3):
                loads[i, d] = masses[i] * weights[k, d]
        state = Step(x.copy(), still, strains, loads, np.inf, 0.0, 0.0, None)
        negatives[k] = _hold(body, equations, x, state, row, tip, targets[k], signs, motion, wrenches[k])
        if negatives[k] < 0:
            return
        middle = middles[k]
        middle[:] = 0.0
        for i in range(x.shape[0]):
            for d in range(3):
                middle[d] += masses[i] * x[i, d]
        assemble(body, x, none, state, equations, True)
        energies[k] = equations.energy[0]
        for d in range(3):
            energies[k] -= middle[d] * weights[k, d]
        for d in range(6):
            wrenches[k, d] = equations.residual[tip, d]
        # The compliance of a free tip may have negative eigenvalues: the stiffness is its inverse all the same.
        if factorise(equations.tangent, pattern.pointers, pattern.targets, signs) < 0:
            continue
        for j in range(6):
            motion[:] = 0.0
            motion[tip, j] = 1.0
            _solve(equations.tangent, pattern, signs, motion)
            for i in range(6):
                compliances[k, i, j] = motion[tip, i]
