"""Moving a mesh of fixed topology from one design to another.

With remeshing, the number of nodes jumps between neighbouring designs, and so does the compliance. Therefore the
baseline mesh is moved instead. Its boundary nodes stay on their geometric features (planes, cylinders, cones), which
move with the design: first corners are placed, then curves, then surfaces. The interior follows by harmonic extension.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from softgym_envs.robots.geometry.meshing import BodyMesh


class Feature:
    """A surface given by a signed distance: ``evaluate(x) -> (distance [m] (k,), gradient (k, 3))``."""

    def evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        raise NotImplementedError


@dataclass(frozen=True)
class Plane(Feature):
    """The plane through ``point`` [m] with a ``normal`` of any length."""

    point: tuple[float, float, float]
    normal: tuple[float, float, float]

    def evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        normal = np.asarray(self.normal) / np.linalg.norm(self.normal)
        return (x - np.asarray(self.point)) @ normal, np.broadcast_to(normal, x.shape)


@dataclass(frozen=True)
class Cone(Feature):
    """A cone about the z axis: radius ``radius + slope * (z - height)`` [m]; a cylinder for slope 0."""

    radius: float
    height: float
    slope: float

    def evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rho = np.maximum(np.hypot(x[:, 0], x[:, 1]), 1e-12)  # on the axis, any gradient will do
        scale = 1.0 / np.hypot(1.0, self.slope)
        distance = (rho - self.radius - self.slope * (x[:, 2] - self.height)) * scale
        gradient = np.column_stack([x[:, 0] / rho, x[:, 1] / rho, np.full(len(x), -self.slope)]) * scale
        return distance, gradient


def Cylinder(radius: float) -> Cone:  # noqa: N802 - named like the features
    """Return the cylinder of a radius [m] about the z axis."""
    return Cone(radius, 0.0, 0.0)


def mean_ratio(nodes: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Return the quality of tetrahedra, shape (m,): 1 if regular, 0 if flat, negative if inverted."""
    corners = nodes[tetrahedra]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    pairs = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    squares = sum(((corners[:, a] - corners[:, b]) ** 2).sum(axis=1) for a, b in pairs)
    return 12.0 * np.cbrt(9.0 * volume**2) * np.sign(volume) / squares


def tetrahedron_edges(tetrahedra: np.ndarray) -> np.ndarray:
    """Return the edges of tetrahedra as pairs of nodes, shape (e, 2)."""
    pairs = np.concatenate([tetrahedra[:, [a, b]] for a in range(4) for b in range(a)])
    return np.unique(np.sort(pairs, axis=1), axis=0)


