"""The sensorized finger: its cavities as sensors, published objectives, and shapes that cannot exist."""

from __future__ import annotations

import math

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.envs.plant import Plants
from softgym_envs.errors import DesignError, InfeasibleDesign
from softgym_envs.mechanics import gmsh_process
from softgym_envs.mechanics.constraints.cavity import ATMOSPHERE, enclosed_volume
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.geometry.finger_shape import check_finger
from softgym_envs.robots.geometry.meshing import BodyMesh

MM = 1e-3


@pytest.fixture(scope="module", params=[2, 4], ids=["2 cavities", "4 cavities"])
def robot(request):
    return make_robot("sensorized_finger", cavities=request.param)


@pytest.fixture(scope="module")
def readings(robot):
    return robot.readings()


def exact_cavity_volume(lengths):
    """Half a turned trapezoid above the cork, by integration over z [mm3]."""
    full, flat = lengths["bellow_height"] / 2, lengths["plateau_height"] / 2
    inner, outer = 8.75 - lengths["wall_thickness"], lengths["outer_radius"] - lengths["wall_thickness"]
    z = np.linspace(0.0, full, 20001)
    radius = np.where(z < flat, outer, outer + (inner - outer) * (z - flat) / (full - flat))
    cork = lengths["cork_thickness"]
    half_width = np.sqrt(np.maximum(radius**2 - cork**2, 0.0))
    area = radius**2 * np.arccos(np.minimum(cork / radius, 1.0)) - cork * half_width
    # To second order in its thickness, the wall in the middle is a slab.
    area -= 2 * lengths.get("split", 0.0) * np.maximum(radius - cork, 0.0)
    return 2 * np.trapezoid(area, z)


# -- cavities -------------------------------------------------------------------------------------------------------


def test_baseline_meshes_are_shipped(robot, monkeypatch, tmp_path):
    """The first use of a robot needs neither gmsh nor a cache."""
    monkeypatch.setenv("SOFTGYM_CACHE", str(tmp_path))

    def refuse(*_, **__):
        raise AssertionError("gmsh was called")

    monkeypatch.setattr(gmsh_process.subprocess, "run", refuse)
    assert 500 < len(robot.body().nodes) < 800
    assert not list(tmp_path.iterdir())


def test_cavities_are_found_in_order_from_the_base_and_from_minus_x(robot):
    mesh = robot.body()
    cavities = mesh.cavities()
    middles = np.array([mesh.nodes[np.unique(part)].mean(axis=0) for part in cavities])
    if robot.cavities == 2:
        np.testing.assert_allclose(middles[:, 2], [-0.040, -0.080], atol=1e-3)
    else:
        np.testing.assert_allclose(middles[:, 2], [-0.040, -0.040, -0.080, -0.080], atol=1e-3)
        assert (np.sign(middles[:, 0]) == [-1, 1, -1, 1]).all()
    # Seen counter-clockwise from inside the hollow; hull and cavities together bound the material.
    volumes = [enclosed_volume(mesh.nodes, part) for part in cavities]
    assert max(volumes) < 0.0
    corners = mesh.nodes[mesh.tetrahedra]
    material = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])).sum() / 6.0
    assert enclosed_volume(mesh.nodes, mesh.surface()) == pytest.approx(material, rel=1e-9)


def test_cavities_have_the_exact_volume_except_for_facets():
    """The facets of a 7 mm mesh cut 4 % off, those of a 3 mm mesh 1.2 %."""
    robot = make_robot("sensorized_finger")
    exact = exact_cavity_volume(robot.lengths(robot.design_space.baseline))
    assert exact == pytest.approx(809.29, abs=0.01)  # by the CAD kernel
    coarse = [-1e9 * enclosed_volume(robot.body().nodes, part) for part in robot.body().cavities()]
    np.testing.assert_allclose(coarse, 0.96 * exact, rtol=0.01)


def test_a_solid_block_has_no_cavities(box):
    nodes, tetrahedra = box((1, 1, 1), (2, 2, 2))
    none = np.empty((0, 3), dtype=np.int64)
    mesh = BodyMesh(nodes, tetrahedra, none, none[:, 0])
    assert mesh.cavities() == []
    assert enclosed_volume(nodes, mesh.surface()) == pytest.approx(1.0)


# -- sensors --------------------------------------------------------------------------------------------------------


