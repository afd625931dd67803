"""Meshes from files: tetrahedra are read as they are, closed surfaces are filled with tetrahedra."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.errors import DataError, unknown_name
from softgym_envs.mechanics.volume_meshing import fill_surface

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
"""Metres in each unit of length."""


@dataclass(frozen=True)
class VolumeMesh:
    """A tetrahedral mesh.

    Attributes:
        nodes: positions [m], shape (n, 3).
        tetrahedra: corner indices, shape (m, 4).
        regions: elements of each named region of the file, for example of a physical group of gmsh.
    """

    nodes: np.ndarray
    tetrahedra: np.ndarray
    regions: dict[str, np.ndarray] = field(default_factory=dict)


def unit_factor(scale: float | None, unit: str | None) -> float:
    """Return the factor from a file's unit to metres, given as a number or as a name of `UNITS`; default 1."""
    if scale is not None and unit is not None:
        raise ValueError(f"pass either scale or unit, got scale = {scale:g} and unit = '{unit}'")
    if unit is not None and unit not in UNITS:
        raise ValueError(unknown_name("unit", unit, UNITS))
    if scale is not None and not (np.isfinite(scale) and scale > 0.0):
        raise ValueError(f"scale = {scale} must be positive and finite")
    return UNITS[unit] if unit is not None else scale if scale is not None else 1.0


def read_mesh(
    path: str | Path,
    *,
    scale: float | None = None,
    unit: str | None = None,
    mesh_size: float | None = None,
    time_limit: float = 60.0,
) -> VolumeMesh:
    """Read a tetrahedral mesh from any file meshio reads.

    A file without tetrahedra but with triangles, such as an STL, is taken as a closed surface and filled with
    tetrahedra by gmsh. Closed surfaces inside it become cavities.

    Args:
        path: mesh file.
        scale: factor to metres, 1e-3 for a file in millimetres.
        unit: unit of the file instead of ``scale``: ``"m"``, ``"cm"``, ``"mm"`` or ``"in"``.
        mesh_size: edge length [m] for filling a surface; default: a twentieth of its diagonal.
        time_limit: time limit for meshing [s].

    Raises:
        DataError: if the file is missing or unreadable, or holds neither tetrahedra nor a closed surface.
        MeshingError: if gmsh cannot be used, or takes too long.
    """
    factor = unit_factor(scale, unit)
    path = Path(path)
    mesh = _read(path)
    blocks = [(number, block.data) for number, block in enumerate(mesh.cells) if block.type == "tetra"]
    triangles = [block.data for block in mesh.cells if block.type == "triangle"]
    if not blocks and not triangles:
        found = ", ".join(sorted({block.type for block in mesh.cells})) or "no cells"
        raise DataError(f"mesh file '{path}' holds no tetrahedra and no triangles; found: {found}")
    points = np.asarray(mesh.points, dtype=float)[:, :3] * factor
    if not blocks:
        surface = _checked(path, "triangles", np.concatenate(triangles), len(points))
        nodes, tetrahedra = fill_surface(points, surface, mesh_size=mesh_size, time_limit=time_limit, source=str(path))
        return VolumeMesh(nodes, tetrahedra)
    tetrahedra = _checked(path, "tetrahedra", np.concatenate([data for _, data in blocks]), len(points))
    used, renumbered = np.unique(tetrahedra, return_inverse=True)
    return VolumeMesh(points[used], renumbered.reshape(tetrahedra.shape), _regions(mesh, [n for n, _ in blocks]))


def _checked(path: Path, name: str, cells: np.ndarray, count: int) -> np.ndarray:
    if cells.size and not 0 <= cells.min() <= cells.max() < count:
        raise DataError(
            f"mesh file '{path}': {name} refer to nodes {cells.min()}..{cells.max()}, but it has {count} nodes"
        )
    return cells


def _read(path: Path) -> Any:
    """Read a file with meshio."""
    import meshio

    if not path.is_file():
        raise DataError(f"mesh file '{path}' does not exist")
    file_format = None
    if path.suffix.lower() == ".msh":
        # Two programs use this suffix. meshio tries Ansys first and hangs on a truncated section.
        content = path.read_bytes()
        file_format = "gmsh" if content.lstrip().startswith(b"$") else "ansys"
        if file_format == "ansys" and not content.rstrip().endswith(b")"):
            raise DataError(f"mesh file '{path}' is neither a Gmsh mesh nor a complete Ansys mesh")
    try:
        with np.errstate(over="ignore"):  # meshio reads part of a text STL as the number of triangles
            return meshio.read(path, file_format=file_format)
    except (Exception, SystemExit) as error:  # meshio raises SystemExit on some malformed files
        raise DataError(f"mesh file '{path}' cannot be read: {error}") from error


def _regions(mesh: Any, blocks: list[int]) -> dict[str, np.ndarray]:
    """Elements of the named regions, counted over the blocks of tetrahedra."""
    regions: dict[str, np.ndarray] = {}
    sizes = [len(mesh.cells[number].data) for number in blocks]
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    for name, parts in mesh.cell_sets.items():
        members = [
            starts[k] + np.asarray(parts[number], dtype=np.int64)
            for k, number in enumerate(blocks)
            if parts[number] is not None and len(parts[number])
        ]
        if members and not name.startswith("gmsh:"):
            regions[name] = np.concatenate(members)
    names = {int(tag): name for name, (tag, dimension) in mesh.field_data.items() if int(dimension) == 3}
    for key in ("gmsh:physical", "medit:ref"):
        if key in mesh.cell_data:
            tags = np.concatenate([np.asarray(mesh.cell_data[key][number]) for number in blocks])
            for tag in np.unique(tags):
                regions[names.get(int(tag), str(int(tag)))] = np.flatnonzero(tags == tag)
    return regions
