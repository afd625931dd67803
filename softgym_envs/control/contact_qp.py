"""Inverse control that makes and breaks contact: quadratic programming with complementarity on the condensed model.

Thesis, sec. 2.3 (eq. 2.14 with contacts); Coevoet, Escande and Duriez, "Optimization-based inverse model of soft robots
with contact handling", IEEE Robotics and Automation Letters 2 (2017). See the note on patents in the file NOTICE.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from softgym_envs.control.inverse_qp import UNBOUNDED, InverseQP
from softgym_envs.control.qpcc import ComplementarityQP, Optimum, solve_qpcc
from softgym_envs.errors import ConvergenceError, unknown_name
from softgym_envs.mechanics.condensation import CondensedModel


@dataclass(frozen=True)
class ForceGoal:
    """A range for a sum of contact forces, e.g. ``ForceGoal({"wall": 1.0}, 1.0)``: press on the wall with 1 N.

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

    Friction: the linear model holds the friction forces of its state. Tangential forces of contacts that stick or slide
    are therefore right at the state and follow with a delay of one step. Step sizes decide how far this is wrong.

    The problem has one local optimum for each set of closed contacts, and the best of them is found by branch and bound
    (`solve_qpcc`). A condensed model without contacts gives the result of `InverseQP`.

    The arguments are those of `InverseQP`.

    Attributes:
        displacement: actuator displacements that the model predicts for the last result, shape (n_a,).
        effort: actuator efforts that it predicts, shape (n_a,).
        contact_force: normal contact forces that it predicts [N], shape (k,).
        opening: openings of the contacts that it predicts [m], shape (k,).
        effector: effector coordinates that it predicts [m], shape (n_e,).
        optimum: the solution of the scaled problem, which says whether it is proven to be the best.
    """

    contact_force: np.ndarray
    opening: np.ndarray
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
    ) -> np.ndarray:
        """Return the next command, shape (n_a,): displacements or efforts, according to the actuators' modes.

        Args:
            condensed: model at the current state; the rows of role ``c`` are openings of contacts [m], not negative,
                and their efforts normal forces [N].
            goal: desired effector coordinates [m], shape (n_e,) or (k, 3), or None if only forces matter.
            command: current command, shape (n_a,).
            slack: actuators that are slack, shape (n_a,); default none.
            forces: goals of contact forces.

        Raises:
            ValueError: if goal, command or model has a wrong shape or is not finite, or for an unknown contact.
            ConvergenceError: if no set of closed contacts allows a step within the limits.
        """
        problem, scale = self.problem(condensed, goal, command, slack, forces=forces)
        a, c = len(self.rates), len(problem.pairs)
        start = _closed_at_present_efforts(problem, a)
        self.optimum = solve_qpcc(problem, start, max_programs=self.max_programs)
        step = scale * self.optimum.z[: a + c]
        before = _efforts(condensed)
        step[a:] -= before[a:]
        W, delta = _blocks(condensed)
        moved = delta + W[:, : a + c] @ step
        self.effort = before[:a] + step[:a]
        self.contact_force = before[a:] + step[a:]
        self.displacement, self.opening, self.effector = moved[:a], moved[a : a + c], moved[a + c :]
        return self.command(self.limits(condensed, np.asarray(command, dtype=float), slack))

    def problem(
        self,
        condensed: CondensedModel,
        goal: np.ndarray | None,
        command: np.ndarray,
        slack: np.ndarray | None = None,
        *,
        forces: Sequence[ForceGoal] = (),
    ) -> tuple[ComplementarityQP, np.ndarray]:
        """Return the scaled problem of `solve`, and the scale of actuator and contact efforts, shape (n_a + k,).

        Its variables are the changes of the actuator efforts, the contact forces, and how far force goals are above
        their lower limits.

        Raises:
            ValueError: as `solve`.
        """
        wanted = condensed.delta.e if goal is None else goal
        wanted, command = self.checked(condensed, wanted, command)
        root = np.ones(wanted.size) if self.goal_weights is None else np.sqrt(self.goal_weights)
        if goal is None:
            root = np.zeros(wanted.size)
        W, delta = _blocks(condensed)
        a = len(command)
        n = len(delta) - wanted.size
        before = _efforts(condensed)
        limits = self.limits(condensed, command, slack)

        # Lengths that count as one: the rates of actuators, and for contacts the motion that they cause.
        stiffness = 1.0 / np.abs(np.diag(W)[:n])
        limited = np.isfinite(self.effort_rates)
        by_effort = np.where(limited, self.effort_rates, 0.0) / stiffness[:a]
        length = np.where(limited, np.minimum(self.rates, by_effort), self.rates)
        reach = float((np.abs(W[a:n, :a]) @ (length * stiffness[:a])).max(initial=0.0))
        reach = reach or float(np.abs(delta[a:n]).max(initial=0.0)) or float(length.max())
        length = np.append(length, np.full(n - a, reach))
        scale = length * stiffness

        # Errors are linear in the changes of actuator efforts, the contact forces, and the excess over lower limits.
        errors = [root[:, None] * W[n:, :n]]
        offsets = [root * (delta[n:] - wanted)]
        names = [row.name for row in condensed.labels[condensed.slices["c"]]] if n > a else []
        excess = np.zeros(len(forces))
        columns = np.zeros((wanted.size + len(forces), len(forces)))
        for number, force in enumerate(forces):
            row = np.zeros(n)
            for name, factor in force.contacts.items():
                if name not in names:
                    raise ValueError(unknown_name("contact", name, names))
                row[a + names.index(name)] = factor
            yielding = np.sqrt(force.weight) * float(row @ W[:n, :n] @ row) / np.linalg.norm(row) ** 3
            errors.append(yielding * row[None])
            offsets.append(np.array([yielding * (row @ before - force.range[0])]))
            columns[wanted.size + number, number] = -reach
            excess[number] = min(yielding * (force.range[1] - force.range[0]) / reach, UNBOUNDED)
        J, error = np.concatenate(errors), np.concatenate(offsets)

        # Energy of the efforts, in units of the errors; see `InverseQP` on states that are stable only while held.
        unit = float(length.max()) / length
        energy = scale[:, None] * W[:n, :n] * scale
        # Contacts do not change the weights, unless there are only goals of forces.
        few = a if J[:, :a].any() else n
        sensitive = J[:, :few] * unit[:few]
        compliance = unit[:few, None] * W[:few, :few] * unit[:few]
        epsilon = np.linalg.norm(sensitive.T @ sensitive) / np.linalg.norm(compliance)
        energies, modes = np.linalg.eigh(0.5 * epsilon * (energy + energy.T))
        quadratic = (modes * np.abs(energies)) @ modes.T
        J = np.concatenate([J * scale, columns], axis=1)
        hessian = J.T @ J
        hessian[:n, :n] += (self.effort_weight + self.step_weight) * quadratic
        gradient = J.T @ error
        gradient[:n] += self.effort_weight * quadratic @ (before / scale)
        norm = float(np.trace(hessian)) or 1.0
        # DAQP needs a definite matrix, also where weights are zero or forces of several contacts have the same effect.
        hessian[range(len(hessian)), range(len(hessian))] += 1e-9 * norm / len(hessian)

        # So far the variables are changes; contact forces themselves are complementary to openings.
        start = np.concatenate([np.zeros(a), before[a:] / scale[a:], np.zeros(len(forces))])
        gradient -= hessian @ start
        rows = np.zeros((n, len(start)))
        rows[:, :n] = W[:n, :n] * scale / length[:, None]
        shift = rows @ start
        low, high = (np.clip(b / length[:a], -UNBOUNDED, UNBOUNDED) + shift[:a] for b in limits.displacement)
        effort_low, effort_high = (np.clip(b / scale[:a], -UNBOUNDED, UNBOUNDED) for b in limits.effort)
        problem = ComplementarityQP(
            hessian=hessian / norm,
            gradient=gradient / norm,
            lower=np.concatenate([effort_low, np.zeros(n - a + len(forces))]),
            upper=np.concatenate([np.maximum(effort_high, effort_low), np.full(n - a, UNBOUNDED), excess]),
            rows=rows[:a],
            rows_lower=low,
            rows_upper=high,
            pairs=np.arange(a, n),
            pair_rows=rows[a:],
            pair_offset=delta[a:n] / length[a:] - shift[a:],
        )
        return problem, scale


def _blocks(condensed: CondensedModel) -> tuple[np.ndarray, np.ndarray]:
    """Compliance and displacements of actuators, contacts and effectors, in this order."""
    numbers, slices = np.arange(condensed.free.size), condensed.slices
    order = np.concatenate([numbers[slices[role]] for role in "ace" if role in slices])
    return condensed.compliance[np.ix_(order, order)], condensed.delta.array[order]


def _efforts(condensed: CondensedModel) -> np.ndarray:
    """Efforts of actuators and contacts, in this order."""
    return np.concatenate([condensed.effort[condensed.slices[r]] for r in "ac" if r in condensed.slices])


def _closed_at_present_efforts(problem: ComplementarityQP, actuators: int) -> np.ndarray | None:
    """Contacts that are closed while the actuator efforts do not change, shape (1, k); None if not found."""
    k = len(problem.pairs)
    compliance = problem.pair_rows[:, actuators : actuators + k]
    contacts = ComplementarityQP(
        hessian=0.5 * (compliance + compliance.T),
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
