"""Cells of mesh files: other solid cells are split into tetrahedra, other faces into triangles."""

from __future__ import annotations

import re

import numpy as np

_HEXAHEDRON = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
_WEDGE = ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5))
_PYRAMID = ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4))
_TETRAHEDRON = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))
_FACES = {"tetra": _TETRAHEDRON, "hexahedron": _HEXAHEDRON, "wedge": _WEDGE, "pyramid": _PYRAMID}
"""Faces of solid cells, by the corners that come first in cells of any order."""

_CORNERS = {"tetra": 4, "hexahedron": 8, "wedge": 6, "pyramid": 5, "triangle": 3, "quad": 4}
_LAGRANGE = {"tetrahedron": "tetra", "quadrilateral": "quad"}


def cell_shape(kind: str) -> str | None:
    """Return the shape of a kind of cells of meshio, whatever its order; None for points, lines and unknown kinds.

    ``"polygon"`` and ``"polyhedron"`` stand for all of theirs.
    """
    name = re.sub(r"^vtk_lagrange_", "", kind.lower())
    name = re.sub(r"\d+$", "", _LAGRANGE.get(name, name))
    if name.startswith("polyhedron") or name in ("penta_prism", "hexa_prism", "hexagonal_prism"):
        return "polyhedron"
    return name if name in (*_CORNERS, "voxel", "pixel", "polygon") else None


def tetrahedra_of(
    points: np.ndarray, blocks: list[tuple[str, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split solid cells into tetrahedra that meet face to face.

    A cell is split from its corner of the smallest index, with the diagonals of its quadrilaterals from theirs: cells
    that share a quadrilateral split it alike. Where tetrahedra of the file want the other diagonal, the cell is split
    from a new point in its middle.

    Args:
        points: [m], shape (n, 3).
        blocks: shapes of solid cells (`cell_shape`) and their nodes (m, k), corners first.

    Returns:
        Points with those that were added (n + a, 3), tetrahedra (t, 4), and the cell of each, counted over the blocks.
    """
    plain = [np.asarray(cells)[:, :4] for shape, cells in blocks if shape == "tetra"]
    pairs = [
        np.sort(cells[:, list(pair)], axis=1)
        for cells in plain
        for pair in ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
    ]
    edges = {(a, b) for found in pairs for a, b in found.tolist()} if len(plain) < len(blocks) else set()
    out: list[np.ndarray] = []
    source: list[np.ndarray] = []
    added: list[np.ndarray] = []
    start = 0
    for shape, block in blocks:
        cells = np.asarray(block, dtype=np.int64)
        if shape == "voxel":
            shape, cells = "hexahedron", cells[:, [0, 1, 3, 2, 4, 5, 7, 6]]
        cells = cells[:, : _CORNERS[shape]]
        if shape == "tetra":
            out.append(cells)
            source.append(start + np.arange(len(cells)))
        else:
            for number, cell in enumerate(cells.tolist()):
                faces = [[cell[k] for k in face] for face in _FACES[shape]]
                cut = [(face, _diagonal(face, edges)) for face in faces]
                apex = min(cell)
                if any(apex in face and apex not in ends for face, ends in cut if ends):
                    apex = len(points) + len(added)
                    added.append(points[cell].mean(axis=0))
                new = [(*t, apex) for face, ends in cut if apex not in face for t in _triangles(face, ends)]
                out.append(np.array(new, dtype=np.int64))
                source.append(np.full(len(new), start + number))
        start += len(cells)
    grown = np.vstack([points, *[point[None] for point in added]]) if added else points
    return grown, np.concatenate(out), np.concatenate(source)


def _diagonal(face: list[int], edges: set[tuple[int, int]]) -> tuple[int, int] | None:
    """Ends of the diagonal along which a face is split: that of tetrahedra there, or from the smallest index."""
    if len(face) == 3:
        return None
    low = face.index(min(face))
    first = face[low], face[(low + 2) % 4]
    second = face[(low + 1) % 4], face[(low + 3) % 4]

    def known(pair: tuple[int, int]) -> bool:
        return (min(pair), max(pair)) in edges

    return second if known(second) and not known(first) else first


def _triangles(face: list[int], ends: tuple[int, int] | None) -> list[tuple[int, int, int]]:
    if ends is None:
        return [(face[0], face[1], face[2])]
    k = face.index(ends[0])
    a, b, c, d = face[k:] + face[:k]
    return [(a, b, c), (a, c, d)]


def triangles_of(points: np.ndarray, shape: str, cells: np.ndarray) -> np.ndarray:
    """Split faces of one shape (m, k) into triangles of their corners (t, 3); six-node triangles into four.

    Args:
        points: [m], shape (n, 3).
        shape: from `cell_shape`.
        cells: nodes, corners first.
    """
    cells = np.asarray(cells, dtype=np.int64)
    if shape == "triangle":
        if cells.shape[1] in (6, 7):
            return cells[:, [[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]]].reshape(-1, 3)
        return cells[:, :3]
    if shape == "pixel":
        cells = cells[:, [0, 1, 3, 2]]
    if shape in ("quad", "pixel"):
        cells = cells[:, :4]
    return np.array([t for face in cells.tolist() for t in _clip_ears(points, face)], dtype=np.int64).reshape(-1, 3)


def _clip_ears(points: np.ndarray, face: list[int]) -> list[tuple[int, int, int]]:
    """Split a polygon, which need not be convex, into triangles by cutting off its corners."""
    place = points[face]
    normal = np.cross(place, np.roll(place, -1, axis=0)).sum(axis=0)
    axis = np.argsort(np.abs(normal))[:2] if normal.any() else np.array([0, 1])
    third = 3 - int(axis.sum())
    if (axis[1] - axis[0]) % 3 == 2:
        axis = axis[::-1]
    flat = dict(zip(face, place[:, axis] * (1.0 if normal[third] >= 0.0 else [1.0, -1.0]), strict=True))

    def turn(a: int, b: int, c: int) -> float:
        u, v = flat[b] - flat[a], flat[c] - flat[a]
        return float(u[0] * v[1] - u[1] * v[0])

    left, out = list(face), []
    while len(left) > 3:
        for k in range(len(left)):
            a, b, c = left[k - 1], left[k], left[(k + 1) % len(left)]
            others = [p for p in left if p not in (a, b, c)]
            inside = any(min(turn(a, b, p), turn(b, c, p), turn(c, a, p)) >= 0.0 for p in others)
            if turn(a, b, c) > 0.0 and not inside:
                break
        else:
            k, a, b, c = 1, left[0], left[1], left[2]  # degenerate: any corner
        out.append((a, b, c))
        left.pop(k)
    return [*out, (left[0], left[1], left[2])]
