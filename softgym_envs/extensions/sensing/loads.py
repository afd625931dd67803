"""Loads that sensors must find: a touch within a cell of a grid, or a payload at the effector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from softgym_envs.extensions.sensing.places import Places
from softgym_envs.extensions.sensing.posterior import Gaussian
from softgym_envs.quantities import check_quantity

Cell = tuple[int, int]

PLACES = 9
"""Places along each edge of a cell that estimates are summed over."""


class Load(Protocol):
    """Forces on a body, proportional to a size of at least 0 and dependent on a place.

    The parameters are the size, then the coordinates of the place.
    """

    @property
    def prior(self) -> Gaussian:
        """What is known of the parameters before any reading."""

    @property
    def points(self) -> np.ndarray:
        """Points of the undeformed body on which the load acts besides the effectors [m], shape (p, 3)."""

    def places(self, effectors: int) -> Places:
        """Places that stand for all at which the load may act."""

    def forces(self, parameters: np.ndarray, effectors: int) -> np.ndarray:
        """Forces on the coordinates of the effectors, then of the points [N], shape (effectors + 3 p,)."""

    def jacobian(self, parameters: np.ndarray, effectors: int) -> np.ndarray:
        """Derivative of `forces`, shape (effectors + 3 p, parameters)."""


@dataclass(frozen=True)
class TouchGrid:
    """A flat grid of square touch cells on the undeformed body: it tells which cell is touched, and no force.

    Args:
        corner: of the first cell [m].
        along: unit vector along the first index.
        across: unit vector along the second index.
        normal: unit vector of the force of a touch, into the body.
        cells: number of cells along both vectors.
        pitch: size of a cell [m].
    """

    corner: tuple[float, float, float]
    along: tuple[float, float, float]
    across: tuple[float, float, float]
    normal: tuple[float, float, float]
    cells: Cell
    pitch: float = 5e-3

    def __post_init__(self) -> None:
        axes = np.array([self.along, self.across, self.normal])
        if not np.allclose(axes @ axes.T, np.eye(3), atol=1e-9):
            raise ValueError(f"'along', 'across' and 'normal' must be perpendicular unit vectors, got {axes.tolist()}")
        if not self.pitch > 0.0 or min(self.cells) < 1:
            raise ValueError(f"a grid needs a positive pitch and cells, got {self.pitch} m and {self.cells}")

    def cell(self, point: np.ndarray) -> Cell:
        """Return the cell that contains a point of the undeformed surface [m] (3,).

        Raises:
            ValueError: if the point is outside the grid, or farther from its plane than the pitch.
        """
        away = np.asarray(point) - np.array(self.corner)
        height = float(away @ np.array(self.normal))
        if not abs(height) <= self.pitch:
            raise ValueError(f"point {np.asarray(point).tolist()} m is {height:g} m away from the plane of the grid")
        first, second = (int(np.floor(away @ np.array(axis) / self.pitch)) for axis in (self.along, self.across))
        return self.checked((first, second))

    def checked(self, cell: Cell) -> Cell:
        """Return a cell; a ValueError if the grid does not have it."""
        if len(cell) != 2 or not all(k in range(n) for k, n in zip(cell, self.cells, strict=True)):
            raise ValueError(
                f"touch in cell {tuple(cell)} is outside the model: the grid has {self.cells[0]} x {self.cells[1]} "
                "cells, numbered from 0"
            )
        return cell

    def inside(self, cell: Cell, coordinates: np.ndarray) -> np.ndarray:
        """Return points [m] (q, 3) of a cell, given by two numbers each from -1 to 1 (q, 2)."""
        first, right, up, _ = self.corners(cell)
        shares = 0.5 * (np.asarray(coordinates) + 1.0)
        return first + shares @ np.array([right - first, up - first])

    def corners(self, cell: Cell) -> np.ndarray:
        """Return the corners of a cell [m], in the order (0, 0), (1, 0), (0, 1), (1, 1), shape (4, 3)."""
        first, second = self.checked(cell)
        steps = np.array([[first, second], [first + 1, second], [first, second + 1], [first + 1, second + 1]])
        return np.array(self.corner) + self.pitch * steps @ np.array([self.along, self.across])


def finger_grid(pitch: float = 5e-3) -> TouchGrid:
    """Return the grid on the flat back of the sensorized finger (y = 0), from 15 to 115 mm below its flange.

    Raises:
        ValueError: for a pitch [m] with which no cell fits across the back.
    """
    if not 0.0 < pitch <= 0.015:
        raise ValueError(f"pitch = {pitch} m of touch cells is out of bounds; allowed: up to 0.015 m")
    columns, rows = int(0.015 / pitch + 1e-9), int(0.100 / pitch + 1e-9)
    corner = (-0.5 * columns * pitch, 0.0, -0.015)
    return TouchGrid(corner, (1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0), (columns, rows), pitch)


def cell_nodes(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes (count^2, 2) from -1 to 1 and weights of a Gauss quadrature over a cell, whose sum is one."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return np.array([[u, v] for v in nodes for u in nodes]), np.kron(weights, weights) / 4.0


@dataclass(frozen=True)
class Touch:
    """A force along the normal of a grid at an unknown place in one cell.

    Parameters: the force [N], at least 0, and the place in the cell, two numbers from -1 to 1. The force is shared by
    nine points of the cell (corners, middles of edges, centre) with quadratic weights, so that the condensed model
    knows how every place responds. It keeps its direction in space while the body bends.

    Args:
        grid: of which a cell is touched.
        cell: the touched cell.
        expected_force: standard deviation of the force before any reading [N].

    Raises:
        ValueError: for a force that is not positive and finite.
    """

    grid: TouchGrid
    cell: Cell
    expected_force: float = 2.0

    def __post_init__(self) -> None:
        _check_positive("expected_force", self.expected_force, "N")
        check_quantity("force", self.expected_force, "expected_force")

    @property
    def points(self) -> np.ndarray:
        corner, right, up, _ = self.grid.corners(self.cell)
        shares = np.array([[i, j] for j in (0.0, 0.5, 1.0) for i in (0.0, 0.5, 1.0)])
        return corner + shares @ np.array([right - corner, up - corner])

    @property
    def prior(self) -> Gaussian:
        spread = 3.0**-0.5  # of a place that is anywhere in the cell with the same probability
        return Gaussian(
            np.zeros(3),
            np.diag([self.expected_force, spread, spread]) ** 2,
            low=np.array([0.0, -1.0, -1.0]),
            high=np.array([np.inf, 1.0, 1.0]),
        )

    def places(self, effectors: int) -> Places:
        """Return the nodes of a Gauss quadrature over the cell: before any reading, all its places are alike."""
        coordinates, shares = cell_nodes(PLACES)
        sizes = np.column_stack([np.ones(len(coordinates)), coordinates])
        directions = np.array([self.forces(parameters, effectors) for parameters in sizes])
        return Places(coordinates, directions, shares)

    def place(self, parameters: np.ndarray) -> np.ndarray:
        """Return the touched point of the undeformed body [m], shape (3,)."""
        return self._weights(parameters)[0] @ self.points

    def forces(self, parameters: np.ndarray, effectors: int) -> np.ndarray:
        weights = self._weights(parameters)[0]
        return np.concatenate([np.zeros(effectors), parameters[0] * np.kron(weights, self.grid.normal)])

    def jacobian(self, parameters: np.ndarray, effectors: int) -> np.ndarray:
        weights, first, second = self._weights(parameters)
        columns = np.stack([weights, parameters[0] * first, parameters[0] * second], axis=1)
        return np.vstack([np.zeros((effectors, 3)), np.kron(columns, np.array(self.grid.normal)[:, None])])

    @staticmethod
    def _weights(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the weights of the points and their derivatives by both places, each of shape (9,)."""
        (along, by_u), (across, by_v) = (_quadratic(place) for place in parameters[1:])
        return np.kron(across, along), np.kron(across, by_u), np.kron(by_v, along)


