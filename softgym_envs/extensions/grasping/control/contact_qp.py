"""Inverse control that makes and breaks contact: quadratic programming with complementarity on the condensed model.

Thesis, sec. 2.3 (eq. 2.14 with contacts); Coevoet, Escande and Duriez, "Optimization-based inverse model of soft robots
with contact handling", IEEE Robotics and Automation Letters 2 (2017). See the note on patents in the file NOTICE.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from softgym_envs.control.inverse_qp import UNBOUNDED, InverseQP, StepLimits
from softgym_envs.errors import ConvergenceError, unknown_name
from softgym_envs.extensions.grasping.control.qpcc import ComplementarityQP, Optimum, solve_qpcc
from softgym_envs.mechanics.condensation import CondensedModel, ContactModel


@dataclass(frozen=True)
class ForceGoal:
    """A range for a sum of contact forces, e.g. ``ForceGoal({"wall": 1.0}, 1.0)``: press on the wall with 1 N.

    While none of its contacts presses, a goal of a positive force also counts their openings, so they are closed first.

    Attributes:
        contacts: factors of the normal forces, by the names of the contacts.
        lower: smallest sum [N].
        upper: largest sum [N], ``lower`` by default; inf for "at least".
        weight: of the squared error. With 1, a force error counts as much as the distance by which this force would
            move the contacts.

    Raises:
        ValueError: for a malformed range, weight or factor.
    """

    contacts: Mapping[str, float]
    lower: float
    upper: float | None = None
    weight: float = 1.0

    def __post_init__(self) -> None:
        low, high = self.range
        if not (np.isfinite(low) and low <= high):
            raise ValueError(f"a force goal needs lower <= upper with a finite lower one, got {low} and {high} N")
        if not (np.isfinite(self.weight) and self.weight > 0.0):
            raise ValueError(f"weight = {self.weight} of a force goal must be positive and finite")
        factors = list(self.contacts.values())
        if not factors or not np.isfinite(factors).all() or not np.any(factors):
            raise ValueError(f"a force goal needs finite factors that are not all zero, got {dict(self.contacts)}")

    @property
    def range(self) -> tuple[float, float]:
        """Smallest and largest sum [N]."""
        return self.lower, self.lower if self.upper is None else self.upper


class ContactQP(InverseQP):
    """Controller that brings effectors and contact forces to goals, and opens and closes contacts on the way.

    With ``f`` the normal forces and ``w`` the openings of the contacts, each call minimises the objective of
    `InverseQP`, plus the squared errors of force goals, subject to the same limits and

        0 <= f _|_ w = W_ca effort + W_cc f + delta_free_c >= 0.

    The energy terms of the objective include the contact forces: ``(effort, f)^T W (effort, f)``.

    Friction: a `ContactModel` may have rows ``t``, with friction forces ``g`` and slips ``s`` along directions of the
    surface. Then, for each of them,

        -coefficient f <= g <= coefficient f,
        s > 0 only where g = -coefficient f,    s < 0 only where g = coefficient f,

    so points stick or slide as Coulomb's law says, along two independent tangential directions (a friction pyramid):
    friction of both at once can be larger by up to the root of two. The first direction is that of the friction force.
    Without such rows, friction forces stay as they are. So the result is right where nothing changes any more, and
    friction that follows the step counts in the next one; `ContactControl` corrects the changes of forces for it.

    Where friction leaves several states possible for the same commands, the result is the best of them.

    The problem has one local optimum for each set of closed contacts, and the best of them is found by branch and bound
    (`solve_qpcc`). A condensed model without contacts gives the result of `InverseQP`.

    The arguments are those of `InverseQP`.

    Attributes:
        displacement: actuator displacements that the model predicts for the last result, shape (n_a,).
        effort: actuator efforts that it predicts, shape (n_a,).
        contact_force: normal contact forces that it predicts [N], shape (k,).
        friction_force: friction forces that it predicts [N], shape (t,).
        opening: openings of the contacts that it predicts [m], shape (k,).
        slip: slips that it predicts [m], shape (t,).
        effector: effector coordinates that it predicts [m], shape (n_e,).
        optimum: the solution of the scaled problem, which says whether it is proven to be the best.
    """

    contact_force: np.ndarray
    friction_force: np.ndarray
    opening: np.ndarray
    slip: np.ndarray
    effector: np.ndarray
    optimum: Optimum

    #: Quadratic programs after which the search for a better set of closed contacts ends.
    max_programs = 1000

    def solve(
        self,
        condensed: CondensedModel,
        goal: np.ndarray | None,
        command: np.ndarray,
        slack: np.ndarray | None = None,
        *,
        forces: Sequence[ForceGoal] = (),
        size: float = 1.0,
    ) -> np.ndarray:
        """Return the next command, shape (n_a,): displacements or efforts, according to the actuators' modes.

        Args:
            condensed: model at the current state; the rows of role ``c`` are openings of contacts [m], not negative,
                and their efforts normal forces [N]; those of role ``t`` are slips and friction forces.
            goal: desired effector coordinates [m], shape (n_e,) or (k, 3), or None if only forces matter.
            command: current command, shape (n_a,).
            slack: actuators that are slack, shape (n_a,); default none.
            forces: goals of contact forces.
            size: share of the rates that this step may use.

        Raises:
            ValueError: if goal, command or model has a wrong shape or is not finite, or for an unknown contact.
            ConvergenceError: if no set of closed contacts allows a step within the limits.
        """
        found = self.problem(condensed, goal, command, slack, forces=forces, size=size)
        problem, tangential = found.program, found.rubbing
        a, t, h = len(self.rates), len(tangential.owner), len(tangential.held)
        c = len(problem.pairs) - 2 * t
        before = _efforts(condensed)
        start = _present_sets(condensed, c, tangential, before) if t else _closed_at_present_efforts(problem, a)
        self.optimum = solve_qpcc(problem, start, max_programs=self.max_programs)
        step = found.base @ self.optimum.z[: a + c + t + h]
        step[a : a + c + t] -= before[a:]
        W, delta = _blocks(condensed)
        n = a + c + t
        moved = delta + W[:, :n] @ step[:n] + tangential.columns(W) @ step[n:]
        self.effort = before[:a] + step[:a]
        self.contact_force, self.friction_force = np.split(before[a:] + step[a:n], [c])
        self.displacement, self.opening, self.slip, self.effector = np.split(moved, [a, a + c, n])
        return self.command(found.limits)

    def error(
        self,
        condensed: CondensedModel,
        goal: np.ndarray | None,
        forces: Sequence[ForceGoal] = (),
        *,
        reference: CondensedModel | None = None,
    ) -> float:
        """Return the root of the weighted sum of squared errors of effectors and forces at a state [m].

        Args:
            condensed: model at the state.
            goal: see `solve`.
            forces: see `solve`.
            reference: model whose compliance turns errors of forces into lengths, by default the same. Errors of
                several states can be compared if their reference is the same.

        Raises:
            ValueError: as `solve`.
        """
        wanted, _, root = self._wanted(condensed, goal, condensed.delta.a)
        W, delta = _blocks(condensed if reference is None else reference)[0], _blocks(condensed)[1]
        errors = [root * (condensed.delta.e - wanted)]
        before = _efforts(condensed)
        for force in forces:
            _, value, width = _force_error(force, self.contact_names(condensed), len(self.rates), W, delta, before)
            errors.append(np.array([min(value, 0.0) + max(value - width, 0.0)]))
        return float(np.linalg.norm(np.concatenate(errors)))

    @staticmethod
    def contact_names(condensed: CondensedModel) -> list[str]:
        """Return the names of the contacts of a model."""
        slices = condensed.slices
        return [row.name for row in condensed.labels[slices["c"]]] if "c" in slices else []

    def _wanted(
        self, condensed: CondensedModel, goal: np.ndarray | None, command: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Goal (n_e,), command (n_a,) and roots of the goal weights (n_e,); zero roots without a goal."""
        wanted, command = self.checked(condensed, condensed.delta.e if goal is None else goal, command)
        root = np.ones(wanted.size) if self.goal_weights is None else np.sqrt(self.goal_weights)
        return wanted, command, np.zeros(wanted.size) if goal is None else root

    def problem(
        self,
        condensed: CondensedModel,
        goal: np.ndarray | None,
        command: np.ndarray,
        slack: np.ndarray | None = None,
        *,
        forces: Sequence[ForceGoal] = (),
        size: float = 1.0,
    ) -> ContactProblem:
        """Return the scaled problem of `solve`.

        Raises:
            ValueError: as `solve`.
        """
        wanted, command, root = self._wanted(condensed, goal, command)
        W, delta = _blocks(condensed)
        a = len(command)
        n = len(delta) - wanted.size
        before = _efforts(condensed)
        limits = self.limits(condensed, command, slack, size)
        tangential = _Rubbing.of(condensed, a)
        t = len(tangential.owner)

        # Lengths that count as one: the rates of actuators, and for contacts the motion that they cause.
        # An open contact of a point that cannot move has no compliance; it stays open whatever its scale.
        own = np.abs(np.diag(W)[:n])
        stiffness = 1.0 / np.where(own > 0.0, own, own.max())
        limited = np.isfinite(self.effort_rates)
        effort_lengths = np.where(limited, self.effort_rates, 0.0) / stiffness[:a]
        length = np.where(limited, np.minimum(self.rates, effort_lengths), self.rates)
        reach = float((np.abs(W[a:n, :a]) @ (length * stiffness[:a])).max(initial=0.0))
        reach = reach or float(np.abs(delta[a:n]).max(initial=0.0)) or float(length.max())
        length = np.append(length, np.full(n - a, reach))
        scale = length * stiffness

        # Errors are linear in the changes of actuator efforts, the forces, and the excess over lower limits.
        every = np.concatenate([W[:, :n], tangential.columns(W)], axis=1)
        errors = [root[:, None] * every[n:]]
        offsets = [root * (delta[n:] - wanted)]
        names = self.contact_names(condensed)
        excess = np.zeros(len(forces))
        columns = np.zeros((wanted.size + len(forces), len(forces)))
        for number, force in enumerate(forces):
            row, offset, width = _force_error(force, names, a, W, delta, before)
            errors.append(np.append(row, np.zeros(len(tangential.held)))[None])
            offsets.append(np.array([offset]))
            columns[wanted.size + number, number] = -reach
            excess[number] = min(width / reach, UNBOUNDED)
        J, error = np.concatenate(errors), np.concatenate(offsets)

        # Energy of the efforts, in units of the errors; see `InverseQP` on states that are stable only while held.
        unit = float(length.max()) / length
        energy = scale[:, None] * W[:n, :n] * scale
        # Contacts do not change the weights, unless there are only goals of forces.
        few = a if J[: wanted.size, :a].any() else n
        sensitive = J[:, :few] * unit[:few]
        compliance = unit[:few, None] * W[:few, :few] * unit[:few]
        epsilon = np.linalg.norm(sensitive.T @ sensitive) / np.linalg.norm(compliance)
        energies, modes = np.linalg.eigh(0.5 * epsilon * (energy + energy.T))
        quadratic = (modes * np.abs(energies)) @ modes.T

        # Variables: see `ContactProblem`. So far, forces were changes.
        base = tangential.base(scale)
        start = np.concatenate([np.zeros(a), before[a:] / scale[a:], np.zeros(len(tangential.held))])
        if t:
            start[n - t : n] += tangential.coefficient * before[tangential.contact] / scale[n - t : n]
        count = base.shape[1]
        extra = np.zeros((len(J), len(forces) + t))
        extra[:, : len(forces)] = columns
        J = np.concatenate([J @ base, extra], axis=1)
        efforts = np.concatenate([base[:n] / scale[:, None], np.zeros((n, extra.shape[1]))], axis=1)
        start = np.concatenate([start, np.zeros(extra.shape[1])])
        hessian = J.T @ J + (self.effort_weight + self.step_weight) * efforts.T @ quadratic @ efforts
        gradient = J.T @ error + self.effort_weight * efforts.T @ (quadratic @ (before / scale))
        norm = float(np.trace(hessian)) or 1.0
        # DAQP needs a definite matrix, also where weights are zero or forces of several contacts have the same effect.
        hessian[range(len(hessian)), range(len(hessian))] += 1e-9 * norm / len(hessian)
        gradient -= hessian @ start

        rows = np.zeros((n, len(start)))
        rows[:, :count] = every[:n] @ base / length[:, None]
        shift = rows @ start
        low, high = (np.clip(b / length[:a], -UNBOUNDED, UNBOUNDED) + shift[:a] for b in limits.displacement)
        effort_low, effort_high = (np.clip(b / scale[:a], -UNBOUNDED, UNBOUNDED) for b in limits.effort)
        ties = np.zeros((len(tangential.held), len(start)))
        ties[:, :count] = tangential.ties(every) @ base / length[tangential.held, None]
        tied = ties @ start
        # Slips along the directions of friction, and the distances of friction from its limits.
        slips, other = rows[n - t :].copy(), np.zeros((t, len(start)))
        sliding = len(start) - t + np.arange(t)
        slips[range(t), sliding] = 1.0
        other[range(t), tangential.contact] = (
            2.0 * tangential.coefficient * scale[tangential.contact] / scale[n - t : n]
        )
        other[range(t), n - t + np.arange(t)] = -1.0
        free = np.full(len(tangential.held), -UNBOUNDED), np.full(len(tangential.held), UNBOUNDED)
        lower = [effort_low, np.zeros(n - a), free[0], np.zeros(len(forces) + t)]
        upper = [np.maximum(effort_high, effort_low), np.full(n - a, UNBOUNDED), free[1], excess, np.full(t, UNBOUNDED)]
        problem = ComplementarityQP(
            hessian=hessian / norm,
            gradient=gradient / norm,
            lower=np.concatenate(lower),
            upper=np.concatenate(upper),
            rows=np.concatenate([rows[:a], ties]),
            rows_lower=np.concatenate([low, tied]),
            rows_upper=np.concatenate([high, tied]),
            pairs=np.concatenate([np.arange(a, n), sliding]),
            pair_rows=np.concatenate([rows[a : n - t], slips, other]),
            pair_offset=np.concatenate([delta[a:n] / length[a:] - shift[a:], np.zeros(t)]),
        )
        return ContactProblem(problem, base, limits, tangential)