def test_sensor_rows_are_changes_of_volume_and_W_is_their_derivative(robot):
    model = robot.build()
    assert model.roles == (("a", 1), ("e", 3), ("s", robot.cavities))
    statics = Statics(model)
    assert np.abs(statics.solve([0.0]).condensed.delta.s).max() < 1e-18
    state = statics.solve([0.006])
    volumes = [sensor.volume(state.x) - sensor.rest_volume for sensor in model.constraints["s"]]
    np.testing.assert_allclose(state.condensed.delta.s, volumes, rtol=1e-9)
    assert max(volumes) < 0.0
    step = 1e-6
    tension = state.effort[0]
    low, high = (statics.solve([tension + s * step], "effort").condensed.delta.s for s in (-1, 1))
    W = state.condensed.W
    np.testing.assert_allclose(W.sa[:, 0], (high - low) / (2 * step), rtol=1e-4)
    assert np.linalg.eigvalsh(state.condensed.compliance)[0] > 0.0
    # Sensors carry no effort.
    assert not state.condensed.lambda_.s.any()


def test_sealed_cavities_show_pressures_and_stiffen_the_finger(robot, readings):
    sealed = make_robot("sensorized_finger", cavities=robot.cavities, sealed=True)
    model = sealed.build()
    statics = Statics(model)
    assert np.abs(statics.solve([0.0]).condensed.delta.s).max() < 1e-6
    state = statics.solve([0.010])
    pressures = state.condensed.delta.s
    np.testing.assert_allclose(pressures, sealed.sensing.scale, rtol=0.05)
    found = sealed.readings()
    np.testing.assert_allclose((ATMOSPHERE + pressures) * found.pulled_volumes, ATMOSPHERE * np.array(found.volumes))
    assert found.relative_volume_change == pytest.approx(pressures[0] / ATMOSPHERE)
    assert found.tension > 1.003 * readings.tension
    step = 1e-3
    low, high = (statics.solve([state.effort[0] + s * step], "effort").condensed.delta.s for s in (-1, 1))
    np.testing.assert_allclose(state.condensed.W.sa[:, 0], (high - low) / (2 * step), rtol=1e-4)
    assert sealed.learning.stiffness_variable is None and sealed.learning.weights.endswith("_sealed")
    with pytest.raises(ValueError, match="sealed air"):
        Plants.check({"stiffness": 1.2}, sealed, "fem")


def test_readings_of_the_baseline(robot, readings):
    """Measured here; thesis table 3.1 has 41.5 mm3 and 21.1 degrees for a cable that lies 2.2 mm higher."""
    assert readings.stable
    change = 57.5 if robot.cavities == 2 else 22.1
    assert 1e9 * readings.volume_change == pytest.approx(change, rel=0.02)
    assert math.degrees(readings.bending_angle) == pytest.approx(22.8 if robot.cavities == 2 else 23.4, abs=0.2)
    assert readings.tension == pytest.approx(16.0, rel=0.02)
    assert readings.volume_change == pytest.approx(readings.volumes[0] - readings.pulled_volumes[0], rel=1e-12)
    assert readings.initial_volume == readings.volumes[0]
    assert readings.relative_volume_change == pytest.approx(readings.volume_change / readings.pulled_volumes[0])
    assert len(readings.volumes) == robot.cavities
    if robot.cavities == 2:
        assert readings.pressure_sensitivity is None and readings.pushed_volumes is None


def test_four_cavities_distinguish_a_lateral_force_from_a_pull():
    robot = make_robot("sensorized_finger", cavities=4)
    readings = robot.readings(lateral_force=5.0)
    mirrored = robot.readings(lateral_force=-5.0)
    rest, pulled, pushed = (np.array(v) for v in (readings.volumes, readings.pulled_volumes, readings.pushed_volumes))
    left, right = (pulled - rest)[:2]
    assert left == pytest.approx(right, rel=0.05)  # symmetric about x = 0, except for the mesh
    left, right = (pushed - rest)[:2]
    assert left > 0.0 > right
    assert mirrored.pushed_volumes[0] < rest[0] < mirrored.pushed_volumes[1]
    # Over the volume at rest (thesis, sec. 3.3.6), unlike f3, which is over the volume under the pull (eq. 3.4).
    changes = [abs(other[0] - rest[0]) / rest[0] for other in (pulled, pushed)]
    assert readings.pressure_sensitivity == pytest.approx(min(changes), rel=1e-12)
    # Beyond the force, nothing is bent.
    assert np.abs(pushed - rest)[2:].max() < 0.1 * np.abs(pushed - rest)[:2].min()


def test_readings_depend_on_the_ratio_of_force_to_stiffness_alone():
    robot = make_robot("sensorized_finger", cavities=4)
    soft, stiff = robot.readings(lateral_force=2.0), robot.readings({"young_modulus": 6e6}, lateral_force=4.0)
    np.testing.assert_allclose(soft.pushed_volumes, stiff.pushed_volumes, rtol=1e-9)
    np.testing.assert_allclose(soft.pulled_volumes, stiff.pulled_volumes, rtol=1e-9)
    assert stiff.tension == pytest.approx(2.0 * soft.tension, rel=1e-6)


