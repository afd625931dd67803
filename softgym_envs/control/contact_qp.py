"""Inverse control that makes and breaks contact: quadratic programming with complementarity on the condensed model.

Thesis, sec. 2.3 (eq. 2.14 with contacts); Coevoet, Escande and Duriez, "Optimization-based inverse model of soft robots
with contact handling", IEEE Robotics and Automation Letters 2 (2017). See the note on patents in the file NOTICE.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from softgym_envs.control.inverse_qp import UNBOUNDED, InverseQP, StepLimits
from softgym_envs.control.qpcc import ComplementarityQP, Optimum, solve_qpcc
from softgym_envs.errors import ConvergenceError, unknown_name
from softgym_envs.mechanics.condensation import CondensedModel


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

    Friction: the model of `Statics.contact_model` holds the friction forces of its state. So the result is right where
    nothing changes any more, and friction that follows the step counts in the next one. `ContactControl` corrects the
    changes of forces for it.

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
        size: float = 1.0,
    ) -> np.ndarray:
        """Return the next command, shape (n_a,): displacements or efforts, according to the actuators' modes.

        Args:
            condensed: model at the current state; the rows of role ``c`` are openings of contacts [m], not negative,
                and their efforts normal forces [N].
            goal: desired effector coordinates [m], shape (n_e,) or (k, 3), or None if only forces matter.
            command: current command, shape (n_a,).
            slack: actuators that are slack, shape (n_a,); default none.
            forces: goals of contact forces.
            size: share of the rates that this step may use.

        Raises:
            ValueError: if goal, command or model has a wrong shape or is not finite, or for an unknown contact.
            ConvergenceError: if no set of closed contacts allows a step within the limits.
        """
        problem, scale, limits = self.problem(condensed, goal, command, slack, forces=forces, size=size)
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
        return self.command(limits)

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
    ) -> tuple[ComplementarityQP, np.ndarray, StepLimits]:
        """Return the scaled problem of `solve`, the scale of actuator and contact efforts (n_a + k,), and the limits.

        Its variables are the changes of the actuator efforts, the contact forces, and how far force goals are above
        their lower limits.

        Raises:
            ValueError: as `solve`.
        """
        wanted, command, root = self._wanted(condensed, goal, command)
        W, delta = _blocks(condensed)
        a = len(command)
        n = len(delta) - wanted.size
        before = _efforts(condensed)
        limits = self.limits(condensed, command, slack, size)

        # Lengths that count as one: the rates of actuators, and for contacts the motion that they cause.
        # An open contact of a point that cannot move has no compliance; it stays open whatever its scale.
        own = np.abs(np.diag(W)[:n])
        stiffness = 1.0 / np.where(own > 0.0, own, own.max())
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
        names = self.contact_names(condensed)
        excess = np.zeros(len(forces))
        columns = np.zeros((wanted.size + len(forces), len(forces)))
        for number, force in enumerate(forces):
            row, offset, width = _force_error(force, names, a, W, delta, before)
            errors.append(row[None])
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
        return problem, scale, limits


def _blocks(condensed: CondensedModel) -> tuple[np.ndarray, np.ndarray]:
    """Compliance and displacements of actuators, contacts and effectors, in this order."""
    numbers, slices = np.arange(condensed.free.size), condensed.slices
    order = np.concatenate([numbers[slices[role]] for role in "ace" if role in slices])
    return condensed.compliance[np.ix_(order, order)], condensed.delta.array[order]


def _efforts(condensed: CondensedModel) -> np.ndarray:
    """Efforts of actuators and contacts, in this order."""
    return np.concatenate([condensed.effort[condensed.slices[r]] for r in "ac" if r in condensed.slices])


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
