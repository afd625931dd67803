"""Kinds of mesh files, whatever they are named: read as the body that they hold, or refused in one line."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import meshio
import numpy as np
import pytest

from softgym_envs.errors import DataError
from softgym_envs.mechanics.io import read_mesh, read_surface
from softgym_envs.mechanics.mesh_checks import check_mesh
from softgym_envs.mechanics.model import MechanicalModel
from tests.mechanics.mesh_kinds import KINDS, SIZE, VOLUME, Kind, by_gmsh, content, mixed, renamed, saved, tetrahedra

PAGE = Path(__file__).parents[2] / "docs" / "meshes.md"
BY_NAME = {kind.name: kind for kind in KINDS}


def made(kind: Kind, folder: Path) -> Path:
    if kind.needs:
        pytest.importorskip(kind.needs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the libraries that write the file
        return kind.make(folder)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_a_kind_of_file(tmp_path, capfd, kind):
    path = made(kind, tmp_path)
    capfd.readouterr()
    if kind.refused is not None:
        with pytest.raises(DataError, match=kind.refused) as raised:
            read_mesh(path, **kind.options)
        assert str(path) in str(raised.value)
        assert "\n" not in str(raised.value)
    else:
        mesh = read_mesh(path, **kind.options)
        corners = mesh.nodes[mesh.tetrahedra[:, :4]]
        assert abs(np.linalg.det(corners[:, 1:] - corners[:, :1])).sum() / 6 == pytest.approx(VOLUME, rel=1e-5)
        check_mesh(mesh.nodes, mesh.tetrahedra[:, :4])
    assert capfd.readouterr() == ("", "")


def test_the_page_lists_these_kinds():
    rows = re.findall(r"^\| (.+?) \| (.+?) \| (.+?) \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    listed = {name: now for name, _, now in rows if name in BY_NAME}
    assert list(listed) == [kind.name for kind in KINDS]
    for name, now in listed.items():
        assert now.startswith("refused" if BY_NAME[name].refused else "read"), name


@pytest.mark.parametrize("name", ["VTK, second order", "Gmsh, second order", "Abaqus, second order"])
@pytest.mark.parametrize("element", ["averaged", "quadratic"])
def test_second_order_meshes_are_used_as_they_are(tmp_path, name, element):
    path = made(BY_NAME[name], tmp_path)
    model = MechanicalModel.from_file(path, unit="mm", fixed=lambda x: x[:, 0] < 1e-9, element=element)
    count = len(read_mesh(path, unit="mm").nodes)
    assert model.volume == pytest.approx(VOLUME, rel=1e-9)
    assert len(model.nodes) == count if element == "quadratic" else len(model.nodes) < count


def test_a_face_and_a_solid_by_their_names(tmp_path):
    path = made(BY_NAME["Gmsh with names"], tmp_path)
    mesh = read_mesh(path, unit="mm")
    assert sorted(mesh.groups) == ["base", "silicone"]
    assert len(mesh.regions["silicone"]) == len(mesh.tetrahedra)
    model = MechanicalModel.from_file(path, unit="mm", fixed="base", young_modulus={"silicone": 2e5})
    np.testing.assert_array_equal(model.fixed, model.nodes[:, 0] < 1e-9)
    with pytest.raises(ValueError, match="unknown group 'bse'; did you mean 'base'"):
        MechanicalModel.from_file(path, unit="mm", fixed=["base", "bse"])
    second = made(Kind("", by_gmsh("second.msh", groups=("silicone", "base"), Mesh_ElementOrder=2)), tmp_path)
    for element in ("averaged", "quadratic"):
        model = MechanicalModel.from_file(second, unit="mm", fixed="base", element=element)
        np.testing.assert_array_equal(model.fixed, model.nodes[:, 0] < 1e-9)


def test_sets_of_abaqus_and_of_split_cells(tmp_path):
    mesh = tetrahedra()
    base = np.flatnonzero(mesh.points[:, 0] == 0.0)
    mesh.point_sets = {"BASE": base}
    mesh.cell_sets = {"FIRST": [np.arange(6)]}
    mesh.write(tmp_path / "bar.inp")
    read = read_mesh(tmp_path / "bar.inp", unit="mm")
    np.testing.assert_array_equal(read.groups["BASE"], base)
    np.testing.assert_array_equal(read.regions["FIRST"], np.arange(6))
    parts = mixed()
    parts.cell_data = {"gmsh:physical": [np.array([1]), np.array([1, 2]), np.full(6, 3)]}
    parts.field_data = {"root": np.array([1, 3]), "tip": np.array([3, 3])}
    meshio.write(tmp_path / "bar.msh", parts, file_format="gmsh22")
    read = read_mesh(tmp_path / "bar.msh", unit="mm")
    centres = read.nodes[read.tetrahedra].mean(axis=1)
    assert (centres[read.regions["tip"], 0] > 0.04).all()
    assert len(read.regions["tip"]) == (centres[:, 0] > 0.04).sum()
    assert (read.nodes[read.groups["root"], 0] <= 0.04 + 1e-9).all()


@pytest.mark.parametrize("seed", range(6))
def test_split_cells_meet_face_to_face_in_any_numbering(tmp_path, seed):
    """Hexahedra, wedges, pyramids and tetrahedra against them, with nodes in random order."""
    for make in (mixed, lambda: mixed(shift=True)):
        mesh = make()
        order = np.random.default_rng(seed).permutation(len(mesh.points))
        place = np.argsort(order)
        cells = [(block.type, place[np.asarray(block.data)]) for block in mesh.cells]
        meshio.Mesh(mesh.points[order], cells).write(tmp_path / "bar.vtu")
        read = read_mesh(tmp_path / "bar.vtu", unit="mm")
        check_mesh(read.nodes, read.tetrahedra)
        corners = read.nodes[read.tetrahedra]
        assert abs(np.linalg.det(corners[:, 1:] - corners[:, :1])).sum() / 6 == pytest.approx(VOLUME, rel=1e-9)


def test_a_step_file_states_its_unit(tmp_path):
    pytest.importorskip("gmsh")
    path = by_gmsh("bar.step", mesh=False)(tmp_path)
    text = path.read_text()
    assert ".MILLI.,.METRE." in text
    path.write_text(text.replace(".MILLI.,.METRE.", ".CENTI.,.METRE."))
    for options in ({}, {"unit": "cm"}):
        np.testing.assert_allclose(np.ptp(read_mesh(path, **options).nodes, axis=0), np.multiply(1e-2, SIZE), rtol=1e-6)
    with pytest.raises(ValueError, match=r"scale = 0.01 must be left out for '.*bar.step', which states its unit"):
        read_mesh(path, scale=1e-2)
    fine, coarse = (len(read_mesh(path, mesh_size=size).tetrahedra) for size in (0.03, 0.1))
    assert fine > 2 * coarse
    _, triangles, in_metres = read_surface(path)
    assert in_metres
    assert len(triangles) > 100


def test_two_solids_of_a_step_file_share_their_face(tmp_path):
    gmsh = pytest.importorskip("gmsh")
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("General.Verbosity", 0)
        gmsh.model.occ.addBox(0, 0, 0, 30, 20, 20)
        gmsh.model.occ.addBox(30, 5, 5, 30, 10, 10)
        gmsh.model.occ.synchronize()
        gmsh.write(str(tmp_path / "two.step"))
    finally:
        gmsh.finalize()
    mesh = read_mesh(tmp_path / "two.step", mesh_size=1e-2)
    model = MechanicalModel.from_mesh(mesh.nodes, mesh.tetrahedra, fixed=lambda x: x[:, 0] < 1e-9)
    assert model.volume == pytest.approx(15e-6, rel=1e-5)


def test_a_truncated_or_malformed_file_of_a_known_kind(tmp_path):
    for name, data, message in (
        ("bar.obj", "v 0 0 0\nv 1 0\nf 1 2 x\n", "cannot be read as obj: "),
        ("bar.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", r"refer to nodes 0..8, but it has 3 nodes"),
        ("bar.msh", "$MeshFormat\n", "cannot be read as gmsh: "),
        ("bar.msh", "$NOD\n3\n", "gmsh|no tetrahedra"),
        ("flat.vtu", "<VTKFile type='UnstructuredGrid'>", "cannot be read as vtu: "),
    ):
        path = content(name, data)(tmp_path)
        with pytest.raises(DataError, match=message) as raised:
            read_mesh(path)
        assert "\n" not in str(raised.value)


def test_polyhedra_are_counted(tmp_path):
    corners = "0 0 0 1 0 0 1 1 0 0 1 0 0 0 1 1 0 1 1 1 1 0 1 1"
    faces = "6 4 0 3 2 1 4 4 5 6 7 4 0 1 5 4 4 1 2 6 5 4 2 3 7 6 4 3 0 4 7"
    arrays = {"connectivity": "0 1 2 3 4 5 6 7", "offsets": "8", "types": "42", "faces": faces, "faceoffsets": "31"}
    rows = "".join(f'<DataArray type="Int64" Name="{k}" format="ascii">{v}</DataArray>' for k, v in arrays.items())
    path = content(
        "bar.vtu",
        '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64">'
        '<UnstructuredGrid><Piece NumberOfPoints="8" NumberOfCells="1"><Points><DataArray type="Float64" '
        f'NumberOfComponents="3" format="ascii">{corners}</DataArray></Points><Cells>{rows}</Cells></Piece>'
        "</UnstructuredGrid></VTKFile>",
    )(tmp_path)
    with pytest.raises(DataError, match="cells that are not read .found: 1 polyhedron8.; export tetrahedra"):
        read_mesh(path)


def test_names_do_not_matter(tmp_path):
    for suffix in (".stl", ".obj", ".msh", ".dat", ".txt"):
        path = renamed(saved(tetrahedra, "bar.vtu"), f"named{suffix}")(tmp_path)
        assert len(read_mesh(path, unit="mm").tetrahedra) == 18


def test_regions_with_different_values_do_not_overlap(tmp_path):
    mesh = tetrahedra()
    mesh.cell_sets = {"soft": [np.arange(9)], "stiff": [np.arange(6, 18)]}
    mesh.write(tmp_path / "bar.inp")
    options = {"unit": "mm", "fixed": lambda x: x[:, 0] < 1e-9}
    with pytest.raises(
        ValueError, match="young_modulus: 3 of 18 elements are in region 'stiff' and in one with another"
    ):
        MechanicalModel.from_file(tmp_path / "bar.inp", young_modulus={"soft": 1e5, "stiff": 1e6}, **options)
    MechanicalModel.from_file(tmp_path / "bar.inp", young_modulus={"soft": 1e5, "stiff": 1e5}, **options)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (
            BY_NAME["STL, binary"].make,
            "is no whole STL: it has 664 bytes, and the 12 triangles that it states take 684",
        ),
        (content("bar.STL", "solid x\nendsolid x\n"), "is an STL without triangles"),
    ],
)
def test_an_stl_that_is_not_whole(tmp_path, data, message):
    path = data(tmp_path)
    if path.stat().st_size > 600:
        path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(DataError, match=message):
        read_mesh(path)
