"""Meshes by name: options, keys, and what each mesh of a robot must keep."""

from __future__ import annotations

import json
from dataclasses import replace

import gmsh
import numpy as np
import pytest

from softgym_envs.errors import InfeasibleDesign
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.geometry.graded_finger import draw_half_finger
from softgym_envs.robots.mesh_tiers import MeshTier
from softgym_envs.robots.registry import make_robot

NAMES = ("published", "accurate", "reference")
ROBOTS = (
    "finger",
    "diamond",
    "cable_trunk",
    "sensorized_finger",
    "trunk",
    "tetrapod",
    "contact_aided_finger",
    "two_finger_gripper",
    "grasping_finger",
)


@pytest.fixture(scope="module")
def finger():
    return make_robot("finger", mesh="accurate", mesh_size=16e-3)


@pytest.mark.parametrize("name", ROBOTS)
def test_every_robot_has_three_meshes_with_keys_of_their_own(name):
    keys = [make_robot(name, mesh=mesh).mechanics_key for mesh in NAMES]
    assert len({json.dumps(key, sort_keys=True) for key in keys}) == len(NAMES)
    assert "mesh" not in keys[0]  # weights that were learned before meshes had names
    with pytest.raises(ValueError, match="unknown mesh 'accurat'; did you mean 'accurate'"):
        make_robot(name, mesh="accurat")


def test_options_replace_parts_of_a_mesh():
    tier = MeshTier(0.010, "quadratic", feature_size=0.002, fillet=1e-3, guide_radius=1e-3, guide_size=4e-3)
    same = {"size": None, "element": None, "fillet": None, "guide_radius": None}
    assert tier.changed("arm", **same) == tier
    finer = tier.changed("arm", **same | {"size": 0.005})
    assert finer == MeshTier(0.005, "quadratic", feature_size=0.001, fillet=1e-3, guide_radius=1e-3, guide_size=2e-3)
    assert tier.changed("arm", **same | {"element": "linear", "fillet": 0.0}).fillet == 0.0
    assert tier.changed("arm", **same | {"guide_radius": 0}) == replace(tier, guide_radius=0.0)
    for change, message in (
        ({"size": 0.0}, "'arm': mesh_size = 0.0 m must be positive"),
        ({"fillet": -1e-3}, "'arm': fillet = -0.001 m must be finite"),
        ({"guide_radius": -1e-3}, "'arm': guide_radius = -0.001 m must be finite"),
        ({"guide_radius": float("nan")}, "'arm': guide_radius = nan m must be finite"),
        ({"guide_radius": "3 mm"}, "'arm': guide_radius = '3 mm' m must be finite"),
        ({"guide_radius": 3.0, "largest": 0.12}, "guide_radius = 3 m is larger than the robot.*did you mean metres"),
        ({"element": "linaer"}, "unknown element 'linaer'; did you mean 'linear'"),
    ):
        with pytest.raises(ValueError, match=message):
            tier.changed("arm", **same | change)


def test_a_robot_that_cannot_be_drawn_with_fillets_says_so():
    with pytest.raises(ValueError, match="'diamond' cannot be drawn with a fillet"):
        make_robot("diamond", fillet=1e-3)


def test_the_guide_radius_is_an_option_and_part_of_the_key():
    radii = {"finger": 3e-3, "press_finger": 3e-3, "two_finger_gripper": 3e-3, "sensorized_finger": 1e-3}
    for name, radius in radii.items():
        by_mesh = [make_robot(name, mesh=mesh) for mesh in NAMES]
        assert [robot.guide_radius for robot in by_mesh] == [0.0, radius, radius]
        assert [robot.mechanics_key.get("guide_radius") for robot in by_mesh] == [None, radius, radius]
        key = by_mesh[1].mechanics_key
        assert make_robot(name, mesh="accurate", guide_radius=radius).mechanics_key == key
        other = make_robot(name, mesh="accurate", guide_radius=2e-3)
        assert other.guide_radius == 2e-3 and other.mechanics_key == key | {"guide_radius": 2e-3}
        points = make_robot(name, mesh="accurate", guide_radius=0.0)
        assert points.guide_radius == 0.0 and "guide_radius" not in points.mechanics_key
        with pytest.raises(ValueError, match="guide_radius = -0.001 m must be finite and not negative"):
            make_robot(name, mesh="accurate", guide_radius=-1e-3)


def test_elements_of_grippers_are_small_where_loads_act():
    gripper = make_robot("two_finger_gripper", mesh="accurate", mesh_size=30e-3)
    assert gripper.guide_size == 9e-3 and gripper.mechanics_key["guide_size"] == 9e-3
    finger = gripper.finger
    mesh, balls = finger.body(), finger.loaded_parts(finger.design_space.baseline)
    assert balls.shape == (7, 4)  # six guides of one cable, and the middle of the contact points
    edges = mesh.tetrahedra[:, [0, 0, 0, 1, 1, 2, 1, 2, 3, 2, 3, 3]].reshape(-1, 2, 6)
    lengths = np.linalg.norm(mesh.nodes[edges[:, 0]] - mesh.nodes[edges[:, 1]], axis=2).mean(axis=1)
    middles = mesh.nodes[mesh.tetrahedra].mean(axis=1)
    for *middle, radius in balls:
        near = np.linalg.norm(middles - middle, axis=1) < radius + 2e-3
        assert near.any() and np.median(lengths[near]) < 1.2 * gripper.guide_size