def test_options_move_the_tip_and_the_cable():
    plain = make_robot("sensorized_finger").readings()
    middle = make_robot("sensorized_finger", tip_height=0.010).readings()
    assert middle.volume_change == pytest.approx(plain.volume_change, rel=1e-6)
    # The point starts 10 mm off the axis of a 120 mm finger.
    assert middle.bending_angle - plain.bending_angle == pytest.approx(0.010 / 0.120, rel=0.05)
    high = make_robot("sensorized_finger", cable_clearance=0.003).readings()
    assert high.bending_angle < plain.bending_angle
    assert high.tension < plain.tension
    hanging = make_robot("sensorized_finger", gravity=(0.0, 0.0, -9.81))
    assert hanging.learning.stiffness_variable is None
    assert hanging.readings().bending_angle < plain.bending_angle


def test_the_design_space_starts_with_the_seven_variables(robot):
    names = ["slope", "outer_radius", "joint_height", "bellow_height", "wall_thickness", "cork_thickness"]
    names += ["plateau_height"] + (["split"] if robot.cavities == 4 else []) + ["young_modulus", "poisson_ratio"]
    assert list(robot.design_space.names) == names


def test_moved_meshes_where_they_are_good():
    robot = make_robot("sensorized_finger", meshing="morph")
    near = {"outer_radius": 14.0 * MM, "joint_height": 6.3 * MM}
    moved, fresh = robot.body(near), make_robot("sensorized_finger").body(near)
    assert (moved.origin, fresh.origin) == ("morphed", "meshed")
    assert robot.body({"outer_radius": 9.0 * MM}).origin == "remeshed"
    volumes = [enclosed_volume(mesh.nodes, mesh.surface()) for mesh in (moved, fresh)]
    assert volumes[0] == pytest.approx(volumes[1], rel=1e-3)


# -- shapes that cannot exist ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("design", "message"),
    [
        ({"slope": 0.97, "joint_height": 6.2 * MM}, "the notches meet: 2 x 20.1"),
        ({"outer_radius": 8.75 * MM, "wall_thickness": 4 * MM, "cork_thickness": 5 * MM}, "the cavity vanishes"),
    ],
    ids=str,
)
def test_closed_formulas_detect_infeasible_shapes_without_meshing(robot, monkeypatch, design, message):
    def refuse(*_, **__):
        raise AssertionError("gmsh was called")

    monkeypatch.setattr(gmsh_process.subprocess, "run", refuse)
    for verb in (robot.body, robot.build, robot.readings):
        with pytest.raises(InfeasibleDesign, match=message):
            verb(design)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"joint_height": 20.0}, "there is no notch"),
        ({"slope": 0.0}, "there is no notch"),
        ({"plateau_height": 8.0}, "a plateau of 8.00 mm on a bellow of 8.00 mm"),
        ({"joint_height": 2.0, "bellow_height": 4.0, "slope": 0.8, "length": 60.0}, "the cavity opens into the notch"),
        ({"cork_thickness": 11.75}, "the cavity vanishes"),
        ({"split": 11.5}, "the cavity vanishes"),
    ],
    ids=str,
)
def test_other_shapes_that_cannot_exist(change, message):
    robot = make_robot("sensorized_finger")
    lengths = robot.lengths(robot.design_space.baseline)
    check_finger(lengths)
    with pytest.raises(InfeasibleDesign, match=message):
        check_finger(lengths | change)


@pytest.mark.parametrize("clearance", [-0.009, 0.006])
def test_a_cable_outside_the_segments(clearance):
    with pytest.raises(InfeasibleDesign, match="the cable must pass"):
        make_robot("sensorized_finger", cable_clearance=clearance).body()


def test_the_limit_of_the_notches_is_where_meshing_ends():
    robot = make_robot("sensorized_finger", mesh_size=0.015)
    limit = math.atan(20.0 / 14.0)
    assert len(robot.body({"slope": limit - 0.01}).cavities()) == 2
    with pytest.raises(InfeasibleDesign):
        robot.body({"slope": limit + 1e-9})


@pytest.mark.parametrize(
    ("options", "message"),
    [({"cavities": 3}, "cavities = 3 is unknown; allowed: 2, 4"), ({"mesh_size": -1.0}, "mesh_size")],
    ids=str,
)
def test_wrong_options(options, message):
    with pytest.raises(ValueError, match=message):
        make_robot("sensorized_finger", **options)


def test_malformed_designs():
    with pytest.raises(DesignError, match="'outer_radius' = 0.02 m is out of bounds"):
        make_robot("sensorized_finger").readings({"outer_radius": 0.02})
