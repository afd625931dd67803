"""What a mesh file holds, whatever its name says: one layer in front of meshio, gmsh and VTK.

The format is told from the content. What is no mesh (pointers of Git LFS, archives, web pages, files of CAD programs)
is named in one line with the remedy, and readers print nothing.
"""

from __future__ import annotations

import contextlib
import io
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.errors import DataError
from softgym_envs.extras import explain
from softgym_envs.mechanics.gmsh_process import GmshFailure, run_gmsh

CAD_FORMATS = ("step", "iges", "brep")
"""Formats of shapes without a mesh."""

WITH_UNIT = ("step", "iges")
"""Those that state their unit: they are read in metres."""

KNOWN = "VTK (.vtk, .vtu, .vtp), Gmsh (.msh), STL, OBJ, PLY, OFF, Abaqus, Nastran, Medit, TetGen, STEP, IGES, BREP"

_EXPORT = "export it as STEP or STL"
_UNPACK = "unpack it first"
# What is no mesh: how its content begins, what it is, and the remedy.
_FOREIGN: tuple[tuple[bytes, str, str], ...] = (
    (b"version https://git-lfs", "a pointer of Git LFS, not the file itself", "run 'git lfs pull' in its repository"),
    (b"/annex/objects/", "a pointer of git-annex, not the file itself", "run 'git annex get' in its repository"),
    (b"<!doctype html", "a web page", "download the raw file"),
    (b"<html", "a web page", "download the raw file"),
    (b"pk\x03\x04", "an archive (zip, or 3MF and others that are made of it)", _UNPACK + ", or export STL"),
    (b"\x1f\x8b", "an archive (gzip)", _UNPACK),
    (b"7z\xbc\xaf", "an archive (7z)", _UNPACK),
    (b"bzh", "an archive (bzip2)", _UNPACK),
    (b"\xfd7zxz", "an archive (xz)", _UNPACK),
    (b"rar!", "an archive (rar)", _UNPACK),
    (b"%pdf", "a PDF document", _EXPORT),
    (b"\xd0\xcf\x11\xe0", "a document of a CAD program (SolidWorks, Inventor)", _EXPORT),
    (b"blender", "a scene of Blender", "export it as STL or OBJ"),
    (b"gltf", "a glTF scene", "export it as STL or OBJ"),
    (b"kaydara fbx", "an FBX scene", "export it as STL or OBJ"),
    (b"ac10", "a drawing of AutoCAD", _EXPORT),
    (b"**abcdefghijklm", "a Parasolid file", _EXPORT),
)


def read_file(path: Path, *, mesh_size: float | None, time_limit: float) -> Any:
    """Read the mesh in a file as it is.

    Args:
        path: of the file.
        mesh_size: edge length of the elements of shapes without a mesh, in metres for STEP and IGES, which state their
            unit, and in the file's unit for others; default: a twentieth of the diagonal.
        time_limit: limit of the CPU time of gmsh [s].

    Returns:
        A `meshio.Mesh`, in metres for STEP and IGES.

    Raises:
        DataError: if the file is missing, cannot be read, or is no mesh.
        MeshingError: if gmsh cannot be used, or takes too long.
    """
    kind = file_format(path)
    if kind in CAD_FORMATS or kind in ("gmsh1", "unv"):
        return _from_gmsh(path, kind, mesh_size, time_limit)
    reader: Callable[[], Any] = {"obj": lambda: _read_obj(path), "vtp": lambda: _read_vtk_surface(path)}.get(
        kind, lambda: _read_meshio(path, kind)
    )
    try:
        # meshio reads part of a text STL as the number of triangles, and prints what it cannot read.
        with np.errstate(over="ignore"), warnings.catch_warnings(), _silent():
            warnings.simplefilter("ignore")
            return reader()
    except (Exception, SystemExit) as error:  # meshio raises SystemExit on some malformed files
        if isinstance(error, DataError):
            raise
        detail = f"{error}" if len(f"{error}") > 2 else f"it is malformed ({type(error).__name__})"
        raise DataError(f"mesh file '{path}' cannot be read as {kind}: {detail}") from error


