"""The condensed model: everything that controllers, environments and objectives need to know about a soft robot.

Thesis, eq. 2.5-2.14 and 4.1-4.3: with ``H_i`` the gradient of constraint function ``delta_i`` and ``A`` the tangent of
the equilibrium,

    W_ij = H_i A^-1 H_j^T,    delta_free = delta - W effort,    delta(effort + d) = W (effort + d) + delta_free.

``A`` here includes the geometric terms, so that ``W`` is exactly the derivative of the equilibrium.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from softgym_envs.units import effort_unit

Roles = tuple[tuple[str, int], ...]
"""Role letters and sizes in order, e.g. ``(("a", 2), ("e", 3))``: actuators, effectors, contacts."""

_ROLE_NAMES = {"a": "actuator", "e": "effector", "c": "contact", "t": "friction", "s": "sensor"}


class Row(NamedTuple):
    """Name and units of one row of a condensed model.

    Attributes:
        name: of the actuator, or of the effector with its axis.
        unit: of the displacement.
        effort_unit: of the effort.
    """

    name: str
    unit: str
    effort_unit: str


def point_rows(name: str, unit: str = "m") -> list[Row]:
    """Return the rows of the three coordinates of a point."""
    return [Row(f"{name} {axis}", unit, effort_unit(unit)) for axis in "xyz"]


class _RoleView:
    """An array whose parts along its last axes are accessed by role letter.

    Args:
        title: what the array holds.
        array: the values.
        model: the condensed model that it belongs to.
    """

    __slots__ = ("array", "model", "title")

    def __init__(self, title: str, array: np.ndarray, model: CondensedModel) -> None:
        self.title = title
        self.array = array
        self.model = model

    def _slice(self, attribute: str, role: str) -> slice:
        if attribute in _RoleView.__slots__ or attribute.startswith("__"):  # while being copied or unpickled
            raise AttributeError(attribute)
        slices = self.model.slices
        if role not in slices:
            kind = "role" if len(attribute) == 1 else "block"
            raise AttributeError(f"no {kind} '{attribute}'; roles: {', '.join(slices)}")
        return slices[role]

    def __array__(self, dtype: np.dtype | None = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.array, dtype=dtype) if copy else np.asarray(self.array, dtype=dtype)


class RoleVector(_RoleView):
    """A vector (..., n) whose parts are accessed by role letter: ``delta.e``."""

    __slots__ = ()

    def __getattr__(self, role: str) -> np.ndarray:
        part = self._slice(role, role)  # first: it rejects the special names that copying looks up
        return self.array[..., part]

    def __repr__(self) -> str:
        rows = self.model.labels
        if self.array.ndim > 1:
            return _batch_summary(self.title, self.array, rows)
        units = [row.effort_unit if self.title == "effort" else row.unit for row in rows]
        values = {self.title: [f"{value:.5g}" for value in self.array]}
        return _table([f"{row.name} [{unit}]" for row, unit in zip(rows, units, strict=True)], values)


class RoleMatrix(_RoleView):
    """A matrix (..., n, n) whose blocks are accessed by two role letters: ``W.ea``."""

    __slots__ = ()

    def __getattr__(self, roles: str) -> np.ndarray:
        row, column = self._slice(roles, roles[:1]), self._slice(roles, roles[1:])
        return self.array[..., row, column]

    def __repr__(self) -> str:
        rows = self.model.labels
        if self.array.ndim > 2:
            return _batch_summary(self.title, self.array, rows)
        columns = {
            f"{row.name} [{row.effort_unit}]": [f"{value:.4g}" for value in column]
            for row, column in zip(rows, self.array.T, strict=True)
        }
        return _table([f"{row.name} [{row.unit}]" for row in rows], columns, corner=self.title)


def _table(rows: Sequence[str], columns: Mapping[str, Sequence[str]], corner: str = "") -> str:
    """Format a text table with row names on the left and column names on top."""
    width = max(map(len, [*rows, corner]))
    widths = [max(map(len, [name, *values])) for name, values in columns.items()]
    head = "  ".join([corner.ljust(width), *(name.rjust(w) for name, w in zip(columns, widths, strict=True))])
    lines = [
        "  ".join([row.ljust(width), *(value.rjust(w) for value, w in zip(values, widths, strict=True))])
        for row, values in zip(rows, zip(*columns.values(), strict=True), strict=True)
    ]
    return "\n".join([head, *lines])


def _batch_summary(title: str, array: np.ndarray, rows: Sequence[Row]) -> str:
    names = ", ".join(f"{row.name} [{row.unit}, {row.effort_unit}]" for row in rows)
    return f"{title} of shape {array.shape}; rows: {names}"


@dataclass(frozen=True, repr=False)
class CondensedModel:
    """Compliance and free displacement between the actuators, effectors and contacts of a robot.

    ``W``, ``delta_free`` and ``delta`` print with names and units.

    Attributes:
        compliance: ``W``, shape (..., n, n), symmetric [displacement unit / effort unit].
        free: ``delta_free``, shape (..., n): the displacements at zero effort, extrapolated with the tangent.
        effort: efforts at which the model was computed, shape (..., n).
        roles: role letters and sizes, in order.
        rows: names and units of the rows, where they are known.
        stretch: how far what drives each actuator stretches per effort, shape (n_a,), or zero for rigid drives.

    Any leading shape is a batch. Effector entries of delta are absolute positions [m].
    """

    compliance: np.ndarray
    free: np.ndarray
    effort: np.ndarray
    roles: Roles
    rows: tuple[Row, ...] = ()
    stretch: np.ndarray | float = 0.0

    @property
    def slices(self) -> dict[str, slice]:
        """Index range of each role."""
        result, start = {}, 0
        for letter, size in self.roles:
            result[letter] = slice(start, start + size)
            start += size
        return result

    @property
    def labels(self) -> tuple[Row, ...]:
        """Names and units of the rows, numbered by role where they are not known."""
        if self.rows:
            return self.rows
        return tuple(Row(f"{_ROLE_NAMES[r]} {k + 1}", "?", "?") for r, size in self.roles for k in range(size))

    @property
    def W(self) -> RoleMatrix:
        """Compliance, accessed by blocks: ``W.ea`` has shape (..., n_e, n_a)."""
        return RoleMatrix("W", self.compliance, self)

    @property
    def delta_free(self) -> RoleVector:
        """Free displacement, accessed by role: ``delta_free.e`` has shape (..., n_e)."""
        return RoleVector("delta_free", self.free, self)

    @property
    def lambda_(self) -> RoleVector:
        """Efforts, accessed by role."""
        return RoleVector("effort", self.effort, self)

    @property
    def delta(self) -> RoleVector:
        """Displacements at the state of the model, ``W effort + delta_free``."""
        delta = np.einsum("...ij,...j->...i", self.compliance, self.effort) + self.free
        return RoleVector("delta", delta, self)

    @property
    def at_drives(self) -> CondensedModel:
        """The model whose actuator displacements are the commands: those of the actuators and what drives stretch."""
        if not np.any(self.stretch):
            return self
        compliance, actuators = self.compliance.copy(), np.arange(dict(self.roles)["a"])
        compliance[..., actuators, actuators] += self.stretch
        return replace(self, compliance=compliance, stretch=0.0)

    def __repr__(self) -> str:
        batch = self.free.shape[:-1]
        return f"CondensedModel({', '.join(row.name for row in self.labels)}{f'; batch {batch}' if batch else ''})"


@dataclass(frozen=True, repr=False)
class ContactModel(CondensedModel):
    """Condensed model whose rows ``c`` are openings of contacts, and rows ``t`` their slips.

    Efforts of rows ``c`` are normal forces, those of rows ``t`` friction forces along fixed directions. ``W`` is that
    of the body without its contacts, so it is symmetric whether points stick or slide. Slips count from the present
    state.

    A body that nothing but its contacts holds has no compliance without them. Springs along some rows then hold it in
    the model: they are relaxed at the present state, and their force is ``y / hold`` for a motion ``y`` along the row.
    Who uses the model adds opposite forces, so the springs do not matter in the end.

    Attributes:
        coefficient: of friction of each contact, shape (n_c,).
        owner: number of the contact of each row ``t``, shape (n_t,).
        hold: compliance of the springs along rows ``c`` and ``t`` [m/N], shape (n_c + n_t,); zero without a spring.
            It is also the part of ``W`` on the diagonal that barrier and friction springs add.
    """

    coefficient: np.ndarray = field(default_factory=lambda: np.zeros(0))
    owner: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    hold: np.ndarray = field(default_factory=lambda: np.zeros(0))
