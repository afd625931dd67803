"""Inputs and results of the static solvers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypedDict

import numpy as np

from softgym_envs.mechanics.condensation import CondensedModel, Roles, Row
from softgym_envs.mechanics.model import MechanicalModel

if TYPE_CHECKING:
    from softgym_envs.mechanics.contact.contact import ContactMemory, Contacts
    from softgym_envs.mechanics.solvers.cable_friction import CableMemory

SATURATED = 1.0 - 1e-9
"""Part of its largest effort from which an actuator counts as saturated: round-off."""
ROUND_OFF = 1e-9
"""Motion of the nodes that does not count [m]."""
CAUTIOUS = 0.25
"""Increments of displacements longer than this part of a step are divided where they meet an indefinite tangent."""


class NewtonFailure(Exception):
    """Newton's method did not converge on one increment; solvers catch it."""


class Conditions(NamedTuple):
    """What an equilibrium depends on besides its efforts.

    Attributes:
        loads: dead loads [N], shape (n, 3).
        elasticity_version: that of the model.
    """

    loads: np.ndarray
    elasticity_version: int


@dataclass(frozen=True)
class Equilibrium:
    """A solved state.

    Attributes:
        x: node positions [m], shape (n, 3).
        condensed: the condensed model at the state, or near it if there are ``conditions``; bonds are eliminated from
            it.
        delta: constraint values of all rows, bonds last, shape (size,).
        effort: efforts of all rows, bonds last, shape (size,).
        slack: per actuator row, True where a unilateral actuator hangs slack.
        stable: whether the tangent is positive definite. Then the state is stable however its actuators are driven;
            otherwise it can still be stable while they are driven in displacement.
        iterations: Newton iterations spent, over all load increments.
        increments: load increments used.
        contacts: where the body touches; None if it cannot.
        memory: what friction remembers, for `Statics.restore`; None without contact.
        conditions: under which `exact_compliance.exact_at` computes the exact ``W``; None if it is exact.
    """

    x: np.ndarray
    condensed: CondensedModel
    delta: np.ndarray
    effort: np.ndarray
    slack: np.ndarray
    stable: bool
    iterations: int
    increments: int
    contacts: Contacts | None = None
    memory: ContactMemory | CableMemory | None = None
    conditions: Conditions | None = None


class AppliedLoads(TypedDict, total=False):
    """Loads besides those of the actuators: keyword arguments of `Statics.solve`, which describes them."""

    effector_force: Sequence[float] | np.ndarray | None
    contact: Sequence[float] | np.ndarray | None
    contact_mode: str


