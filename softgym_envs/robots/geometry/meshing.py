"""Meshes from gmsh, with a cache and a time limit.

A geometry is a function ``build(**parameters)`` that draws one volume in the current gmsh model in millimetres, or in
metres after it has set gmsh's option ``Geometry.OCCTargetUnit`` to ``M``. It runs in a separate process, because
OpenCASCADE may hang on an infeasible shape. Nodes are returned in metres. SciPy and
the mechanics are imported only where they are used, as loading them takes longer than a coarse mesh in that process.
"""

from __future__ import annotations

import ast
import hashlib
import inspect
import json
import pickle
import sys
import tempfile
import textwrap
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.errors import DataError, InfeasibleDesign, MeshingError, unknown_name
from softgym_envs.extras import explain
from softgym_envs.storage import atomic_write, cache_directory, read_npz

_FORMAT = 2
# Exit statuses of the meshing process: gmsh is missing or does not load; gmsh rejects the shape; the drawing has a bug.
_NO_GMSH, _NO_SHAPE, _BUG = 3, 4, 5
_SHIPPED = Path(__file__).parents[1] / "meshes"


@dataclass(frozen=True)
class BodyMesh:
    """A tetrahedral mesh with its classified surface.

    Attributes:
        nodes: positions [m], shape (n, 3).
        tetrahedra: corner indices, shape (m, 4).
        triangles: boundary triangles, shape (k, 3).
        surfaces: geometric surface of each boundary triangle, shape (k,).
        origin: how the mesh was made: ``"meshed"``, ``"morphed"`` from another one or ``"remeshed"`` in its place.
        groups: surfaces of each physical group of the drawing, by its name.
    """

    nodes: np.ndarray
    tetrahedra: np.ndarray
    triangles: np.ndarray
    surfaces: np.ndarray
    origin: str = "meshed"
    groups: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    def nodes_on(self, group: str) -> np.ndarray:
        """Return the mask (n,) of the nodes on the surfaces of a group.

        Raises:
            ValueError: for a group that the drawing does not have.
        """
        mask = np.zeros(len(self.nodes), dtype=bool)
        mask[self.triangles[np.isin(self.surfaces, self._surfaces_of(group))]] = True
        return mask

    def faces_of(self, group: str) -> np.ndarray:
        """Return the triangles (k, 3) on the surfaces of a group, seen counter-clockwise from outside the material.

        Raises:
            ValueError: for a group that the drawing does not have.
        """
        chosen = np.sort(self.triangles[np.isin(self.surfaces, self._surfaces_of(group))], axis=1)
        surface, count = self.surface(), len(self.nodes)
        key = np.array([count * count, count, 1])
        return surface[np.isin(np.sort(surface, axis=1) @ key, chosen @ key)]

    def _surfaces_of(self, group: str) -> tuple[int, ...]:
        if group not in self.groups:
            raise ValueError(unknown_name("group of faces", group, self.groups))
        return self.groups[group]

    def surface(self) -> np.ndarray:
        """Return the boundary triangles (k, 3), seen counter-clockwise from outside the material."""
        from softgym_envs.mechanics.elements.tetrahedra import boundary_triangles, orient_corners

        return boundary_triangles(orient_corners(self.nodes, self.tetrahedra)[0])

    def cavities(
        self, along: Sequence[float] = (0.0, 0.0, -1.0), across: Sequence[float] = (1.0, 0.0, 0.0)
    ) -> list[np.ndarray]:
        """Return the closed cavities: the connected pieces of the boundary except the outer hull.

        Args:
            along: direction in which the cavities are ordered by their middle, shape (3,).
            across: second direction, for middles that agree within a hundredth of the body's size, shape (3,).

        Returns:
            Triangles (k, 3) of each cavity, seen counter-clockwise from inside it.
        """
        from softgym_envs.mechanics.elements.tetrahedra import orient_corners
        from softgym_envs.mechanics.surfaces import inner_surfaces

        hollow = inner_surfaces(self.nodes, orient_corners(self.nodes, self.tetrahedra)[0])
        middle = np.array([self.nodes[np.unique(part)].mean(axis=0) for part in hollow]).reshape(-1, 3)
        grid = 1e-2 * np.ptp(self.nodes, axis=0).max()
        order = np.lexsort([middle @ np.asarray(across), np.round(middle @ np.asarray(along) / grid)])
        return [hollow[k] for k in order]

    def save(self, path: Path) -> None:
        """Write to an npz file, atomically."""
        with atomic_write(path) as stream:
            np.savez_compressed(
                stream,
                format=_FORMAT,
                nodes=self.nodes,
                tetrahedra=self.tetrahedra.astype(np.int32),
                triangles=self.triangles.astype(np.int32),
                surfaces=self.surfaces.astype(np.int32),
                group_names=np.array([name for name, tags in self.groups.items() for _ in tags], dtype=str),
                group_surfaces=np.array([tag for tags in self.groups.values() for tag in tags], dtype=np.int32),
            )

    @classmethod
    def load(cls, path: Path) -> BodyMesh:
        """Read an npz file.

        Raises:
            DataError: if the file is missing, truncated or of another format.
        """
        arrays = ("format", "nodes", "tetrahedra", "triangles", "surfaces")
        data = read_npz(path, arrays, ("group_names", "group_surfaces"))
        if int(data["format"]) != _FORMAT:
            raise DataError(f"mesh '{path}' has format {int(data['format'])}, expected {_FORMAT}")
        groups: dict[str, tuple[int, ...]] = {}
        for name, tag in zip(data.get("group_names", ()), data.get("group_surfaces", ()), strict=True):
            groups[str(name)] = (*groups.get(str(name), ()), int(tag))
        return cls(
            nodes=data["nodes"],
            tetrahedra=data["tetrahedra"].astype(np.int64),
            triangles=data["triangles"].astype(np.int64),
            surfaces=data["surfaces"].astype(np.int64),
            groups=groups,
        )


