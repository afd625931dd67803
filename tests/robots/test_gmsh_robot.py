"""Robots that gmsh draws: named faces, meshes that follow the drawing, exact shapes."""

from __future__ import annotations

import re

import gmsh
import numpy as np
import pytest

from softgym_envs import DesignSpace, DesignVariable
from softgym_envs.errors import InfeasibleDesign, MeshingError
from softgym_envs.extensions.deployment.cad import export_body
from softgym_envs.extensions.deployment.moulds import export_moulds
from softgym_envs.mechanics import Statics
from softgym_envs.robots import Actuator, GmshRobot
from softgym_envs.robots.geometry.morphing import mean_ratio


class Bellows(GmshRobot):
    """A block with a cylindrical chamber; below a length it has a notch, so other faces."""

    name = "bellows"
    effectors = ("top",)
    size = 0.04
    effector_rest = (0.0, 0.0, 0.04)
    effort_scale = (1e4,)
    mesh_size = 0.008
    young_modulus = 1e5
    design_space = DesignSpace(
        DesignVariable("height", 0.02, 0.06, 0.04, "m", "height of the block"),
        DesignVariable("radius", 0.003, 0.02, 0.006, "m", "radius of the chamber"),
    )
    actuators = (Actuator("chamber", 0.0, 1e-6, 1e-7, unit="m3"),)

    def __init__(self, *, side: float = 0.02, **options):
        super().__init__(**options)
        self.side = side

    def draw(self, design):
        """Cut a cylinder out of a block."""
        side, height, radius = self.side, design["height"], design["radius"]
        if radius > 0.5 * side:
            raise InfeasibleDesign(f"a chamber of radius {radius:g} m leaves a block of side {side:g} m")
        block = gmsh.model.occ.addBox(-0.5 * side, -0.5 * side, 0, side, side, height)
        cuts = [(3, gmsh.model.occ.addCylinder(0, 0, 0.005, 0, 0, height - 0.010, radius))]
        if height < 0.03:
            cuts.append((3, gmsh.model.occ.addBox(-side, -side, 0.5 * height, side, side, 0.002)))
        gmsh.model.occ.cut([(3, block)], cuts)
        self.name_faces("fixed", z=0.0)
        self.name_faces("chamber", x=(-radius, radius), y=(-radius, radius), z=(0.005, height - 0.005))

    def equip(self, model, design):
        """Put the effector on top."""
        model.add_effector("top", [0.0, 0.0, design["height"]])


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SOFTGYM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "meshes"


def volume(mesh):
    corners = mesh.nodes[mesh.tetrahedra]
    return float(np.linalg.det(corners[:, 1:] - corners[:, :1]).sum()) / 6.0


def step_volume(path):
    """Volume of the one solid in a STEP file [mm3]."""
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.occ.importShapes(str(path))
        gmsh.model.occ.synchronize()
        ((_, body),) = gmsh.model.getEntities(3)
        return gmsh.model.occ.getMass(3, body)
    finally:
        gmsh.finalize()


def test_one_mesh_follows_all_designs_with_the_same_faces():
    robot = Bellows()
    reference = robot.body()
    chamber = np.unique(reference.faces_of("chamber"))
    assert reference.nodes_on("fixed").tolist() == (reference.nodes[:, 2] < 1e-9).tolist()
    for height, radius in ((0.05, 0.0045), (0.035, 0.008), (0.06, 0.006)):
        moved = robot.body({"height": height, "radius": radius})
        assert moved.origin == "morphed" and np.array_equal(moved.tetrahedra, reference.tetrahedra)
        low, high = moved.nodes.min(axis=0), moved.nodes.max(axis=0)
        np.testing.assert_allclose([low, high], [[-0.01, -0.01, 0.0], [0.01, 0.01, height]], atol=1e-9)
        x, y, z = moved.nodes[chamber].T
        wall = (z > 0.005 + 1e-9) & (z < height - 0.005 - 1e-9)
        assert wall.any()
        np.testing.assert_allclose(np.hypot(x, y)[wall], radius, rtol=1e-6)
        assert mean_ratio(moved.nodes, moved.tetrahedra).min() > 0.1


def test_the_reference_design_keeps_its_mesh():
    robot = Bellows()
    np.testing.assert_allclose(robot.body().nodes, robot.mesh(robot.design_space.baseline).nodes, atol=1e-12)


