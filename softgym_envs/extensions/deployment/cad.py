"""Bodies as files for CAD programs, slicers and other simulators: STEP (exact shapes) and STL (triangles).

Lengths in the files are in **millimetres**, unlike everywhere else in the suite.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from softgym_envs.robots.base import Drawing, Robot
from softgym_envs.robots.geometry.meshing import BodyMesh, run_gmsh
from softgym_envs.robots.gmsh_robot import GmshRobot
from softgym_envs.storage import atomic_write

FORMATS = (".step", ".stl")
"""Allowed file endings."""


def export_body(
    robot: Robot, path: str | Path, design: Mapping[str, float] | None = None, *, time_limit: float = 60.0
) -> Path:
    """Write the undeformed body of a design, in millimetres.

    Args:
        robot: the family of bodies.
        path: ends with ``.step`` (the exact shape) or ``.stl`` (the boundary of its finite-element mesh).
        design: the body; missing variables take their baseline.
        time_limit: limit of the CPU time of drawing a STEP file [s].

    Returns:
        The path.

    Raises:
        DesignError: for a malformed design.
        InfeasibleDesign: if the geometry cannot exist.
        ValueError: for another ending, or a robot without an exact shape (STEP) or a solid part (STL).
    """
    path = _check_path(path)
    robot = robot.printable()
    if path.suffix == ".step":
        write_drawing(robot.drawing(robot.design_space.complete(design)), path, time_limit=time_limit)
    elif isinstance(robot, GmshRobot):
        mesh = robot.body(design)
        write_stl(path, mesh.nodes, mesh.surface())
    else:
        model = robot.build(design)
        corners = [block.connectivity[:, :4] for block in model.solids]
        if not corners:
            raise ValueError(f"robot '{robot.name}' has no solid part to write")
        none = np.empty((0, 3), dtype=np.int64)
        mesh = BodyMesh(model.nodes, np.concatenate(corners), none, none[:, 0])
        write_stl(path, mesh.nodes, mesh.surface())
    return path


def write_drawing(drawing: Drawing, path: str | Path, *, mesh_size: float = 0.005, time_limit: float = 60.0) -> Path:
    """Write one drawn volume as STEP or STL, in millimetres, atomically.

    Args:
        drawing: the function and its parameters.
        path: ends with ``.step`` or ``.stl``.
        mesh_size: largest edge of the triangles of an STL [m]; round parts have shorter edges.
        time_limit: limit of the CPU time [s].

    Raises:
        InfeasibleDesign: if the volume cannot be drawn, or takes too long.
        MeshingError: if gmsh cannot be imported.
        ValueError: for another ending.
    """
    path = _check_path(path)
    draw, parameters = drawing
    with tempfile.TemporaryDirectory() as scratch:
        output = Path(scratch) / f"part{path.suffix}"
        request = {
            "build": draw,
            "parameters": parameters,
            "mesh_size": mesh_size,
            "output": str(output),
        }
        run_gmsh(request, time_limit=time_limit)
        with atomic_write(path) as stream:
            stream.write(output.read_bytes())
    return path


def write_stl(path: str | Path, nodes: np.ndarray, triangles: np.ndarray) -> Path:
    """Write triangles as a binary STL in millimetres, atomically.

    Args:
        path: the file.
        nodes: positions [m], shape (n, 3).
        triangles: corner indices, shape (k, 3), seen counter-clockwise from outside.
    """
    corners = 1e3 * nodes[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    records = np.zeros(len(triangles), dtype=record)
    records["normal"], records["corners"] = normals, corners
    with atomic_write(path) as stream:
        stream.write(b"softgym-envs, millimetres".ljust(80) + np.uint32(len(records)).tobytes() + records.tobytes())
    return Path(path)


def _check_path(path: str | Path) -> Path:
    path = Path(path)
    if path.suffix not in FORMATS:
        raise ValueError(f"'{path}' must end with {' or '.join(FORMATS)}")
    return path