def mesh_geometry(
    build: Callable[..., None],
    parameters: Mapping[str, Any],
    *,
    mesh_size: float,
    uses: Sequence[Callable[..., object]] = (),
    key: Mapping[str, Any] | None = None,
    time_limit: float = 60.0,
) -> BodyMesh:
    """Return the mesh of a geometry, from the cache if it is stored there.

    Args:
        build: function that draws one volume with ``gmsh.model.occ``; see this module for its unit.
        parameters: its keyword arguments: numbers, unless there is a ``key``.
        mesh_size: target edge length [m].
        uses: other functions that the drawing calls; editing them makes a new mesh, as editing the drawing does.
        key: what the mesh follows from besides its size, as JSON data, instead of the function and its parameters. An
            empty one: the mesh is not kept.
        time_limit: limit of the CPU time of the meshing process [s], so that no body fails on a busy machine.

    Raises:
        InfeasibleDesign: if gmsh cannot draw or mesh the geometry, or takes too long.
        MeshingError: if gmsh cannot be imported, or the drawing function fails.
    """
    if key is None:
        parameters = {name: float(value) for name, value in sorted(parameters.items())}
        name = _cache_key(build, parameters, mesh_size, uses)
    else:
        name = _hash({**key, "mesh_size": float(mesh_size), "format": _FORMAT}) if key else ""
    request = {"build": build, "parameters": parameters, "mesh_size": float(mesh_size)}
    for folder in (_SHIPPED, cache_directory("meshes")) if name else ():
        path = folder / f"{name}.npz"
        if path.exists():
            try:
                return BodyMesh.load(path)
            except DataError:
                if folder == _SHIPPED:
                    raise
                path.unlink(missing_ok=True)  # replace a damaged cache entry
    with tempfile.TemporaryDirectory() as scratch:
        output = Path(scratch) / "mesh.npz"
        run_gmsh({**request, "output": str(output)}, time_limit=time_limit)
        mesh = BodyMesh.load(output)
    if not name:
        return mesh
    try:
        mesh.save(path)
    except OSError as error:
        warnings.warn(f"the mesh is not cached, because '{path.parent}' cannot be written: {error}", stacklevel=2)
    return mesh


def _cache_key(
    build: Callable[..., None],
    parameters: dict[str, float],
    mesh_size: float,
    uses: Sequence[Callable[..., object]] = (),
) -> str:
    """Return the cache key of a mesh: a hash of the code and constants of its drawing functions, and its parameters."""
    code, constants = _source(build)
    parts: dict[str, Any] = {
        "code": code,
        "constants": constants,
        "parameters": parameters,
        "mesh_size": float(mesh_size),
        "format": _FORMAT,
    }
    if uses:
        parts["uses"] = [_source(function) for function in uses]
    return _hash(parts)


def _hash(parts: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:24]


def _source(build: Callable[..., object]) -> tuple[str, dict[str, float]]:
    """Return the code of a function and the numbers that its module defines.

    Comments, its docstring, white space and the path of the file do not count, because they do not change the shape.
    """
    code = ast.parse(textwrap.dedent(inspect.getsource(build)))
    function = code.body[0]
    assert isinstance(function, ast.FunctionDef)
    if ast.get_docstring(function) is not None:
        del function.body[0]
    constants = {
        name: value
        for name, value in vars(sys.modules[build.__module__]).items()
        if name.isupper() and isinstance(value, int | float) and name != "TYPE_CHECKING"
    }
    return "".join(ast.unparse(code).split()), constants


