"""The state of a solver: the equilibrium equations of a model, linearised and factorised at one state."""

from __future__ import annotations

import numpy as np

from softgym_envs.mechanics.assembly import Assembled, Inertia
from softgym_envs.mechanics.contact.contact import ContactState, ContactTerms
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.tangent import Tangent


class Linearisation:
    """Assembles the equations of a model and keeps the factorised tangent with the compliance of its constraints.

    While points slide with friction, the tangent is ``S + U V^T`` with a symmetric ``S``: ``S`` is factorised, and the
    formula of Woodbury does the rest.

    Args:
        model: the body. Its constraints must not change afterwards.

    Attributes:
        loads: dead loads that act [N], shape (n, 3); a solver may apply them in steps.
        inertia: what a time step adds to the equilibrium; None in statics.
        contact: the contacts of the body, or None.
        current: whether this is the linearisation at the solver's current state; the solver resets it.
        exact: whether the factorised tangent is exact. Away from an equilibrium, terms of contact that make it
            indefinite are left out.
        residual: of the equilibrium, shape (N,).
        correction: ``A^-1 residual``, shape (N,).
        H: gradients of the constraints, shape (N, size).
        delta: values of the constraints, shape (size,).
        W: their compliance ``H^T A^-1 H``, shape (size, size); symmetric unless points slide.
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
        self.contact = None if model.contact is None else ContactState(model.contact, model.kinematics, model.nodes)
        self.current = False
        self.exact = True
        self._model = model
        self._terms: ContactTerms | None = None
        self._tangent = Tangent(self.assembly.indptr, self.assembly.indices, model.solver)

    @property
    def sliding(self) -> bool:
        """Whether points slide, so that ``W`` is not symmetric."""
        return self._slips > 0

    @property
    def positive_definite(self) -> bool:
        """Whether the factorised tangent is exact and positive definite."""
        return self.exact and self._tangent.solver.positive_definite

    def assemble(self, x: np.ndarray, effort: np.ndarray) -> Assembled | None:
        """Return the equations at rows ``x`` (n, 3) and efforts (size,), or None if an element is inverted."""
        loads = self.loads
        if self.contact is not None:
            self._terms = self.contact.evaluate(x)
            loads = loads - self._terms.gradient
        return self.assembly.evaluate(x, effort, loads, self.inertia)

    def update(self, x: np.ndarray, effort: np.ndarray, *, exact: bool = False) -> bool:
        """Linearise at a state. False if elements are inverted or the tangent is singular."""
        assembled = self.assemble(x, effort)
        return assembled is not None and self.factorise(assembled, x, exact=exact)

    def factorise(self, assembled: Assembled, x: np.ndarray, *, exact: bool = False) -> bool:
        """Take over the equations that were assembled last and factorise their tangent. False if it is singular.

        Args:
            assembled: the equations.
            x: rows at which they were assembled, shape (n, 3).
            exact: do not leave out terms of contact.
        """
        self.residual, tangent, self.H, self.delta, self._elastic = assembled
        terms = self._terms
        extra = None if terms is None else terms.tangent
        self.exact = self._tangent.factorise(tangent, extra, fallback=exact or terms is None)
        if not self.exact:
            if terms is None or exact:
                return False
            assert self.contact is not None
            if not self._tangent.factorise(tangent, self.contact.evaluate(x, convex=True).tangent):
                return False
        count = self.H.shape[1]
        self._slips = 0 if terms is None else terms.directions.shape[1]
        columns = self.H
        if self._slips:
            assert terms is not None
            self._loading = terms.loading
            columns = np.asfortranarray(np.hstack([self.H, terms.directions, terms.loading]))
        gram, self._half = self._tangent.solver.condense(columns)
        if not np.isfinite(gram).all():
            return False
        self.W = 0.5 * (gram[:count, :count] + gram[:count, :count].T)
        if self._slips:
            slide, load = slice(count, count + self._slips), slice(count + self._slips, None)
            self._core = np.eye(self._slips) + gram[load, slide]
            try:
                self._slip_of_effort = np.linalg.solve(self._core, gram[load, :count])
            except np.linalg.LinAlgError:
                return False
            self.W = self.W - gram[:count, slide] @ self._slip_of_effort
        self.correction = self.solve(self.residual)
        self.current = True
        return True

    def solve(self, residual: np.ndarray) -> np.ndarray:
        """Return ``A^-1 residual``, shape (N,)."""
        solution = self._tangent.solver.solve(residual[:, None])[:, 0]
        if self._slips:
            count = self.H.shape[1]
            slip = np.linalg.solve(self._core, self._loading.T @ solution)
            solution = solution - self._tangent.solver.expand(self._half[:, count : count + self._slips] @ slip)
        return solution

    def response(self, effort: np.ndarray) -> np.ndarray:
        """Return ``A^-1 H effort``, the step of the equations (N,) that efforts (size,) cause."""
        count = len(effort)
        half = self._half[:, :count] @ effort
        if self._slips:
            half = half - self._half[:, count : count + self._slips] @ (self._slip_of_effort @ effort)
        return self._tangent.solver.expand(half)

    def without_contact(
        self, x: np.ndarray, effort: np.ndarray, columns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the compliance of the constraints and of further rows if obstacles had no stiffness.

        Args:
            x: rows at an equilibrium, shape (n, 3).
            effort: efforts of the constraints, shape (size,).
            columns: gradients of the further rows, shape (N, k).

        Returns:
            Compliance (size + k, size + k) and values of the constraints (size,); None if the tangent is singular.
        """
        assert self.contact is not None
        assembled = self.assemble(x, effort)
        if assembled is None or not self._tangent.factorise(assembled.tangent, self.contact.forces_held(x)):
            return None
        gram, _ = self._tangent.solver.condense(np.asfortranarray(np.hstack([assembled.gradients, columns])))
        return (gram, assembled.delta) if np.isfinite(gram).all() else None

    def energy(self, x: np.ndarray) -> float:
        """Return the energy [J] at rows ``x`` (n, 3) with the loads that act and limits of friction held; or inf."""
        energy = 0.0 if self.contact is None else self.contact.energy(x)
        if not np.isfinite(energy):
            return np.inf
        return energy + self._model.elastic_energy(x) - self._work_of_loads(x)

    def current_energy(self, x: np.ndarray) -> float:
        """Return `energy` at the rows ``x`` (n, 3) of this linearisation."""
        energy = 0.0 if self.contact is None else self.contact.energy(x)
        return energy + self._elastic - self._work_of_loads(x)

    def _work_of_loads(self, x: np.ndarray) -> float:
        return float(np.vdot(self.loads, x - self._model.nodes))

    def inertial_work(self, start: np.ndarray, end: np.ndarray) -> float:
        """Return the work [J] against the forces that a time step adds, from rows ``start`` to ``end`` (n, 3).

        The forces are taken to change linearly on the way, as they do for motions without rotating frames.
        """
        if self.inertia is None:
            return 0.0
        before, after = (self.assembly.inertia_force(self.inertia, x) for x in (start, end))
        return 0.5 * float(np.vdot(before + after, end - start))