def _check_positive(name: str, value: float, unit: str) -> None:
    if not (np.isfinite(value) and value > 0.0):
        raise ValueError(f"{name} = {value} {unit} must be positive and finite")


def _quadratic(place: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of -1, 0 and 1 in quadratic interpolation at a place, and their derivatives."""
    weights = np.array([0.5 * place * (place - 1.0), 1.0 - place**2, 0.5 * place * (place + 1.0)])
    return weights, np.array([place - 0.5, -2.0 * place, place + 0.5])


@dataclass(frozen=True)
class Payload:
    """A mass that hangs on the first effector. Parameter: the mass [kg], at least 0.

    Args:
        gravity: acceleration [m/s2].
        expected_mass: standard deviation of the mass before any reading [kg].

    Raises:
        ValueError: for a mass that is not positive and finite.
    """

    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    expected_mass: float = 0.1

    def __post_init__(self) -> None:
        _check_positive("expected_mass", self.expected_mass, "kg")
        check_quantity("mass", self.expected_mass, "expected_mass")

    @property
    def points(self) -> np.ndarray:
        return np.empty((0, 3))

    @property
    def prior(self) -> Gaussian:
        return Gaussian(np.zeros(1), np.array([[self.expected_mass**2]]), low=np.zeros(1), high=np.array([np.inf]))

    def places(self, effectors: int) -> Places:
        """Return the only place."""
        return Places(np.empty((1, 0)), self.jacobian(np.ones(1), effectors).T, np.ones(1))

    def forces(self, parameters: np.ndarray, effectors: int) -> np.ndarray:
        return self.jacobian(parameters, effectors) @ parameters

    def jacobian(self, parameters: np.ndarray, effectors: int) -> np.ndarray:
        column = np.zeros((effectors, 1))
        column[:3, 0] = self.gravity
        return column
