"""The process in which gmsh works: ``python -m ... JOB request.npz output.npz LIMIT``; `run_gmsh` starts it.

gmsh may crash or hang on malformed input. Besides NumPy and gmsh the process imports next to nothing: loading SciPy and
Numba would take longer than a coarse mesh.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from softgym_envs.errors import MeshingError
from softgym_envs.extras import explain

UNUSABLE = 3
"""Exit status when gmsh is missing or does not load."""

_TYPES = {4: "tetra", 5: "hexahedron", 6: "wedge", 7: "pyramid", 2: "triangle", 3: "quad", 11: "tetra10"}
"""Names of the cells of gmsh that are bodies and surfaces."""


_HUNG = 600.0, 20.0
"""Wall time [s], and the same over the limit of CPU time, after which a process is taken for hung: the larger one."""


class GmshFailure(Exception):
    """What gmsh says about input that it cannot use."""


def run_limited(
    module: str, *arguments: str, time_limit: float, given: bytes = b""
) -> subprocess.CompletedProcess[bytes]:
    """Run a module in a process of its own, with a limit of its CPU time: nothing fails because a machine is busy.

    Args:
        module: to run; it calls `limit_cpu_time` first.
        *arguments: of its command line.
        time_limit: limit of its CPU time [s].
        given: what it reads from its standard input.

    Raises:
        TimeoutError: if it takes longer, or hangs.
    """
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    command, hung = [sys.executable, "-m", module, *arguments], max(_HUNG[0], _HUNG[1] * time_limit)
    try:
        done = subprocess.run(command, input=given, capture_output=True, timeout=hung, env=environment, check=False)
    except subprocess.TimeoutExpired:
        raise TimeoutError(f"did not end in {hung:.3g} s") from None
    if done.returncode == -signal.SIGPROF:
        raise TimeoutError(f"took longer than time_limit = {time_limit:.3g} s of CPU time")
    return done


def limit_cpu_time(seconds: float) -> None:
    """End this process after some CPU time [s], whatever code it is in then."""
    signal.setitimer(signal.ITIMER_PROF, max(seconds, 1e-6))


def run_gmsh(
    job: str, request: Mapping[str, Any], *, time_limit: float, task: str, remedy: str
) -> dict[str, np.ndarray]:
    """Run a job of gmsh in a separate process.

    Args:
        job: name of one of `JOBS`.
        request: its arrays and numbers.
        time_limit: limit of its CPU time [s].
        task: what is done, for messages: "meshing 'body.stl'".
        remedy: what to do if it takes too long.

    Raises:
        GmshFailure: with the last line that gmsh says about its input.
        MeshingError: if gmsh cannot be used, or takes too long.
    """
    with tempfile.TemporaryDirectory() as scratch:
        given, output = Path(scratch) / "request.npz", Path(scratch) / "output.npz"
        np.savez(given, **request)
        arguments = job, str(given), str(output), str(time_limit)
        try:
            done = run_limited("softgym_envs.mechanics.gmsh_process", *arguments, time_limit=time_limit)
        except TimeoutError as problem:
            raise MeshingError(f"{task} {problem}; {remedy}") from None
        errors, said = (text.decode(errors="replace").strip() for text in (done.stderr, done.stdout))
        if done.returncode == UNUSABLE:
            raise MeshingError(f"gmsh cannot be used: {errors.splitlines()[-1]}")
        if done.returncode != 0 or not output.is_file():
            raise GmshFailure((errors or said or "it crashed").splitlines()[-1])
        with np.load(output) as data:
            return dict(data)


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


def _fill_shells(gmsh: ModuleType, request: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Mesh the volume between the shells of a request, see `fill_surface`.

    Triangles that meet at more than the ``angle`` [degrees] form an edge of the shape, whose faces are meshed anew.
    Without an angle the triangles stay as they are.
    """
    points, triangles, shells, parts = (request[name] for name in ("points", "triangles", "shells", "parts"))
    angle = float(request["angle"])
    set_options(gmsh, float(request["mesh_size"]))
    gmsh.model.add("body")
    surfaces: list[list[int]] = [[] for _ in parts]
    for shell in range(len(parts)):
        corners, renumbered = np.unique(triangles[shells == shell], return_inverse=True)
        entity = gmsh.model.addDiscreteEntity(2)
        gmsh.model.mesh.addNodes(2, entity, (corners + 1).tolist(), points[corners].ravel().tolist())
        gmsh.model.mesh.addElementsByType(entity, 2, [], (corners[renumbered.ravel()] + 1).tolist())
        surfaces[shell].append(entity)
    if np.isfinite(angle):
        gmsh.model.mesh.classifySurfaces(np.radians(angle), True, True, np.pi)
        shell_of_point = np.empty(len(points), dtype=np.int64)
        shell_of_point[triangles.ravel()] = np.repeat(shells, 3)
        surfaces = [[] for _ in parts]
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
    found = _mesh(gmsh)
    if not len(found.get("tetra", ())):
        raise ValueError("gmsh made no tetrahedra")
    used, renumbered = np.unique(found["tetra"], return_inverse=True)
    return {"nodes": found["points"][used], "tetrahedra": renumbered.reshape(-1, 4)}


