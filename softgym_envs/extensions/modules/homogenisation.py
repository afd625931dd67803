"""Stiffness of a periodic cell, such as the infill of a printed body, by finite elements.

A body of many small cells strains like a homogeneous one: on each cell acts a mean strain, and its displacements
differ from those of that strain by periodic ones, which minimise the energy. The result holds for small strains and for
bodies that are several cells thick (see docs/mechanics.md for how many).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, tril

from softgym_envs.extensions.modules.orthotropic import PAIRS
from softgym_envs.mechanics.elements.quadratic import QuadraticTetrahedra, add_midside_nodes
from softgym_envs.mechanics.materials import lame_parameters
from softgym_envs.mechanics.solvers.linear import make_solver

# Kuhn's division of a cube into six tetrahedra along its diagonal; it matches between neighbours and opposite faces.
_CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]])
_KUHN = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])


@dataclass(frozen=True)
class Cell:
    """A periodic cell of boxes, some of which are filled.

    Attributes:
        edges: coordinates of the faces of the boxes along each axis [m], rising; three arrays of n_i + 1.
        filled: which boxes are material, shape (n_1, n_2, n_3).

    Raises:
        ValueError: if the shapes do not match or nothing is filled.
    """

    edges: tuple[np.ndarray, np.ndarray, np.ndarray]
    filled: np.ndarray

    def __post_init__(self) -> None:
        shape = tuple(len(edges) - 1 for edges in self.edges)
        if self.filled.shape != shape or not self.filled.any():
            raise ValueError(
                f"filled has shape {self.filled.shape} and {self.filled.sum()} boxes; needed {shape}, not empty"
            )
        if not all((np.diff(edges) > 0.0).all() for edges in self.edges):
            raise ValueError("edges of a cell must rise")

    @property
    def density(self) -> float:
        """Share of the cell that is material."""
        sizes = [np.diff(edges) for edges in self.edges]
        volumes = sizes[0][:, None, None] * sizes[1][None, :, None] * sizes[2][None, None, :]
        return float(volumes[self.filled].sum() / volumes.sum())

    def mesh(self, repeats: Sequence[int] = (1, 1, 1)) -> tuple[np.ndarray, np.ndarray]:
        """Return nodes [m] (n, 3) and tetrahedra (m, 4) of the material in a block of cells."""
        edges = []
        for axis, count in zip(self.edges, repeats, strict=True):
            steps = (axis[-1] - axis[0]) * np.arange(count)
            edges.append(np.append((axis[:-1] + steps[:, None]).ravel(), axis[-1] + steps[-1]))
        boxes = np.argwhere(np.tile(self.filled, repeats))
        counts = [len(axis) for axis in edges]
        corners = boxes[:, None] + _CORNERS
        numbers = np.ravel_multi_index(tuple(np.moveaxis(corners, 2, 0)), counts)
        used, tetrahedra = np.unique(numbers[:, _KUHN].reshape(-1, 4), return_inverse=True)
        places = np.stack(np.unravel_index(used, counts), axis=1)
        nodes = np.stack([edges[axis][places[:, axis]] for axis in range(3)], axis=1)
        return nodes, tetrahedra.reshape(-1, 4)


def lattice(wall_x: float, wall_y: float, *, pitch: float = 1.0, boxes: int = 4) -> Cell:
    """Return the cell of crossing walls that are extruded along z, as slicers print the infill "grid".

    Half a wall lies on each side of the cell.

    Args:
        wall_x: thickness of the walls across x over the pitch, 0 to 1.
        wall_y: thickness of the walls across y over the pitch, 0 to 1; one of the two may be 0.
        pitch: distance of the walls along x and y [m].
        boxes: boxes over half a wall, and over half of the gap between walls.

    Raises:
        ValueError: for a wall out of bounds, or without walls.
    """
    edges = []
    for name, wall in (("wall_x", wall_x), ("wall_y", wall_y)):
        if not 0.0 <= wall <= 1.0 or wall_x + wall_y == 0.0:
            raise ValueError(f"{name} = {wall} is out of bounds; allowed: 0 to 1, and not both walls 0")
        ends = np.array([0.0, 0.5 * wall, 0.5, 1.0 - 0.5 * wall, 1.0]) * pitch
        parts = [np.linspace(a, b, boxes + 1) for a, b in zip(ends[:-1], ends[1:], strict=True) if b > a]
        edges.append(np.unique(np.concatenate(parts)))
    x, y = edges
    middles = [0.5 * (axis[1:] + axis[:-1]) for axis in edges]
    solid = [np.abs(m - 0.5 * pitch) > 0.5 * (1.0 - w) * pitch for m, w in zip(middles, (wall_x, wall_y), strict=True)]
    filled = solid[0][:, None, None] | solid[1][None, :, None]
    return Cell((x, y, np.array([0.0, 0.5 * pitch / boxes])), filled)


def homogenise(cell: Cell, *, young_modulus: float = 1.0, poisson_ratio: float = 0.3) -> np.ndarray:
    """Return the stiffness (6, 6) of a body of many cells, in the unit of Young's modulus of the material.

    Components are in the order of `orthotropic_stiffness`. A direction in which nothing carries loads has (nearly) no
    stiffness.

    Args:
        cell: the cell; quadratic tetrahedra fill its boxes.
        young_modulus: of the material.
        poisson_ratio: of the material.

    Raises:
        ValueError: for impossible elasticity.
    """
    mu, lame = lame_parameters(young_modulus, poisson_ratio)
    material = np.diag([2.0 * mu] * 3 + [mu] * 3)
    material[:3, :3] += lame
    nodes, tetrahedra = cell.mesh()
    nodes, tetrahedra = add_midside_nodes(nodes, tetrahedra)
    block = QuadraticTetrahedra(nodes, tetrahedra, young_modulus=1.0, poisson_ratio=0.3)
    strain = _strain_matrices(block.gradients)  # (m q, 6, 3 k)
    weights = block.weights
    sides = np.array([axis[-1] - axis[0] for axis in cell.edges])
    same = _periodic_numbers(nodes - [axis[0] for axis in cell.edges], sides)
    dofs = (3 * same[block.connectivity][:, :, None] + np.arange(3)).reshape(len(block.connectivity), -1)
    elements = np.einsum("qia,q,ij,qjb->qab", strain, weights, material, strain, optimize=True)
    elements = elements.reshape(len(dofs), block.points, *elements.shape[1:]).sum(axis=1)
    loads = np.einsum("qia,q,ij->qaj", strain, weights, material, optimize=True)
    loads = loads.reshape(len(dofs), block.points, *loads.shape[1:]).sum(axis=1)
    size = 3 * (same.max() + 1)
    rows, columns = np.repeat(dofs, dofs.shape[1], axis=1), np.tile(dofs, (1, dofs.shape[1]))
    K = coo_matrix((elements.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size)).tocsc()
    right = np.zeros((size, 6))
    np.add.at(right, dofs, loads)
    # A weak ground holds rigid motions, and parts that touch nothing.
    ground = 1e-9 * K.diagonal().mean()
    lower = tril(K + ground * coo_matrix((np.ones(size), (range(size), range(size)))), format="csc")
    lower.sort_indices()
    solver = make_solver("auto", lower.indptr, lower.indices)
    if not solver.factorise(lower.data):
        raise ValueError("the cell has no stiffness")
    periodic = solver.solve(right)
    mean = np.einsum("q,ij->ij", weights, material) - right.T @ periodic
    stiffness = mean / np.prod(sides)
    return 0.5 * (stiffness + stiffness.T)


def _strain_matrices(gradients: np.ndarray) -> np.ndarray:
    """Return strains of nodal displacements, shape (q, 6, 3 k), for gradients of shape functions (q, k, 3)."""
    out = np.zeros((len(gradients), 6, gradients.shape[1], 3))
    for component, (i, j) in enumerate(PAIRS):
        out[:, component, :, i] += gradients[:, :, j]
        if i != j:
            out[:, component, :, j] += gradients[:, :, i]
    return out.reshape(len(gradients), 6, -1)


def _periodic_numbers(nodes: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Return numbers of nodes (n, 3), the same for nodes on opposite faces of a box from 0 to ``sides``."""
    place = np.round(nodes / sides * 2**20).astype(np.int64) % 2**20
    return np.unique(place, axis=0, return_inverse=True)[1].ravel()