def file_format(path: Path) -> str:
    """Return the format of a file by its content, and by its name where the content does not tell.

    Raises:
        DataError: for a file that does not exist, is empty, or whose content is known to be no mesh.
    """
    if not path.is_file():
        raise DataError(f"mesh file '{path}' does not exist")
    with path.open("rb") as file:
        head = file.read(8192)
    if not head.strip():
        raise DataError(f"mesh file '{path}' is empty")
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    low = text.lower()
    for start, what, remedy in _FOREIGN:
        if low.startswith(start):
            raise DataError(f"mesh file '{path}' is {what}; {remedy}")
    suffix = path.suffix.lower()
    for start, kind in (
        (b"# vtk datafile", "vtk"),
        (b"$meshformat", "gmsh"),
        (b"$nod", "gmsh1"),
        (b"meshversionformatted", "medit"),
        (b"iso-10303-21", "step"),
        (b"dbrep_drawableshape", "brep"),
        (b"cascade topology", "brep"),
        (b"ply\n", "ply"),
        (b"ply\r", "ply"),
    ):
        if low.startswith(start):
            if kind == "vtk" and re.search(rb"^dataset\s+polydata", low, re.MULTILINE):
                return "vtp"
            return kind
    if text.startswith(b"<"):
        return _xml_format(path, low)
    if text.startswith(b"$"):
        for start, kind in ((b"$meshformat", "gmsh"), (b"$nod", "gmsh1")):
            if start in low:
                return kind
    for pattern, kind in ((rb"(st|c|n|4)*off\b", "off"), (rb"mesh3d\s*$", "netgen")):
        if re.match(rb"(\s*#[^\n]*\n)*\s*" + pattern, low, re.MULTILINE):
            return kind
    if _is_stl(path, head):
        return "stl"
    if suffix == ".stl":
        raise DataError(f"mesh file '{path}' {_broken_stl(path, head)}")
    if re.match(rb"\s*-1\r?\n\s*\d+\r?\n", head):
        return "unv"
    if len(head) > 73 and re.match(rb"[^\r\n]{72}S\s*\d+\s*[\r\n]", head):
        return "iges"
    if re.search(rb"^\*(heading|node|part|element)\b", low, re.MULTILINE):
        return "abaqus"
    if re.search(rb"^(begin bulk|grid\*?[ ,])", low, re.MULTILINE):
        return "nastran"
    if re.search(rb"^v\s+[-+.\d]", text, re.MULTILINE) and suffix not in (".node", ".ele"):
        return "obj"
    if suffix == ".msh":
        # meshio's reader of Ansys hangs on a truncated section.
        if not path.read_bytes().rstrip().endswith(b")"):
            raise DataError(f"mesh file '{path}' is neither a Gmsh mesh nor a complete Ansys mesh")
        return "ansys"
    return _by_suffix(path)


def _is_stl(path: Path, head: bytes) -> bool:
    if len(head) >= 84 and path.stat().st_size == 84 + 50 * int.from_bytes(head[80:84], "little"):
        return True
    return head.lstrip().lower().startswith(b"solid") and b"facet" in head.lower()


def _broken_stl(path: Path, head: bytes) -> str:
    """Say why a file that is named .stl is none."""
    if head.lstrip().lower().startswith(b"solid") and b"\0" not in head:
        return "is an STL without triangles"
    if len(head) < 84 or b"\0" not in head:
        return f"is in no known format, though it is named .stl; known: {KNOWN}"
    count, size = int.from_bytes(head[80:84], "little"), path.stat().st_size
    return f"is no whole STL: it has {size} bytes, and the {count} triangles that it states take {84 + 50 * count}"


def _xml_format(path: Path, low: bytes) -> str:
    """Format of an XML file, whose beginning ``low`` is in lower case."""
    found = re.search(rb"<vtkfile[^>]*\btype\s*=\s*[\"'](\w+)", low)
    if found is not None:
        grid = found[1].decode()
        if grid in ("unstructuredgrid", "polydata"):
            return {"unstructuredgrid": "vtu", "polydata": "vtp"}[grid]
        raise DataError(f"mesh file '{path}' is a VTK file of type {grid}; save it as an UnstructuredGrid (.vtu)")
    for start, kind in ((b"<dolfin", "dolfin-xml"), (b"<xdmf", "xdmf")):
        if start in low:
            return kind
    if b"<collada" in low:
        raise DataError(f"mesh file '{path}' is a COLLADA scene; export it as STL or OBJ")
    raise DataError(f"mesh file '{path}' is an XML file that is no mesh; known formats: {KNOWN}")


