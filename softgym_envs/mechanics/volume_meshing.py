"""Filling closed surfaces with tetrahedra, by gmsh in a separate process with a time limit."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from itertools import permutations
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from softgym_envs.errors import DataError, MeshingError
from softgym_envs.mechanics.constraints.cavity import enclosed_volume
from softgym_envs.mechanics.gmsh_process import UNUSABLE
from softgym_envs.mechanics.surfaces import connected_pieces, encloses, self_intersection


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
        time_limit: wall-clock limit [s].
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
    size = diagonal / 20.0 if mesh_size is None else float(mesh_size)
    if not (np.isfinite(size) and size > 0.0):
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
    with tempfile.TemporaryDirectory() as scratch:
        request, output = Path(scratch) / "surface.npz", Path(scratch) / "mesh.npz"
        np.savez(
            request,
            points=points / diagonal,  # the tolerances of gmsh are absolute
            triangles=np.concatenate(shells),
            shells=np.repeat(np.arange(len(shells)), [len(shell) for shell in shells]),
            parts=parts,
            mesh_size=size / diagonal,
        )
        _run(request, output, time_limit, source, size)
        with np.load(output) as data:
            return data["nodes"] * diagonal, data["tetrahedra"]


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
    """Split a surface into closed shells."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    _, first, counts = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
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
    if len(np.unique(edges, axis=0)) != len(edges):
        raise DataError(f"the triangles of '{source}' are oriented inconsistently; make their normals consistent")
    return connected_pieces(triangles)


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


def _run(request: Path, output: Path, time_limit: float, source: str, size: float) -> None:
    """Mesh in a separate process: gmsh may crash or hang on a malformed surface."""
    command = [sys.executable, "-m", "softgym_envs.mechanics.gmsh_process", str(request), str(output)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=time_limit, env=environment, check=False)
    except subprocess.TimeoutExpired:
        raise MeshingError(
            f"meshing '{source}' took longer than {time_limit:g} s with mesh_size = {size:.3g} m; "
            "a larger mesh_size is faster"
        ) from None
    if done.returncode == UNUSABLE:
        raise MeshingError(f"gmsh cannot be used: {done.stderr.strip().splitlines()[-1]}")
    if done.returncode != 0 or not output.is_file():
        lines = (done.stderr.strip() or done.stdout.strip() or "it crashed").splitlines()
        raise DataError(f"'{source}' cannot be meshed: {lines[-1]}; does its surface intersect itself?")