def test_a_moved_body_is_as_stiff_as_one_that_is_meshed_anew():
    design = {"height": 0.05}  # with the same circles, which are polygons in the mesh
    compliance = [
        Statics(robot.build(design)).solve([0.0]).condensed.W.array[0, 0]
        for robot in (Bellows(mesh_size=0.004), Bellows(mesh_size=0.004, meshing="remesh"))
    ]
    assert compliance[0] == pytest.approx(compliance[1], rel=0.02)


def test_work_of_a_chamber():
    """The change of the chamber's volume that is commanded is that of its triangles, which face inwards."""
    robot = Bellows()
    model = robot.build()
    (chamber,) = model.constraints["a"]
    state = Statics(model).solve([2e-8])
    change = chamber.value(state.x) - chamber.value(model.nodes)
    assert change == pytest.approx(2e-8, rel=1e-6) and state.effort[0] > 0.0


def test_other_faces_are_meshed_anew():
    robot = Bellows()
    notched = robot.body({"height": 0.025})
    assert notched.origin == "remeshed" and len(notched.groups["chamber"]) == 3
    assert volume(notched) < 0.02**2 * 0.025


def test_options_and_code_are_part_of_what_is_kept(cache, monkeypatch):
    wide, narrow = Bellows(side=0.03), Bellows(side=0.02)
    assert volume(wide.body()) > 1.5 * volume(narrow.body())
    assert len(list(cache.glob("*.npz"))) == 2
    Bellows(side=0.02).body()
    assert len(list(cache.glob("*.npz"))) == 2


def test_the_step_file_is_the_exact_shape_in_millimetres(tmp_path):
    path = export_body(Bellows(), tmp_path / "body.step", {"height": 0.05})
    assert re.search(r"SI_UNIT\(\.MILLI\.,\.METRE\.\)", path.read_text())
    assert step_volume(path) == pytest.approx(20.0**2 * 50.0 - np.pi * 6.0**2 * 40.0, rel=1e-6)


def test_a_mould_is_a_block_less_the_body_and_the_cores_of_its_chambers(tmp_path):
    """Open where the body is clamped, at z = 0; walls of 3 mm elsewhere."""
    files = export_moulds(Bellows(), tmp_path, {"height": 0.05}, formats=(".step",))
    assert [file.stem for file in files] == ["low", "high", "core_chamber"]
    half = 0.5 * (26.0**2 * 53.0 - 20.0**2 * 50.0)
    for file, exact in zip(files, (half, half, np.pi * 6.0**2 * 40.0), strict=True):
        assert step_volume(file) == pytest.approx(exact, rel=1e-4)  # gmsh's boxes are larger by 1e-7 m


def test_impossible_shapes():
    with pytest.raises(InfeasibleDesign, match="a chamber of radius"):
        Bellows(meshing="remesh").body({"radius": 0.015})
    with pytest.raises(InfeasibleDesign, match="a chamber of radius"):
        Bellows().body({"radius": 0.015})


class Nameless(Bellows):
    """Names a face that does not exist."""

    def draw(self, design):
        """Draw, and name nothing."""
        super().draw(design)
        self.name_faces("lid", z=1.0)


class Unclamped(Bellows):
    """Names no face."""

    def draw(self, design):
        """Draw only."""
        gmsh.model.occ.addBox(0, 0, 0, 0.02, 0.02, design["height"])


class Undrawn(Bellows):
    """Forgets to draw."""

    draw = GmshRobot.draw


class Massless(Bellows):
    """Has no stiffness."""

    @property
    def young_modulus(self):
        """Not defined."""
        raise AttributeError


@pytest.mark.parametrize(
    ("robot", "error", "message"),
    [
        (Nameless, MeshingError, r"no face for 'lid' lies in x, y, z from .*1\.0"),
        (Unclamped, ValueError, "unknown group of faces 'fixed'"),
        (Undrawn, ValueError, "has no exact shape|defines neither draw nor mesh"),
        (Massless, TypeError, "defines no young_modulus, neither as an attribute nor as a design variable"),
    ],
)
def test_mistakes_are_named(robot, error, message):
    with pytest.raises(error, match=message):
        robot().build()