def _by_suffix(path: Path) -> str:
    from meshio import extension_to_filetypes

    names = extension_to_filetypes.get(path.suffix.lower(), [])
    text = {"vtk", "vtu", "gmsh", "stl", "obj", "ply", "off", "medit", "netgen", "xdmf", "dolfin-xml", "svg"}
    left = [name for name in names if name not in text or path.suffix.lower() == ".meshb"]
    if left:
        return left[0]
    suffix = path.suffix.lower()
    said = f", though it is named {suffix}" if names or suffix in (".step", ".stp", ".iges", ".igs", ".brep") else ""
    raise DataError(f"mesh file '{path}' is in no known format{said}; known: {KNOWN}")


@contextlib.contextmanager
def _silent() -> Any:
    """Swallow what readers print."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        yield


# -- readers --------------------------------------------------------------------------------------------------------


def _read_meshio(path: Path, kind: str) -> Any:
    import meshio

    return meshio.read(path, file_format=kind)


def _read_obj(path: Path) -> Any:
    """Read the faces of a Wavefront OBJ file; its texture, normals, lines and materials are not geometry."""
    import meshio

    points: list[list[float]] = []
    faces: dict[int, list[list[int]]] = {}
    for line in path.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ").splitlines():
        word, *values = line.split("#")[0].split() or [""]
        if word == "v":
            points.append([float(value) for value in values[:3]])
        elif word == "f":
            numbers = [int(value.split("/")[0]) for value in values]
            face = [n - 1 if n > 0 else len(points) + n for n in numbers]  # negative: counted from the last point
            faces.setdefault(len(face), []).append(face)
    kinds = {3: "triangle", 4: "quad"}
    cells = [(kinds.get(k, "polygon"), np.array(found, dtype=np.int64)) for k, found in sorted(faces.items())]
    return meshio.Mesh(np.array(points, dtype=float).reshape(-1, 3), cells)


def _read_vtk_surface(path: Path) -> Any:
    """Read a surface of VTK (PolyData), old or XML, which meshio does not know."""
    import meshio

    try:
        import pyvista
    except ImportError as error:
        raise DataError(f"'{path}' is a surface of VTK: {explain(error) or error}; or save it as STL") from None

    with path.open("rb") as file:
        xml = b"<VTKFile" in file.read(8192)
    surface = pyvista.read(path, force_ext=".vtp" if xml else ".vtk").triangulate()
    return meshio.Mesh(np.asarray(surface.points), [("triangle", surface.faces.reshape(-1, 4)[:, 1:])])


def _from_gmsh(path: Path, kind: str, mesh_size: float | None, time_limit: float) -> Any:
    """Read a file with gmsh, in a process of its own; shapes without a mesh are meshed."""
    import meshio

    shape, factor = kind in CAD_FORMATS, 1e-3 if kind in WITH_UNIT else 1.0
    try:
        found = run_gmsh(
            "convert",
            {
                "path": str(path.resolve()),
                "kind": kind,
                "mesh_size": np.nan if mesh_size is None else mesh_size / factor,
            },
            time_limit=time_limit,
            task=f"{'meshing' if shape else 'reading'} '{path}'",
            remedy="pass a larger time_limit" + (", or a larger mesh_size" if shape else ""),
        )
    except GmshFailure as problem:
        if "no solid" in str(problem):
            raise DataError(
                f"'{path}' holds no solid, only surfaces or curves; join them to a solid, or export STL"
            ) from None
        raise DataError(
            f"mesh file '{path}' cannot be {'meshed' if shape else 'read'} by gmsh: {problem}; export it as STL"
        ) from None
    names = [
        name for name in ("tetra", "hexahedron", "wedge", "pyramid", "triangle", "quad", "tetra10") if name in found
    ]
    tags = [found[f"{name}_tags"] for name in names]
    fields = {
        str(name): np.array([tag, dimension])
        for name, tag, dimension in zip(found["names"], found["name_tags"], found["name_dimensions"], strict=True)
    }
    return meshio.Mesh(
        factor * found["points"],
        [(name, found[name]) for name in names],
        cell_data={"gmsh:physical": tags} if any(tag.any() for tag in tags) else {},
        field_data=fields,
    )
