"""The process in which gmsh fills closed shells with tetrahedra: ``python -m ... request.npz output.npz``.

Besides NumPy and gmsh it imports next to nothing: loading SciPy and Numba would take longer than a coarse mesh.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import numpy as np

from softgym_envs.extras import explain

UNUSABLE = 3
"""Exit status when gmsh is missing or does not load."""

_SHARP_ANGLE = 40.0  # triangles that meet at a larger angle [degrees] form an edge of the shape


def set_options(gmsh: ModuleType, size: float) -> None:
    """Set options for reproducible meshes whose edges have one length, in the unit of the drawing."""
    for option, value in (
        ("General.Terminal", 0),
        ("General.NumThreads", 1),
        ("Mesh.RandomSeed", 1),
        ("Mesh.MeshSizeExtendFromBoundary", 0),
        ("Mesh.MeshSizeFromPoints", 0),
        ("Mesh.MeshSizeFromCurvature", 0),
        ("Mesh.OptimizeNetgen", 1),
        ("Mesh.MeshSizeMax", size),
        ("Mesh.MeshSizeMin", size),
    ):
        gmsh.option.setNumber(option, value)


def _fill_shells(request: Path, output: Path) -> None:
    """Mesh the volume between the shells of a request, see `fill_surface`."""
    import gmsh

    with np.load(request) as data:
        points, triangles, shells, parts = (data[name] for name in ("points", "triangles", "shells", "parts"))
        size = float(data["mesh_size"])
    gmsh.initialize()
    try:
        set_options(gmsh, size)
        gmsh.model.add("body")
        for shell in range(len(parts)):
            corners, renumbered = np.unique(triangles[shells == shell], return_inverse=True)
            entity = gmsh.model.addDiscreteEntity(2)
            gmsh.model.mesh.addNodes(2, entity, (corners + 1).tolist(), points[corners].ravel().tolist())
            gmsh.model.mesh.addElementsByType(entity, 2, [], (corners[renumbered.ravel()] + 1).tolist())
        gmsh.model.mesh.classifySurfaces(np.radians(_SHARP_ANGLE), True, True, np.pi)
        shell_of_point = np.empty(len(points), dtype=np.int64)
        shell_of_point[triangles.ravel()] = np.repeat(shells, 3)
        surfaces: list[list[int]] = [[] for _ in parts]
        for _, surface in gmsh.model.getEntities(2):
            nodes = gmsh.model.mesh.getElementsByType(2, surface)[1]
            surfaces[shell_of_point[int(nodes[0]) - 1]].append(surface)
        gmsh.model.mesh.createGeometry()
        loops = [gmsh.model.geo.addSurfaceLoop(found) for found in surfaces]
        for outer in np.flatnonzero(parts == np.arange(len(parts))):
            holes = [loops[k] for k in np.flatnonzero(parts == outer) if k != outer]
            gmsh.model.geo.addVolume([loops[outer], *holes])
        gmsh.model.geo.synchronize()
        gmsh.model.mesh.generate(3)
        tags, coordinates, _ = gmsh.model.mesh.getNodes()
        number = np.zeros(int(tags.max()) + 1, dtype=np.int64)
        number[tags] = np.arange(len(tags))
        tetrahedra = number[gmsh.model.mesh.getElementsByType(4)[1].reshape(-1, 4)]
    finally:
        gmsh.finalize()
    if len(tetrahedra) == 0:
        raise ValueError("gmsh made no tetrahedra")
    used, renumbered = np.unique(tetrahedra, return_inverse=True)
    np.savez(output, nodes=coordinates.reshape(-1, 3)[used], tetrahedra=renumbered.reshape(tetrahedra.shape))


if __name__ == "__main__":
    try:
        _fill_shells(Path(sys.argv[1]), Path(sys.argv[2]))
    except (ImportError, OSError) as problem:  # OSError: a system library that gmsh needs is missing
        print(explain(problem) or problem, file=sys.stderr)
        sys.exit(UNUSABLE)
