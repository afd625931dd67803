"""Geometry of a robot to draw: the surface of its body, its cables, and its shape in a state."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from softgym_envs.backends.backend import State
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.designs import Design
from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.constraints.cable import Cable
from softgym_envs.mechanics.constraints.cavity import Cavity
from softgym_envs.mechanics.elements.tetrahedra import boundary_triangles
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.base import Robot


class BodySurface:
    """Surface of a body, split along its sharp edges so that the rest can be shaded smoothly.

    It consists of the boundary of the solids and the skins of beams and rigid parts. `shape` numbers its points.

    Args:
        model: the body.
        feature_angle: an edge is sharp if the normals of its two faces at rest differ by more [rad].

    Attributes:
        nodes: point of each surface vertex, shape (v,); a point on a sharp edge has several vertices.
        triangles: corner vertices, shape (t, 3).
        edges: point pairs of the sharp edges, shape (s, 2).
        clamped: mask of the triangles whose points are all fixed, shape (t,).
        rigid: mask of the triangles of rigid objects, shape (t,).
    """

    def __init__(self, model: MechanicalModel, feature_angle: float = np.pi / 6) -> None:
        self._skins = [skin.points for skin in model.skins]
        rest = self.shape(model.nodes)
        parts, held = [np.empty((0, 3), dtype=np.int64)], [model.fixed]
        if model.solids:
            parts.append(boundary_triangles(np.concatenate([block.corners for block in model.solids])))
        start = len(model.nodes)
        for skin in model.skins:
            parts.append(skin.triangles + start)
            held.append(model.fixed[skin.points.node_ids[:, ::4]].all(axis=1))  # the origins of its frames
            start += len(skin.points.node_ids)
        corners = np.concatenate(parts)
        self.clamped = np.concatenate(held)[corners].all(axis=1)
        solid = len(corners) - sum(len(skin.triangles) for skin in model.skins)
        flags = [np.full(len(skin.triangles), skin.rigid) for skin in model.skins]
        self.rigid = np.concatenate([np.zeros(solid, dtype=bool), *flags])

        # Sort the half edges (t, 3) by their node pair, which makes the two faces of an edge neighbours.
        tails, heads = corners, np.roll(corners, -1, axis=1)
        key = (np.minimum(tails, heads) * len(rest) + np.maximum(tails, heads)).ravel()
        order = np.argsort(key, kind="stable")
        pairs = np.flatnonzero(key[order][1:] == key[order][:-1])
        one, other = order[pairs], order[pairs + 1]
        normals = _face_normals(rest, corners)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        smooth = np.einsum("ij,ij->i", normals[one // 3], normals[other // 3]) > np.cos(feature_angle)
        self.edges = np.column_stack([tails.ravel(), heads.ravel()])[one[~smooth]]

        # Corners of triangles become one vertex if they share a node across a smooth edge. The neighbour traverses the
        # edge in the opposite direction, so that the tail of one half edge is the head of the other.
        a, b = one[smooth], other[smooth]
        after = np.roll(np.arange(3 * len(corners)).reshape(-1, 3), -1, axis=1).ravel()
        rows, columns = np.concatenate([a, after[a]]), np.concatenate([after[b], b])
        graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(corners.size, corners.size))
        _, vertex = connected_components(graph, directed=False)
        self.triangles = vertex.reshape(-1, 3)
        self.nodes = np.empty(vertex.max(initial=-1) + 1, dtype=np.int64)
        self.nodes[vertex] = corners.ravel()

    def shape(self, x: np.ndarray) -> np.ndarray:
        """Return all points [m] (p, 3) at rows ``x`` [m] (n, 3): the rows, then the points of the skins."""
        return np.vstack([x, *(points.positions(x) for points in self._skins)])

    def points(self, x: np.ndarray) -> np.ndarray:
        """Return the vertices [m] (v, 3) at rows ``x`` [m] (n, 3)."""
        return self.shape(x)[self.nodes]

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Return unit normals (v, 3) at vertices [m] (v, 3): area-weighted means of the adjacent faces."""
        faces = np.repeat(_face_normals(points, self.triangles), 3, axis=0)
        corners = self.triangles.ravel()
        total = np.column_stack([np.bincount(corners, faces[:, d], minlength=len(points)) for d in range(3)])
        return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)


def surface_kinds(surface: BodySurface) -> np.ndarray:
    """Return the kind of each triangle, shape (t,): 0 for the body, 1 for its clamped part, 2 for a rigid object."""
    return np.where(surface.rigid, 2, surface.clamped.astype(int))


def _face_normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    corners = points[triangles]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def cable_lines(
    model: MechanicalModel, x: np.ndarray, state: State, *, stub: float, side: Sequence[float] = (0.0, 1.0, 0.0)
) -> dict[int, np.ndarray]:
    """Return the visible line of each cable in a state: a polyline [m] (p, 3) from the pulled end to the anchor.

    Args:
        model: the body.
        x: node positions [m], shape (n, 3).
        state: the state.
        stub: length of an unpulled cable outside the body [m]; it grows as the cable is pulled.
        side: direction of the waves of a slack cable, shape (3,).

    Returns:
        Polylines by actuator row; actuators other than cables are left out.
    """
    lines, row = {}, 0
    pulled = commanded_displacement(state)
    for constraint in model.constraints["a"]:
        if hasattr(constraint, "path"):
            path = constraint.path(x)
            outwards = (path[0] - path[1]) / np.linalg.norm(path[0] - path[1])
            end = path[0] + (stub + pulled[row]) * outwards
            lines[row] = np.vstack([end, slacken(path, state.displacement[row] - pulled[row], side)])
        row += constraint.size
    return lines


