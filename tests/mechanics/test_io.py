"""User meshes: files of tetrahedra and of surfaces, units, elasticity by region, cavities, and malformed input."""

from __future__ import annotations

import signal
from types import SimpleNamespace

import meshio
import numpy as np
import pytest

from softgym_envs.errors import DataError, MeshingError
from softgym_envs.mechanics.constraints.cavity import enclosed_volume
from softgym_envs.mechanics.elements.tetrahedra import Tetrahedra
from softgym_envs.mechanics.io import UNITS, read_mesh
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solids import SOLIDS
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.mechanics.surfaces import encloses, self_intersection
from softgym_envs.quantities import unchecked

ONE_TETRAHEDRON = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])

# -- files of tetrahedra --------------------------------------------------------------------------------------------


@pytest.fixture
def mesh_in_millimetres(box):
    nodes, tetrahedra = box((100, 20, 20), (4, 1, 1))
    # A node without tetrahedra, and cells that are not solid, as gmsh writes them.
    return meshio.Mesh(np.vstack([nodes, [[1e3, 1e3, 1e3]]]), [("triangle", [[0, 1, 2]]), ("tetra", tetrahedra)])


# File names, and the format meshio writes where the name leaves a choice.
FORMATS = [("beam.vtk", None), ("beam.msh", "gmsh22"), ("beam.vtu", None), ("beam.mesh", None)]


@pytest.mark.parametrize(("name", "written_as"), FORMATS)
def test_model_from_a_file(tmp_path, mesh_in_millimetres, name, written_as):
    path = tmp_path / name
    mesh_in_millimetres.write(path, file_format=written_as)
    box = (-1e-6, 1e-6, -1, 1, -1, 1)
    model = MechanicalModel.from_file(path, fixed_box=box, scale=1e-3, density=1000.0, element="linear")
    assert model.volume == pytest.approx(0.1 * 0.02 * 0.02, rel=1e-9)
    assert model.mass == pytest.approx(0.04, rel=1e-9)
    assert len(model.nodes) == 20
    assert model.fixed.sum() == 4
    # The same as from the arrays, node by node.
    mesh = read_mesh(path)
    np.testing.assert_allclose(mesh.nodes, mesh_in_millimetres.points[:-1], atol=1e-9)
    np.testing.assert_array_equal(mesh.tetrahedra, mesh_in_millimetres.cells_dict["tetra"])


@pytest.mark.parametrize("binary", [0, 1])
def test_model_from_a_file_of_gmsh(tmp_path, binary):
    """A file as gmsh itself writes it (format 4.1), with nodes of curves and a surface mesh beside the solid one."""
    gmsh = pytest.importorskip("gmsh")
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("Mesh.Binary", binary)
        gmsh.option.setNumber("Mesh.MeshSizeMax", 20.0)
        gmsh.model.occ.addBox(0, 0, 0, 100, 20, 20)
        gmsh.model.occ.synchronize()
        gmsh.model.mesh.generate(3)
        gmsh.write(str(tmp_path / "beam.msh"))
    finally:
        gmsh.finalize()
    model = MechanicalModel.from_file(
        tmp_path / "beam.msh", fixed_box=(-1e-6, 1e-6, -1, 1, -1, 1), scale=1e-3, element="linear"
    )
    assert model.volume == pytest.approx(0.1 * 0.02 * 0.02, rel=1e-9)
    assert 4 <= model.fixed.sum() < len(model.nodes)


def test_a_box_that_fixes_nothing_is_rejected(tmp_path, mesh_in_millimetres):
    mesh_in_millimetres.write(tmp_path / "beam.vtk")
    with pytest.raises(ValueError, match=r"none lies in fixed_box .* the body spans 0 to 0.1, 0 to 0.02, 0 to"):
        MechanicalModel.from_file(tmp_path / "beam.vtk", unit="mm", fixed_box=(-9, -8, -1, 1, -1, 1), element="linear")


def test_missing_file(tmp_path):
    with pytest.raises(DataError, match=r"nothing\.msh.*does not exist"):
        read_mesh(tmp_path / "nothing.msh")
    with pytest.raises(DataError, match="does not exist"):
        read_mesh(tmp_path)


class ReaderHangs(BaseException):
    """Not an Exception, which `read_mesh` would report as a malformed file."""