def run_gmsh(request: dict, *, time_limit: float) -> None:
    """Draw a geometry in a separate process and write it to a file.

    Args:
        request: the function ``build``, its ``parameters``, ``mesh_size`` [m] and ``output``: a path that ends with
            .npz (a `BodyMesh`), .step (the exact shape, in mm) or .stl (its surface, in mm).
        time_limit: limit of its CPU time [s].

    Raises:
        InfeasibleDesign: if gmsh cannot draw or mesh the geometry, or takes too long.
        MeshingError: if gmsh cannot be imported, or the drawing function fails.
    """
    import cloudpickle  # also takes functions of scripts and notebooks

    from softgym_envs.mechanics.gmsh_process import run_limited

    given, parameters = cloudpickle.dumps({**request, "time_limit": time_limit}), request["parameters"]
    try:
        done = run_limited("softgym_envs.robots.geometry.meshing", time_limit=time_limit, given=given)
    except TimeoutError as problem:
        raise InfeasibleDesign(f"meshing {problem} for {parameters}") from None
    if done.returncode == 0:
        return
    text = done.stderr.decode(errors="replace").strip()
    reason = text.splitlines()[-1] if text else "no message"
    if done.returncode == _NO_GMSH:
        raise MeshingError(f"gmsh cannot be used: {reason}")
    if done.returncode == _NO_SHAPE:
        raise InfeasibleDesign(f"the geometry cannot be meshed for {parameters}: {reason}")
    if done.returncode < 0:  # OpenCASCADE crashes on some shapes
        raise InfeasibleDesign(f"gmsh crashed with signal {-done.returncode} for {parameters}")
    build = request["build"]
    raise MeshingError(f"the drawing function {build.__module__}:{build.__qualname__} failed for {parameters}:\n{text}")


def _draw_here(request: dict) -> None:
    """Draw in this process, mesh if the output is a mesh, and write the output."""
    import gmsh

    from softgym_envs.mechanics.gmsh_process import set_options

    gmsh.initialize()
    try:
        size = float(request["mesh_size"])
        set_options(gmsh, size * 1e3)
        gmsh.model.add("body")
        request["build"](**request["parameters"])
        gmsh.model.occ.synchronize()
        metres = gmsh.option.getString("Geometry.OCCTargetUnit") == "M"
        if metres and gmsh.option.getNumber("Mesh.MeshSizeMax") == size * 1e3:
            gmsh.option.setNumber("Mesh.MeshSizeMin", size)
            gmsh.option.setNumber("Mesh.MeshSizeMax", size)
        volumes = gmsh.model.getEntities(3)
        if len(volumes) != 1:
            raise InfeasibleDesign(f"the geometry has {len(volumes)} volumes, expected one")
        output = Path(request["output"])
        if output.suffix != ".npz":
            if output.suffix == ".stl":
                gmsh.option.setNumber("Mesh.MeshSizeMin", 0.0)
                gmsh.option.setNumber("Mesh.MeshSizeFromCurvature", 24)  # edges per turn
                gmsh.option.setNumber("Mesh.Binary", 1)
                gmsh.option.setNumber("Mesh.SaveAll", 1)  # not only named faces
                gmsh.option.setNumber("Mesh.ScalingFactor", 1e3 if metres else 1.0)
                gmsh.model.mesh.generate(2)
                gmsh.model.mesh.setOutwardOrientation(volumes[0][1])
            gmsh.write(str(output))
            return
        gmsh.model.mesh.generate(3)
        tags, coordinates, _ = gmsh.model.mesh.getNodes()
        number = np.zeros(int(tags.max()) + 1, dtype=np.int64)
        number[tags] = np.arange(len(tags))
        tetrahedra = number[gmsh.model.mesh.getElementsByType(4)[1].reshape(-1, 4)]
        triangles, surfaces = [], []
        for _, surface in gmsh.model.getEntities(2):
            found = number[gmsh.model.mesh.getElementsByType(2, surface)[1].reshape(-1, 3)]
            triangles.append(found)
            surfaces.append(np.full(len(found), surface))
        if len(tetrahedra) == 0:
            raise InfeasibleDesign("gmsh made no tetrahedra")
        nodes = coordinates.reshape(-1, 3) * (1.0 if metres else 1e-3)
        used, renumbered = np.unique(tetrahedra, return_inverse=True)
        back = np.full(len(nodes), -1)
        back[used] = np.arange(len(used))
        BodyMesh(
            nodes=nodes[used],
            tetrahedra=renumbered.reshape(tetrahedra.shape),
            triangles=back[np.concatenate(triangles)],
            surfaces=np.concatenate(surfaces),
            groups={
                gmsh.model.getPhysicalName(2, group): tuple(gmsh.model.getEntitiesForPhysicalGroup(2, group).tolist())
                for _, group in gmsh.model.getPhysicalGroups(2)
            },
        ).save(output)
    finally:
        gmsh.finalize()


def _main() -> int:
    """Run as the meshing process; return its exit status."""
    from softgym_envs.mechanics.gmsh_process import limit_cpu_time

    try:
        request = pickle.load(sys.stdin.buffer)
        limit_cpu_time(request["time_limit"])
        _draw_here(request)
    except (ImportError, OSError) as problem:  # OSError: a system library that gmsh needs is missing
        print(explain(problem) or problem, file=sys.stderr)
        return _NO_GMSH
    except Exception as problem:
        # gmsh raises plain Exceptions; any other type comes from the drawing's code.
        if type(problem) is not Exception and not isinstance(problem, InfeasibleDesign):
            traceback.print_exc()
            return _BUG
        print(problem, file=sys.stderr)
        return _NO_SHAPE
    return 0


if __name__ == "__main__":
    sys.exit(_main())
