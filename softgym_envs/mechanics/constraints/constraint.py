"""The interface of a constraint function."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

import numpy as np

from softgym_envs.errors import unknown_name
from softgym_envs.mechanics.condensation import Row, point_rows
from softgym_envs.wording import brief


class Constraint(ABC):
    """A function ``delta(x)`` of the nodes with ``size`` rows and a work-conjugate effort per row.

    An effort is positive when it does positive work while delta grows.

    Attributes:
        name: identifier within a model.
        size: number of rows.
        dofs: degrees of freedom of the full node array (3 * node + axis) it depends on, shape (k,).
        unilateral: whether the effort must not be negative when displacement-driven (a cable cannot push).
        unit: units of displacement and effort, for tables.
        compliance: how far what drives it stretches per effort [m/N]: driven in displacement, a command is what the far
            end does, and delta stays behind by ``compliance * effort``. Statics only.
    """

    name: str
    size: int
    dofs: np.ndarray
    unilateral: bool = False
    unit: tuple[str, str] = ("m", "N")
    compliance: float = 0.0

    def rows(self) -> list[Row]:
        """Names and units of its rows."""
        return [Row(self.name, *self.unit)] if self.size == 1 else point_rows(self.name, self.unit[0])

    def rest_size(self) -> float:
        """Return what displacements compare with: a length [m] or volume [m3] at rest; NaN for angles and positions."""
        return np.nan

    @abstractmethod
    def value(self, x: np.ndarray) -> np.ndarray:
        """Return delta, shape (size,), at node positions ``x`` [m], shape (n, 3)."""

    @abstractmethod
    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Return d delta / d x over ``dofs``, shape (size, k)."""

    def linearise(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `value` and `jacobian` at once."""
        return self.value(x), self.jacobian(x)

    def hessian_pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns (degrees of freedom) of the entries of `hessian`; all pairs of ``dofs`` by default.

        Both halves are listed; entries of the same place add up.
        """
        k = len(self.dofs)
        return np.repeat(self.dofs, k), np.tile(self.dofs, k)

    def hessian(self, x: np.ndarray, effort: np.ndarray) -> np.ndarray | None:
        """Return the entries of ``sum_i effort_i d2 delta_i / dx2`` in the order of `hessian_pattern`.

        Any shape of that size works, such as (k, k) for the default pattern; None if delta is linear.
        """
        return None


def add_constraint(constraints: Mapping[str, list[Constraint]], role: str, constraint: Constraint) -> None:
    """Add a constraint to those of its role.

    Raises:
        ValueError: for an unknown role, what is no constraint, or a name that another one of the role has.
    """
    if role not in constraints:
        raise ValueError(unknown_name("role", role, constraints))
    if not isinstance(constraint, Constraint):
        raise ValueError(f"role '{role}' takes a constraint, got {brief(constraint)}")
    if role in "aes" and any(each.name == constraint.name for each in constraints[role]):
        word = {"a": "an actuator", "e": "an effector", "s": "a sensor"}[role]
        raise ValueError(f"the model already has {word} named '{constraint.name}'; give each its own name")
    constraints[role].append(constraint)
