"""The state of a solver: the equilibrium equations of a model, linearised and factorised at one state."""

from __future__ import annotations

import numpy as np

from softgym_envs.mechanics.assembly import Assembled, Inertia
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.linear import SuperLUSolver, make_solver


class Linearisation:
    """Assembles the equations of a model and keeps the factorised tangent with the compliance of its constraints.

    Args:
        model: the body. Its constraints must not change afterwards.

    Attributes:
        loads: dead loads that act [N], shape (n, 3); a solver may apply them in steps.
        inertia: what a time step adds to the equilibrium; None in statics.
        current: whether this is the linearisation at the solver's current state; the solver resets it.
        residual: of the equilibrium, shape (N,).
        correction: ``A^-1 residual``, shape (N,).
        H: gradients of the constraints, shape (N, size).
        delta: values of the constraints, shape (size,).
        W: their compliance ``H^T A^-1 H``, shape (size, size).
    """

    residual: np.ndarray
    correction: np.ndarray
    H: np.ndarray
    delta: np.ndarray
    W: np.ndarray

    def __init__(self, model: MechanicalModel) -> None:
        self.assembly = model.assembly
        self.loads = np.zeros_like(model.nodes)
        self.inertia: Inertia | None = None
        self.current = False
        self._solver = make_solver(model.solver, self.assembly.indptr, self.assembly.indices)
        self._fallback: SuperLUSolver | None = None
        self._active = self._solver

    @property
    def positive_definite(self) -> bool:
        """Whether the factorised tangent is positive definite."""
        return self._active.positive_definite

    def assemble(self, x: np.ndarray, effort: np.ndarray) -> Assembled | None:
        """Return the equations at rows ``x`` (n, 3) and efforts (size,), or None if an element is inverted."""
        return self.assembly.evaluate(x, effort, self.loads, self.inertia)

    def update(self, x: np.ndarray, effort: np.ndarray) -> bool:
        """Linearise at a state. False if elements are inverted or the tangent is singular."""
        assembled = self.assemble(x, effort)
        return assembled is not None and self.factorise(assembled)

    def factorise(self, assembled: Assembled) -> bool:
        """Take over assembled equations and factorise their tangent. False if it is singular."""
        self.residual, tangent, self.H, self.delta = assembled
        self._active = self._solver
        if not self._solver.factorise(tangent):
            # Cholesky fails on a tangent that is indefinite although the constrained problem is stable.
            if self._fallback is None:
                self._fallback = SuperLUSolver(self._solver.indptr, self._solver.indices)
            if not self._fallback.factorise(tangent):
                return False
            self._active = self._fallback
        self.correction = self.solve(self.residual)
        W, self._half = self._active.condense(self.H)
        if not np.isfinite(W).all():
            return False
        self.W = 0.5 * (W + W.T)
        self.current = True
        return True

    def solve(self, residual: np.ndarray) -> np.ndarray:
        """Return ``A^-1 residual``, shape (N,)."""
        return self._active.solve(residual[:, None])[:, 0]

    def response(self, effort: np.ndarray) -> np.ndarray:
        """Return ``A^-1 H effort``, the step of the equations (N,) that efforts (size,) cause."""
        return self._active.expand(self._half @ effort)
