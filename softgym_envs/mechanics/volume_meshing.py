"""Filling closed surfaces with tetrahedra, by gmsh in a separate process with a time limit."""

from __future__ import annotations

from itertools import permutations
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.spatial import cKDTree

from softgym_envs.errors import DataError
from softgym_envs.mechanics.constraints.cavity import enclosed_volume
from softgym_envs.mechanics.gmsh_process import GmshFailure, run_gmsh
from softgym_envs.mechanics.surfaces import connected_pieces, encloses, self_intersection
from softgym_envs.quantities import finite_number

_ANGLES = (40.0, 80.0, np.nan)
"""Ways to fill a surface: triangles that meet at a larger angle [degrees] form an edge of the shape; NaN: as it is."""

_LOST_VOLUME = 0.25
"""Part of the volume that coarser triangles on a curved surface may lose; more shows that a face is missing."""


def fill_surface(
    points: np.ndarray,
    triangles: np.ndarray,
    *,
    mesh_size: float | None = None,
    time_limit: float = 60.0,
    source: str = "the surface",
) -> tuple[np.ndarray, np.ndarray]:
    """Mesh the volume within a closed surface; closed surfaces inside it become cavities.

    The surface is remeshed with triangles of the mesh size; its sharp edges are kept.

    Args:
        points: [m], shape (n, 3).
        triangles: point indices, shape (k, 3); coincident points count as one.
        mesh_size: edge length [m]; default: a twentieth of the diagonal.
        time_limit: limit of the CPU time of each way of meshing that is tried [s].
        source: name of the surface in messages.

    Returns:
        Nodes [m] (n, 3) and tetrahedra (m, 4).

    Raises:
        DataError: if the surface is open, inconsistently oriented or intersects itself.
        MeshingError: if gmsh cannot be used, or takes too long.
        ValueError: for a mesh size that is not positive or larger than the body.
    """
    points, triangles = _weld(points, triangles)
    if len(triangles) < 4:
        raise DataError(f"'{source}' holds no closed surface: it has {len(triangles)} triangles")
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    size = diagonal / 20.0 if mesh_size is None else finite_number(mesh_size, "mesh_size", "m")
    if not size > 0.0:
        raise ValueError(f"mesh_size = {mesh_size} m must be positive and finite")
    if size > diagonal:
        raise ValueError(
            f"mesh_size = {size:g} m is larger than the body, whose diagonal is {diagonal:.3g} m; did you mean metres?"
        )
    shells = _shells(points, triangles, source)
    place = self_intersection(points, triangles)
    if place is not None:
        raise DataError(f"the surface of '{source}' intersects itself near {np.round(place, 6).tolist()} m")
    parts = _nesting(points, shells, source)
    request = {
        "points": points / diagonal,  # the tolerances of gmsh are absolute
        "triangles": np.concatenate(shells),
        "shells": np.repeat(np.arange(len(shells)), [len(shell) for shell in shells]),
        "parts": parts,
        "mesh_size": size / diagonal,
    }
    volumes = np.array([abs(enclosed_volume(points, shell)) for shell in shells])
    volume = float(np.where(parts == np.arange(len(parts)), volumes, -volumes).sum())
    nodes, tetrahedra = _fill(request, volume / diagonal**3, time_limit, source, size)
    return nodes * diagonal, tetrahedra


def _fill(
    request: dict[str, Any], volume: float, time_limit: float, source: str, size: float
) -> tuple[np.ndarray, np.ndarray]:
    """Fill shells by the first way of `_ANGLES` that works, and check the volume."""
    count, last = len(request["triangles"]), ""
    for angle in _ANGLES:
        try:
            found = run_gmsh(
                "fill",
                {**request, "angle": angle},
                time_limit=time_limit,
                task=f"meshing '{source}', a surface of {count} triangles, with mesh_size = {size:.3g} m",
                remedy="pass a larger time_limit, or a larger mesh_size",
            )
        except GmshFailure as problem:
            last = str(problem)
            continue
        nodes, tetrahedra = found["nodes"], found["tetrahedra"]
        corners = nodes[tetrahedra]
        filled = float(np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])).sum()) / 6.0
        if abs(filled - volume) <= (_LOST_VOLUME if np.isfinite(angle) else 1e-6) * volume:
            return nodes, tetrahedra
        last = f"gmsh filled {100 * filled / volume:.0f} % of its volume"
    raise DataError(
        f"'{source}' cannot be meshed: {last}; its surface is closed and does not cross itself, and was tried with "
        "edges at two angles and as it is; remesh it with triangles of about one size"
    )


