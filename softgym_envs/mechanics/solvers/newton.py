"""Newton's method for the equilibrium of one load level.

It solves the KKT system by its Schur complement: an iteration factorises the tangent once and solves for
the few constraint columns, which also gives ``W``. Step lengths follow the affine-invariant monotonicity test of
Deuflhard (Newton Methods for Nonlinear Problems, 2004, NLEQ-ERR): a step is accepted when the simplified correction
that follows is smaller, whatever the scales of forces and lengths. Displacement-driven cables are unilateral: each
correction solves a small linear complementarity problem. Bonds are driven rows that are always held at zero.

With contact, steps stop before anything passes through anything (continuous collision detection on the way), and their
lengths follow an exact penalty function: the energy less the work of given efforts, plus the violation of driven rows.
A barrier grows too fast for the monotonicity test.
"""

from __future__ import annotations

import numpy as np

from softgym_envs.mechanics.assembly import Assembled
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.complementarity import complementary_step, held_step
from softgym_envs.mechanics.solvers.equilibrium import NewtonFailure
from softgym_envs.mechanics.solvers.linearisation import Linearisation
from softgym_envs.mechanics.solvers.penalty import Penalty
from softgym_envs.mechanics.solvers.prediction import Bend, Steps

MAX_SIMPLIFIED = 3
"""Simplified Newton corrections that together take less time than a factorisation and what it needs."""
MAX_SHORT_STEPS = 6
"""In contact, an increment is divided after this number of short steps in a row."""