@pytest.fixture
def reader_time_limit():
    """Interrupt a reader that hangs (a good one needs milliseconds)."""

    def stop(*_):
        raise ReaderHangs

    previous = signal.signal(signal.SIGALRM, stop)
    signal.alarm(10)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, previous)


@pytest.mark.parametrize(("name", "written_as"), FORMATS)
@pytest.mark.parametrize("kept", [0.0, 0.02, 0.4, 0.7, 0.95])
def test_truncated_file(tmp_path, reader_time_limit, mesh_in_millimetres, name, written_as, kept):
    path = tmp_path / name
    mesh_in_millimetres.write(path, file_format=written_as)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(DataError, match=name):
        read_mesh(path)


@pytest.mark.parametrize("kept", [0.4, 0.44, 0.985])
def test_truncated_ansys_file(tmp_path, reader_time_limit, mesh_in_millimetres, kept):
    """Ansys also uses the suffix ``.msh``: meshio tries that reader first, which hangs on such files."""
    path = tmp_path / "ansys.msh"
    mesh_in_millimetres.write(path, file_format="ansys")
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(DataError, match=r"ansys\.msh"):
        read_mesh(path)


@pytest.mark.parametrize("name", ["noise.msh", "noise.vtk", "noise.unknown"])
def test_file_that_is_not_a_mesh(tmp_path, name, rng):
    (tmp_path / name).write_bytes(rng.bytes(2000))
    with pytest.raises(DataError, match=name):
        read_mesh(tmp_path / name)


def test_file_without_tetrahedra(tmp_path, box):
    nodes, _ = box()
    meshio.Mesh(nodes, [("line", [[0, 1]])]).write(tmp_path / "wire.vtk")
    with pytest.raises(DataError, match=r"no tetrahedra and no triangles; found: 1 line"):
        read_mesh(tmp_path / "wire.vtk")
    meshio.Mesh(nodes, [("triangle", [[0, 1, 2]])]).write(tmp_path / "shell.vtk")
    with pytest.raises(DataError, match=r"shell.vtk' holds no closed surface: it has 1 triangles"):
        read_mesh(tmp_path / "shell.vtk")


@pytest.mark.parametrize("wrong", [99, -1], ids=["beyond the nodes", "negative"])
def test_file_whose_tetrahedra_refer_to_missing_nodes(tmp_path, wrong):
    meshio.Mesh(ONE_TETRAHEDRON, [("tetra", [[0, 1, 2, wrong]])]).write(tmp_path / "broken.vtk", binary=False)
    with pytest.raises(DataError, match=r"broken\.vtk"):
        read_mesh(tmp_path / "broken.vtk")


# -- units and sizes ------------------------------------------------------------------------------------------------


def test_unit_and_scale_are_equivalent(tmp_path, mesh_in_millimetres):
    path = tmp_path / "beam.vtk"
    mesh_in_millimetres.write(path)
    for unit, scale in UNITS.items():
        np.testing.assert_array_equal(read_mesh(path, unit=unit).nodes, read_mesh(path, scale=scale).nodes)
    with pytest.raises(ValueError, match="pass either scale or unit, got scale = 0.001 and unit = 'mm'"):
        read_mesh(path, unit="mm", scale=1e-3)
    with pytest.raises(ValueError, match="unknown unit 'km'; .*allowed: m, cm, mm, in"):
        read_mesh(path, unit="km")
    with pytest.raises(ValueError, match="scale = 0.0 must be positive"):
        read_mesh(path, scale=0.0)


def test_a_body_in_millimetres_is_rejected(tmp_path, mesh_in_millimetres, box):
    mesh_in_millimetres.write(tmp_path / "beam.vtk")
    message = r"the body measures 100 x 20 x 20 m; its size = 100 m is implausible, .* did you mean 0.1 m \(100 mm\)\? "
    with pytest.raises(ValueError, match=message + r"\(for a file in millimetres pass unit='mm', .*\)"):
        MechanicalModel.from_file(tmp_path / "beam.vtk", fixed_box=(-1, 1, -1, 30, -1, 30), element="linear")
    nodes, tetrahedra = box((100.0, 20.0, 20.0))
    with pytest.raises(ValueError, match=message + r"\(for nodes in millimetres pass 1e-3 \* nodes\)"):
        MechanicalModel.from_mesh(nodes, tetrahedra, fixed=lambda x: x[:, 0] < 1e-9, element="linear")
    with unchecked("size"):
        large = MechanicalModel.from_mesh(nodes, tetrahedra, fixed=lambda x: x[:, 0] < 1e-9, element="linear")
    assert large.volume == pytest.approx(4e4)


