"""Meshes from files: solid cells are split into tetrahedra, closed surfaces and shapes are filled with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.arguments import explained
from softgym_envs.errors import DataError, unknown_name
from softgym_envs.mechanics.cells import cell_shape, tetrahedra_of, triangles_of
from softgym_envs.mechanics.elements.tetrahedra import boundary_triangles, orient_corners
from softgym_envs.mechanics.mesh_files import WITH_UNIT, file_format, read_file
from softgym_envs.mechanics.volume_meshing import fill_surface
from softgym_envs.quantities import finite_number

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
"""Metres in each unit of length."""

LARGEST_UNSTATED = 1.0
"""Largest body [m] of a file without a unit, taken as metres. Above, the file is probably in inches or centimetres."""

_SOLID, _FLAT = ("tetra", "hexahedron", "wedge", "pyramid", "voxel"), ("triangle", "quad", "polygon", "pixel")


@dataclass(frozen=True)
class VolumeMesh:
    """A tetrahedral mesh.

    Attributes:
        nodes: positions [m], shape (n, 3).
        tetrahedra: corner indices, shape (m, 4), or with midside nodes (m, 10) where all cells of the file have them.
        regions: elements of each named region of the file, for example of a physical group of gmsh.
        groups: nodes of each named group of cells or nodes, such as a face to clamp.
    """

    nodes: np.ndarray
    tetrahedra: np.ndarray
    regions: dict[str, np.ndarray] = field(default_factory=dict)
    groups: dict[str, np.ndarray] = field(default_factory=dict)

    def corners_only(self) -> VolumeMesh:
        """Return the mesh without midside nodes."""
        if self.tetrahedra.shape[1] == 4:
            return self
        used, renumbered = np.unique(self.tetrahedra[:, :4], return_inverse=True)
        groups = {name: np.searchsorted(used, np.intersect1d(found, used)) for name, found in self.groups.items()}
        return VolumeMesh(self.nodes[used], renumbered.reshape(-1, 4), self.regions, groups)

    def named(self, choice: Any) -> Any:
        """Return the nodes of groups, mask of shape (n,), for one or several names; anything else as it is.

        Raises:
            ValueError: for a group that the file does not have.
        """
        names = [choice] if isinstance(choice, str) else choice
        if not isinstance(names, list | tuple) or not any(isinstance(name, str) for name in names):
            return choice
        mask = np.zeros(len(self.nodes), dtype=bool)
        for name in names:
            if name not in self.groups:
                raise ValueError(unknown_name("group", name, self.groups))
            mask[self.groups[name]] = True
        return mask


def states_unit(path: str | Path) -> bool:
    """Return whether the format of a file states the unit of its lengths."""
    return file_format(Path(path)) in WITH_UNIT


def unit_factor(scale: float | None, unit: str | None) -> float:
    """Return the factor from a file's unit to metres, given as a number or as a name of `UNITS`; default 1."""
    if scale is not None and unit is not None:
        raise ValueError(f"pass either scale or unit, got scale = {scale:g} and unit = '{unit}'")
    if unit is not None and unit not in UNITS:
        raise ValueError(unknown_name("unit", unit, UNITS))
    if scale is not None and not finite_number(scale, "scale") > 0.0:
        raise ValueError(f"scale = {scale} must be positive and finite")
    return UNITS[unit] if unit is not None else scale if scale is not None else 1.0