class ContactProblem(NamedTuple):
    """The scaled problem of a step, and what turns its solution into efforts.

    Its variables are the changes of the actuator efforts; the contact forces; for each direction of friction, by how
    much the friction force is above its lower limit ``-coefficient * f``; forces of springs that hold the body in the
    model; how far force goals are above their lower limits; and how far points slip against the directions of friction.

    Attributes:
        program: the problem.
        base: changes of actuator efforts, forces of contacts and friction, and forces of springs (n_a + k + t + h) by
            the first variables, a square matrix.
        limits: of the step.
        rubbing: directions of friction, and springs.
    """

    program: ComplementarityQP
    base: np.ndarray
    limits: StepLimits
    rubbing: _Rubbing


class _Rubbing(NamedTuple):
    """Directions of friction among the efforts of actuators, contacts and friction, and springs that hold the body.

    Attributes:
        owner: number of the contact of each direction, shape (t,).
        contact: its place among the efforts, shape (t,).
        coefficient: of friction of each direction, shape (t,).
        held: places of the rows with springs among the efforts, shape (h,).
        compliance: of these springs [m/N], shape (h,).
    """

    owner: np.ndarray
    contact: np.ndarray
    coefficient: np.ndarray
    held: np.ndarray
    compliance: np.ndarray

    @classmethod
    def of(cls, condensed: CondensedModel, actuators: int) -> _Rubbing:
        if not isinstance(condensed, ContactModel):
            nothing = np.zeros(0, dtype=np.int64)
            return cls(nothing, nothing, np.zeros(0), nothing, np.zeros(0))
        held = np.flatnonzero(condensed.hold)
        owner = condensed.owner
        return cls(owner, actuators + owner, condensed.coefficient[owner], actuators + held, condensed.hold[held])

    def base(self, scale: np.ndarray) -> np.ndarray:
        """Return `ContactProblem.base` for the scale of the efforts (n,)."""
        n, t = len(scale), len(self.owner)
        base = np.diag(np.append(scale, scale[self.held]))
        base[n - t + np.arange(t), self.contact] = -self.coefficient * scale[self.contact]
        return base

    def columns(self, W: np.ndarray) -> np.ndarray:
        """Return the compliance of all rows to forces of the springs, shape (n + n_e, h)."""
        columns = W[:, self.held].copy()
        columns[self.held, range(len(self.held))] -= self.compliance
        return columns

    def ties(self, every: np.ndarray) -> np.ndarray:
        """Return the rows that are zero where springs have the forces of their stretch, shape (h, n + h)."""
        ties = every[self.held].copy()
        ties[range(len(self.held)), self.held] -= self.compliance
        ties[:, every.shape[1] - len(self.held) :] -= np.diag(self.compliance)
        return ties