@dataclass(frozen=True)
class RowLayout:
    """What the constraint rows of a model are: actuators first, bonds last.

    Attributes:
        roles: role letters and sizes without bonds.
        labels: names and units of these rows.
        bonds: number of bond rows.
        slack_tolerance: by how much more than commanded a taut actuator may be displaced, by round-off [m, m3, ...],
            shape (n_a,).
        stretch: how far the drives of actuators stretch per effort, shape (n_a,); 0 if all are rigid.
    """

    roles: Roles
    labels: tuple[Row, ...]
    bonds: int
    slack_tolerance: np.ndarray
    stretch: np.ndarray | float

    @classmethod
    def of(cls, model: MechanicalModel) -> RowLayout:
        """Return the layout of a model's rows."""
        groups = [group for letter, group in model.constraints.items() if letter != "b"]
        # A volume changes by the motion of the nodes times an area.
        actuators = model.constraints["a"]
        slopes = [np.abs(c.jacobian(model.nodes)).sum(axis=1) for c in actuators]
        stretches = np.concatenate([np.zeros(0), *(np.full(c.size, c.compliance) for c in actuators)])
        return cls(
            roles=tuple(role for role in model.roles if role[0] != "b"),
            labels=tuple(row for group in groups for c in group for row in c.rows()),
            bonds=dict(model.roles).get("b", 0),
            slack_tolerance=ROUND_OFF * np.concatenate([np.zeros(0), *slopes]).clip(max=1.0),
            stretch=stretches if stretches.any() else 0.0,
        )

    def slack(
        self, effort: np.ndarray, delta: np.ndarray, target: np.ndarray, driven: np.ndarray, unilateral: np.ndarray
    ) -> np.ndarray:
        """Return which actuators hang slack, shape (n_a,): unilateral ones that are driven beyond where they are.

        Args:
            effort: of all rows, shape (size,).
            delta: values of all rows, shape (size,).
            target: values that driven rows are commanded to, shape (size,) or (n_a,).
            driven: driven rows, shape (d,).
            unilateral: actuators that cannot push, shape (n_a,).
        """
        slack = np.zeros(len(unilateral), dtype=bool)
        rows = driven[driven < len(unilateral)]
        rows = rows[unilateral[rows]] if len(rows) else rows
        # The sign of the effort alone does not suffice: at rest it is round-off.
        slack[rows] = (effort[rows] <= 0.0) & (delta[rows] > target[rows] + self.slack_tolerance[rows])
        return slack

    def equilibrium(
        self,
        x: np.ndarray,
        effort: np.ndarray,
        delta: np.ndarray,
        W: np.ndarray,
        slack: np.ndarray,
        *,
        stable: bool,
        iterations: int,
        increments: int = 1,
        symmetric: bool = True,
        contacts: Contacts | None = None,
        memory: ContactMemory | CableMemory | None = None,
        conditions: Conditions | None = None,
    ) -> Equilibrium:
        """Return an equilibrium with its condensed model, from which bonds are eliminated.

        Args:
            x: node positions [m], shape (n, 3).
            effort: of all rows, shape (size,).
            delta: values of all rows, shape (size,).
            W: compliance of all rows, shape (size, size).
            slack: actuators that hang slack, shape (n_a,).
            stable: as in `Equilibrium`.
            iterations: as there.
            increments: as there.
            symmetric: whether ``W`` is symmetric: no point slides.
            contacts: as there.
            memory: as there.
            conditions: as there.
        """
        count = len(effort) - self.bonds
        if self.bonds:
            W = W[:count, :count] - W[:count, count:] @ np.linalg.solve(W[count:, count:], W[count:, :count])
            if symmetric:
                W = 0.5 * (W + W.T)
        free = delta[:count] - W @ effort[:count]
        condensed = CondensedModel(W, free, effort[:count], self.roles, self.labels, self.stretch)
        return Equilibrium(
            x, condensed, delta, effort, slack, stable, iterations, increments, contacts, memory, conditions
        )


def checked(name: str, values: Sequence[float] | np.ndarray, count: int) -> np.ndarray:
    """Return values as an array (count,).

    Raises:
        ValueError: for a wrong shape or a value that is not finite.
    """
    array = np.asarray(values, dtype=float)
    if array.shape != (count,):
        raise ValueError(f"{name} must have shape ({count},), got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got {array.tolist()}")
    return array


def check_shapes(x: np.ndarray, effort: np.ndarray, nodes: tuple[int, ...], size: int) -> None:
    """Raise a ValueError unless rows have the shape of a body's ``nodes`` and there are ``size`` efforts."""
    if x.shape != nodes or effort.shape != (size,):
        raise ValueError(
            f"the state has nodes of shape {x.shape} and efforts of shape {effort.shape}, but the body has {nodes} "
            f"and {(size,)}"
        )


def check_contact(mode: str, contact: Sequence[float] | np.ndarray | None) -> None:
    """Raise a ValueError for an unknown mode of driven contacts, or if driven positions are missing."""
    if mode not in ("displacement", "effort"):
        raise ValueError(f"contact_mode must be 'displacement' or 'effort', got {mode!r}")
    if mode == "displacement" and contact is None:
        raise ValueError("contact_mode = 'displacement' needs the positions in 'contact'")


def checked_modes(mode: str | Sequence[str], target: np.ndarray, unilateral: np.ndarray) -> list[str]:
    """Return how each actuator is driven, shape (n_a,).

    Args:
        mode: ``"displacement"`` or ``"effort"`` for all actuators, or one of them for each.
        target: their commands, shape (n_a,).
        unilateral: actuators that cannot push, shape (n_a,).

    Raises:
        ValueError: for an unknown mode, or a negative effort on an actuator that cannot push.
    """
    count = len(target)
    modes = [mode] * count if isinstance(mode, str) else list(mode)
    if len(modes) != count or any(m not in ("displacement", "effort") for m in modes):
        raise ValueError(f"mode must be 'displacement' or 'effort' (one, or {count} of them), got {mode!r}")
    for row, (kind, value) in enumerate(zip(modes, target, strict=True)):
        if kind == "effort" and unilateral[row] and value < 0.0:
            raise ValueError(f"effort {value:g} on actuator row {row} must not be negative: this actuator cannot push")
    return modes