@explained
def read_mesh(
    path: str | Path,
    *,
    scale: float | None = None,
    unit: str | None = None,
    mesh_size: float | None = None,
    time_limit: float = 60.0,
) -> VolumeMesh:
    """Read a body from a mesh, a closed surface or a shape; docs/meshes.md lists the kinds of files.

    The format is told from the content. Solid cells that are no tetrahedra are split into them; a file with triangles
    or other faces only, such as an STL, is taken as a closed surface and filled by gmsh, with closed surfaces inside it
    as cavities. STEP and IGES files are meshed by gmsh.

    Args:
        path: file.
        scale: factor to metres, 1e-3 for a file in millimetres.
        unit: unit of the file instead of ``scale``: ``"m"``, ``"cm"``, ``"mm"`` or ``"in"``. STEP and IGES files state
            their unit, which counts.
        mesh_size: edge length [m] for filling a surface or a shape; default: a twentieth of its diagonal.
        time_limit: time limit for meshing [s].

    Raises:
        DataError: if the file is missing or unreadable, holds no body, or cells that cannot be used: counted by kind.
        MeshingError: if gmsh cannot be used, or takes too long.
        ValueError: for an unknown unit, or a scale of a file that states its unit.
    """
    path = Path(path)
    mesh, factor = _read(path, scale, unit, mesh_size, time_limit)
    points = _points(path, mesh, factor)
    shapes = [cell_shape(block.type) for block in mesh.cells]
    counts = {block.type: 0 for block in mesh.cells}
    for block in mesh.cells:
        counts[block.type] += len(block.data)
    found = ", ".join(f"{count} {kind}" for kind, count in sorted(counts.items())) or "no cells"
    if "polyhedron" in shapes:
        raise DataError(f"mesh file '{path}' holds cells that are not read (found: {found}); export tetrahedra")
    solid = [number for number, shape in enumerate(shapes) if shape in _SOLID]
    for number, block in enumerate(mesh.cells):
        if shapes[number] in (*_SOLID, *_FLAT):
            _check_cells(path, block, len(points))
    if not solid:
        names = ", ".join(sorted(_names(mesh).values()))
        hint = f"; gmsh saves only cells of physical groups, and the file has '{names}'" if names else ""
        if not any(shape in _FLAT for shape in shapes):
            raise DataError(f"mesh file '{path}' holds no tetrahedra and no triangles; found: {found}{hint}")
        triangles = _faces(mesh, shapes, points)
        try:
            nodes, tetrahedra = fill_surface(
                points, triangles, mesh_size=mesh_size, time_limit=time_limit, source=str(path)
            )
        except DataError as error:
            if names:
                raise DataError(f"mesh file '{path}' holds no tetrahedra{hint}; {error}") from None
            raise
        return VolumeMesh(nodes, tetrahedra)
    quadratic = all(mesh.cells[number].type == "tetra10" for number in solid)
    if quadratic:
        cells = np.concatenate([mesh.cells[number].data for number in solid])
        source = np.arange(len(cells))
    else:
        blocks = [(str(shapes[number]), mesh.cells[number].data) for number in solid]
        points, cells, source = tetrahedra_of(points, blocks)
    in_solid = np.zeros(len(points), dtype=bool)
    for number in solid:
        in_solid[np.ravel(mesh.cells[number].data)] = True
    outside = sum(
        int((~in_solid[np.asarray(block.data)].all(axis=1)).sum())
        for block, shape in zip(mesh.cells, shapes, strict=True)
        if shape in _FLAT
    )
    if outside:
        raise DataError(
            f"mesh file '{path}' holds {outside} faces that belong to no solid cell (found: {found}): a part that is "
            "not filled, or a surface for show; fill it, or leave it out of the file"
        )
    used, renumbered = np.unique(cells, return_inverse=True)
    groups = {name: np.searchsorted(used, np.intersect1d(nodes, used)) for name, nodes in _groups(mesh).items()}
    return VolumeMesh(
        points[used],
        renumbered.reshape(cells.shape),
        _regions(mesh, solid, source),
        {name: nodes for name, nodes in groups.items() if len(nodes)},
    )


@explained
def read_surface(path: str | Path, *, time_limit: float = 60.0) -> tuple[np.ndarray, np.ndarray, bool]:
    """Read the surface in a file, or that of the solid cells in it.

    Args:
        path: file.
        time_limit: time limit for gmsh [s].

    Returns:
        Points (n, 3), triangles (t, 3), and whether the points are in metres, since the file states its unit.

    Raises:
        DataError: if the file is missing or unreadable, or holds no surface.
        MeshingError: if gmsh cannot be used, or takes too long.
    """
    path = Path(path)
    mesh, factor = _read(path, None, None, None, time_limit)
    points = _points(path, mesh, factor)
    shapes = [cell_shape(block.type) for block in mesh.cells]
    solid = [(str(shape), block.data) for block, shape in zip(mesh.cells, shapes, strict=True) if shape in _SOLID]
    if solid:
        points, cells, _ = tetrahedra_of(points, solid)
        return points, boundary_triangles(orient_corners(points, cells)[0]), states_unit(path)
    if not any(shape in _FLAT for shape in shapes):
        raise DataError(f"mesh file '{path}' holds no surface")
    return points, _faces(mesh, shapes, points), False