def inverse_lengths(nodes: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return one over the lengths of edges (e, 2) [1/m], shape (e,)."""
    return 1.0 / np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1)


def extension(count: int, edges: np.ndarray, weights: np.ndarray, known: np.ndarray, anchor: float):
    """Return a function that extends displacements from the ``known`` nodes by a weighted graph Laplacian."""
    from scipy.sparse import coo_matrix, csc_matrix, identity  # here: see `softgym_envs.robots.geometry.meshing`
    from scipy.sparse.linalg import splu

    i, j = edges.T
    w = coo_matrix((weights, (i, j)), shape=(count, count)).tocsc()
    w = w + w.T
    laplacian = csc_matrix(-w + coo_matrix((np.asarray(w.sum(axis=1)).ravel(), (range(count), range(count)))))
    touched = np.zeros(count, dtype=bool)
    touched[edges.ravel()] = True
    unknown = touched & ~known
    size = int(unknown.sum())
    # The anchor keeps components without a known node at their guess.
    factor = splu(csc_matrix(laplacian[unknown][:, unknown] + anchor * identity(size))) if size else None
    coupling = laplacian[unknown][:, known]

    def extend(displacement: np.ndarray, guess: np.ndarray) -> np.ndarray:
        if factor is not None:
            displacement[unknown] = factor.solve(anchor * guess[unknown] - coupling @ displacement[known])
        return displacement

    return extend


class Morpher:
    """Moves one baseline mesh over a design space.

    Args:
        mesh: the baseline mesh.
        features: features of the baseline design by name. Every surface of the mesh must lie on one.

    Raises:
        ValueError: if a surface of the mesh lies on no feature.
    """

    def __init__(self, mesh: BodyMesh, features: Mapping[str, Feature]) -> None:
        self.mesh = mesh
        nodes, n = mesh.nodes, len(mesh.nodes)
        names = list(features)
        on = np.zeros((n, len(names)), dtype=bool)
        for surface in np.unique(mesh.surfaces):
            ids = np.unique(mesh.triangles[mesh.surfaces == surface])
            errors = [np.abs(features[name].evaluate(nodes[ids])[0]).max() for name in names]
            best = int(np.argmin(errors))
            if errors[best] > 1e-6:
                raise ValueError(
                    f"mesh surface {surface} lies on no feature: the nearest is '{names[best]}', "
                    f"{errors[best] * 1e3:.3g} mm away"
                )
            on[ids, best] = True
        count = on.sum(axis=1)
        self._groups = {}
        for pattern in np.unique(on[count > 0], axis=0):
            chosen = tuple(names[k] for k in np.flatnonzero(pattern))
            self._groups[chosen] = np.flatnonzero((on == pattern).all(axis=1))
        triangle_edges = np.unique(
            np.sort(
                np.concatenate([mesh.triangles[:, [0, 1]], mesh.triangles[:, [1, 2]], mesh.triangles[:, [0, 2]]]),
                axis=1,
            ),
            axis=0,
        )
        shared = (on[triangle_edges[:, 0]] & on[triangle_edges[:, 1]]).sum(axis=1)
        curve_edges = triangle_edges[shared >= 2]

        volume_edges = tetrahedron_edges(mesh.tetrahedra)
        self._stages = []
        for level, edges in ((3, curve_edges), (2, triangle_edges), (1, volume_edges)):
            weights = inverse_lengths(nodes, edges)
            extend = extension(n, edges, weights, count >= level, 1e-6 * weights.mean())
            self._stages.append((level, extend))
        self._quality = float(mean_ratio(nodes, mesh.tetrahedra).min())

    def move(self, features: Mapping[str, Feature], guess: np.ndarray) -> np.ndarray:
        """Return the nodes [m] (n, 3) on the features of another design.

        Args:
            features: features of the new design, under the same names.
            guess: rough displacements of the nodes [m], shape (n, 3); may be zero.
        """
        rest = self.mesh.nodes
        displacement = guess.copy()
        for level, extend in self._stages:
            for chosen, ids in self._groups.items():
                if min(len(chosen), 3) == level:
                    displacement[ids] = self._project(rest[ids] + displacement[ids], features, chosen) - rest[ids]
            displacement = extend(displacement, guess)
        return rest + displacement

    def quality(self, nodes: np.ndarray) -> float:
        """Smallest element quality of moved nodes relative to that of the baseline mesh; negative if inverted."""
        return float(mean_ratio(nodes, self.mesh.tetrahedra).min()) / self._quality

    @staticmethod
    def _project(x: np.ndarray, features: Mapping[str, Feature], chosen: tuple[str, ...]) -> np.ndarray:
        """Nearest points on the intersection of the chosen features, by Gauss-Newton with least-norm steps."""
        flat = all(isinstance(features[name], Plane) for name in chosen)
        for _ in range(20):
            parts = [features[name].evaluate(x) for name in chosen]
            distance = np.stack([part[0] for part in parts], axis=1)
            if flat:  # planes: one matrix for all points, and one step is exact
                return x - distance @ np.linalg.pinv(np.stack([part[1][0] for part in parts]), rcond=1e-6).T
            gradient = np.stack([part[1] for part in parts], axis=1)
            step = np.einsum("kij,kj->ki", np.linalg.pinv(gradient, rcond=1e-6), distance)
            x = x - step
            if np.abs(step).max() < 1e-12:
                break
        return x
