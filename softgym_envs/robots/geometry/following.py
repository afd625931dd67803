"""A mesh that follows the faces of a drawing from one design to another.

`softgym_envs.robots.geometry.morphing` moves meshes whose surfaces are known as formulas. Here they are known to gmsh
only: the reference and the new design are drawn, and if both have the same faces, edges and corners, nodes at corners
and on edges keep their place along them, and those on faces keep their place between the edges. gmsh works in a process
that is kept between designs, since starting one takes a hundred times as long as a drawing.
"""

from __future__ import annotations

import os
import pickle
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from softgym_envs.errors import InfeasibleDesign
from softgym_envs.robots.geometry.meshing import BodyMesh
from softgym_envs.robots.geometry.morphing import extension, inverse_lengths, mean_ratio, tetrahedron_edges

Drawing = tuple[Callable[..., None], dict[str, Any]]

TIME_LIMIT = 60.0
"""Wall-clock limit of one drawing [s]."""

IDLE = 300.0
"""Time after which the unused process of gmsh ends [s]."""

ON = 1e-7
"""Distance from a corner or an edge at which a node lies on it, relative to the size of the body."""

_processes: dict[int, Any] = {}


class ShapeFollower:
    """Moves one mesh over the designs that have the same faces.

    Args:
        mesh: mesh of the reference drawing.
        reference: this drawing.
    """

    def __init__(self, mesh: BodyMesh, reference: Drawing) -> None:
        self.mesh = mesh
        self._reference = reference
        edges = tetrahedron_edges(mesh.tetrahedra)
        self._surface = np.unique(mesh.triangles)
        known = np.zeros(len(mesh.nodes), dtype=bool)
        known[self._surface] = True
        weights = inverse_lengths(mesh.nodes, edges)
        self._extend = extension(len(mesh.nodes), edges, weights, known, 1e-6 * weights.mean())
        self._quality = float(mean_ratio(mesh.nodes, mesh.tetrahedra).min())

    def move(self, drawing: Drawing) -> np.ndarray | None:
        """Return the nodes [m] (n, 3) in another drawing; None if it has other faces.

        Raises:
            InfeasibleDesign: if gmsh cannot draw the shape, or takes too long.
        """
        mesh = self.mesh
        # The same numbers in both drawings need not be drawn to be followed.
        moved = _in_gmsh(_surface_nodes, self._reference, drawing, mesh.nodes, mesh.triangles, mesh.surfaces)
        if moved is None:
            return None
        known = self._surface
        guess = _affine(mesh.nodes[known], moved[known] - mesh.nodes[known], mesh.nodes)
        rest = np.zeros_like(mesh.nodes)
        rest[known] = moved[known] - mesh.nodes[known] - guess[known]
        return mesh.nodes + guess + self._extend(rest, np.zeros_like(rest))

    def quality(self, nodes: np.ndarray) -> float:
        """Smallest element quality of moved nodes relative to that of the reference mesh; negative if inverted."""
        return float(mean_ratio(nodes, self.mesh.tetrahedra).min()) / self._quality