def _blocks(condensed: CondensedModel) -> tuple[np.ndarray, np.ndarray]:
    """Compliance and displacements of actuators, contacts, friction and effectors, in this order."""
    numbers, slices = np.arange(condensed.free.size), condensed.slices
    order = np.concatenate([numbers[slices[role]] for role in "acte" if role in slices])
    return condensed.compliance[np.ix_(order, order)], condensed.delta.array[order]


def _efforts(condensed: CondensedModel) -> np.ndarray:
    """Efforts of actuators, contacts and friction, in this order."""
    return np.concatenate([condensed.effort[condensed.slices[r]] for r in "act" if r in condensed.slices])


def _force_error(
    force: ForceGoal, names: Sequence[str], actuators: int, W: np.ndarray, delta: np.ndarray, before: np.ndarray
) -> tuple[np.ndarray, float, float]:
    """Return the error of a force goal as a length: its derivative by efforts (n,), its value, and the goal's width.

    Efforts ``before`` are those of actuators and contacts; ``W`` and ``delta`` may have further rows.
    """
    W, delta = W[: len(before), : len(before)], delta[: len(before)]
    row = np.zeros(len(before))
    for name, factor in force.contacts.items():
        if name not in names:
            raise ValueError(unknown_name("contact", name, names))
        row[actuators + names.index(name)] = factor
    low, high = force.range
    norm, weight = np.linalg.norm(row), np.sqrt(force.weight)
    yielding = weight * float(row @ W @ row) / norm**3
    derivative, value = yielding * row, yielding * float(row @ before - low)
    if low > 0.0 and not before[row != 0.0].any():
        # Nothing presses yet, so that small steps cause no force: the openings are what is missing.
        opening = weight * np.abs(row) / norm
        derivative, value = derivative - opening @ W, value - float(opening @ delta)
    return derivative, value, yielding * (high - low)


