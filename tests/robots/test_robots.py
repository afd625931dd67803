"""Every robot of the registry over its design box: bodies, models and their smoothness; invalid options and designs."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.errors import DesignError, InfeasibleDesign
from softgym_envs.mechanics import gmsh_process
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots import ROBOTS
from softgym_envs.robots.geometry import meshing
from softgym_envs.robots.geometry.finger_shape import check_finger, draw_finger
from softgym_envs.robots.geometry.morphing import mean_ratio
from softgym_envs.robots.soft_finger import BELLOWS

# Every robot with a mesh from gmsh, in every variant: a new one adds its row. The others have their own files.
VARIANTS = [("finger", {"cables": 1}), ("finger", {"cables": 2}), ("diamond", {})]
ELASTICITY = {"young_modulus", "poisson_ratio"}


@pytest.fixture(scope="module", params=VARIANTS, ids=lambda p: p[0] + "".join(f"-{k}{v}" for k, v in p[1].items()))
def robot(request):
    name, options = request.param
    return make_robot(name, **options)


@pytest.fixture(scope="module")
def remeshing(robot):
    """The same robot, remeshing every design."""
    options = next(o for n, o in VARIANTS if make_robot(n, **o).learning.weights == robot.learning.weights)
    return make_robot(robot.name, **options, meshing="remesh")


def volume(mesh):
    corners = mesh.nodes[mesh.tetrahedra]
    return np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])).sum() / 6.0


def rest_state(model):
    statics = Statics(model)
    return statics.solve(np.zeros(sum(c.size for c in model.constraints["a"])), "effort")


def corners_of(space):
    """All corners of the variables that change the shape; elasticity alternates."""
    shape = [name for name in space.names if name not in ELASTICITY]
    for k, signs in enumerate(itertools.product((-1.0, 1.0), repeat=len(shape))):
        unit = dict.fromkeys(space.names, 1.0 if k % 2 else -1.0) | dict(zip(shape, signs, strict=True))
        yield space.from_unit(np.array([unit[name] for name in space.names]))


def test_every_registered_robot_is_tested():
    """Here, or in a file that names it or is named like its own."""
    tests = {path.stem: path.read_text() for path in Path(__file__).parents[1].rglob("test_*.py")}
    for name, cls in ROBOTS.items():
        module = cls.__module__.rpartition(".")[2]
        assert f"test_{module}" in tests or any(f'"{name}"' in text for text in tests.values()), name


def test_attributes(robot):
    count = len(robot.actuators)
    assert robot.name in ROBOTS
    assert robot.lower.shape == robot.upper.shape == robot.rates.shape == (count,)
    assert (robot.lower <= 0.0).all()
    assert (robot.upper > 0.0).all()
    assert (robot.rates > 0.0).all()
    assert np.shape(robot.effort_scale) == (count,)
    assert len({actuator.name for actuator in robot.actuators}) == count
    assert json.loads(json.dumps(robot.mechanics_key)) == robot.mechanics_key
    assert robot.learning.weights.startswith(robot.name)
    assert robot.learning.stiffness_variable is None or robot.learning.stiffness_variable in robot.design_space.names


def test_variants_have_their_own_weights_names_and_mechanics_keys():
    robots = [make_robot(name, **options) for name, options in VARIANTS]
    assert len({r.learning.weights for r in robots}) == len(robots)
    assert len({json.dumps(r.mechanics_key, sort_keys=True) for r in robots}) == len(robots)


def test_baseline_model(robot):
    model = robot.build()
    assert [c.name for c in model.constraints["a"]] == [actuator.name for actuator in robot.actuators]
    assert [c.unilateral for c in model.constraints["a"]] == [actuator.unilateral for actuator in robot.actuators]
    assert [c.name for c in model.constraints["e"]] == list(robot.effectors)
    state = rest_state(model)
    np.testing.assert_allclose(state.delta[-3:], robot.effector_rest, atol=1e-9)
    np.testing.assert_allclose(state.delta[: len(robot.actuators)], 0.0, atol=1e-12)
    assert np.linalg.eigvalsh(state.condensed.compliance)[0] > 0.0


def test_finger_has_its_published_size():
    two, one = (make_robot("finger", cables=c).body() for c in (2, 1))
    assert (two.nodes.shape[0], two.tetrahedra.shape[0]) == pytest.approx((485, 1570), rel=0.03)
    assert (one.nodes.shape[0], one.tetrahedra.shape[0]) == pytest.approx((520, 1720), rel=0.03)
    assert volume(two) == pytest.approx(35e-6, rel=0.03)
    low, high = two.nodes.min(axis=0), two.nodes.max(axis=0)
    np.testing.assert_allclose(low[[0, 2]], [-0.01475, -0.120], atol=1e-9)  # the bellows are the widest part
    assert high[0] == pytest.approx(0.01475, abs=1e-9)
    assert high[1] == pytest.approx(0.023, abs=1e-9)  # the flange, 3 mm above the body
    assert high[2] == pytest.approx(0.0, abs=1e-9)


def test_baseline_meshes_are_shipped(robot, monkeypatch, tmp_path):
    """The first use of a robot requires neither gmsh nor a cache."""
    monkeypatch.setenv("SOFTGYM_CACHE", str(tmp_path))

    def refuse(*_, **__):
        raise AssertionError("gmsh was called")

    monkeypatch.setattr(gmsh_process.subprocess, "run", refuse)
    assert robot.mesh(robot.reference_design).origin == "meshed"
    assert not list(tmp_path.iterdir())


def test_bodies_at_the_corners_and_inside_of_the_design_box(robot, rng):
    designs = list(corners_of(robot.design_space)) + [robot.design_space.sample(rng) for _ in range(5)]
    origins = []
    for design in designs:
        mesh = robot.body(design)
        quality = mean_ratio(mesh.nodes, mesh.tetrahedra).min()
        origins.append(mesh.origin)
        # The morphed body is kept only where its elements are not much worse than the baseline's.
        assert quality > 0.05, design
        model = robot.build_model(mesh, robot.design_space.complete(design))
        assert model.energy(model.nodes) == pytest.approx(0.0, abs=1e-12)
        for cable in model.constraints["a"]:
            # Cable points are in the body, or on its surface to round-off.
            assert cable.embedding.weights.min() > -1e-6, design
        state = rest_state(model)
        assert np.isfinite(state.condensed.compliance).all()
        assert np.linalg.eigvalsh(state.condensed.compliance)[0] > 0.0
    assert set(origins) == {"morphed"}


def test_effectors_outside_the_body_are_tied_to_one_element(robot, rng):
    """The nearest element changes from design to design; an effector tied to the nearest one would jump."""
    (base,) = robot.build().constraints["e"]
    if base.embedding.weights.min() > -1e-9:
        pytest.skip("the effector is inside the body")
    for _ in range(8):
        design = robot.design_space.sample(rng)
        mesh = robot.body(design)
        (effector,) = robot.build_model(mesh, design).constraints["e"]
        if mesh.origin == "morphed" and effector.embedding.weights.min() < -1e-9:
            np.testing.assert_array_equal(effector.embedding.elements, base.embedding.elements)
            assert np.abs(effector.embedding.weights - base.embedding.weights).max() < 0.5


def test_the_reference_body_is_the_unmoved_mesh(robot):
    mesh = robot.body(robot.reference_design)
    assert mesh.origin == "morphed"
    np.testing.assert_allclose(mesh.nodes, robot.mirror(robot.mesh(robot.reference_design)).nodes, rtol=0, atol=1e-12)


def test_the_same_design_gives_the_same_body_bit_for_bit(robot):
    options = next(o for n, o in VARIANTS if make_robot(n, **o).learning.weights == robot.learning.weights)
    design = robot.design_space.from_unit(np.linspace(-0.3, 0.4, len(robot.design_space)))
    first = robot.body(design)
    robot.body(robot.design_space.from_unit(np.linspace(0.5, -0.2, len(robot.design_space))))  # must leave no trace
    for other in (robot.body(design), make_robot(robot.name, **options).body(design)):
        np.testing.assert_array_equal(first.nodes, other.nodes)
        np.testing.assert_array_equal(first.tetrahedra, other.tetrahedra)


def test_elasticity_does_not_move_the_mesh(robot):
    plain = robot.body()
    for name in ELASTICITY & set(robot.design_space.names):
        np.testing.assert_array_equal(robot.body({name: robot.design_space[name].high}).nodes, plain.nodes)


def test_moved_bodies_have_the_volume_of_remeshed_ones(robot, remeshing):
    """Boundary nodes lie on the new shape; only the facets of its curved parts differ (measured: 0.02 % and less)."""
    for unit in (1.0, -1.0):
        design = robot.design_space.from_unit(np.full(len(robot.design_space), unit))
        moved, fresh = robot.body(design), remeshing.body(design)
        assert moved.origin == "morphed"
        assert fresh.origin == "meshed"
        assert volume(moved) == pytest.approx(volume(fresh), rel=1e-3)
        assert volume(moved) != pytest.approx(volume(robot.body()), rel=1e-2)
        np.testing.assert_allclose(moved.nodes.min(axis=0), fresh.nodes.min(axis=0), atol=1e-9)
        np.testing.assert_allclose(moved.nodes.max(axis=0), fresh.nodes.max(axis=0), atol=1e-9)


def compliances(robot, name, values):
    W = np.array([rest_state(robot.build({name: value})).condensed.compliance for value in values])
    size = np.sqrt(np.einsum("kii->ki", W)).mean(axis=0)
    return W / np.outer(size, size)


def test_compliance_is_smooth_along_design_lines(robot):
    """Entries of W, relative to its diagonal, bend but do not jump.

    A jump would make the second differences as large as the first. Where a cable point passes from one element to
    the next, W has a kink: measured 6e-5 of 2e-4 there (one cable, height), 1e-2 of the first differences elsewhere.
    """
    for name in robot.design_space.names:
        variable = robot.design_space[name]
        # Steps of 0.2 % of the box, in the middle of it.
        values = variable.from_unit(np.linspace(0.1, 0.124, 7))
        W = compliances(robot, name, values)
        first = np.abs(np.diff(W, axis=0)).max()
        second = np.abs(np.diff(W, 2, axis=0)).max()
        assert first > 1e-9, name  # every variable matters
        assert second < 0.5 * first, name


def test_moving_the_mesh_is_far_smoother_than_remeshing(robot, remeshing):
    name = next(n for n in robot.design_space.names if n not in ELASTICITY)
    values = robot.design_space[name].from_unit(np.array([-0.25, 0.0, 0.25]))
    moved, fresh = (np.abs(np.diff(compliances(r, name, values), 2, axis=0)).max() for r in (robot, remeshing))
    # Measured: 7e-4 and 5e-4 against 0.10 (finger); 4e-3 against 0.025 (diamond, whose legs widen by a tenth).
    assert moved < 5e-3
    assert fresh > 5.0 * moved


def test_stiffness_variable_scales_compliance_and_nothing_else(robot):
    name = robot.learning.stiffness_variable
    assert name is not None
    base = robot.design_space.baseline[name]
    soft, stiff = (rest_state(robot.build({name: f * base})) for f in (0.5, 2.0))
    np.testing.assert_allclose(soft.condensed.compliance, 4.0 * stiff.condensed.compliance, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(soft.delta, stiff.delta, rtol=0, atol=1e-14)


def test_with_gravity_nothing_scales():
    robot = make_robot("finger", gravity=(0.0, 0.0, -9.81))
    assert robot.learning.stiffness_variable is None
    model = robot.build()
    assert model.loads.sum(axis=0)[2] == pytest.approx(-9.81 * 1100.0 * model.volume, rel=1e-9)


def test_cables_can_push_by_option():
    model = make_robot("finger", unilateral=False).build()
    assert [c.unilateral for c in model.constraints["a"]] == [False, False]


# -- invalid input --------------------------------------------------------------------------------------------------


def test_unknown_robot():
    with pytest.raises(ValueError, match=r"unknown robot 'octopus'; allowed: .*finger"):
        make_robot("octopus")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tentacles": 8}, "robot 'finger'.*tentacles"),
        ({"cables": 3}, r"cables = 3 is unknown; allowed: 1, 2"),
        ({"meshing": "magic"}, "meshing = 'magic' is unknown; allowed: 'morph', 'remesh'"),
        ({"mesh_size": 0.0}, "mesh_size = 0.0 m must be positive"),
        ({"mesh_size": float("nan")}, "mesh_size"),
        ({"mesh_size": "8 mm"}, "robot 'finger'"),
    ],
    ids=str,
)
def test_wrong_options(options, message):
    with pytest.raises(ValueError, match=message):
        make_robot("finger", **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"material": "jelly"}, "unknown material 'jelly'"), ({"gravity": (0.0, -9.81)}, "gravity")],
    ids=str,
)
def test_wrong_physics_is_an_error_of_the_caller_not_of_the_design(options, message):
    """An optimiser continues after `InfeasibleDesign`, so a typing error must not raise it."""
    with pytest.raises(ValueError, match=message):
        make_robot("finger", **options).build()


@pytest.mark.parametrize(
    ("design", "message"),
    [
        ({"lenght": 0.04}, r"unknown design variable 'lenght'; did you mean 'length'\? allowed: length"),
        ({"length": 0.05}, r"'length' = 0.05 m is out of bounds; allowed: 0.038 to 0.042 m"),
        ({"height": float("nan")}, "'height' = nan is not finite"),
        ([0.04], "a design is a mapping"),
    ],
    ids=str,
)
def test_malformed_designs(design, message):
    robot = make_robot("finger")
    for verb in (robot.build, robot.body):
        with pytest.raises(DesignError, match=message):
            verb(design)


def test_a_geometry_that_cannot_exist_is_infeasible(monkeypatch):
    """`build` passes on `InfeasibleDesign` for a design within its bounds."""
    robot = make_robot("finger", meshing="remesh", mesh_size=0.02)

    def impossible(design):
        lengths = {"length": 10.0, "height": 30.0, "joint_height": 5.0, "slope": 0.8}
        return meshing.mesh_geometry(draw_finger, {**lengths, **BELLOWS}, mesh_size=0.02)

    monkeypatch.setattr(robot, "mesh", impossible)
    with pytest.raises(InfeasibleDesign, match="notches meet"):
        robot.build()


# -- design boxes -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cables", [1, 2])
def test_every_body_of_the_wide_box_of_the_finger_can_exist(cables):
    robot = make_robot("finger", cables=cables, design_box="wide")
    for published in make_robot("finger", cables=cables).design_space:
        own = robot.design_space[published.name]
        assert own.low <= published.low < published.high <= own.high and own.baseline == published.baseline
    for design in corners_of(robot.design_space):
        check_finger(robot.lengths(design))
        # Cables stay 1 mm inside the body, the radius of their guides.
        assert robot.cable_height + 1e-3 <= design["height"]


@pytest.mark.parametrize("name", ["diamond", "cable_trunk", "trunk"])
def test_bodies_at_corners_of_a_wide_box_move(name):
    robot = make_robot(name, design_box="wide")
    lengths = [v for v in robot.design_space if v.unit == "m"]
    narrow = make_robot(name).design_space
    assert all(v.low <= narrow[v.name].low and narrow[v.name].high <= v.high for v in robot.design_space)
    assert sum(v.high >= 1.295 * v.baseline for v in lengths) >= len(lengths) - 1
    command = np.maximum(robot.lower + (robot.upper - robot.lower) * np.resize([0.5, 0.0, 0.25], len(robot.lower)), 0.0)
    # Every fifth corner: each variable has both ends.
    for design in list(corners_of(robot.design_space))[::5]:
        design = {**design, "poisson_ratio": 0.45}
        statics = Statics(robot.build(design))
        rest = statics.solve(np.zeros(len(command)))
        state = statics.solve(command)
        assert np.linalg.norm(state.delta[len(command) :][:3] - rest.delta[len(command) :][:3]) > 5e-3, design


def test_chambers_lie_inside_every_body_of_the_wide_box():
    space = make_robot("trunk", design_box="wide").design_space
    assert space["chamber_offset"].high + space["chamber_radius"].high < space["outer_radius"].low


def test_a_design_box_does_not_change_the_mechanics():
    narrow, wide = (make_robot("finger", mesh="accurate", design_box=box) for box in ("published", "wide"))
    assert narrow.mechanics_key == wide.mechanics_key
    assert narrow.reference_design == dict(wide.reference_design)


def test_an_unknown_design_box_is_refused():
    with pytest.raises(ValueError, match="robot 'finger': unknown design_box 'wider'; did you mean 'wide'"):
        make_robot("finger", design_box="wider")
    with pytest.raises(ValueError, match="robot 'tetrapod': unknown design_box 'wide'; allowed: published"):
        make_robot("tetrapod", design_box="wide")