def _affine(places: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the affine function of places (k, 3) nearest to values (k, 3), at the wanted places (n, 3)."""
    middle = places.mean(axis=0)
    rows = np.column_stack([places - middle, np.ones(len(places))])
    return np.column_stack([wanted - middle, np.ones(len(wanted))]) @ np.linalg.lstsq(rows, values, rcond=1e-9)[0]


def _in_gmsh(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function in the process of gmsh.

    Raises:
        InfeasibleDesign: if gmsh fails, crashes or takes too long.
    """
    from joblib.externals.loky import ProcessPoolExecutor, TimeoutError
    from joblib.externals.loky.backend.reduction import dumps
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    process = _processes.get(os.getpid())  # a copy of this process has none
    if process is None:
        process = _processes[os.getpid()] = ProcessPoolExecutor(max_workers=1, timeout=IDLE)
    try:
        return process.submit(_called, sys.path, bytes(dumps((function, arguments)))).result(timeout=TIME_LIMIT)
    except TimeoutError:
        problem = f"drawing took longer than {TIME_LIMIT:g} s"
    except TerminatedWorkerError:  # OpenCASCADE crashes on some shapes
        problem = "gmsh crashed"
    _processes.pop(os.getpid()).shutdown(kill_workers=True)
    raise InfeasibleDesign(f"{problem} for {arguments[1][1]}")


# -- in the process of gmsh -------------------------------------------------------------------------------------------


def _called(path: list[str], call: bytes) -> Any:
    """Call a function of a module that may lie where the other process looks for modules only since this one began."""
    sys.path[:] = path
    function, arguments = pickle.loads(call)
    return function(*arguments)


def _surface_nodes(
    reference: Drawing, drawing: Drawing, nodes: np.ndarray, triangles: np.ndarray, surfaces: np.ndarray
) -> np.ndarray | None:
    """Return the nodes [m] (n, 3) with those on the surface moved from one drawing to another; None if faces differ."""
    import gmsh

    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        scale = _draw(gmsh, reference)
        faces, survey = _faces(gmsh), _Survey(gmsh, scale, nodes, triangles, surfaces)
        _draw(gmsh, drawing)
        return survey.follow(gmsh) if _faces(gmsh) == faces else None
    except Exception as problem:
        if type(problem) is Exception:  # gmsh raises plain Exceptions
            raise InfeasibleDesign(f"the geometry cannot be drawn for {drawing[1]}: {problem}") from None
        raise
    finally:
        gmsh.finalize()


def _draw(gmsh: Any, drawing: Drawing) -> float:
    """Draw in a new model, and return metres per unit of the drawing."""
    function, parameters = drawing
    gmsh.clear()
    gmsh.model.add("body")
    function(**parameters)
    gmsh.model.occ.synchronize()
    return 1.0 if gmsh.option.getString("Geometry.OCCTargetUnit") == "M" else 1e-3


def _faces(gmsh: Any) -> list[tuple[Any, ...]]:
    """Return what two drawings must share: entities with their kinds and what bounds them."""
    found: list[tuple[Any, ...]] = []
    for dimension, tag in gmsh.model.getEntities():
        below = gmsh.model.getAdjacencies(dimension, tag)[1]
        found.append((dimension, tag, gmsh.model.getType(dimension, tag), tuple(sorted(below.tolist()))))
    return found


class _Survey:
    """Where the surface nodes of a mesh lie in the drawing that gmsh has now.

    Args:
        gmsh: the module.
        scale: metres per unit of the drawing.
        nodes: [m], shape (n, 3).
        triangles: on the surface, shape (t, 3).
        surfaces: of each triangle, shape (t,).
    """

    def __init__(self, gmsh: Any, scale: float, nodes: np.ndarray, triangles: np.ndarray, surfaces: np.ndarray) -> None:
        self.nodes, self.triangles, self.surfaces, self.scale = nodes, triangles, surfaces, scale
        slack = ON * float(np.ptp(nodes, axis=0).max())
        self.on_face = {int(face): np.unique(triangles[surfaces == face]) for face in np.unique(surfaces)}
        used = np.unique(triangles)
        self.corners: dict[int, int] = {}
        for _, corner in gmsh.model.getEntities(0):
            distance = np.linalg.norm(nodes[used] - scale * np.array(gmsh.model.getValue(0, corner, [])), axis=1)
            if distance.min() < slack:
                self.corners[corner] = int(used[distance.argmin()])
        taken = set(self.corners.values())
        self.edges: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        for _, edge in gmsh.model.getEntities(1):
            around = [self.on_face.get(int(face), used[:0]) for face in gmsh.model.getAdjacencies(1, edge)[0]]
            near = np.array([n for n in _common(around) if n not in taken], dtype=np.int64)
            if not len(near):
                continue
            places = np.array(gmsh.model.getParametrization(1, edge, (nodes[near] / scale).ravel().tolist()))
            (low,), (high,) = gmsh.model.getParametrizationBounds(1, edge)
            back = scale * np.array(gmsh.model.getValue(1, edge, places.tolist())).reshape(-1, 3)
            on = (np.linalg.norm(back - nodes[near], axis=1) < slack) & (places >= low) & (places <= high)
            if on.any():
                self.edges[edge] = near[on], (places[on] - low) / (high - low)
                taken |= set(near[on].tolist())

    def follow(self, gmsh: Any) -> np.ndarray:
        """Return the nodes [m] (n, 3) with those on the surface moved to the drawing that gmsh has now."""
        moved, scale = self.nodes.copy(), self.scale
        known = np.zeros(len(moved), dtype=bool)
        for corner, node in self.corners.items():
            moved[node], known[node] = scale * np.array(gmsh.model.getValue(0, corner, [])), True
        for edge, (ids, shares) in self.edges.items():
            (low,), (high,) = gmsh.model.getParametrizationBounds(1, edge)
            places = low + shares * (high - low)
            moved[ids] = scale * np.array(gmsh.model.getValue(1, edge, places.tolist())).reshape(-1, 3)
            known[ids] = True
        for face, ids in self.on_face.items():
            self._fill(gmsh, face, ids, moved, known)
        return moved

    def _fill(self, gmsh: Any, face: int, ids: np.ndarray, moved: np.ndarray, known: np.ndarray) -> None:
        """Move the nodes of a face whose edges were moved."""
        held = known[ids]
        if held.all():
            return
        if not held.any():
            raise ValueError(f"face {face} of the drawing has no edge that its mesh could follow")
        triangles = np.searchsorted(ids, self.triangles[self.surfaces == face])
        edges = np.unique(np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
        rest = self.nodes[ids]
        motion = moved[ids] - rest
        guess = _affine(rest[held], motion[held], rest)
        weights = inverse_lengths(rest, edges)
        extend = extension(len(ids), edges, weights, held, 1e-6 * weights.mean())
        inner = np.where(held[:, None], motion - guess, 0.0)
        places = rest + guess + extend(inner, np.zeros_like(inner))
        if gmsh.model.getType(2, face) != "Plane":
            free = np.flatnonzero(~held)
            near, _ = gmsh.model.getClosestPoint(2, face, (places[free] / self.scale).ravel().tolist())
            places[free] = self.scale * np.array(near).reshape(-1, 3)
        moved[ids[~held]] = places[~held]
        known[ids] = True


def _common(groups: list[np.ndarray]) -> np.ndarray:
    """Return what all groups of nodes share."""
    common = groups[0] if groups else np.empty(0, dtype=np.int64)
    for other in groups[1:]:
        common = np.intersect1d(common, other)
    return common
