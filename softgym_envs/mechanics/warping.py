"""Warping of Newton steps: turns a linear step into a large bending motion without spurious growth.

Rotation-strain warping (Huang et al. 2011): every solid element is rotated by the exponential of the step's spin and
strained by its symmetric part, and the nodes follow in the least-squares sense (a Poisson problem, factorised once).
Beams are treated the same way, along their axis. The result equals the linear step to first order, so Newton's method
keeps its quadratic convergence and takes far larger steps in bending.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_matrix, tril
from scipy.sparse.csgraph import connected_components

from softgym_envs.mechanics.elements.block import ElementBlock
from softgym_envs.mechanics.kinematics import Kinematics
from softgym_envs.mechanics.solvers.linear import LinearSolver, make_solver


@dataclass(frozen=True)
class _PoissonProblem:
    """The Poisson problem along some axes: free rows, known rows, the coupling between them, and its solver."""

    axes: np.ndarray
    free: np.ndarray
    known: np.ndarray
    coupling: csc_matrix | None
    solver: LinearSolver


class Warping:
    """Bends linear steps of the equations into displacements of all rows.

    Args:
        kinematics: degrees of freedom of the body.
        blocks: its element blocks.
        solver: name of the linear solver.
        floating: allow parts that no fixed node holds; they keep their linear step.

    Raises:
        ValueError: if a part is not connected to a fixed node and ``floating`` is False.
    """

    def __init__(self, kinematics: Kinematics, blocks: Sequence[ElementBlock], *, solver: str, floating: bool) -> None:
        self._kinematics = kinematics
        self._blocks = blocks
        self._problems: list[_PoissonProblem] = []
        entries = [block.laplacian_entries() for block in blocks]
        rows, columns, values = (np.concatenate(parts) for parts in zip(*entries, strict=True))
        n = len(kinematics.fixed)
        laplacian = csc_matrix((values, (rows, columns)), shape=(n, n))
        touched = np.zeros(n, dtype=bool)
        touched[rows] = True
        frames = kinematics.frames
        carried = np.zeros(n, dtype=bool)
        carried[frames.carried] = True
        # A rigid part moves as a whole: its origin must not be warped apart from what it carries.
        carried[frames.rows[frames.owner[frames.moves > 0.0]]] = True
        _, part = connected_components(laplacian, directed=False)
        # Nodes may be held along some axes only; axes that hold the same nodes share a factorisation.
        patterns, group = np.unique(kinematics.held | carried[:, None], axis=1, return_inverse=True)
        for number, held in enumerate(patterns.T):
            anchored = np.isin(part, part[held & touched])
            if not floating and not anchored[touched].all():
                raise ValueError("the mesh has a part that is not connected to a fixed node")
            free = np.flatnonzero(touched & anchored & ~held)
            if not len(free):
                continue
            known = np.flatnonzero(carried & touched)
            lower = tril(laplacian[free][:, free], format="csc")
            lower.sort_indices()
            factor = make_solver(solver, lower.indptr, lower.indices)
            if not factor.factorise(lower.data):
                raise ValueError("the Laplacian of the mesh cannot be factorised")
            coupling = laplacian[free][:, known] if len(known) else None
            axes = np.flatnonzero(group.ravel() == number)
            self._problems.append(_PoissonProblem(axes, free[:, None], known[:, None], coupling, factor))

    def displacement(self, x: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Displacement of all rows (n, 3) by a step of the equations (N,) from rows ``x`` (n, 3), warped."""
        kinematics = self._kinematics
        full = kinematics.displacement(x, step)
        linear = kinematics.row_velocity(x, step) if kinematics.map is not None else full.copy()
        rhs = np.zeros_like(full)
        for block in self._blocks:
            block.add_warped(x, linear, rhs)
        for problem in self._problems:
            right = rhs[problem.free, problem.axes]
            if problem.coupling is not None:
                right = right - problem.coupling @ full[problem.known, problem.axes]
            full[problem.free, problem.axes] = problem.solver.solve(right)
        return full