@pytest.mark.parametrize(
    ("add", "message"),
    [
        (lambda m: m.add_effector("tip", [90, 10, 10]), r"effector 'tip' at \[90.0, 10.0, 10.0\] m lies 91 m outside"),
        (lambda m: m.add_contact("pad", [90, 10, 10]), r"contact 'pad' at .* did you mean metres\?"),
        (
            lambda m: m.add_cable("c", [[0.01, 0.01, 0.01], [90, 10, 10]], [-0.01, 0.01, 0.01]),
            r"a guide of cable 'c' at \[90.0, 10.0, 10.0\] m lies 91 m outside the body, which is 0.104 m long",
        ),
        (
            lambda m: m.add_cable("c", [[0.09, 0.01, 0.01]], [-10, 10, 10]),
            r"the pull point of cable 'c' at \[-10.0, 10.0, 10.0\] m lies 17.3 m outside",
        ),
        (lambda m: m.add_cavity("air", inside=[50, 10, 10]), "the point inside cavity 'air' at .* did you mean metres"),
        (lambda m: m.add_effector("tip", [0.09, 0.01]), r"effector 'tip' must have coordinates of shape \(p, 3\)"),
    ],
    ids=["effector", "contact", "guide", "pull point", "cavity", "plane"],
)
def test_points_in_millimetres_are_rejected(box, add, message):
    nodes, tetrahedra = box((0.1, 0.02, 0.02), (5, 1, 1))
    model = MechanicalModel.from_mesh(nodes, tetrahedra, fixed=lambda x: x[:, 0] == 0.0, element="linear")
    with pytest.raises(ValueError, match=message):
        add(model)
    assert not model.rows
    with pytest.raises(ValueError, match="block = 1 is out of range: the model has 1 solids"):
        model.add_effector("tip", [0.09, 0.01, 0.01], block=1)
    model.add_effector("tip", [0.15, 0.01, 0.01])  # beside the body, as a probe may be


# -- elasticity, mass and element kind ------------------------------------------------------------------------------


@pytest.fixture
def halves(tmp_path, box):
    """A bar whose halves are physical groups of gmsh, in a file: its path, and the elements of the stiff half."""
    nodes, tetrahedra = box((0.1, 0.02, 0.02), (4, 1, 1))
    stiff = nodes[tetrahedra].mean(axis=1)[:, 0] < 0.05
    mesh = meshio.Mesh(
        nodes,
        [("tetra", tetrahedra[stiff]), ("tetra", tetrahedra[~stiff])],
        cell_data={
            "gmsh:physical": [np.full(stiff.sum(), 4), np.full((~stiff).sum(), 7)],
            "gmsh:geometrical": [np.full(stiff.sum(), 1), np.full((~stiff).sum(), 2)],
        },
        field_data={"stiff": np.array([4, 3]), "soft": np.array([7, 3])},
    )
    mesh.write(tmp_path / "halves.msh", file_format="gmsh22")
    return tmp_path / "halves.msh", stiff


def test_modulus_by_region_by_element_and_by_place(halves):
    path, stiff = halves
    mesh = read_mesh(path)
    assert sorted(mesh.regions) == ["soft", "stiff"]
    centroids = mesh.nodes[mesh.tetrahedra].mean(axis=1)
    np.testing.assert_array_equal(np.sort(mesh.regions["stiff"]), np.flatnonzero(centroids[:, 0] < 0.05))
    expected = np.where(centroids[:, 0] < 0.05, 3e6, 1e5)
    for modulus in ({"stiff": 3e6, "soft": 1e5}, expected, lambda c: np.where(c[:, 0] < 0.05, 3e6, 1e5)):
        model = MechanicalModel.from_file(
            path, fixed=lambda x: x[:, 0] == 0.0, young_modulus=modulus, poisson_ratio=0, element="linear"
        )
        np.testing.assert_allclose(model.solids[0].mu, expected / 2.0)


