"""The state of a solver: the equilibrium equations of a model, linearised and factorised at one state."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csc_matrix, hstack

from softgym_envs.mechanics.assembly import Assembled, Inertia
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.cable_friction import CableFriction, CableMemory, FrictionTerms
from softgym_envs.mechanics.solvers.tangent import Tangent

if TYPE_CHECKING:
    from softgym_envs.mechanics.contact.contact import ContactMemory, ContactState, ContactTerms


class Linearisation:
    """Assembles the equations of a model and keeps the factorised tangent with the compliance of its constraints.

    While points or cables slide with friction, the tangent is ``S + U V^T`` with a symmetric ``S``: ``S`` is
    factorised, and the formula of Woodbury does the rest.

    Args:
        model: the body. Its constraints must not change afterwards.

    Attributes:
        loads: dead loads that act at the solver's current state [N], shape (n, 3); it may apply them in steps.
        inertia: what a time step adds to the equilibrium; None in statics.
        contact: the contacts of the body, or None.
        cable_friction: the frictional cables of the body, or None.
        current: whether this is the linearisation at the solver's current state; the solver resets it.
        located: whether the factorised tangent is that of the equations, and not of a state nearby.
        exact: whether the factorised tangent is exact. Away from an equilibrium, terms of contact that make it
            indefinite are left out.
        residual: of the equilibrium, shape (N,).
        shift: ``H^T A^-1 residual``, shape (size,).
        H: gradients of the constraints, shape (N, size).
        delta: values of the constraints, shape (size,).
        elastic: elastic energy [J].
        W: their compliance ``H^T A^-1 H``, shape (size, size); symmetric unless points or cables slide. Cables with
            friction act along another gradient than ``H``.
    """

    residual: np.ndarray
    shift: np.ndarray
    H: np.ndarray
    delta: np.ndarray
    elastic: float
    W: np.ndarray

    def __init__(self, model: MechanicalModel) -> None:
        self.assembly = model.assembly
        self.loads = np.zeros_like(model.nodes)
        self.inertia: Inertia | None = None
        self.contact: ContactState | None = None
        if model.contact is not None:
            from softgym_envs.mechanics.contact.contact import ContactState

            self.contact = ContactState(model.contact, model.kinematics, model.nodes)
        self.cable_friction = CableFriction.of(model)
        self.current = False
        self.located = True
        self.exact = True
        self._model = model
        self._friction_terms: FrictionTerms | None = None
        self._terms: ContactTerms | None = None
        self._tangent = Tangent(self.assembly.indptr, self.assembly.indices, model.solver)

    @property
    def sliding(self) -> bool:
        """Whether points slide, so that ``W`` is not symmetric."""
        return self._slips > 0

    @property
    def has_friction(self) -> bool:
        """Whether points or cables can slide with friction, which starts anew from each equilibrium."""
        return self.cable_friction is not None or (self.contact is not None and self.contact.has_friction)

    @property
    def memory(self) -> ContactMemory | CableMemory | None:
        """What friction remembers; None without contact and friction of cables."""
        rubbing = self.contact or self.cable_friction
        return None if rubbing is None else rubbing.memory

    def remember(self, x: np.ndarray, memory: ContactMemory | CableMemory | None) -> None:
        """Set the memory of friction; without one, friction starts anew at rows ``x`` (n, 3)."""
        if self.contact is not None:
            if memory is None or isinstance(memory, CableMemory):
                self.contact.begin(x)
            else:
                self.contact.memory = memory
        if self.cable_friction is not None:
            if isinstance(memory, CableMemory):
                self.cable_friction.memory = memory
            else:
                self.cable_friction.begin(x)
        self.current = False

    @property
    def positive_definite(self) -> bool:
        """Whether the factorised tangent is exact and positive definite."""
        return self.exact and self._tangent.solver.positive_definite

    def buckling(self, rows: np.ndarray, compliance: np.ndarray) -> int:
        """Return how many negative eigenvalues ``W`` has in rows that carry efforts; 0 where contact may hold the body.

        The body would buckle if these efforts were given. It is stable with the rows held in place, by drives of a
        ``compliance`` (size,), if its tangent has as many.
        """
        if self.contact is not None:
            return 0
        held = self.W[rows[:, None], rows] + np.diag(compliance[rows])
        return int((np.linalg.eigvalsh(held) < 0.0).sum())

    @property
    def negative_eigenvalues(self) -> int:
        """How many eigenvalues of the factorised tangent are negative; -1 if that is not known."""
        return self._tangent.solver.negative_eigenvalues

    def assemble(self, x: np.ndarray, effort: np.ndarray, *, tangent: bool = True) -> Assembled | None:
        """Return the equations at rows ``x`` (n, 3) and efforts (size,), or None if an element is inverted.

        Without the ``tangent``, `factorise` assembles it. That is faster where it is not likely to be needed.
        """
        loads = self.loads
        if self.contact is not None:
            self._terms = self.contact.evaluate(x)
            loads = loads - self._terms.gradient
        self._effort = effort
        assembled = self.assembly.evaluate(x, effort, loads, self.inertia, tangent=tangent)
        if assembled is None or self.cable_friction is None:
            return assembled
        self._friction_terms = self.cable_friction.evaluate(x, effort)
        return assembled._replace(residual=assembled.residual - self._friction_terms.gradients @ effort)

    def update(self, x: np.ndarray, effort: np.ndarray, *, exact: bool = False) -> bool:
        """Linearise at a state. False if elements are inverted or the tangent is singular."""
        assembled = self.assemble(x, effort)
        return assembled is not None and self.factorise(assembled, x, exact=exact)

    def factorise(self, assembled: Assembled, x: np.ndarray, *, exact: bool = False, definite: bool = False) -> bool:
        """Take over the equations that were assembled last and factorise their tangent. False if it is singular.

        Args:
            assembled: the equations.
            x: rows at which they were assembled, shape (n, 3).
            exact: do not leave out terms of contact.
            definite: without contact, return False for an indefinite tangent too, which takes far longer to factorise.
        """
        if assembled.tangent is None:
            complete = self.assemble(x, self._effort)
            assert complete is not None  # without the tangent no element was inverted either
            assembled = complete
        self.residual, tangent, self.H, self.delta, self.elastic = assembled
        assert tangent is not None
        terms, friction = self._terms, self._friction_terms
        extra = None if terms is None else terms.tangent
        if friction is not None:
            extra = friction.tangent
        self.exact = self._tangent.factorise(tangent, extra, fallback=exact or (terms is None and not definite))
        if not self.exact:
            if terms is None or exact:
                return False
            assert self.contact is not None
            if not self._tangent.factorise(tangent, self.contact.evaluate(x, convex=True).tangent):
                return False
        count = self.H.shape[1]
        self._slips = 0 if terms is None else terms.directions.shape[1]
        extra = None
        if terms is not None:
            assert self.contact is not None
            self.contact.hold(terms)
            if self._slips:
                self._loading = terms.loading
                extra = hstack([terms.directions, terms.loading], format="csc")
        columns = np.empty((len(self.residual), count + 1), order="F")
        columns[:, :count], columns[:, count] = self.H, self.residual
        if friction is not None:
            # Efforts act along G, and H measures what they move.
            columns[:, :count] += friction.gradients
            self._slips, self._loading = friction.directions.shape[1], friction.loading
            extra = hstack([friction.directions, friction.loading, csc_matrix(self.H)], format="csc")
        gram, self._half = self._tangent.solver.condense(columns, extra)
        if not np.isfinite(gram).all():
            return False
        known = slice(0, count + 1)  # columns of the constraints and of the residual
        measured = known if friction is None else slice(len(gram) - count, None)
        response = gram[measured, known]
        if self._slips:
            slide = self._slide
            load = slice(slide.stop, slide.stop + self._slips)
            self._core = np.eye(self._slips) + gram[load, slide]
            try:
                self._slip = np.linalg.solve(self._core, gram[load, known])
            except np.linalg.LinAlgError:
                return False
            response = response - gram[measured, slide] @ self._slip
        W = response[:count, :count]
        self.W = W if self._slips else 0.5 * (W + W.T)
        self.shift = response[:count, count]
        self.current = self.located = True
        return True

    def follow(self, assembled: Assembled) -> None:
        """Take over the equations of an equilibrium that is so near that the factorised tangent still serves.

        ``W`` stays what it was.
        """
        self.residual, _, self.H, self.delta, self.elastic = assembled
        self.located = False
        self.shift = np.zeros_like(self.shift)
        self._half[:, self.H.shape[1]] = 0.0
        if self._slips:
            self._slip[:, self.H.shape[1]] = 0.0
        if self.contact is not None and self._terms is not None:
            self.contact.hold(self._terms)

    def solve(self, residual: np.ndarray) -> np.ndarray:
        """Return ``A^-1 residual``, shape (N,)."""
        solution = self._tangent.solver.solve(residual[:, None])[:, 0]
        if self._slips:
            slip = np.linalg.solve(self._core, self._loading.T @ solution)
            solution = solution - self._tangent.solver.expand(self._half[:, self._slide] @ slip)
        return solution

    def response(self, effort: np.ndarray, residual: float = 0.0) -> np.ndarray:
        """Return ``A^-1 (H effort - r)``, the step of the equations (N,) that efforts (size,) cause.

        Args:
            effort: efforts.
            residual: multiple of the residual of this linearisation to be corrected.
        """
        combined = np.append(effort, -residual)
        half = self._half[:, : len(combined)] @ combined
        if self._slips:
            half = half - self._half[:, self._slide] @ (self._slip @ combined)
        return self._tangent.solver.expand(half)

    def motions(self, count: int) -> np.ndarray:
        """Return the motions of the equations that the efforts of the first constraints cause.

        Args:
            count: number of constraints.

        Returns:
            Shape (N, k), with a largest component of one; constraints that move nothing are left out.
        """
        units = np.eye(self.H.shape[1])[:count]
        motions = np.reshape([self.response(effort) for effort in units], (count, len(self.residual))).T
        largest = np.abs(motions).max(axis=0, initial=0.0)
        return motions[:, largest > 0.0] / largest[largest > 0.0]

    @property
    def _slide(self) -> slice:
        """Columns of the directions of sliding points."""
        first = self.H.shape[1] + 1
        return slice(first, first + self._slips)

    def without_contact(
        self, x: np.ndarray, effort: np.ndarray, columns: np.ndarray, springs: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the compliance of the constraints and of further rows if obstacles had no stiffness.

        Args:
            x: rows at an equilibrium, shape (n, 3).
            effort: efforts of the constraints, shape (size,).
            columns: gradients of the further rows, shape (N, k).
            springs: stiffness of springs that hold the body along the further rows [N/m], shape (k,); zero for none.

        Returns:
            Compliance (size + k, size + k) and values of the constraints (size,); None if the tangent is singular.
        """
        assert self.contact is not None
        assembled = self.assemble(x, effort)
        held = csc_matrix(columns[:, springs > 0.0])
        extra = self.contact.forces_held(x) + (held.multiply(springs[springs > 0.0]) @ held.T).tocsr()
        if assembled is None or assembled.tangent is None or not self._tangent.factorise(assembled.tangent, extra):
            return None
        gram, _ = self._tangent.solver.condense(np.asfortranarray(np.hstack([assembled.gradients, columns])))
        return (gram, assembled.delta) if np.isfinite(gram).all() else None

    def energy(self, x: np.ndarray, stored: float) -> float:
        """Return the energy [J] stored at rows ``x`` (n, 3) less the work of the loads that act."""
        return stored - float(np.vdot(self.loads, x - self._model.nodes))

    def inertial_work(self, start: np.ndarray, end: np.ndarray) -> float:
        """Return the work [J] against the forces that a time step adds, from rows ``start`` to ``end`` (n, 3)."""
        return 0.0 if self.inertia is None else self.assembly.inertial_work(self.inertia, start, end)
