"""The cable trunk: size, symmetry, exact condensed model, what its cables can reach."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends import make_backend
from softgym_envs.control import InverseQP
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.cable_trunk import octagonal_bar
from softgym_envs.robots.geometry.morphing import mean_ratio

COARSE = {"layers": 12, "rings": 1}


@pytest.fixture(scope="module")
def trunk():
    return make_robot("cable_trunk")


@pytest.fixture(scope="module")
def coarse():
    """A light trunk whose cables may push, so that differences about the rest state exist."""
    return make_robot("cable_trunk", **COARSE, unilateral=False)


def test_published_size(trunk):
    model = trunk.build()
    nodes = model.nodes
    assert (len(nodes), len(model.blocks[0].connectivity)) == (825, 3456)
    assert model.mass == pytest.approx(0.042, rel=1e-9)
    np.testing.assert_allclose(nodes.max(axis=0), [0.013, 0.013, 0.195], atol=1e-12)
    tip = nodes[nodes[:, 2] > 0.1949]
    np.testing.assert_allclose(tip.max(axis=0)[:2], 0.005, atol=1e-12)
    cables = model.constraints["a"]
    assert [len(cable.embedding.points) for cable in cables] == [20] * 4 + [10] * 4
    for cable, end in zip(cables, [(0.002, 0.195)] * 4 + [(0.006, 0.0975)] * 4, strict=True):
        assert np.linalg.norm(cable.pull_point) == pytest.approx(0.010)
        anchor = cable.embedding.points[-1]
        assert (np.hypot(*anchor[:2]), anchor[2]) == pytest.approx(end)
    np.testing.assert_allclose(model.constraints["e"][0].value(nodes), [0, 0, 0.195], atol=1e-12)


@pytest.mark.parametrize(("layers", "rings"), [(1, 1), (3, 2), (2, 3)])
def test_octagonal_bar_fills_its_shape(layers, rings):
    nodes, tetrahedra = octagonal_bar(layers, rings)
    assert len(nodes) == (layers + 1) * (1 + 16 * rings)
    assert len(tetrahedra) == layers * (48 + 96 * (rings - 1))
    corners = nodes[tetrahedra]
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    assert (volumes > 0.0).all()
    assert volumes.sum() == pytest.approx(8.0 * np.tan(np.pi / 8))
    faces = np.sort(tetrahedra[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3), axis=1)
    used, count = np.unique(faces, axis=0, return_counts=True)
    assert count.max() == 2  # no face belongs to three elements: neighbours fit
    assert (count == 1).sum() == 2 * (16 + 32 * (rings - 1)) + 2 * 16 * layers
    assert len(used) == (4 * len(tetrahedra) + (count == 1).sum()) / 2


def test_bodies_at_the_corners_of_the_design_box(coarse):
    space = coarse.design_space
    for k, signs in enumerate(itertools.product((-1.0, 1.0), repeat=5)):
        elasticity = 1.0 if k % 2 else -1.0
        design = space.from_unit(np.array([*signs, elasticity, -elasticity]))
        model = coarse.build(design)
        assert model.volume == pytest.approx(coarse.volume(design), rel=1e-12)
        # With the default 24 layers also 0.094: in the stretched half, elements are 12 mm long and only 2 mm wide at
        # the thin tip.
        assert mean_ratio(model.nodes, model.blocks[0].connectivity).min() > 0.09
        for cable in model.constraints["a"]:
            assert cable.embedding.weights.min() > -1e-9  # inside the body
        W = Statics(model).solve(np.zeros(8), "effort").condensed.compliance
        assert np.linalg.eigvalsh(W)[0] > 0.0


def test_quarter_turns_change_nothing(coarse):
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    statics = Statics(coarse.build())
    long, short = np.array([0.012, 0.002, 0.0, 0.004]), np.array([0.0, 0.006, 0.003, 0.0])
    states = []
    for k in range(4):
        statics.solve(np.zeros(8))
        states.append(statics.solve(np.concatenate([np.roll(long, k), np.roll(short, k)])))
    for k in range(1, 4):
        expected = np.linalg.matrix_power(turn, k) @ states[0].delta[8:]
        np.testing.assert_allclose(states[k].delta[8:], expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("share", [0.0, 0.3], ids=["rest", "actuated"])
def test_compliance_is_the_derivative_of_the_equilibrium(coarse, share):
    statics = Statics(coarse.build(), tolerance=1e-12)
    command = share * coarse.upper * np.array([1.0, 0.2, 0.1, 0.4, 0.0, 0.7, 0.3, 0.1])
    effort = statics.solve(command).effort[:8]
    W = statics.solve(effort, "effort").condensed.compliance
    step = 2e-3  # N
    for k in range(8):
        ends = [statics.solve(effort + sign * step * np.eye(8)[k], "effort").delta for sign in (1.0, -1.0)]
        difference = (ends[0] - ends[1]) / (2.0 * step)
        assert np.abs(difference - W[:, k]).max() < 1e-5 * np.abs(W[:, k]).max()


def test_without_gravity_stiffness_does_not_change_the_motion(coarse):
    command = 0.4 * coarse.upper * np.array([1.0, 0.0, 0.0, 0.5, 0.0, 1.0, 0.0, 0.0])
    deltas = [Statics(coarse.build({"young_modulus": E})).solve(command).delta for E in (2.0e5, 9.0e5)]
    np.testing.assert_allclose(deltas[0], deltas[1], rtol=0, atol=1e-7)


def test_compliance_is_smooth_along_design_lines(coarse):
    for name in coarse.design_space.names:
        values = coarse.design_space[name].from_unit(np.linspace(0.1, 0.124, 7))
        W = np.array(
            [Statics(coarse.build({name: v})).solve(np.zeros(8), "effort").condensed.compliance for v in values]
        )
        first, second = np.abs(np.diff(W, axis=0)).max(), np.abs(np.diff(W, 2, axis=0)).max()
        assert first > 0.0
        assert second < 0.5 * first, name


def test_cables_reach_their_stroke():
    """Each alone, all together, and random pulls, at the rate of the actuators; antagonists hang slack or hold."""
    robot = make_robot("cable_trunk", **COARSE)
    fem = make_backend("fem", robot)
    rng = np.random.default_rng(0)
    shares = [np.eye(8)[0], np.eye(8)[4], np.ones(8), *rng.uniform(0.0, 1.0, (3, 8))]
    saw_slack = False
    for share in shares:
        fem.reset()
        for k in range(1, 21):
            state = fem.step(k / 20.0 * share * robot.upper)
        saw_slack |= bool(state.slack.any())
        assert (state.displacement >= share * robot.upper - 1e-9).all()
        assert (state.effort >= 0.0).all()
        assert np.isfinite(state.effector).all()
    assert saw_slack


def test_follows_its_circle(trunk):
    """Measured: 0.02 mm at most, two steps per goal."""
    fem = make_backend("fem", trunk)
    controller = InverseQP.for_robot(trunk)
    path, state, distances = trunk.reference_path(), fem.state, []
    assert path.shape == (30, 3)
    for goal in [path[0]] * 14 + [goal for goal in path[1:10] for _ in range(2)]:
        state = fem.step(controller.solve(state.condensed, goal, state.command, state.slack))
        distances.append(np.linalg.norm(state.effector[0] - goal))
    assert max(distances[15::2]) < 1e-4


def test_attributes(trunk, coarse):
    assert trunk.learning.weights.startswith(trunk.name)
    assert json.loads(json.dumps(trunk.mechanics_key)) == trunk.mechanics_key
    assert coarse.mechanics_key != trunk.mechanics_key
    np.testing.assert_allclose(trunk.upper, [0.035] * 4 + [0.020] * 4)
    np.testing.assert_allclose(make_robot("cable_trunk", strokes=(0.07, 0.04)).upper, [0.070] * 4 + [0.040] * 4)
    assert make_robot("cable_trunk", gravity=(0.0, 0.0, -9.81)).learning.stiffness_variable is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"layers": 0}, "layers = 0"),
        ({"rings": 1.5}, "rings = 1.5"),
        ({"strokes": (0.03, -0.01)}, "strokes"),
        ({"material": "jelly"}, "unknown material 'jelly'"),
        ({"gravity": (0.0, 1.0)}, "gravity"),
    ],
    ids=str,
)
def test_wrong_options(options, message):
    with pytest.raises(ValueError, match=message):
        make_robot("cable_trunk", **options)


def test_the_coarse_mesh_answers_as_the_accurate_one():
    """At rest, where linear elements of the published mesh are farther off."""
    moved = {}
    for mesh in ("published", "coarse", "accurate"):
        W = Statics(make_robot("cable_trunk", mesh=mesh).build()).solve(np.zeros(8)).condensed.W
        moved[mesh] = W.ea / W.aa.diagonal()  # of the tip, over that of one cable while the others are free
    size = np.linalg.norm(moved["accurate"], axis=0)
    off = {mesh: np.linalg.norm(found - moved["accurate"], axis=0) / size for mesh, found in moved.items()}
    assert off["coarse"].max() < 0.02 < off["published"].max()