@pytest.mark.parametrize(
    ("modulus", "message"),
    [
        ({"stif": 1e6, "soft": 1e5}, r"young_modulus: unknown region 'stif'; did you mean 'stiff'\? allowed: .*soft"),
        ({"soft": 1e5}, "young_modulus gives no value for 12 of 24 elements, in the regions stiff"),
        ([1e5, 1e6], r"young_modulus must be one number, or one for each of the 24 elements, got shape \(2,\)"),
        (lambda c: 1e5 * c, r"young_modulus must be .* got shape \(24, 3\)"),
        ({"stiff": -1e6, "soft": 1e5}, "young_modulus = -1000000.0 Pa must be positive"),
    ],
    ids=["misspelt", "incomplete", "short", "not per element", "negative"],
)
def test_malformed_moduli_are_rejected(halves, modulus, message):
    with pytest.raises(ValueError, match=message):
        MechanicalModel.from_file(halves[0], fixed=lambda x: x[:, 0] == 0.0, young_modulus=modulus, element="linear")


@pytest.mark.parametrize("element", SOLIDS)
def test_total_mass_scales_the_density(box, element):
    nodes, tetrahedra = box((0.1, 0.02, 0.02), (4, 1, 1), 0.2)
    options = {"fixed": lambda x: x[:, 0] == 0.0, "element": element, "gravity": (0.0, 0.0, -9.81)}
    model = MechanicalModel.from_mesh(nodes, tetrahedra, total_mass=0.123, **options)
    assert model.mass == pytest.approx(0.123, rel=1e-12)
    np.testing.assert_allclose(model.loads.sum(axis=0), [0.0, 0.0, -0.123 * 9.81], atol=1e-12)
    with pytest.raises(ValueError, match="total_mass = -1.0 kg must be positive"):
        MechanicalModel.from_mesh(nodes, tetrahedra, total_mass=-1.0, **options)


def test_the_element_kind_is_chosen_by_name(box):
    nodes, tetrahedra = box((0.1, 0.02, 0.02), (4, 1, 1))
    for element, kind in SOLIDS.items():
        model = MechanicalModel.from_mesh(nodes, tetrahedra, fixed=lambda x: x[:, 0] == 0.0, element=element)
        assert type(model.solids[0]) is kind
        np.testing.assert_array_equal(model.fixed, model.nodes[:, 0] == 0.0)  # midside nodes too
    with pytest.raises(ValueError, match="unknown element 'cubic'; allowed: linear, averaged, quadratic"):
        MechanicalModel.from_mesh(nodes, tetrahedra, fixed=lambda x: x[:, 0] < 1e-9, element="cubic")


# -- surfaces -------------------------------------------------------------------------------------------------------


