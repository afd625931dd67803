"""Static equilibrium of displacement- and effort-driven actuators: loads and commands in increments.

Each increment is solved by `Newton`; one that fails is divided.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from softgym_envs.arguments import explained
from softgym_envs.errors import ConvergenceError, no_equilibrium
from softgym_envs.mechanics.condensation import ContactModel
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.equilibrium import (
    CAUTIOUS,
    Conditions,
    Equilibrium,
    NewtonFailure,
    RowLayout,
    check_contact,
    check_shapes,
    checked,
    checked_modes,
)
from softgym_envs.mechanics.solvers.newton import Newton
from softgym_envs.mechanics.surfaces import ShapeCheck

if TYPE_CHECKING:
    from softgym_envs.mechanics.contact.contact import ContactMemory
    from softgym_envs.mechanics.solvers.cable_friction import CableMemory
    from softgym_envs.mechanics.solvers.compiled import CompiledSolver


@explained
class Statics(Newton):
    """Finds the equilibria of a model under changing commands, starting each solve from the last state.

    Args:
        model: the body.
        tolerance: largest remaining correction of any node at convergence [m].
        max_iterations: limit of Newton iterations per load increment.
        max_halvings: the smallest load increment is ``0.5 ** max_halvings`` of the whole step.
        exact_compliance: compute ``W`` and stability at each equilibrium. Otherwise they may be those of the last
            iterate, which saves a factorisation; without friction, `exact_at` computes them later.
        compiled: use the compiled solver of an installed package where one knows the body; the equilibria are the same.

    Attributes:
        x: current node positions [m], shape (n, 3), and ``effort``: current efforts of all rows, shape (size,).
        unilateral: actuator rows that cannot push, shape (n_a,); may be changed between solves.
        compliance: of the drives of all rows, shape (size,), see `Constraint`; may be changed between solves.
        linearisation: the equations linearised where the last iteration ended.
    """

    _moving = False

    def __init__(
        self,
        model: MechanicalModel,
        *,
        tolerance: float = 1e-10,
        max_iterations: int = 30,
        max_halvings: int = 8,
        exact_compliance: bool = True,
        compiled: bool = True,
    ) -> None:
        if not (np.isfinite(tolerance) and tolerance > 0.0):
            raise ValueError(f"tolerance = {tolerance} m must be positive and finite")
        if max_iterations < 1 or max_halvings < 0:
            given = f"max_iterations = {max_iterations}, max_halvings = {max_halvings}"
            raise ValueError(f"{given}; allowed: 1 iteration or more, and no negative number of halvings")
        super().__init__(model, tolerance=tolerance, max_iterations=max_iterations, exact_compliance=exact_compliance)
        self.max_halvings = max_halvings
        self._elasticity_version = model.elasticity_version
        self._layout, self._shape = RowLayout.of(model), ShapeCheck.of(model)
        self._compiled = self._asked = compiled
        self._lumped = False
        self._special: CompiledSolver | None = None
        self.reset()

    def reset(self) -> None:
        """Go back to the undeformed shape with no effort. The equilibrium under loads is found by `solve`."""
        self.x = self.model.nodes.copy()
        self.effort = np.zeros(self._assembly.size)
        self.linearisation.loads = np.zeros_like(self.x)
        self._remember(None)

    def restore(self, x: np.ndarray, effort: np.ndarray, *, memory: ContactMemory | CableMemory | None = None) -> None:
        """Start the next solve from node positions ``x`` (n, 3) and efforts (size,) of all rows.

        Args:
            x: node positions [m].
            effort: efforts of all rows.
            memory: what friction remembers at this state; by default there are no friction forces.

        Raises:
            ValueError: for another number of nodes or efforts, as those of another body.
        """
        check_shapes(x, effort, self.model.nodes.shape, self._assembly.size)
        self.x = x.copy()
        self.effort = effort.copy()
        self.linearisation.loads = self.model.loads
        self._remember(memory)

    @property
    def snapshot(self) -> tuple:
        """State that a solve starts from; assign it to undo solves."""
        return self.x, self.effort, self.memory

    @snapshot.setter
    def snapshot(self, kept: tuple) -> None:
        self.restore(*kept[:2], memory=kept[2])

    @property
    def memory(self) -> ContactMemory | CableMemory | None:
        """What friction remembers at the current state; None without contact and friction of cables."""
        return self.linearisation.memory

    def _remember(self, memory: ContactMemory | CableMemory | None) -> None:
        """Set the memory of friction; without one, friction starts anew at the current state."""
        self._bend = None
        self.linearisation.remember(self.x, memory)

    def solve(
        self,
        target: Sequence[float] | np.ndarray,
        mode: str | Sequence[str] = "displacement",
        *,
        effector_force: Sequence[float] | np.ndarray | None = None,
        contact: Sequence[float] | np.ndarray | None = None,
        contact_mode: str = "effort",
    ) -> Equilibrium:
        """Find the equilibrium under commanded actuators.

        Args:
            target: one value per actuator row: displacement [m, m3, ...] or effort [N, Pa, ...].
            mode: ``"displacement"`` or ``"effort"`` for all actuators, or one of them per row.
            effector_force: loads on the effector rows [N], shape (n_e,); default none.
            contact: forces on the contact rows [N], or positions [m] that they are driven to, shape (n_c,); default
                no force.
            contact_mode: ``"effort"`` (forces) or ``"displacement"`` (driven positions).

        Returns:
            The equilibrium. Unilateral actuators driven in displacement may end slack: their displacement is then
            larger than commanded, and their effort is zero.

        Raises:
            ConvergenceError: if no equilibrium is found that a body can have; the last converged state is kept.
            ValueError: for a wrong shape, a non-finite value, an unknown mode, or a negative effort on an actuator that
                cannot push.
        """
        count = self._actuators
        target = checked("target", target, count)
        modes = checked_modes(mode, target, self.unilateral)
        check_contact(contact_mode, contact)
        held = [np.array([i for i, m in enumerate(modes) if m == "displacement"], dtype=int)]
        if contact_mode == "displacement":
            held.append(self._contacts)
        driven = np.concatenate([*held, self._bonds])
        goal = np.zeros(self._assembly.size)
        goal[:count] = target
        if effector_force is not None:
            goal[self._effectors] = checked("effector_force", effector_force, len(self._effectors))
        if contact is not None:
            goal[self._contacts] = checked("contact", contact, len(self._contacts))
        if self.model.assembly is not self._assembly:
            raise ValueError(
                f"the model's constraints changed after this {type(self).__name__} was made; make a new one"
            )
        if (balanced := self._balance(goal, driven)) is not None:
            return balanced
        linear = self.linearisation
        if self._elasticity_version != self.model.elasticity_version:
            self._elasticity_version = self.model.elasticity_version
            linear.current = False
        loads, start_loads = self.model.loads, linear.loads
        ramped, carried = bool((loads != start_loads).any()), start_loads
        if not linear.current and not self._linearise():
            raise ConvergenceError("the starting state has inverted elements or a singular tangent", fraction=0.0)

        # Commands are ramped from the current values.
        before, start = self.snapshot, self.effort.copy()
        start[driven] = (linear.delta + self.compliance * start)[driven]
        done, size, iterations, increments = 0.0, 1.0, 0, 0
        while done < 1.0:
            level = min(1.0, done + size)
            kept = self.x, self.effort
            if ramped:
                linear.loads = start_loads + level * (loads - start_loads)
                linear.current = False
            # A long increment of displacements that meets an indefinite tangent misses its equilibrium nearly always.
            definite = "effort" not in modes and level - done > CAUTIOUS and linear.current and linear.positive_definite
            try:
                iterations += self._newton(start + level * (goal - start), driven, definite=definite)
            except BaseException as problem:
                # After any exception, even Ctrl-C, the last equilibrium is restored.
                self.x, self.effort = kept
                linear.loads = carried
                linear.current = False
                if not isinstance(problem, NewtonFailure):
                    raise
                size = 0.5 * (level - done)
                if size < 0.5**self.max_halvings or not (ramped or self._linearise()):
                    reached = (start + done * (goal - start))[:count]
                    raise no_equilibrium(target, modes, done, reached) from None
                continue
            increments += 1
            done, carried = level, linear.loads
            size *= 1.5
            found = self._state(target, driven, iterations, increments)
            if linear.has_friction and (done == 1.0 or linear.inertia is None):  # springs slide once in a time step
                self._accept()
                found = replace(found, memory=self.memory)
        if (impossible := self._shape.problem(self.x)) is not None:
            self.snapshot = before
            raise impossible
        self._shape.warn(self.x)
        return found

    def contact_model(self, *, each_point: bool = False, friction: bool = False) -> ContactModel:
        """Return the condensed model with the openings of contacts as further rows ``c``.

        The opening of a contact is zero while it presses, and otherwise the gap less the distance of contact. So
        forces ``0 <= effort.c`` and openings ``0 <= delta.c`` are complementary, and they predict how contacts close
        and open. Each obstacle has one row: the mean over the points that press, weighted with their forces, or the
        point that actuators bring there first. Or each point that presses has one; eliminating these gives back ``W``.
        ``W.cc`` includes the compliance of the barrier. Contacts between surfaces of the body stay as they are.

        With ``friction``, each contact with a coefficient of friction has two rows ``t`` more: how far it slips along
        the surface, in the direction of its friction force and across. An object that nothing else holds then has rows
        for each point that presses on it. Without, friction forces stay as they are.

        Raises:
            ConvergenceError: if the body has no equilibrium without its contacts, e.g. because they alone hold it.
            ValueError: if the body has no contact.
        """
        contact = self.linearisation.contact
        if contact is None:
            raise ValueError("the model has no contact; call its 'set_contact' before making the solver")
        if not self.linearisation.current and not self._linearise(exact=True):
            raise ConvergenceError("the tangent of the current state is singular", fraction=0.0)
        motions = self.linearisation.motions(self._actuators)
        from softgym_envs.mechanics.solvers.contact_rows import ContactRows

        found = contact.rows(self.x, motions, each_point=each_point, friction=friction)
        rows = ContactRows.of(found, self.model.equations, friction)
        solved = self.linearisation.without_contact(self.x, self.effort, rows.gradients, rows.springs)
        self.linearisation.current = False
        if solved is None:
            raise ConvergenceError("the body has no stable equilibrium without its contacts", fraction=0.0)
        return rows.condensed(*solved, self.effort, self._layout, self._bonds)

    def _accept(self) -> None:
        """Let friction remember the current state, at which the next increment starts."""
        # Forces of contact stay as they are, so the linearisation stays current; sliding points are to slide on.
        for rubbing in (self.linearisation.contact, self.linearisation.cable_friction):
            if rubbing is not None:
                rubbing.commit(self.x)

    def _state(self, target: np.ndarray, driven: np.ndarray, iterations: int, increments: int) -> Equilibrium:
        linear, effort = self.linearisation, self.effort.copy()
        slack = self._layout.slack(effort, linear.delta, target, driven, self.unilateral)
        return self._layout.equilibrium(
            *(self.x.copy(), effort, linear.delta.copy(), linear.W.copy(), slack),
            stable=linear.positive_definite,
            iterations=iterations,
            increments=increments,
            symmetric=not linear.sliding,
            contacts=None if linear.contact is None else linear.contact.contacts(self.x),
            memory=self.memory,
            conditions=None if linear.located else Conditions(linear.loads, self._elasticity_version),
        )

    # -- compiled solvers -------------------------------------------------------------------------------------------

    def compiled_solver(self) -> CompiledSolver | None:
        """Return the compiled solver of the body, or None if it needs the general one."""
        solid = len(self.model.solids) == len(self.model.blocks)
        if solid or not self._compiled or self.model.assembly is not self._assembly:
            return None
        if self._special is None or self._special.elasticity_version != self.model.elasticity_version:
            from softgym_envs.mechanics.solvers.compiled import compiled_solver

            found = compiled_solver(self.model, moving=self._moving)
            if isinstance(found, str):
                self._compiled = False
                return None
            self._special = found(self.model, self._assembly.mass_matrix(self._lumped))
        return self._special

    @contextmanager
    def solved_by(self, solver: CompiledSolver) -> Iterator[None]:
        """Let another compiled solver of this body take its steps for a while, such as one that records them."""
        kept, self._special = self._special, solver
        try:
            yield
        finally:
            self._special = kept

    @property
    def not_compiled(self) -> str | None:
        """Why the general solver computes this body, which takes far longer; None where compiled code does."""
        if not self._asked:
            return "compiled code was not asked for, or the scheme is not 'euler'"
        from softgym_envs.mechanics.solvers.compiled import compiled_solver

        found = compiled_solver(self.model, moving=self._moving)
        return found if isinstance(found, str) else None

    def _balance(self, goal: np.ndarray, driven: np.ndarray) -> Equilibrium | None:
        """Find the equilibrium for commanded rows (size,) in compiled code; None where the general solver is needed."""
        special, loads = self.compiled_solver(), self.model.loads
        ramped = bool((loads != self.linearisation.loads).any())
        if special is None or ramped or self.linearisation.inertia is not None or (driven >= self._actuators).any():
            return None
        found = special.balance(
            self.x, self.effort, goal, driven, self.unilateral, loads=loads, tolerance=self.tolerance
        )
        if not found.solved:
            return None
        self.x, self.effort = found.x, found.effort.copy()
        self.linearisation.current = False
        slack = self._layout.slack(found.effort, found.delta, goal, driven, self.unilateral)
        solved = found.x.copy(), found.effort, found.delta, found.compliance, slack
        return self._layout.equilibrium(*solved, stable=True, iterations=found.iterations)
