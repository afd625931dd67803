"""The interface of a block of elements."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np


class StrainRates(NamedTuple):
    """What determines the rates of strain in a time step.

    The rate of a strain that is quadratic in the rows is its derivative at `middle` along `velocity`.

    Attributes:
        start: rows at the start of the step [m], shape (n, 3).
        middle: rows at which the velocity acts [m], shape (n, 3).
        velocity: of the rows [m/s], shape (n, 3).
        factor: derivative of velocities with respect to displacements [1/s].
        damping: Rayleigh's beta [s].
    """

    start: np.ndarray
    middle: np.ndarray
    velocity: np.ndarray
    factor: float
    damping: float


NO_ENTRIES = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0)
"""Rows, columns and values of an empty matrix."""


def lower_pairs(dofs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of the lower triangles, each (m, k (k + 1) / 2), of elements with degrees of freedom ``dofs`` (m, k)."""
    r, s = np.tril_indices(dofs.shape[1])
    return dofs[:, r], dofs[:, s]


class ElementBlock(ABC):
    """Elements of one kind: an energy of the rows of ``x`` with its gradient and exact tangent.

    Degrees of freedom are numbered ``3 * row + axis`` over all rows of ``x``. Blocks treat all rows alike,
    whether they are free, fixed or carried by a frame.

    Attributes:
        nodes_used: rows of ``x`` that the elements touch, shape (u,).
        volume: rest volume [m3].
        mass: mass [kg].
        stiffness: a typical stiffness against displacements [N/m], for scaling.
        damped: whether there are forces against velocities besides Rayleigh's damping.
        learned: whether the energy is learned, so that `possible_errors` has rows.
        elasticity_version: increases with every change of the elasticity, so that solvers can detect it.
    """

    nodes_used: np.ndarray
    volume: float
    mass: float
    stiffness: float
    damped: bool = False
    learned: bool = False
    elasticity_version: int = 0

    @property
    def largest_young_modulus(self) -> float:
        """Young's modulus [Pa] of the stiffest element; zero for parts that are not elastic."""
        return 0.0

    def knows(self, x: np.ndarray) -> bool:
        """Whether the energy is known at rows ``x`` (n, 3); learned ones are known where they were learned."""
        return True

    def is_folded(self, x: np.ndarray) -> bool:
        """Whether an element is bent beyond what it can resist at rows ``x`` (n, 3), which depends on the mesh."""
        return False

    def possible_errors(self, x: np.ndarray, fields: np.ndarray) -> np.ndarray:
        """Return the work of possible errors of the forces at rows ``x`` (n, 3) along motions of the rows.

        Args:
            x: positions [m].
            fields: motions per unit, shape (m, n, 3).

        Returns:
            A row for each of k independent errors, shape (k, m); no rows where the energy is exact.
        """
        return np.empty((0, len(fields)))

    @abstractmethod
    def stencils(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Pairs of degrees of freedom of the tangent's entries: (rows, columns), index arrays of one shape.

        Each pair stands for one entry of the symmetric element matrix and its mirror image.
        """

    @abstractmethod
    def add(
        self, x: np.ndarray, gradient: np.ndarray, values: np.ndarray | None, scatter: list[np.ndarray] | None
    ) -> tuple[float, int]:
        """Add gradient (n, 3) and, if ``values`` is given, the tangent at positions ``x`` (n, 3).

        Args:
            x: positions [m], shape (n, 3).
            gradient: output, added to.
            values: output, to which each entry is added at the index in ``scatter`` (-1: skipped).
            scatter: one array for each of `stencils`, of its shape.

        Returns:
            The elastic energy [J] and the number of inverted elements; if there are any, the outputs are meaningless.
        """

    @abstractmethod
    def add_damping(
        self,
        x: np.ndarray,
        rates: StrainRates,
        gradient: np.ndarray,
        values: np.ndarray | None,
        scatter: list[np.ndarray] | None,
    ) -> float:
        """Add the forces against the rates of strain, and their tangent, if a time step ends at rows ``x`` (n, 3).

        The stress is the elastic one of the strain rates times Rayleigh's beta, without that of the strain itself:
        it dissipates energy in any state, and a rigid motion, however fast, causes none.

        Args:
            x: positions at the end of the step [m], shape (n, 3).
            rates: see `StrainRates`.
            gradient: output, as for `add`.
            values: output, as for `add`: the exact tangent if the velocity acts at the middle of the step. Otherwise
                it omits what the motion of `middle` adds to the rates.
            scatter: as for `add`.

        Returns:
            The dissipated power [W].
        """

    @abstractmethod
    def nodal_masses(self, count: int) -> np.ndarray:
        """Mass [kg] on which gravity acts at each of ``count`` rows, shape (count,)."""

    @abstractmethod
    def mass_entries(self, lumped: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mass matrix between rows [kg]: row, column (row >= column in the element) and value, each of shape (k,).

        The kinetic energy is ``sum value v_row . v_column / 2`` over these entries and their mirror images.
        """

    @abstractmethod
    def add_warped(self, x: np.ndarray, step: np.ndarray, out: np.ndarray) -> None:
        """Add the right-hand side of rotation-strain warping of a ``step`` (n, 3) from ``x`` (n, 3) to ``out``."""

    @abstractmethod
    def laplacian_entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows, columns and values of the Laplacian that warping solves, each of shape (k,)."""


class Massless(ElementBlock):
    """Elements that store energy but have neither mass nor viscosity; steps are warped by what is around them."""

    volume = 0.0
    mass = 0.0
    stiffness = 0.0

    def add_damping(
        self,
        x: np.ndarray,
        rates: StrainRates,
        gradient: np.ndarray,
        values: np.ndarray | None,
        scatter: list[np.ndarray] | None,
    ) -> float:
        return 0.0

    def nodal_masses(self, count: int) -> np.ndarray:
        return np.zeros(count)

    def mass_entries(self, lumped: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return NO_ENTRIES

    def add_warped(self, x: np.ndarray, step: np.ndarray, out: np.ndarray) -> None:
        """Nothing of these elements is warped."""

    def laplacian_entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return NO_ENTRIES


def add_entries(values: np.ndarray, places: np.ndarray, entries: np.ndarray) -> None:
    """Add entries to ``values`` at places of the same size, where these are not negative."""
    kept = places.ravel() >= 0
    np.add.at(values, places.ravel()[kept], entries.ravel()[kept])
