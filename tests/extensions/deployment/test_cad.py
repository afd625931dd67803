"""Bodies and moulds as files: units, closed surfaces, volumes that add up, and clear errors."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.errors import DesignError, InfeasibleDesign
from softgym_envs.extensions.deployment.cad import export_body, write_drawing
from softgym_envs.extensions.deployment.moulds import MOULD_PARTS, WALL, WIRE_RADIUS, export_moulds, mould_parts
from softgym_envs.mechanics.constraints.cavity import enclosed_volume
from softgym_envs.robots.geometry.finger_shape import draw_finger

FINGERS = [
    ("finger", {"cables": 1}, {}),
    ("finger", {"cables": 2}, {"height": 0.021}),
    ("sensorized_finger", {}, {}),
    ("sensorized_finger", {"cavities": 4}, {"slope": 0.4, "bellow_height": 0.011}),
    ("sensorized_finger", {}, {"outer_radius": 0.0091, "slope": 0.878, "cork_thickness": 0.00214}),
]


@pytest.fixture
def occ():
    """The CAD kernel of gmsh, in this process."""
    import gmsh

    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    try:
        yield gmsh.model.occ
    finally:
        gmsh.finalize()


def draw(occ, build, parameters):
    """Draw into the current model; returns the added volumes."""
    before = set(occ.getEntities(3))
    build(**parameters)
    return sorted(set(occ.getEntities(3)) - before)


def volume(occ, entities):
    return sum(occ.getMass(*e) for e in entities if e[0] == 3)


def common(occ, entities, others):
    """Volume of the intersection; both stay."""
    shared, _ = occ.intersect(entities, others, removeObject=False, removeTool=False)
    result = volume(occ, shared)
    occ.remove([e for e in shared if e not in entities + others], recursive=True)
    return result


def read_stl(path):
    """Corners of the triangles of a binary STL, shape (k, 3, 3)."""
    content = path.read_bytes()
    count = int(np.frombuffer(content, "<u4", 1, 80)[0])
    assert len(content) == 84 + 50 * count
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    return np.frombuffer(content, record, count, 84)["corners"].astype(float)


def check_closed(corners):
    """Return the enclosed volume of a closed, consistently oriented surface."""
    points, ids = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    triangles = ids.reshape(-1, 3)
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    np.testing.assert_array_equal(np.unique(edges, axis=0), np.unique(edges[:, ::-1], axis=0))
    return enclosed_volume(points, triangles)


# -- bodies ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["finger", "sensorized_finger"])
def test_bodies_as_files_in_millimetres(name, tmp_path, occ):
    robot = make_robot(name)
    mesh = robot.body()
    path = export_body(robot, tmp_path / "body.stl")
    corners = read_stl(path)
    assert check_closed(corners) == pytest.approx(1e9 * enclosed_volume(mesh.nodes, mesh.surface()), rel=1e-5)
    assert np.ptp(corners[..., 2]) == pytest.approx(120.0, abs=1e-3)
    path = export_body(robot, tmp_path / "new folder" / "body.step")
    assert "SI_UNIT(.MILLI.,.METRE.)" in path.read_text()
    entities = occ.importShapes(str(path))
    low, high = np.array(occ.getBoundingBox(*entities[0])).reshape(2, 3)
    assert high[2] - low[2] == pytest.approx(120.0, abs=1e-3)
    # Facets cut the bellows' outside and their cavities.
    assert volume(occ, entities) == pytest.approx(1e9 * enclosed_volume(mesh.nodes, mesh.surface()), rel=0.005)


@pytest.mark.parametrize("mesh", ["published", "accurate"])
def test_files_of_a_printed_finger_have_its_exact_shape(mesh, tmp_path, occ):
    """The outline has flat sides only, so no mesh cuts it."""
    robot = make_robot("contact_aided_finger", mesh=mesh, control_points=7)
    x, y = 1e3 * robot.outline(robot.design_space.baseline).T
    exact = 20.0 * 0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))
    assert check_closed(read_stl(export_body(robot, tmp_path / "body.stl"))) == pytest.approx(exact, rel=1e-5)
    entities = occ.importShapes(str(export_body(robot, tmp_path / "body.step")))
    assert volume(occ, entities) == pytest.approx(exact, rel=1e-9)


def test_designs_change_the_files(tmp_path):
    robot = make_robot("finger")
    corners = read_stl(export_body(robot, tmp_path / "body.stl", {"length": 0.042}))
    assert np.ptp(corners[..., 2]) == pytest.approx(126.0, abs=1e-3)


def test_both_fingers_are_one_drawing(occ):
    """Moulds draw the Soft Finger by the function of the sensorized one."""
    robot = make_robot("finger")
    body = draw(occ, *robot.drawing(robot.design_space.baseline))
    again = draw(occ, draw_finger, mould_parts(robot)["lid"][1]["lengths"])
    assert volume(occ, body) == pytest.approx(volume(occ, again), rel=1e-9)
    assert common(occ, body, again) == pytest.approx(volume(occ, body), rel=1e-6)


@pytest.mark.parametrize(
    ("name", "file", "design", "error", "message"),
    [
        ("finger", "body.obj", None, ValueError, r"must end with \.step or \.stl"),
        ("finger", "body", None, ValueError, r"must end with \.step or \.stl"),
        ("finger", "body.stl", {"length": 1.0}, DesignError, "out of bounds"),
        ("sensorized_finger", "body.step", {"slope": 1.04}, InfeasibleDesign, "the notches meet"),
        ("sensorized_finger", "body.stl", {"slope": 1.04}, InfeasibleDesign, "the notches meet"),
        ("trunk", "body.step", None, ValueError, "has no exact shape"),
    ],
)
def test_errors_leave_no_files_behind(name, file, design, error, message, tmp_path):
    with pytest.raises(error, match=message):
        export_body(make_robot(name), tmp_path / file, design)
    assert list(tmp_path.iterdir()) == []


def test_a_drawing_that_fails_or_takes_too_long_leaves_no_files_behind(tmp_path):
    robot = make_robot("finger")
    draw_body, lengths = robot.drawing(robot.design_space.baseline)
    with pytest.raises(InfeasibleDesign, match="the notches meet"):
        write_drawing((draw_body, lengths | {"slope": 1.4}), tmp_path / "body.step")
    with pytest.raises(InfeasibleDesign, match="took longer than"):
        write_drawing((draw_body, lengths), tmp_path / "body.step", time_limit=0.01)
    assert list(tmp_path.iterdir()) == []


# -- moulds ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "options", "design"), FINGERS, ids=lambda p: str(p))
def test_the_cast_parts_form_the_body(name, options, design, occ):
    import gmsh

    robot = make_robot(name, **options)
    parts = mould_parts(robot, design)
    assert tuple(parts) == MOULD_PARTS
    lengths, wires = parts["box"][1]["lengths"], parts["box"][1]["wires"]

    body = draw(occ, *robot.drawing(robot.design_space.complete(design)))
    cavities = draw(occ, draw_finger, lengths | {"part": "cavities"})
    tray, lid, box, clamp = (draw(occ, *parts[part]) for part in ("cork", "lid", "box", "clamp"))
    for part in (tray, lid, box, clamp):
        assert len(part) == 1
        assert volume(occ, part) > 1000.0
    # The plugs: what is missing from a block to make the tray.
    low, high = np.array(occ.getBoundingBox(*tray[0])).reshape(2, 3)
    plugs = np.prod(high - low) - volume(occ, tray)
    assert plugs == pytest.approx(common(occ, lid, body), rel=1e-4)  # the cores stand where the plugs go
    assert common(occ, lid, cavities) == pytest.approx(volume(occ, cavities), rel=1e-6)  # and fill the cavities
    assert common(occ, box, body) == pytest.approx(0.0, abs=1e-6)
    assert common(occ, clamp, body) == pytest.approx(0.0, abs=1e-6)
    assert common(occ, box, lid) == pytest.approx(0.0, abs=1e-6)
    # The closed mould leaves room for the body without its plugs and, in the box, for the wires.
    low, high = np.array(occ.getBoundingBox(*box[0])).reshape(2, 3)
    block = np.prod(high - low)
    bores = [(3, occ.addCylinder(x, y, low[2], 0, 0, high[2] - low[2], WIRE_RADIUS)) for x, y in wires]
    in_silicone = common(occ, bores, body)
    assert common(occ, bores, cavities) == pytest.approx(0.0, abs=1e-6)
    in_box = volume(occ, bores) - in_silicone
    # Volume of the lid inside the mould. Start at half the height of the plugs and keep clear of the rim: with
    # coincident faces, gmsh finds an empty intersection in about one run in fifty.
    middle = lengths["cork_thickness"] / 2
    inside = occ.addBox(low[0] - 0.05, middle, low[2] - 0.05, *(high - low + 0.1))
    in_lid = common(occ, lid, [(3, inside)]) + plugs / 2
    cast = block - volume(occ, box) - in_lid - in_box
    assert cast == pytest.approx(volume(occ, body) - plugs, rel=1e-5)
    assert low[1] == pytest.approx(0.0, abs=1e-5) and gmsh.model is not None
    assert high[2] == pytest.approx(WALL, abs=1e-5)


def test_mould_files_are_closed(tmp_path, occ):
    files = export_moulds(make_robot("sensorized_finger"), tmp_path / "moulds")
    assert [file.name for file in files] == [f"{part}{e}" for part in MOULD_PARTS for e in (".step", ".stl")]
    for step, stl in zip(files[::2], files[1::2], strict=True):
        entities = occ.importShapes(str(step))
        assert check_closed(read_stl(stl)) == pytest.approx(volume(occ, entities), rel=0.003)


def test_moulds_need_a_feasible_finger(tmp_path):
    with pytest.raises(ValueError, match="robot 'trunk' has no moulds; allowed: robots that draw"):
        mould_parts(make_robot("trunk"))
    with pytest.raises(InfeasibleDesign, match="the notches meet"):
        export_moulds(make_robot("sensorized_finger"), tmp_path / "moulds", {"slope": 1.04})
    assert list(tmp_path.iterdir()) == []


# -- command line ---------------------------------------------------------------------------------------------------


def test_command_line(softgym, tmp_path):
    step, stl = tmp_path / "body.step", tmp_path / "body.stl"
    arguments = ["finger", step, stl, "--option", "cables=1", "--design", "length=0.041", "--moulds", tmp_path / "m"]
    status, out, _ = softgym("export", *arguments)
    assert status == 0
    assert f"wrote {stl} (millimetres)" in out
    assert np.ptp(read_stl(stl)[..., 2]) == pytest.approx(123.0, abs=1e-3)
    assert len(list((tmp_path / "m").iterdir())) == 8


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["finger"], ["nothing to write", "--moulds"]),
        (["finger", "body.obj"], ["body.obj", ".step", ".stl"]),
        (["octopus", "body.stl"], ["octopus", "finger"]),
        (["finger", "body.stl", "--design", "length=1"], ["length", "0.038"]),
        (["sensorized_finger", "body.step", "--design", "slope=1.04"], ["the notches meet"]),
        (["trunk", "--moulds", "moulds"], ["robot 'trunk' has no moulds"]),
    ],
)
def test_bad_input_is_one_line_and_status_two(refused, arguments, words):
    line = refused("export", *arguments)
    for word in words:
        assert word in line
