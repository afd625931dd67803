"""Files of a bar of 60 x 20 x 20 mm in many formats, and files that are no mesh: the kinds of docs/meshes.md."""

from __future__ import annotations

import gzip
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import meshio
import numpy as np

from tests.helpers import box_mesh

SIZE = (60.0, 20.0, 20.0)
VOLUME = 24e-6


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        name: in the table of docs/meshes.md.
        make: writes the file into a folder and returns its path.
        refused: pattern of the message, or None if the file is read.
        needs: module without which it cannot be written or read.
        options: of `read_mesh`.
    """

    name: str
    make: Callable[[Path], Path]
    refused: str | None = None
    needs: str = ""
    options: dict[str, Any] = field(default_factory=lambda: {"unit": "mm", "mesh_size": 1e-2})


def tetrahedra(order: int = 1) -> meshio.Mesh:
    nodes, cells = box_mesh(SIZE, (3, 1, 1))
    if order == 1:
        return meshio.Mesh(nodes, [("tetra", cells)])
    pairs = np.sort(cells[:, [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]], axis=2).reshape(-1, 2)
    edges, place = np.unique(pairs, axis=0, return_inverse=True)
    middles = len(nodes) + place.reshape(-1, 6)
    return meshio.Mesh(np.vstack([nodes, nodes[edges].mean(axis=1)]), [("tetra10", np.hstack([cells, middles]))])


def grid(counts: tuple[int, int, int] = (3, 1, 1)) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and hexahedra of the bar."""
    n = [count + 1 for count in counts]
    axes = [np.linspace(0.0, side, count) for side, count in zip(SIZE, n, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    i, j, k = (part.ravel() for part in np.meshgrid(*(np.arange(count) for count in counts), indexing="ij"))
    corner = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
    cells = np.column_stack([((i + a) * n[1] + j + b) * n[2] + k + c for a, b, c in corner])
    return nodes, cells


def mixed(shift: bool = False) -> meshio.Mesh:
    """One hexahedron, one of two wedges, and one of pyramids or of tetrahedra with the other diagonal."""
    nodes, cells = grid()
    a, b, c = cells
    nodes = np.vstack([nodes, [[50.0, 10.0, 10.0]]])
    top = len(nodes) - 1
    faces = [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
    pyramids = [[*(c[k] for k in face), top] for face in faces]
    wedges = [[b[0], b[1], b[2], b[4], b[5], b[6]], [b[0], b[2], b[3], b[4], b[6], b[7]]]
    if not shift:
        return meshio.Mesh(nodes, [("hexahedron", [a]), ("wedge", wedges), ("pyramid", pyramids)])
    cut = [t for p, q, r, s, e in pyramids for t in ([p, q, s, e], [q, r, s, e])]
    more = [t for p, q, r, s, e in pyramids for t in ([p, q, r, e], [p, r, s, e])]
    first = [k for k, face in enumerate(faces) if face == (3, 0, 4, 7)][0]
    other = more[2 * first : 2 * first + 2] if min(c[3], c[0], c[4], c[7]) in (c[0], c[7]) else []
    chosen = cut[: 2 * first] + (other or cut[2 * first : 2 * first + 2]) + cut[2 * first + 2 :]
    return meshio.Mesh(nodes, [("hexahedron", [a, b]), ("tetra", chosen)])


def quads() -> tuple[np.ndarray, np.ndarray]:
    """Points and quadrilaterals of the surface, seen counter-clockwise from outside."""
    points = np.array([(x, y, z) for z in (0, 20) for x, y in ((0, 0), (60, 0), (60, 20), (0, 20))], dtype=float)
    return points, np.array([(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)])


def surface() -> meshio.Mesh:
    points, faces = quads()
    return meshio.Mesh(points, [("triangle", np.vstack([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]]))])


def saved(mesh: Callable[[], meshio.Mesh], name: str, written_as: str | None = None, **options: Any):
    def make(folder: Path) -> Path:
        path = folder / name
        mesh().write(path, **({} if written_as is None else {"file_format": written_as}), **options)
        return path

    return make


def renamed(make: Callable[[Path], Path], name: str):
    return lambda folder: make(folder).rename(folder / name)


def content(name: str, data: bytes | str):
    def make(folder: Path) -> Path:
        path = folder / name
        path.write_bytes(data.encode() if isinstance(data, str) else data)
        return path

    return make


def by_gmsh(name: str, *, mesh: bool = True, groups: tuple[str, ...] = (), **options: float):
    def make(folder: Path) -> Path:
        import gmsh

        gmsh.initialize(interruptible=False)
        try:
            gmsh.option.setNumber("General.Terminal", 0)
            gmsh.option.setNumber("General.Verbosity", 0)
            for option, value in options.items():
                gmsh.option.setNumber(option.replace("_", "."), value)
            gmsh.model.occ.addBox(0, 0, 0, *SIZE)
            gmsh.model.occ.synchronize()
            if "silicone" in groups:
                gmsh.model.addPhysicalGroup(3, [1], name="silicone")
            if "base" in groups:
                gmsh.model.addPhysicalGroup(2, [1], name="base")
            gmsh.option.setNumber("Mesh.MeshSizeMax", 20.0)
            if mesh:
                gmsh.model.mesh.generate(3)
            gmsh.write(str(folder / name))
        finally:
            gmsh.finalize()
        return folder / name

    return make


def obj(faces: str, extra: str = "") -> str:
    return "# a bar\n" + "".join("v {} {} {}\n".format(*point) for point in quads()[0]) + extra + faces


def _quads_obj(form: str) -> str:
    return "".join("f " + " ".join(form.format(k + 1, k - 8) for k in face) + "\n" for face in quads()[1].tolist())


def angled_obj() -> str:
    """A bar of L-shaped section, whose ends are polygons that are not convex; its volume is that of the bar."""
    section = [(0, 0), (30, 0), (30, 10), (10, 10), (10, 30), (0, 30)]
    length = VOLUME * 1e9 / 500.0
    points = [(0.0, *p) for p in section] + [(length, *p) for p in section]
    lines = ["v {} {} {}".format(*p) for p in points]
    lines += ["f 6 5 4 3 2 1", "f 7 8 9 10 11 12"]
    lines += [f"f {k + 1} {(k + 1) % 6 + 1} {(k + 1) % 6 + 7} {k + 7}" for k in range(6)]
    return "\n".join(lines) + "\n"


def legacy_polydata() -> str:
    points, faces = quads()
    rows = [" ".join(map(str, point)) for point in points]
    cells = ["4 " + " ".join(map(str, face)) for face in faces]
    head = f"# vtk DataFile Version 3.0\nbar\nASCII\nDATASET POLYDATA\nPOINTS {len(rows)} float\n"
    return head + "\n".join(rows) + f"\nPOLYGONS {len(cells)} {5 * len(cells)}\n" + "\n".join(cells) + "\n"


def xml_polydata() -> str:
    points, faces = quads()
    numbers = " ".join(map(str, points.ravel()))
    return (
        '<?xml version="1.0"?>\n<VTKFile type="PolyData" version="0.1" byte_order="LittleEndian"><PolyData>'
        f'<Piece NumberOfPoints="{len(points)}" NumberOfPolys="{len(faces)}"><Points><DataArray type="Float64" '
        f'NumberOfComponents="3" format="ascii">{numbers}</DataArray></Points><Polys><DataArray type="Int64" '
        f'Name="connectivity" format="ascii">{" ".join(map(str, faces.ravel()))}</DataArray><DataArray type="Int64" '
        f'Name="offsets" format="ascii">{" ".join(str(4 * k + 4) for k in range(6))}</DataArray></Polys></Piece>'
        "</PolyData></VTKFile>\n"
    )


def old_gmsh() -> str:
    mesh = tetrahedra()
    nodes = [f"{k + 1} {x} {y} {z}" for k, (x, y, z) in enumerate(mesh.points)]
    cells = [f"{k + 1} 4 1 1 4 " + " ".join(str(n + 1) for n in cell) for k, cell in enumerate(mesh.cells[0].data)]
    body = [f"$NOD\n{len(nodes)}", *nodes, f"$ENDNOD\n$ELM\n{len(cells)}", *cells, "$ENDELM\n"]
    return "\n".join(body)


def binary_stl(header: bytes = b"", turned: tuple[int, ...] = (), repeated: tuple[int, ...] = ()) -> bytes:
    mesh = surface()
    faces = mesh.cells[0].data.copy()
    for k in turned:
        faces[k] = faces[k][::-1]
    faces = np.vstack([faces, faces[list(repeated)]]) if repeated else faces
    rows = [struct.pack("<12fH", 0.0, 0.0, 0.0, *mesh.points[face].ravel(), 0) for face in faces]
    return header.ljust(80, b" ") + struct.pack("<I", len(rows)) + b"".join(rows)


def text_stl(solids: int = 1) -> str:
    mesh = surface()
    out = []
    for part in np.array_split(mesh.cells[0].data, solids):
        out.append("solid part")
        for face in part:
            corners = "\n".join("vertex {} {} {}".format(*mesh.points[k]) for k in face)
            out.append(f"facet normal 0 0 0\nouter loop\n{corners}\nendloop\nendfacet")
        out.append("endsolid part")
    return "\n".join(out) + "\n"


def compressed(folder: Path) -> Path:
    path = folder / "bar.stl.gz"
    path.write_bytes(gzip.compress(text_stl().encode()))
    return path


def zipped(name: str):
    def make(folder: Path) -> Path:
        with zipfile.ZipFile(folder / name, "w") as file:
            file.writestr("3D/3dmodel.model", "<model/>")
        return folder / name

    return make


def second_order_surface() -> meshio.Mesh:
    mesh = surface()
    faces = mesh.cells[0].data
    pairs = np.sort(faces[:, [(0, 1), (1, 2), (2, 0)]], axis=2).reshape(-1, 2)
    edges, place = np.unique(pairs, axis=0, return_inverse=True)
    points = np.vstack([mesh.points, mesh.points[edges].mean(axis=1)])
    return meshio.Mesh(points, [("triangle6", np.hstack([faces, 8 + place.reshape(-1, 3)]))])


def second_order_hexahedra() -> meshio.Mesh:
    nodes, cells = grid()
    edges = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
    pairs = np.sort(cells[:, edges], axis=2).reshape(-1, 2)
    unique, place = np.unique(pairs, axis=0, return_inverse=True)
    points = np.vstack([nodes, nodes[unique].mean(axis=1)])
    return meshio.Mesh(points, [("hexahedron20", np.hstack([cells, len(nodes) + place.reshape(-1, 12)]))])


def part_without_cells() -> meshio.Mesh:
    """Tetrahedra of one part, and only the surface of another."""
    mesh, other = tetrahedra(), surface()
    points = np.vstack([mesh.points, other.points + [60.0, 0.0, 0.0]])
    return meshio.Mesh(points, [mesh.cells[0], ("triangle", other.cells[0].data + len(mesh.points))])


KINDS = [
    Kind("VTK, old text form", saved(tetrahedra, "bar.vtk", "vtk42", binary=False)),
    Kind("VTK, old binary form", saved(tetrahedra, "bar.vtk", "vtk42", binary=True)),
    Kind("VTK 5.1", saved(tetrahedra, "bar.vtk")),
    Kind("VTK XML, compressed", saved(tetrahedra, "bar.vtu")),
    Kind("VTK XML, text", saved(tetrahedra, "bar.vtu", binary=False)),
    Kind("VTK XML named .vtk", renamed(saved(tetrahedra, "bar.vtu"), "named.vtk")),
    Kind("old VTK named .vtu", renamed(saved(tetrahedra, "bar.vtk"), "named.vtu")),
    Kind("VTK without a suffix", renamed(saved(tetrahedra, "bar.vtk"), "bar")),
    Kind("Gmsh 4.1", by_gmsh("bar.msh"), needs="gmsh"),
    Kind("Gmsh 4.1, binary", by_gmsh("bar.msh", Mesh_Binary=1), needs="gmsh"),
    Kind("Gmsh 2.2", saved(tetrahedra, "bar.msh", "gmsh22", binary=False)),
    Kind("Gmsh 2.2 named .vtk", renamed(saved(tetrahedra, "bar.msh", "gmsh22"), "named.vtk")),
    Kind("Gmsh 1, of before 2007", content("bar.msh", old_gmsh()), needs="gmsh"),
    Kind("Gmsh, second order", by_gmsh("bar.msh", Mesh_ElementOrder=2), needs="gmsh"),
    Kind("Gmsh with names", by_gmsh("bar.msh", groups=("silicone", "base")), needs="gmsh"),
    Kind("Medit", saved(tetrahedra, "bar.mesh")),
    Kind("Abaqus", saved(tetrahedra, "bar.inp")),
    Kind("Abaqus, second order", saved(lambda: tetrahedra(2), "bar.inp")),
    Kind("Nastran", saved(tetrahedra, "bar.bdf")),
    Kind("Netgen", saved(tetrahedra, "bar.vol")),
    Kind("TetGen", saved(tetrahedra, "bar.ele")),
    Kind("I-DEAS universal", by_gmsh("bar.unv"), needs="gmsh"),
    Kind("VTK, second order", saved(lambda: tetrahedra(2), "bar.vtu")),
    Kind("hexahedra", saved(lambda: meshio.Mesh(*_blocks("hexahedron", *grid((3, 2, 2)))), "bar.vtu")),
    Kind("hexahedra of second order", saved(second_order_hexahedra, "bar.vtu")),
    Kind("hexahedra, wedges and pyramids", saved(mixed, "bar.vtk")),
    Kind("hexahedra and tetrahedra", saved(lambda: mixed(shift=True), "bar.vtk")),
    Kind("STL, text", content("bar.stl", text_stl())),
    Kind("STL, text of several solids", content("bar.stl", text_stl(3))),
    Kind("STL, binary", content("bar.STL", binary_stl(b"made by a CAD program"))),
    Kind("STL, binary that begins with solid", content("bar.stl", binary_stl(b"solid bar"))),
    Kind("STL with triangles that look inwards", content("bar.stl", binary_stl(turned=(1, 4, 5)))),
    Kind("STL with repeated triangles", content("bar.stl", binary_stl(repeated=(2, 2, 7)))),
    Kind("OBJ with texture", content("bar.obj", obj(_quads_obj("{0}/1/1"), "vt 0 0\nvn 0 0 1\n"))),
    Kind("OBJ of quadrilaterals", content("bar.obj", obj(_quads_obj("{0}")))),
    Kind("OBJ with numbers from the end", content("bar.obj", obj(_quads_obj("{1}")))),
    Kind("OBJ of polygons", content("bar.obj", angled_obj())),
    Kind("PLY", saved(surface, "bar.ply")),
    Kind("PLY of quadrilaterals", saved(lambda: meshio.Mesh(*_blocks("quad", *quads())), "bar.ply")),
    Kind("OFF", saved(surface, "bar.off")),
    Kind("VTK surface, old", content("bar.vtk", legacy_polydata()), needs="pyvista"),
    Kind("VTK surface, XML", content("bar.vtp", xml_polydata()), needs="pyvista"),
    Kind("triangles of second order", saved(second_order_surface, "bar.vtu")),
    Kind("STEP", by_gmsh("bar.step", mesh=False), needs="gmsh"),
    Kind("IGES", by_gmsh("bar.iges", mesh=False), needs="gmsh"),
    Kind("BREP", by_gmsh("bar.brep", mesh=False), needs="gmsh"),
    Kind(
        "pointer of Git LFS",
        content("bar.stl", "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"),
        r"pointer of Git LFS, .*; run 'git lfs pull'",
    ),
    Kind("pointer of git-annex", content("bar.stl", "/annex/objects/SHA256E-s12--4d7a.stl\n"), "run 'git annex get'"),
    Kind("web page", content("bar.stl", "<!DOCTYPE html>\n<html></html>"), "is a web page; download the raw file"),
    Kind("archive", compressed, r"is an archive \(gzip\); unpack it first"),
    Kind("3MF", zipped("bar.3mf"), r"is an archive \(zip, or 3MF .*export STL"),
    Kind(
        "SolidWorks part",
        content("bar.sldprt", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(600)),
        "document of a CAD program .*; export it as STEP or STL",
    ),
    Kind("Blender", content("bar.blend", b"BLENDER-v300RENDH"), "scene of Blender; export it as STL or OBJ"),
    Kind("glTF", content("bar.glb", b"glTF\x02\x00\x00\x00"), "glTF scene; export it as STL or OBJ"),
    Kind("COLLADA", content("bar.dae", '<?xml version="1.0"?>\n<COLLADA></COLLADA>'), "COLLADA scene; export"),
    Kind("VTK image", content("bar.vti", '<VTKFile type="ImageData"></VTKFile>'), "VTK file of type imagedata; save"),
    Kind("other XML", content("bar.xml", '<?xml version="1.0"?>\n<robot></robot>'), "an XML file that is no mesh"),
    Kind(
        "unknown content", content("bar.step", "hello"), r"is in no known format, though it is named \.step; known: V"
    ),
    Kind("empty file", content("bar.stl", ""), "is empty"),
    Kind(
        "open surface", content("bar.stl", binary_stl()[:80] + struct.pack("<I", 11) + binary_stl()[84:-50]), "is open"
    ),
    Kind(
        "group of a face only", by_gmsh("bar.msh", groups=("base",)), "gmsh saves only cells of .* 'base'", needs="gmsh"
    ),
    Kind(
        "a part without cells",
        saved(part_without_cells, "bar.vtu"),
        "12 faces that belong to no solid cell .found: 18 tetra, 12 ",
    ),
    Kind("STEP of a face", lambda folder: _step_of_a_face(folder), "holds no solid, only surfaces", needs="gmsh"),
]


def _blocks(kind: str, points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, list[tuple[str, np.ndarray]]]:
    return points, [(kind, cells)]


def _step_of_a_face(folder: Path) -> Path:
    import gmsh

    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("General.Verbosity", 0)
        gmsh.model.occ.addRectangle(0, 0, 0, 60, 20)
        gmsh.model.occ.synchronize()
        gmsh.write(str(folder / "face.step"))
    finally:
        gmsh.finalize()
    return folder / "face.step"