def test_a_guide_of_a_gripper_does_not_reach_over_a_notch():
    robot = make_robot("two_finger_gripper", mesh="accurate", mesh_size=16e-3)
    box = robot.design_space
    for joint_height in (box["joint_height"].low, box["joint_height"].high):
        design = box.complete({"joint_height": joint_height})
        model = robot.build(design)
        for cable in model.constraints["a"]:
            # Guides are where the cable leaves and enters segments: two in each of three.
            assert len(cable.embedding.points) == 6
            for k, nodes in enumerate(cable.embedding.node_ids):
                z = model.nodes[nodes, 2] / design["length"]
                assert (z <= -(k // 2)).all() and (z >= -(k // 2) - 1).all()


def test_a_graded_finger_is_symmetric(finger):
    mesh = finger.body()
    left = mesh.nodes[mesh.nodes[:, 0] < -1e-9] * [-1, 1, 1]
    right = mesh.nodes[mesh.nodes[:, 0] > 1e-9]
    assert np.array_equal(left[np.lexsort(left.T)], right[np.lexsort(right.T)])
    state = Statics(finger.build()).solve([0.0, 0.0])
    one, other = state.condensed.W.aa[0, 0], state.condensed.W.aa[1, 1]
    assert one == pytest.approx(other, rel=1e-9)
    assert np.allclose(state.condensed.delta.e, finger.effector_rest, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("cables", [1, 2])
def test_the_accurate_finger_moves_its_mesh_to_every_corner_of_the_design_space(cables):
    robot = make_robot("finger", mesh="accurate", cables=cables)
    for joint_height in (0.005, 0.008):
        for height in (0.020, 0.022):
            mesh = robot.body({"length": 0.042, "height": height, "joint_height": joint_height})
            assert mesh.origin == "morphed"


def test_elements_are_small_at_the_joints(finger):
    nodes, tetrahedra = finger.body().nodes, finger.body().tetrahedra
    edges = np.linalg.norm(nodes[tetrahedra[:, 1]] - nodes[tetrahedra[:, 0]], axis=1)
    z = nodes[tetrahedra].mean(axis=1)[:, 2]
    near = np.abs(z + 0.0405) < 0.004
    assert np.median(edges[near]) < 0.6 * np.median(edges[z < -0.1])


def drawn_volume(draw, **parameters):
    """Volume [mm3] of what a function draws."""
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        draw(**parameters)
        gmsh.model.occ.synchronize()
        ((_, body),) = gmsh.model.getEntities(3)
        return gmsh.model.occ.getMass(3, body), len(gmsh.model.getEntities(2))
    finally:
        gmsh.finalize()


def test_fillets_add_material_in_proportion_to_the_square_of_their_radius():
    robot = make_robot("finger")
    lengths = robot.lengths(robot.design_space.baseline)
    half = {**lengths, "size": 8.0, "feature_size": 8.0}
    sharp, faces = drawn_volume(draw_half_finger, **half, fillet=0.0)
    small, rounded_faces = drawn_volume(draw_half_finger, **half, fillet=0.5)
    large, _ = drawn_volume(draw_half_finger, **half, fillet=1.0)
    assert rounded_faces > faces
    # Exactly four times, but for the corners at which edges meet.
    assert (large - sharp) / (small - sharp) == pytest.approx(4.0, rel=0.05)


def test_a_fillet_makes_the_finger_stiffer():
    sharp, rounded = (make_robot("finger", mesh="accurate", mesh_size=30e-3, fillet=r) for r in (0.0, 1.5e-3))
    assert rounded.meshing == "remesh" and rounded.mechanics_key != sharp.mechanics_key
    compliance = [float(Statics(r.build()).solve([0.0, 0.0]).condensed.W.aa.sum()) for r in (sharp, rounded)]
    assert compliance[1] < 0.8 * compliance[0]


def test_a_fillet_that_does_not_fit_is_infeasible():
    with pytest.raises(InfeasibleDesign):
        make_robot("finger", mesh="accurate", mesh_size=30e-3, fillet=20e-3).body()


def test_fingers_of_a_gripper_are_tied_by_averaged_points():
    robot = make_robot("two_finger_gripper", mesh="accurate", mesh_size=30e-3)
    model = robot.build()
    (bond,) = model.constraints["b"]
    assert len(bond.dofs) > 3 * 2 * 10  # a single point depends on the ten nodes of an element
    state = Statics(model).solve(np.zeros(4))
    assert np.allclose(bond.value(state.x), 0.0, rtol=0.0, atol=1e-9)
    # Both fingers bend alike: the bar stays in the middle.
    assert np.allclose(state.condensed.delta.e[:2], robot.effector_rest[:2], rtol=0.0, atol=1e-6)


def test_cavities_of_the_accurate_sensorized_finger_are_those_of_the_published_mesh():
    volumes = {
        mesh: [sensor.rest_volume for sensor in make_robot("sensorized_finger", **options).build().constraints["s"]]
        for mesh, options in {"published": {}, "accurate": {"mesh": "accurate", "mesh_size": 20e-3}}.items()
    }
    assert len(volumes["accurate"]) == 2
    # Facets of different sizes cut off different parts of the round cavities.
    assert np.allclose(volumes["accurate"], volumes["published"], rtol=0.1)
    assert volumes["accurate"][0] == pytest.approx(volumes["accurate"][1], rel=0.01)