class Newton:
    """The state of a body, and iterations that bring it to the equilibrium of one load level.

    Args:
        model: the body.
        tolerance: largest remaining correction of any node at convergence [m].
        max_iterations: limit of iterations.
        exact_compliance: compute ``W`` and stability at each equilibrium, and not at the last iterate.

    Attributes:
        x: current node positions [m], shape (n, 3), and ``effort``: current efforts of all rows, shape (size,).
        unilateral: actuator rows that cannot push, shape (n_a,); may be changed between solves.
        compliance: of the drives of all rows, shape (size,), see `Constraint`; may be changed between solves.
        linearisation: the equations linearised where the last iteration ended.
    """

    x: np.ndarray
    effort: np.ndarray
    _bend: Bend | None

    def __init__(
        self, model: MechanicalModel, *, tolerance: float, max_iterations: int, exact_compliance: bool
    ) -> None:
        self.model = model
        self.exact_compliance = exact_compliance
        self.tolerance = tolerance
        self.max_iterations = max_iterations
        self.linearisation = Linearisation(model)
        self._assembly = model.assembly
        sizes = dict(model.roles)
        self._actuators = sizes.get("a", 0)
        self._effectors = self._actuators + np.arange(sizes.get("e", 0))
        self._contacts = self._actuators + sizes.get("e", 0) + np.arange(sizes.get("c", 0))
        self._bonds = self._assembly.size - sizes.get("b", 0) + np.arange(sizes.get("b", 0))
        self.unilateral = np.array([c.unilateral for c in model.constraints["a"] for _ in range(c.size)], dtype=bool)
        self.compliance = np.concatenate([np.zeros(0), *(np.full(c.size, c.compliance) for c, _ in model.rows)])
        if self.compliance.any() and model.contact is not None:
            raise ValueError("drives with compliance are computed without contact only; allowed: compliance = 0")
        used = np.unique(np.concatenate([block.nodes_used for block in model.blocks]))  # not the directors of frames
        extent = float(np.linalg.norm(np.ptp(model.nodes[used], axis=0)))
        self._longest_step = 0.2 * extent  # with contact
        self._short_step = 1e-3 * extent  # without contact: simplified corrections may reach the tolerance after it
        self._round_off = 1e-6 * extent  # steps this short no longer change the energy

    def _linearise(self, *, exact: bool = False) -> bool:
        """Linearise at the current state. False if elements are inverted or the tangent is singular."""
        return self.linearisation.update(self.x, self.effort, exact=exact)

    def _correction(
        self, Ar: np.ndarray | None, delta: np.ndarray, effort: np.ndarray, target: np.ndarray, driven: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Solve the linearised KKT system for the steps of the equations (N,) and of the efforts (size,).

        Args:
            Ar: ``A^-1 residual`` of another state, shape (N,), or None at the state of the linearisation.
            delta: values of the constraints, shape (size,).
            effort: their efforts, shape (size,).
            target: commanded values of driven rows and efforts of all others, shape (size,).
            driven: rows whose values are commanded.
        """
        linear = self.linearisation
        step_effort = np.zeros_like(effort)
        # Effort-driven rows: the residual already holds their current effort; move it to the commanded value.
        forced = np.ones(len(effort), dtype=bool)
        forced[driven] = False
        step_effort[forced] = target[forced] - effort[forced]
        if len(driven):
            shift = linear.shift if Ar is None else Ar @ linear.H
            gap = (delta + self.compliance * effort - target - shift + linear.W @ step_effort)[driven]
            W = linear.W[driven[:, None], driven] + np.diag(self.compliance[driven])
            unilateral = np.zeros(len(effort), dtype=bool)
            unilateral[: self._actuators] = self.unilateral
            step = held_step if self._buckling(driven, effort) else complementary_step
            try:
                step_effort[driven] = step(W, gap, effort[driven], unilateral[driven])
            except np.linalg.LinAlgError:  # W is indefinite (unstable) or singular (two actuators act alike)
                raise NewtonFailure from None
        step_q = linear.response(step_effort, 1.0) if Ar is None else linear.response(step_effort) - Ar
        if len(self._bonds):
            # The tangent holds `bond_stiffness` H_b H_b^T, which already carries its share of the force.
            open_by = delta[self._bonds] - target[self._bonds]
            step_effort[self._bonds] += self._assembly.bond_stiffness * open_by
        return step_q, step_effort

    def _buckling(self, driven: np.ndarray, effort: np.ndarray) -> int:
        """Return how many ways the body would buckle if the efforts (size,) of its driven rows were given."""
        if self.linearisation.positive_definite or not self.unilateral.any():
            return 0
        slack = np.flatnonzero(self.unilateral & (effort[: self._actuators] <= 0.0))
        return self.linearisation.buckling(np.setdiff1d(driven, slack), self.compliance)

    def _norm(self, step: np.ndarray) -> float:
        """Largest displacement [m] of a step of the equations."""
        return float(np.abs(step * self.model.kinematics.dof_scale).max(initial=0.0))

    def _displacement(self, x: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Displacement of the rows (n, 3) for a step of the equations (N,) from ``x`` (n, 3)."""
        return self.model.warping.displacement(x, step)

    def _newton(self, target: np.ndarray, driven: np.ndarray, *, definite: bool = False) -> int:
        """Converge at one load level and return the iterations; for the arguments see `_correction`.

        Raises:
            NewtonFailure: if it does not converge, or meets an indefinite tangent although only ``definite`` ones are
                allowed (which holds without contact). The caller restores the state.
        """
        linear = self.linearisation
        if not linear.current and not self._linearise():
            raise NewtonFailure
        step_q, step_effort = self._correction(None, linear.delta, self.effort, target, driven)
        if self._rests(step_q, step_effort, driven):
            return 0
        if linear.contact is not None:
            return self._newton_in_contact(target, driven)
        length = 1.0
        for iteration in range(1, self.max_iterations + 1):
            norm = self._norm(step_q)
            if not np.isfinite(norm):
                raise NewtonFailure
            while True:
                most = MAX_SIMPLIFIED if norm <= self._short_step and length == 1.0 else 0
                part = length * step_q
                x = self.x + self._displacement(self.x, part)
                effort = self.effort + length * step_effort
                assembled = linear.assemble(x, effort, tangent=not most)
                if assembled is not None:
                    x, effort, assembled, _, remaining = self._polish(part, x, effort, assembled, target, driven, most)
                    # Near convergence, round-off dominates.
                    if remaining <= (1.0 - 0.25 * length) * norm or remaining <= self.tolerance:
                        break
                length *= 0.5
                if length < 1e-3:
                    raise NewtonFailure
            self.x, self.effort = x, effort
            near = iteration > 1 and length == 1.0 and remaining <= self.tolerance  # to the last factorisation
            if near and not self.exact_compliance and linear.positive_definite:
                linear.follow(assembled)
                return iteration
            if not linear.factorise(assembled, x, definite=definite):
                raise NewtonFailure
            step_q, step_effort = self._correction(None, linear.delta, effort, target, driven)
            if length == 1.0 and self._norm(step_q) <= self.tolerance:
                if self._buckling(driven, effort) not in (0, linear.negative_eigenvalues):
                    raise NewtonFailure  # unstable, even with the driven rows held in place
                return iteration
            length = min(1.0, 2.0 * length)
        raise NewtonFailure

    def _newton_in_contact(self, target: np.ndarray, driven: np.ndarray) -> int:
        """Converge as `_newton` does, on the way that contact leaves free.

        The first step adds what was corrected in the last increment, if that was alike.
        """
        linear, change = self.linearisation, target - self.effort
        change[driven] = (target - linear.delta)[driven]
        last, self._bend = self._bend, None
        expected = None if last is None or linear.inertia is not None else last.expected(change)
        penalty, steps = Penalty.of(target, driven, self.unilateral), Steps(np.zeros(self.model.equations))
        for iteration in range(self.max_iterations + 1):
            step_q, step_effort = self._correction(None, linear.delta, self.effort, target, driven)
            norm = self._norm(step_q)
            if not np.isfinite(norm):
                raise NewtonFailure
            if steps.length == 1.0 and norm <= self.tolerance:
                if not linear.exact and not self._linearise(exact=True):
                    raise NewtonFailure
                self._bend = steps.bend(change, self._norm(steps.corrections))
                return iteration
            if norm > self._longest_step:
                step_q = step_q * (self._longest_step / norm)
                norm = self._longest_step
            penalty.raise_weights(self.effort + step_effort)
            slope = float((linear.residual + linear.H @ (self.effort - penalty.forced)) @ step_q)
            slope -= float(penalty.weight @ penalty.violation(linear.delta))
            found, taken, polished = None, step_q, norm**2 <= 1e2 * self.tolerance * self._longest_step
            if expected is not None:
                taken = step_q + expected
                found = self._search(taken, step_effort, penalty, slope, shortest=1.0)
            if found is None:
                # Sliding friction has no potential, so that a good step can climb: it is known by being shorter.
                climbs = linear.sliding and slope > 0.0 and norm < 0.5 * steps.norm
                anyway, taken, expected = climbs or norm < self._round_off, step_q, None
                found = self._search(step_q, step_effort, penalty, slope, anyway=anyway, tangent=not polished)
            if found is None:
                raise NewtonFailure
            x, effort, assembled, length = found
            steps.add(step_q, norm, length, expected)
            expected = None
            if steps.short == MAX_SHORT_STEPS:
                raise NewtonFailure
            remaining = np.inf
            if length == 1.0 and polished:
                x, effort, assembled, added, remaining = self._polish(taken, x, effort, assembled, target, driven)
                steps.corrections += added
            self.x, self.effort = x, effort
            if iteration and remaining <= self.tolerance and linear.exact and not self.exact_compliance:
                linear.follow(assembled)
                self._bend = steps.bend(change, self._norm(steps.corrections))
                return iteration + 1
            if not linear.factorise(assembled, x):
                raise NewtonFailure
        raise NewtonFailure

    def _polish(
        self,
        step: np.ndarray,
        x: np.ndarray,
        effort: np.ndarray,
        assembled: Assembled,
        target: np.ndarray,
        driven: np.ndarray,
        most: int = MAX_SIMPLIFIED,
    ) -> tuple[np.ndarray, np.ndarray, Assembled, np.ndarray, float]:
        """Apply simplified Newton corrections, if they alone can reach the tolerance: this saves a factorisation.

        They are added to the step before it is bent: elements have turned since the tangent was factorised, and a
        straight correction would strain them by that turn. Rows ``x`` (n, 3), efforts (size,) and equations are those
        after a ``step`` (N,), and ``most`` limits the corrections; for the rest see `_correction`.

        Returns:
            Rows, efforts and equations; the sum of the corrections (N,); the largest displacement of the next [m], or
            of the last where the exact tangent will tell whether it has sufficed.
        """
        linear, total, remaining = self.linearisation, np.zeros_like(step), self._norm(step)
        for left in range(most, -1, -1):
            Ar = linear.solve(assembled.residual)
            step_q, step_effort = self._correction(Ar, assembled.delta, effort, target, driven)
            before, remaining = remaining, self._norm(step_q)
            hopeful = remaining ** (left + 1) <= 0.25 * self.tolerance * before**left
            if left == 0 or remaining <= self.tolerance or not hopeful:
                break
            closer = self.x + self._displacement(self.x, step + total + step_q)
            if linear.contact is not None and linear.contact.free_path(x, closer) < 1.0:
                break
            last = self.exact_compliance and remaining**2 <= 0.25 * self.tolerance * before
            x, effort, total = closer, effort + step_effort, total + step_q
            found = linear.assemble(x, effort, tangent=last)
            if found is None:
                raise NewtonFailure
            assembled = found
            if last:
                break
        return x, effort, assembled, total, remaining

    def _search(
        self,
        step_q: np.ndarray,
        step_effort: np.ndarray,
        penalty: Penalty,
        slope: float,
        *,
        shortest: float = 1e-6,
        anyway: bool = False,
        tangent: bool = True,
    ) -> tuple[np.ndarray, np.ndarray, Assembled, float] | None:
        """Find how far a step can go: nothing collides on the way, and energy plus penalty decrease.

        Args:
            step_q: of the equations, shape (N,).
            step_effort: of the efforts, shape (size,).
            penalty: violation of the driven rows.
            slope: derivative of energy plus penalty at the start [J].
            shortest: smallest part of the step to try.
            anyway: accept any change of the energy, for steps that it cannot resolve.
            tangent: assemble the tangent there.

        Returns:
            Rows (n, 3), efforts (size,) and equations at the end of the step, and the part of it; None if the part
            would be smaller than the shortest.
        """
        linear = self.linearisation
        assert linear.contact is not None
        before = linear.energy(self.x, linear.elastic + linear.contact.energy(self.x))
        before += penalty.value(linear.delta)
        length = 1.0
        while length >= shortest:
            x = self.x + self._displacement(self.x, length * step_q)
            effort = self.effort + step_effort * (1.0 if length > 0.1 else length)
            part = linear.contact.free_path(self.x, x)
            if part < 1.0:
                length *= max(part, 0.05)  # the way bends, so it is tested again
                continue
            barrier = linear.contact.energy(x)
            assembled = linear.assemble(x, effort, tangent=tangent) if np.isfinite(barrier) else None
            if assembled is not None:
                after = linear.energy(x, assembled.energy + barrier) + penalty.value(assembled.delta)
                after += linear.inertial_work(self.x, x)
                if anyway or after <= before + 1e-4 * length * min(slope, 0.0) + 1e-12 * abs(before) + 1e-14:
                    return x, effort, assembled, length
            length *= 0.5
        return None

    def _rests(self, step_q: np.ndarray, step_effort: np.ndarray, driven: np.ndarray) -> bool:
        """Whether the current state is the commanded equilibrium, from its correction; see `_correction`."""
        linear = self.linearisation
        # Friction starts anew from the last equilibrium, so it has to be solved for once more.
        if not linear.exact or linear.has_friction or np.delete(step_effort, driven).any():
            return False
        if self._norm(step_q) > self.tolerance or self._norm(linear.response(step_effort)) > self.tolerance:
            return False
        self._displacement(self.x, step_q)  # raises ValueError for a part that nothing holds
        return self._buckling(driven, self.effort) in (0, linear.negative_eigenvalues)

    def _values(self, x: np.ndarray) -> np.ndarray:
        """Values of all constraints (size,) at rows ``x`` (n, 3)."""
        return np.concatenate([np.zeros(0), *(c.value(x) for c, _ in self.model.rows)])