def cuboid(low, high, *, inward=False):
    """Points and triangles of a cuboid."""
    sides = zip(low, high, strict=True)
    points = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3).astype(float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    return points, triangles[:, ::-1] if inward else triangles


def joined(*parts):
    """One surface of several: points (n, 3) and triangles (k, 3)."""
    starts = np.cumsum([0] + [len(points) for points, _ in parts])
    triangles = [part[1] + start for part, start in zip(parts, starts[:-1], strict=True)]
    return np.concatenate([points for points, _ in parts]), np.concatenate(triangles)


BAR = cuboid((0, 0, 0), (60, 20, 20))
HOLE = cuboid((20, 6, 6), (50, 14, 14), inward=True)


def write_stl(folder, *parts, binary=True):
    points, triangles = joined(*parts)
    meshio.Mesh(points, [("triangle", triangles)]).write(folder / "body.stl", binary=binary)
    return folder / "body.stl"


@pytest.fixture(scope="module")
def hollow(tmp_path_factory):
    """A bar with a closed cavity, from an STL in millimetres: the path and its mesh."""
    path = write_stl(tmp_path_factory.mktemp("hollow"), BAR, HOLE, binary=False)
    return SimpleNamespace(path=path, mesh=read_mesh(path, unit="mm", mesh_size=8e-3))


def test_a_surface_is_filled_and_its_inner_shell_is_a_hole(hollow):
    nodes, tetrahedra = hollow.mesh.nodes, hollow.mesh.tetrahedra
    np.testing.assert_allclose(nodes.min(axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(nodes.max(axis=0), [0.06, 0.02, 0.02], atol=1e-9)
    block = Tetrahedra(nodes, tetrahedra)
    assert block.volume == pytest.approx(60 * 20 * 20e-9 - 30 * 8 * 8e-9, rel=1e-9)  # sharp edges are kept
    edges = np.linalg.norm(nodes[tetrahedra[:, 0]] - nodes[tetrahedra[:, 1]], axis=1)
    assert 4e-3 < np.median(edges) < 12e-3


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("kept", [0.0, 0.3, 0.8, 0.95])
def test_truncated_surface(tmp_path, reader_time_limit, kept, binary):
    path = write_stl(tmp_path, BAR, binary=binary)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(DataError, match=r"body\.stl"):
        read_mesh(path)


def test_a_finer_mesh_and_an_island_in_the_cavity(tmp_path):
    path = write_stl(tmp_path, BAR, HOLE, cuboid((30, 8, 8), (40, 12, 12)))
    mesh = read_mesh(path, unit="mm", mesh_size=4e-3)
    volume = 60 * 20 * 20e-9 - 30 * 8 * 8e-9 + 10 * 4 * 4e-9
    assert Tetrahedra(mesh.nodes, mesh.tetrahedra).volume == pytest.approx(volume, rel=1e-9)
    with pytest.raises(ValueError, match="a part of .* is not connected to anything that is held"):
        MechanicalModel.from_mesh(mesh.nodes, mesh.tetrahedra, fixed=lambda x: x[:, 0] < 1e-9, element="linear")


def test_the_default_mesh_size_is_a_twentieth_of_the_diagonal(tmp_path):
    mesh = read_mesh(write_stl(tmp_path, BAR), unit="mm")
    edges = np.linalg.norm(mesh.nodes[mesh.tetrahedra[:, 0]] - mesh.nodes[mesh.tetrahedra[:, 1]], axis=1)
    assert np.median(edges) == pytest.approx(np.linalg.norm([0.06, 0.02, 0.02]) / 20.0, rel=0.4)


@pytest.mark.parametrize("element", SOLIDS)
def test_from_a_surface_to_the_condensed_model(hollow, element):
    """Two cables and a cavity: W is the derivative of the equilibrium."""
    mesh = hollow.mesh
    model = MechanicalModel.from_mesh(
        mesh.nodes, mesh.tetrahedra, fixed=lambda x: x[:, 0] < 1e-9, element=element, young_modulus=1e6
    )
    for name, z in (("upper", 0.017), ("lower", 0.003)):
        guides = np.column_stack([np.linspace(0.005, 0.055, 6), np.full(6, 0.01), np.full(6, z)])
        model.add_cable(name, guides, [-0.005, 0.01, z])
    cavity = model.add_cavity("air", inside=[0.03, 0.01, 0.01])
    model.add_effector("tip", [0.06, 0.01, 0.01])
    assert cavity.rest_volume == pytest.approx(30 * 8 * 8e-9, rel=1e-9)
    # Quadratic elements take the pressure by their own shape functions.
    assert cavity.triangles.shape[1] == (6 if element == "quadratic" else 3)
    statics = Statics(model, tolerance=1e-13)
    command, mode = np.array([1e-3, 0.5, 2e3]), ["displacement", "effort", "effort"]
    W = statics.solve(command, mode).condensed.W
    plus, minus = (statics.solve(command + [0, 0, s], mode) for s in (10.0, -10.0))
    # With the first cable held, the response to pressure is that of the Schur complement.
    held = W.ea[:, 2] - W.ea[:, 0] * W.aa[0, 2] / W.aa[0, 0]
    np.testing.assert_allclose((plus.delta[3:] - minus.delta[3:]) / 20.0, held, rtol=1e-5, atol=1e-12)


def test_a_cavity_from_its_surface(hollow):
    nodes, tetrahedra = hollow.mesh.nodes, hollow.mesh.tetrahedra
    model = MechanicalModel.from_mesh(nodes, tetrahedra, fixed=lambda x: x[:, 0] < 1e-9, element="linear")
    found = model.add_cavity("air", inside=[0.03, 0.01, 0.01])
    again = model.add_cavity("same", surface=found.triangles)
    assert again.rest_volume == found.rest_volume
    with pytest.raises(ValueError, match="cavity 'air' needs either its 'surface' or a point 'inside' it"):
        model.add_cavity("air")
    with pytest.raises(ValueError, match="surface of cavity 'open' is not closed"):
        model.add_cavity("open", surface=found.triangles[1:])
    quadratic = MechanicalModel.from_mesh(nodes, tetrahedra, fixed=lambda x: x[:, 0] < 1e-9, element="quadratic")
    assert quadratic.add_cavity("air", surface=found.triangles).rest_volume == pytest.approx(found.rest_volume)
    with pytest.raises(ValueError, match="not joined by an edge of the quadratic elements"):
        corners = hollow.mesh.tetrahedra[[0, -1]].ravel()
        quadratic.add_cavity("strange", surface=corners[[[0, 1, 6], [0, 6, 2], [1, 2, 6], [0, 2, 1]]])


def test_a_point_in_the_material_or_outside_is_in_no_cavity(hollow, box):
    model = MechanicalModel.from_mesh(
        hollow.mesh.nodes, hollow.mesh.tetrahedra, fixed=lambda x: x[:, 0] < 1e-9, element="linear"
    )
    for point in ([0.01, 0.01, 0.01], [0.03, 0.01, 0.03]):
        with pytest.raises(ValueError, match=r"no closed cavity .* for 'air'; its cavities lie around \[\[0.03"):
            model.add_cavity("air", inside=point)
    nodes, tetrahedra = box((0.1, 0.02, 0.02))
    solid = MechanicalModel.from_mesh(nodes, tetrahedra, fixed=lambda x: x[:, 0] < 1e-9, element="linear")
    with pytest.raises(ValueError, match="it has none, or they are open to the outside"):
        solid.add_cavity("air", inside=[0.05, 0.01, 0.01])


def pierced():
    """A bar with one corner pushed out through the opposite side."""
    points, triangles = cuboid((0, 0, 0), (60, 20, 20))
    points[7] = [30, 9, -10]
    return points, triangles


FAULTS = {
    "open": ([(BAR[0], BAR[1][:-1])], r"the surface of '.*body.stl' is open: 3 edges belong to one triangle only"),
    "pierced": ([pierced()], r"the surface of '.*body.stl' intersects itself near \["),
    "crossing": ([BAR, cuboid((50, 5, 5), (90, 15, 15))], "intersects itself near"),
    "touching": ([BAR, cuboid((10, 20, 5), (30, 30, 15))], "two of its closed shells overlap"),
    "two bodies on one edge": ([BAR, cuboid((60, 20, 0), (70, 30, 20))], "touches itself: 1 edges belong to more than"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faulty_surfaces_are_rejected(tmp_path, fault):
    parts, message = FAULTS[fault]
    with pytest.raises(DataError, match=message):
        read_mesh(write_stl(tmp_path, *parts), unit="mm")


@pytest.mark.parametrize(
    ("size", "message"),
    [
        (6.0, r"mesh_size = 6 m is larger than the body, whose diagonal is 0.0663 m; did you mean metres\?"),
        (0.0, "mesh_size = 0.0 m must be positive"),
        (np.nan, r"mesh_size = nan must be one finite number \[m\]"),
        ("6 mm", r"mesh_size = .6 mm. must be a number \[m\]"),
    ],
)
def test_malformed_mesh_sizes_are_rejected(tmp_path, size, message):
    with pytest.raises(ValueError, match=message):
        read_mesh(write_stl(tmp_path, BAR), unit="mm", mesh_size=size)


def test_meshing_has_a_time_limit(tmp_path):
    with pytest.raises(MeshingError, match=r"12 triangles, .* 0.00332 m took longer than .* 0.01 s of CPU time; pass"):
        read_mesh(write_stl(tmp_path, BAR), unit="mm", time_limit=0.01)


def test_a_missing_gmsh_is_reported(tmp_path, monkeypatch):
    (tmp_path / "gmsh.py").write_text("raise ImportError('libGLU.so.1: cannot open shared object file')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MeshingError, match="gmsh cannot be used: libGLU"):
        read_mesh(write_stl(tmp_path, BAR), unit="mm")


def test_inside_and_outside_of_a_surface(rng):
    points, triangles = BAR
    for point in rng.uniform(-20.0, 80.0, (200, 3)):
        assert encloses(points, triangles, point) == bool(((point > 0) & (point < [60, 20, 20])).all())
    assert self_intersection(*joined(BAR, HOLE)) is None
    assert enclosed_volume(*HOLE) < 0.0