def _closed_at_present_efforts(problem: ComplementarityQP, actuators: int) -> np.ndarray | None:
    """Contacts that are closed while the actuator efforts do not change, shape (1, k); None if not found."""
    k = len(problem.pairs)
    compliance = problem.pair_rows[:, actuators : actuators + k]
    contacts = ComplementarityQP(
        hessian=0.5 * (compliance + compliance.T) + 1e-9 * np.eye(k),
        gradient=problem.pair_offset,
        lower=np.zeros(k),
        upper=np.full(k, UNBOUNDED),
        rows=np.zeros((0, k)),
        rows_lower=np.zeros(0),
        rows_upper=np.zeros(0),
        pairs=np.arange(0),
        pair_rows=np.zeros((0, k)),
        pair_offset=np.zeros(0),
    )
    try:
        forces = contacts.minimise(np.zeros(0, dtype=bool), np.zeros(0, dtype=bool))
    except ConvergenceError:
        return None
    return None if forces is None else forces[None] > 0.0


def _present_sets(condensed: CondensedModel, contacts: int, tangential: _Rubbing, before: np.ndarray) -> np.ndarray:
    """Closed pairs of states that need no change of actuators, shape (2, k + 2 t): all points stick; or slide on.

    A point that slides on keeps the direction of its friction force.
    """
    a = len(before) - contacts - len(tangential.owner)
    pressing = before[a : a + contacts] > 0.0
    friction, limit = before[a + contacts :], tangential.coefficient * before[tangential.contact]
    at_limit = np.abs(friction) >= (1.0 - 1e-6) * limit
    # Of an open contact, both limits of friction are zero, and points slip either way.
    touching = pressing[tangential.owner]
    stick = np.concatenate([pressing, touching, ~touching])
    up, down = touching & at_limit & (friction > 0.0), touching & at_limit & (friction <= 0.0)
    slide = np.concatenate([pressing, touching & ~down, ~touching | up])
    return np.array([stick, slide])