def _weld(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge coincident points, and drop triangles that have no area left."""
    points, triangles = np.asarray(points, dtype=float), np.asarray(triangles, dtype=np.int64)
    if not np.isfinite(points).all():
        raise DataError("the points of the surface must be finite")
    used, renumbered = np.unique(triangles, return_inverse=True)
    points, triangles = points[used], renumbered.reshape(triangles.shape)
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0
    pairs = cKDTree(points).query_pairs(1e-7 * diagonal, output_type="ndarray") if len(points) else np.empty((0, 2))
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=2 * (len(points),))
    count, group = connected_components(graph, directed=False)
    merged = np.empty((count, 3))
    merged[group] = points
    triangles = group[triangles]
    a, b, c = triangles.T
    return merged, triangles[(a != b) & (b != c) & (c != a)]


def _shells(points: np.ndarray, triangles: np.ndarray, source: str) -> list[np.ndarray]:
    """Split a surface into closed shells, without its repeated triangles and with one orientation each."""
    corners = np.sort(triangles, axis=1)
    _, first, counts = np.unique(corners, axis=0, return_index=True, return_counts=True)
    if (counts > 1).any():
        # One copy belongs to the surface, or none: both sides of a sheet that sticks to it.
        for chosen in (first, first[counts == 1]):
            if len(chosen) and (_edge_counts(triangles[chosen])[2] == 2).all():
                triangles = triangles[np.sort(chosen)]
                break
    edges, first, counts = _edge_counts(triangles)
    if (counts == 1).any():
        place = np.round(points[edges[first[counts == 1][0]]].mean(axis=0), 6).tolist()
        raise DataError(
            f"the surface of '{source}' is open: {(counts == 1).sum()} edges belong to one triangle only, "
            f"the first near {place} m; close its holes"
        )
    if (counts > 2).any():
        place = np.round(points[edges[first[counts > 2][0]]].mean(axis=0), 6).tolist()
        raise DataError(
            f"the surface of '{source}' touches itself: {(counts > 2).sum()} edges belong to more than two triangles, "
            f"the first near {place} m"
        )
    return connected_pieces(_oriented(triangles, source))


def _edge_counts(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges of triangles (3 k, 2), the first place of each among them, and how many triangles have it."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    _, first, counts = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    return edges, first, counts


def _oriented(triangles: np.ndarray, source: str) -> np.ndarray:
    """Turn triangles (k, 3) that look another way than their neighbours; each edge has two of them."""
    count = len(triangles)
    edges, _, _ = _edge_counts(triangles)
    order = np.lexsort(np.sort(edges, axis=1).T)
    one, two = order[::2], order[1::2]
    alike = edges[one, 0] == edges[two, 1]  # neighbours run along their edge in opposite directions
    if alike.all():
        return triangles
    one, two = one % count, two % count
    graph = coo_matrix((np.ones(len(one)), (one, two)), shape=(count, count)).tocsr()
    sign = {(a, b): same for a, b, same in zip(one.tolist(), two.tolist(), alike.tolist(), strict=True)}
    turned = np.zeros(count, dtype=bool)
    for start in np.unique(connected_components(graph, directed=False)[1], return_index=True)[1]:
        found, before = breadth_first_order(graph, start, directed=False)
        for triangle in found[1:].tolist():
            last = int(before[triangle])
            same = sign[last, triangle] if (last, triangle) in sign else sign[triangle, last]
            turned[triangle] = turned[last] if same else not turned[last]
        if turned[found].mean() > 0.5:
            turned[found] = ~turned[found]  # keep the orientation of most
    out = triangles.copy()
    out[turned] = out[turned][:, ::-1]
    if ((turned[one] == turned[two]) != alike).any():
        raise DataError(f"the surface of '{source}' has no inside: its triangles cannot be oriented consistently")
    return out


def _nesting(points: np.ndarray, shells: list[np.ndarray], source: str) -> np.ndarray:
    """Return for each shell the outer shell of the part that it bounds, shape (s,)."""
    count = len(shells)
    within = np.zeros((count, count), dtype=bool)
    for i, j in permutations(range(count), 2):
        corners = np.unique(shells[i])
        found = {encloses(points, shells[j], points[corner]) for corner in corners[:: max(1, len(corners) // 50)]}
        if len(found) > 1:
            raise DataError(f"the surface of '{source}' intersects itself: two of its closed shells overlap")
        within[i, j] = found.pop()
    volumes = np.array([abs(enclosed_volume(points, shell)) for shell in shells])
    parts = np.arange(count)
    for i in range(count):
        if within[i].sum() % 2 == 0:
            continue  # an outer shell
        around = np.flatnonzero(within[i])
        parts[i] = around[np.argmin(volumes[around])]
    return parts