def _convert(gmsh: ModuleType, request: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Read a file; a shape of solids is meshed, in millimetres if its format states the unit."""
    path, kind, size = str(request["path"]), str(request["kind"]), float(request["mesh_size"])
    if kind not in ("step", "iges", "brep"):
        # gmsh tells formats by their suffix.
        with tempfile.TemporaryDirectory() as scratch:
            named = Path(scratch) / {"gmsh1": "file.msh", "unv": "file.unv"}[kind]
            named.write_bytes(Path(path).read_bytes())
            gmsh.open(str(named))
            return _mesh(gmsh)
    gmsh.model.add("body")
    gmsh.model.occ.importShapes(path, highestDimOnly=True, format="" if kind == "brep" else kind)
    if not gmsh.model.occ.getEntities(3):  # IGES files hold faces
        gmsh.model.occ.healShapes(sewFaces=True, makeSolids=True)
    solids = gmsh.model.occ.getEntities(3)
    if not solids:
        raise ValueError("no solid")
    if len(solids) > 1:  # parts that touch share their faces
        gmsh.model.occ.fragment(solids[:1], solids[1:])
    gmsh.model.occ.synchronize()
    low, high = np.array(gmsh.model.getBoundingBox(-1, -1)).reshape(2, 3)
    set_options(gmsh, size if np.isfinite(size) else float(np.linalg.norm(high - low)) / 20.0)
    gmsh.model.mesh.generate(3)
    return _mesh(gmsh)


def _mesh(gmsh: ModuleType) -> dict[str, np.ndarray]:
    """Return the points (n, 3), cells by kind and their physical groups."""
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    number = np.zeros(int(tags.max(initial=0)) + 1, dtype=np.int64)
    number[tags] = np.arange(len(tags))
    out: dict[str, np.ndarray] = {"points": coordinates.reshape(-1, 3)}
    cells: dict[str, list[np.ndarray]] = {}
    groups: dict[str, list[np.ndarray]] = {}
    for dimension, entity in gmsh.model.getEntities():
        physical = gmsh.model.getPhysicalGroupsForEntity(dimension, entity)
        for kind, _, nodes in zip(*gmsh.model.mesh.getElements(dimension, entity), strict=True):
            if kind not in _TYPES:
                continue
            count = gmsh.model.mesh.getElementProperties(kind)[3]
            found = number[nodes].reshape(-1, count)
            if kind == 11:  # the last two midside nodes have the other order
                found = found[:, [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]]
            cells.setdefault(_TYPES[kind], []).append(found)
            groups.setdefault(_TYPES[kind], []).append(np.full(len(found), physical[0] if len(physical) else 0))
    for name in cells:
        out[name], out[f"{name}_tags"] = np.concatenate(cells[name]), np.concatenate(groups[name])
    named = [(d, t, gmsh.model.getPhysicalName(d, t)) for d, t in gmsh.model.getPhysicalGroups()]
    named = [each for each in named if each[2]]
    out["names"] = np.array([name for _, _, name in named], dtype=str)
    out["name_tags"] = np.array([tag for _, tag, _ in named], dtype=np.int64)
    out["name_dimensions"] = np.array([dimension for dimension, _, _ in named], dtype=np.int64)
    return out


JOBS = {"fill": _fill_shells, "convert": _convert}


def _main(job: str, request: str, output: str, time_limit: str) -> None:
    limit_cpu_time(float(time_limit))
    import gmsh

    with np.load(request) as data:
        given = dict(data)
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        np.savez(output, **JOBS[job](gmsh, given))  # type: ignore[arg-type]
    finally:
        gmsh.finalize()


if __name__ == "__main__":
    try:
        _main(*sys.argv[1:])
    except (ImportError, OSError) as problem:  # OSError: a system library that gmsh needs is missing
        print(explain(problem) or problem, file=sys.stderr)
        sys.exit(UNUSABLE)
