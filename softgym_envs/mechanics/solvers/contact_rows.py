"""Rows of a condensed model for the openings of contacts and their slips."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np

from softgym_envs.mechanics.condensation import ContactModel, Row
from softgym_envs.mechanics.solvers.equilibrium import RowLayout

if TYPE_CHECKING:
    from softgym_envs.mechanics.contact.contact import ContactRow


class ContactRows(NamedTuple):
    """Openings of k contacts, then slips.

    Attributes:
        gradients: derivatives by the equations, shape (N, k + t).
        compliance: of barriers and friction springs [m/N], shape (k + t,).
        springs: that hold the body along the rows [N/m], shape (k + t,); zero for none.
        effort: normal and friction forces [N], shape (k + t,).
        opening: shape (k,).
        coefficient: of friction, shape (k,).
        owner: number of the contact of each slip, shape (t,).
        names: shape (k + t,).
    """

    gradients: np.ndarray
    compliance: np.ndarray
    springs: np.ndarray
    effort: np.ndarray
    opening: np.ndarray
    coefficient: np.ndarray
    owner: np.ndarray
    names: tuple[str, ...]

    @classmethod
    def of(cls, rows: Sequence[ContactRow], equations: int, friction: bool) -> Self:
        """Join the rows of all contacts; only with friction do they have slips."""
        rubbing = [(k, row) for k, row in enumerate(rows) if friction and row.coefficient > 0.0]
        normal = [row.gradient[:, None] for row in rows]
        # An open contact of a point has no spring, so only its barrier tells whether it presses.
        compliance = np.array([row.compliance for row in rows] + [row.yielding for _, row in rubbing for _ in range(2)])
        free = np.array([row.free for row in rows] + [row.free for _, row in rubbing for _ in range(2)], dtype=bool)
        held = free & (compliance > 0.0) & friction
        return cls(
            gradients=np.hstack([np.empty((equations, 0)), *normal, *(row.slips for _, row in rubbing)]),
            compliance=compliance,
            springs=np.where(held, 1.0 / np.where(held, compliance, 1.0), 0.0),
            effort=np.concatenate([[row.force for row in rows], *(row.rubbing for _, row in rubbing)]),
            opening=np.array([row.opening for row in rows]),
            coefficient=np.array([row.coefficient if friction else 0.0 for row in rows]),
            owner=np.repeat(np.array([k for k, _ in rubbing], dtype=np.int64), 2),
            names=(*(row.name for row in rows), *(f"{row.name} slip {j + 1}" for _, row in rubbing for j in range(2))),
        )

    def condensed(
        self, W: np.ndarray, delta: np.ndarray, effort: np.ndarray, layout: RowLayout, bonds: np.ndarray
    ) -> ContactModel:
        """Return the condensed model.

        Args:
            W: compliance of the rows of the layout and these, without contacts, shape (size + k + t,) squared.
            delta: values of the former, shape (size,).
            effort: their efforts, shape (size,).
            layout: names and roles of the rows that are not bonds.
            bonds: rows that are held, and left out.
        """
        size, slips = len(effort), len(self.owner)
        keep = np.delete(np.arange(size + len(self.effort)), bonds)
        if len(bonds):
            W = W - W[:, bonds] @ np.linalg.solve(W[np.ix_(bonds, bonds)], W[bonds])
        effort = np.concatenate([effort, self.effort])
        delta = np.concatenate([delta, self.opening, np.zeros(slips)])
        W[range(size, len(effort)), range(size, len(effort))] += self.compliance
        # Rows of contacts come before those of sensors.
        sensors = dict(layout.roles).get("s", 0)
        first = size - len(bonds) - sensors
        order = np.concatenate([keep[:first], keep[first + sensors :], keep[first : first + sensors]])
        labels = list(layout.labels)
        labels[first:first] = [Row(name, "m", "N") for name in self.names]
        sizes = dict(layout.roles)
        points = np.zeros(sizes.get("c", 0))  # rows of points that are no contacts with obstacles
        sizes["c"] = sizes.get("c", 0) + len(self.opening)
        if slips:
            sizes["t"] = slips
        W = W[np.ix_(order, order)]
        return ContactModel(
            compliance=0.5 * (W + W.T),
            free=delta[order] - W @ effort[order],
            effort=effort[order],
            roles=tuple((role, sizes[role]) for role in "aects" if role in sizes),
            rows=tuple(labels),
            coefficient=np.concatenate([points, self.coefficient]),
            owner=self.owner + len(points),
            hold=np.concatenate([points, np.where(self.springs > 0.0, self.compliance, 0.0)]),
        )
