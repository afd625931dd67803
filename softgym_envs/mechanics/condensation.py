"""The condensed model: all that is known of a soft robot above the physics.

Thesis eq. 2.5-2.14 and 4.1-4.3: with ``H_i`` the gradient of constraint function ``delta_i`` and ``A`` the
tangent of the equilibrium,

    W_ij = H_i A^-1 H_j^T,    delta_free = delta - W effort,    delta(effort + d) = W (effort + d) + delta_free.

``A`` here holds the geometric terms too, so that ``W`` is exactly the derivative of the equilibrium.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

__all__ = ["CondensedModel", "Roles"]

Roles = tuple[tuple[str, int], ...]
"""Role letters and sizes in order, e.g. ``(("a", 2), ("e", 3))``: actuators, effectors, contacts."""


class RoleVector:
    """A vector (..., n) whose parts are read by role letter: ``delta.e``."""

    __slots__ = ("array", "slices")

    def __init__(self, array: np.ndarray, slices: Mapping[str, slice]) -> None:
        self.array = array
        self.slices = slices

    def __getattr__(self, role: str) -> np.ndarray:
        if role in self.__slots__:  # while being copied or unpickled
            raise AttributeError(role)
        try:
            return self.array[..., self.slices[role]]
        except KeyError:
            raise AttributeError(f"no role '{role}'; roles: {', '.join(self.slices)}") from None

    def __array__(self, dtype: np.dtype | None = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.array, dtype=dtype) if copy else np.asarray(self.array, dtype=dtype)


class RoleMatrix:
    """A matrix (..., n, n) whose blocks are read by two role letters: ``W.ea``."""

    __slots__ = ("array", "slices")

    def __init__(self, array: np.ndarray, slices: Mapping[str, slice]) -> None:
        self.array = array
        self.slices = slices

    def __getattr__(self, roles: str) -> np.ndarray:
        if roles in self.__slots__:  # while being copied or unpickled
            raise AttributeError(roles)
        if len(roles) == 2 and roles[0] in self.slices and roles[1] in self.slices:
            return self.array[..., self.slices[roles[0]], self.slices[roles[1]]]
        raise AttributeError(f"no block '{roles}'; roles: {', '.join(self.slices)}")

    def __array__(self, dtype: np.dtype | None = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.array, dtype=dtype) if copy else np.asarray(self.array, dtype=dtype)


@dataclass(frozen=True)
class CondensedModel:
    """Compliance and free displacement between the actuators, effectors and contacts of a robot.

    Attributes:
        compliance: ``W``, shape (..., n, n), symmetric [delta unit / effort unit].
        free: ``delta_free``, shape (..., n): the displacements at zero effort by the tangent.
        effort: efforts at which the model was taken, shape (..., n).
        roles: role letters and sizes, in order.

    Any leading shape is a batch. Effector entries of delta are absolute positions [m].
    """

    compliance: np.ndarray
    free: np.ndarray
    effort: np.ndarray
    roles: Roles

    @property
    def slices(self) -> dict[str, slice]:
        """Index range of each role."""
        result, start = {}, 0
        for letter, size in self.roles:
            result[letter] = slice(start, start + size)
            start += size
        return result

    @property
    def W(self) -> RoleMatrix:
        """Compliance, read by blocks: ``W.ea`` has shape (..., n_e, n_a)."""
        return RoleMatrix(self.compliance, self.slices)

    @property
    def delta_free(self) -> RoleVector:
        """Free displacement, read by role: ``delta_free.e`` has shape (..., n_e)."""
        return RoleVector(self.free, self.slices)

    @property
    def lambda_(self) -> RoleVector:
        """Efforts, read by role."""
        return RoleVector(self.effort, self.slices)

    @property
    def delta(self) -> RoleVector:
        """Displacements at the state of the model, ``W effort + delta_free``."""
        return RoleVector(np.einsum("...ij,...j->...i", self.compliance, self.effort) + self.free, self.slices)