def cable_radius(model: MechanicalModel, largest: float) -> float:
    """Return the radius of a body's cables in pictures [m]: at most ``largest`` and an eighth of their distance."""
    paths = [constraint.path(model.nodes) for constraint in model.constraints["a"] if isinstance(constraint, Cable)]
    gaps = [cdist(one, other).min() for one, other in itertools.combinations(paths, 2)]
    return min([largest, *(0.125 * gap for gap in gaps if gap > 0.0)])


def chamber_skins(model: MechanicalModel, x: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the walls of cavities, actuators and sensors, by name: points [m] (p, 3) and triangles (t, 3)."""
    skins = {}
    for role in ("a", "s"):
        for constraint in model.constraints.get(role, ()):
            if isinstance(constraint, Cavity):
                nodes, triangles = np.unique(constraint.flat_triangles, return_inverse=True)
                skins[constraint.name] = x[nodes], triangles.reshape(-1, 3)
    return skins


def commanded_displacement(state: State) -> np.ndarray:
    """Return the displacement of the actuator drives, shape (n_a,), for commands in displacement or effort.

    It equals the displacement of the state except for a slack cable, whose path shortens further than it is pulled.
    """
    return np.where(state.slack, state.command, state.displacement)  # efforts leave no actuator slack


def slacken(path: np.ndarray, excess: float, side: Sequence[float], count: int = 12) -> np.ndarray:
    """Return the path of a cable with waves that show its slack; a taut cable is returned unchanged.

    Each segment of length L takes its share e of the excess as a sine of one period. To second order the sine lengthens
    it by ``(pi a)^2 / L``, hence the amplitude ``a = sqrt(e L) / pi``.

    Args:
        path: polyline [m], shape (p, 3).
        excess: length of the cable minus length of the path [m].
        side: direction of the waves, shape (3,).
        count: points per segment.

    Returns:
        Polyline [m], shape ((p - 1) * count + 1, 3) if slack.
    """
    if excess <= 0.0:
        return path
    segments = np.diff(path, axis=0)
    lengths = np.linalg.norm(segments, axis=1)
    tangents = segments / lengths[:, None]
    across = np.asarray(side) - tangents * (tangents @ np.asarray(side))[:, None]
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    # The formula fails beyond a quarter of the segment.
    amplitude = np.minimum(lengths * np.sqrt(excess / lengths.sum()) / np.pi, 0.25 * lengths)
    s = np.arange(count) / count
    waves = np.sin(2.0 * np.pi * s)[None, :, None] * (amplitude[:, None] * across)[:, None, :]
    line = path[:-1, None] + s[None, :, None] * segments[:, None] + waves
    return np.vstack([line.reshape(-1, 3), path[-1:]])


class ShapeFinder:
    """Returns the nodes of a state: its own nodes, or those of a finite-element model if the backend computes none.

    Args:
        robot: the family of bodies.
        source: finite elements whose model serves for their present design, instead of a new one. They are not moved.
    """

    def __init__(self, robot: Robot, source: FEMBackend | None = None) -> None:
        self.robot = robot
        self._source = source
        self._backend: FEMBackend | None = None
        self._target: np.ndarray | None = None

    def load(self, design: Mapping[str, float] | None = None) -> MechanicalModel:
        """Return the mechanical model of a design, which is rebuilt only if the design has changed.

        Raises:
            DesignError: for a malformed design.
            InfeasibleDesign: if its geometry cannot exist.
            ConvergenceError: if it has no equilibrium at rest.
        """
        complete = self.robot.design_space.complete(design)
        if self._source is not None and complete == self._source.design:
            return self._source.model
        return self._own(complete).model

    def rest(self, design: Mapping[str, float] | None = None) -> State:
        """Return the state of a design at rest, with its nodes."""
        complete = self.robot.design_space.complete(design)
        if self._source is not None and complete == self._source.design:
            return self._source.rest
        return self._own(complete).rest

    @property
    def state(self) -> State:
        """State of the finite-element model after the last call of `at`."""
        return self._loaded_backend.state

    def nodes(self, design: Mapping[str, float], state: State) -> np.ndarray:
        """Return the nodes [m] (n, 3) of a state of a design."""
        if state.nodes is not None:
            return state.nodes
        return self.at(design, commanded_displacement(state))

    def at(self, design: Mapping[str, float] | None, displacement: np.ndarray | None = None) -> np.ndarray:
        """Return the nodes [m] (n, 3) of a design at actuator displacements (n_a,), by default at rest.

        If no equilibrium is found, the last shape is returned, because an image should not end a rollout.
        """
        self._own(self.robot.design_space.complete(design))
        self._move(displacement)
        nodes = self._loaded_backend.state.nodes
        assert nodes is not None
        return nodes

    def _own(self, design: Design) -> FEMBackend:
        """Return finite elements of a design that may be moved."""
        if self._backend is None or design != self._backend.design:
            self._backend = FEMBackend(self.robot, design)
            self._target = None
        return self._backend

    @property
    def _loaded_backend(self) -> FEMBackend:
        assert self._backend is not None, "load a design first"
        return self._backend

    def _move(self, displacement: np.ndarray | None) -> None:
        backend = self._loaded_backend
        if displacement is None:
            self._target = None
            backend.reset()
            return
        if self._target is not None and np.array_equal(displacement, self._target):
            return
        self._target = np.array(displacement, dtype=float)
        last = backend.state
        try:
            backend.step(self._target, "displacement")
            return
        except ConvergenceError:
            pass
        try:  # the step from the last shape may be too long, while the one from rest converges
            backend.reset()
            backend.step(self._target, "displacement")
        except ConvergenceError:
            backend.restore(last)