def _read(
    path: Path, scale: float | None, unit: str | None, mesh_size: float | None, time_limit: float
) -> tuple[Any, float]:
    """Return the mesh in a file and the factor to metres."""
    factor = unit_factor(scale, unit)
    stated = states_unit(path)
    if stated and scale is not None:
        raise ValueError(f"scale = {scale:g} must be left out for '{path}', which states its unit")
    if not finite_number(time_limit, "time_limit", "s") > 0.0:
        raise ValueError(f"time_limit = {time_limit} s must be positive")
    if mesh_size is not None and not finite_number(mesh_size, "mesh_size", "m") > 0.0:
        raise ValueError(f"mesh_size = {mesh_size} m must be positive and finite")
    if stated:
        factor = 1.0
    size = None if mesh_size is None else mesh_size / factor
    return read_file(path, mesh_size=size, time_limit=time_limit), factor


def _points(path: Path, mesh: Any, factor: float) -> np.ndarray:
    points = np.asarray(mesh.points, dtype=float)
    if points.ndim != 2 or points.shape[1] < 3:
        raise DataError(f"mesh file '{path}' has no points in space: their shape is {points.shape}")
    if len(bad := np.flatnonzero(~np.isfinite(points).all(axis=1))):
        raise DataError(f"mesh file '{path}': point {bad[0]} is not finite: {points[bad[0]].tolist()}")
    return points[:, :3] * factor


def _faces(mesh: Any, shapes: Sequence[str | None], points: np.ndarray) -> np.ndarray:
    """Return the faces of a mesh as triangles (t, 3)."""
    return np.concatenate(
        [
            triangles_of(points, str(shape), block.data)
            for block, shape in zip(mesh.cells, shapes, strict=True)
            if shape in _FLAT
        ]
    )


def _check_cells(path: Path, block: Any, count: int) -> None:
    cells = np.asarray(block.data)
    if cells.size and not 0 <= cells.min() <= cells.max() < count:
        raise DataError(
            f"mesh file '{path}': cells ({block.type}) refer to nodes {cells.min()}..{cells.max()}, but it has {count} "
            "nodes"
        )


_TAGS = ("gmsh:physical", "medit:ref")


def _names(mesh: Any) -> dict[tuple[int, int], str]:
    """Names of physical groups by tag and dimension."""
    return {(int(value[0]), int(value[1])): name for name, value in mesh.field_data.items() if np.shape(value) == (2,)}


def _dimension(kind: str) -> int:
    shape = cell_shape(kind)
    return 3 if shape in _SOLID else 2 if shape in _FLAT else 0 if kind.startswith("vertex") else 1


def _groups(mesh: Any) -> dict[str, np.ndarray]:
    """Nodes of the named groups of cells and nodes; groups without a name are called by their number."""
    found: dict[str, list[np.ndarray]] = {}
    for name, parts in mesh.cell_sets.items():
        for block, part in zip(mesh.cells, parts, strict=True):
            if part is not None and len(part) and not name.startswith("gmsh:"):
                found.setdefault(name, []).append(np.ravel(block.data[np.asarray(part, dtype=np.int64)]))
    for name, members in mesh.point_sets.items():
        found.setdefault(name, []).append(np.asarray(members, dtype=np.int64))
    names = _names(mesh)
    for key in _TAGS:
        for block, tags in zip(mesh.cells, mesh.cell_data.get(key, ()), strict=False):
            for tag in np.unique(tags):
                name = names.get((int(tag), _dimension(block.type)), str(int(tag)) if tag else "")
                if name:
                    found.setdefault(name, []).append(np.ravel(block.data[np.asarray(tags) == tag]))
    return {name: np.unique(np.concatenate(parts)) for name, parts in found.items()}


def _regions(mesh: Any, solid: list[int], source: np.ndarray) -> dict[str, np.ndarray]:
    """Elements of the named regions; ``source`` is the solid cell of each element, counted over the blocks."""
    regions: dict[str, np.ndarray] = {}
    sizes = [len(mesh.cells[number].data) for number in solid]
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    for name, parts in mesh.cell_sets.items():
        members = [
            starts[k] + np.asarray(parts[number], dtype=np.int64)
            for k, number in enumerate(solid)
            if parts[number] is not None and len(parts[number])
        ]
        if members and not name.startswith("gmsh:"):
            regions[name] = np.flatnonzero(np.isin(source, np.concatenate(members)))
    names = _names(mesh)
    for key in _TAGS:
        if key in mesh.cell_data:
            tags = np.concatenate([np.asarray(mesh.cell_data[key][number]) for number in solid])
            for tag in np.unique(tags):
                regions[names.get((int(tag), 3), str(int(tag)))] = np.flatnonzero(
                    np.isin(source, np.flatnonzero(tags == tag))
                )
    return regions
