"""Grippers: against single fingers that are tied, finite differences, balance of forces, symmetry, designs.

The meshes are coarse: the tested properties hold for any mesh.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.errors import DesignError
from softgym_envs.mechanics.frames import rotation_of
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.soft_finger import SoftFinger

GRIPPERS = ("press_finger", "two_finger_gripper", "three_finger_gripper")
MESH_SIZE = 12e-3
# Cables [m] that pull the object aside, turn and lift it.
COMMANDS = {
    "press_finger": 1e-3 * np.array([14.0, 9.0]),
    "two_finger_gripper": 1e-3 * np.array([10.0, 9.0, 7.0, 8.5]),
    "three_finger_gripper": 1e-3 * np.array([3.0, 2.0, 4.0, 1.0, 1.0, 5.0]),
}


@pytest.fixture(scope="module")
def grippers():
    """Function ``grippers(name, **options) -> robot, model``; each is built once."""
    made = {}

    def get(name, **options):
        key = (name, *sorted(options.items()))
        if key not in made:
            robot = make_robot(name, mesh_size=MESH_SIZE, **options)
            made[key] = robot, robot.build()
        return made[key]

    return get


def solved(gripper, command, mode="displacement", **options):
    statics = Statics(gripper[1], tolerance=1e-12)
    return statics, statics.solve(command, mode, **options)


def contact_forces(state, count):
    """Forces of the object on the fingers' contact points [N], shape (count, 3)."""
    return state.effort[-3 * count :].reshape(-1, 3)


def contacts(model, x):
    """Contact points of the fingers, or the tip of the first finger [m], shape (k, 3)."""
    return np.array([bond.first.positions(x)[0] for bond in model.constraints["b"]])


def tips(model, x):
    """Tips of the two fingers that hold a bar [m], shape (2, 3)."""
    (bond,) = model.constraints["b"]
    count = len(model.nodes) // 2  # the same node of the other finger
    return np.array([bond.first.weights[0] @ x[bond.first.node_ids[0] + shift] for shift in (0, count)])


# -- against single fingers -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("pulled", [False, True], ids=["rest", "pulled"])
def test_tied_fingers_pinch_as_one_model_does(grippers, pulled):
    """Fingers solved alone, with their tips where they are held, and tied: ``C (W (f + C^T m) + free) = d``."""
    robot, model = grippers("two_finger_gripper", unilateral=False)
    _, state = solved((robot, model), pulled * COMMANDS[robot.name])
    finger = SoftFinger(cables=2, mesh_size=robot.finger.mesh_size, unilateral=False).build()
    finger.add("c", finger.constraints["e"][0])  # so that the tie can drive the tip
    count, W, free, C = len(finger.nodes), np.zeros((16, 16)), np.zeros(16), np.zeros((3, 16))
    for k, (turn, shift) in enumerate(robot.placements):
        local = (tips(model, state.x)[k] - shift) @ turn
        part = Statics(finger, tolerance=1e-13).solve(
            state.delta[2 * k : 2 * k + 2], contact=local, contact_mode="displacement"
        )
        np.testing.assert_allclose(part.x @ turn.T + shift, state.x[k * count : (k + 1) * count], atol=1e-10)
        # Cables, effector and the same point as a contact: rotated, the last two shifted.
        whole = np.eye(8)
        whole[2:5, 2:5] = whole[5:, 5:] = turn
        rows = slice(8 * k, 8 * k + 8)
        W[rows, rows] = whole @ part.condensed.compliance @ whole.T
        free[rows] = whole @ part.condensed.free + np.concatenate([np.zeros(2), shift, shift])
        C[:, rows.stop - 3 : rows.stop] = (2 * k - 1) * np.eye(3)
    held = W - W @ C.T @ np.linalg.solve(C @ W @ C.T, C @ W)
    closed = free + W @ C.T @ np.linalg.solve(C @ W @ C.T, [0.0, 0.040, 0.0] - C @ free)
    # The effector is the middle of the two tips.
    chosen = np.zeros((7, 16))
    chosen[[0, 1, 2, 3], [0, 1, 8, 9]] = 1.0
    chosen[4:, 2:5] = chosen[4:, 10:13] = 0.5 * np.eye(3)
    expected = state.condensed
    found = type(expected)(chosen @ held @ chosen.T, chosen @ closed, expected.effort, expected.roles)
    for block in ("aa", "ea", "ee"):
        largest = np.abs(getattr(expected.W, block)).max()
        np.testing.assert_allclose(getattr(found.W, block), getattr(expected.W, block), rtol=0, atol=1e-8 * largest)
    np.testing.assert_allclose(found.free, expected.free, rtol=0, atol=1e-8 * np.abs(expected.free).max())


# -- W --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", GRIPPERS)
@pytest.mark.parametrize("mode", ["effort", "displacement"])
def test_W_is_the_derivative_of_the_equilibrium(grippers, name, mode):
    """Cables one by one and forces on the effector; driven by displacement, at held cables."""
    robot, model = grippers(name, unilateral=False)
    statics, here = solved((robot, model), COMMANDS[name])
    count = len(robot.actuators)
    W = here.condensed.W
    if mode == "effort":
        steps, start = np.full(count, 5e-3), here.effort[:count]
        expected = np.block([[W.aa, W.ea.T], [W.ea, W.ee]])
    else:
        steps, start = np.full(count, 1e-5), here.delta[:count]
        across = W.ea @ np.linalg.inv(W.aa)
        expected = np.block([[np.linalg.inv(W.aa), -across.T], [across, W.ee - across @ W.ea.T]])
    steps = np.append(steps, np.full(3, 5e-3))
    columns = []
    for step, direction in zip(steps, np.eye(count + 3), strict=True):
        ends = []
        for sign in (1, -1):
            target = sign * step * direction
            end = statics.solve(start + target[:count], mode, effector_force=target[count:])
            rows = end.delta if mode == "effort" else np.append(end.effort[:count], end.delta[count:])
            ends.append(rows[: count + 3])
        columns.append((ends[0] - ends[1]) / (2.0 * step))
    difference = np.array(columns).T
    for rows, others in itertools.product((slice(0, count), slice(count, count + 3)), repeat=2):
        largest = np.abs(expected[rows, others]).max()
        assert np.abs(difference[rows, others] - expected[rows, others]).max() < 1e-5 * largest, (rows, others)


# -- forces ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["three_finger_gripper", "press_finger"])
def test_the_free_object_is_in_balance(grippers, name):
    """Its contact forces add up to its load, a force on its centre included, and have no torque about its centre."""
    robot, model = grippers(name)
    push = np.array([0.3, -0.2, -0.5])
    _, state = solved((robot, model), COMMANDS[name], effector_force=push)
    frame = model.frames.rows[0]
    points, forces = contacts(model, state.x), contact_forces(state, 3 * len(robot.placements))
    assert np.abs(forces).max() > 1.0
    np.testing.assert_allclose(forces.sum(axis=0), model.nodal_loads[frame] + push, atol=1e-8)
    torque = np.cross(points - state.x[frame], forces).sum(axis=0)
    np.testing.assert_allclose(torque, 0.0, atol=1e-9)
    # The points of the fingers stay on the object's.
    turn = rotation_of(state.x, frame)
    held = state.x[frame] + (contacts(model, model.nodes) - model.nodes[frame]) @ turn.T
    np.testing.assert_allclose(points, held, atol=1e-12)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)


def test_the_bar_keeps_its_length_and_the_effector_is_its_middle(grippers):
    robot, model = grippers("two_finger_gripper")
    _, state = solved((robot, model), COMMANDS[robot.name])
    first, second = tips(model, state.x)
    np.testing.assert_allclose(second - first, [0.0, 0.040, 0.0], atol=1e-12)
    np.testing.assert_allclose(state.condensed.delta.e, 0.5 * (first + second), atol=1e-12)


def test_the_button_pushes_the_finger_back(grippers):
    positions = {}
    for force in (0.0, 1.0, 2.0):
        robot, model = grippers("press_finger", button_force=force)
        _, state = solved((robot, model), np.zeros(2), "effort")
        positions[force] = state.condensed.delta.e[1]
        np.testing.assert_allclose(contact_forces(state, 3).sum(axis=0), [0.0, -force, 0.0], atol=1e-8)
    assert positions[0.0] == pytest.approx(robot.effector_rest[1], abs=1e-12)
    assert positions[2.0] < positions[1.0] - 1e-3 < positions[0.0] - 2e-3


# -- symmetry -------------------------------------------------------------------------------------------------------


def test_half_a_turn_swaps_the_two_fingers(grippers):
    robot, model = grippers("two_finger_gripper")
    command = COMMANDS[robot.name]
    _, first = solved((robot, model), command)
    _, second = solved((robot, model), command[[2, 3, 0, 1]])
    turn, centre = np.diag([-1.0, -1.0, 1.0]), np.array([0.0, 0.040, 0.0])
    order = np.array([2, 3, 0, 1])
    np.testing.assert_allclose(
        second.condensed.delta.e, turn @ (first.condensed.delta.e - centre) + centre, rtol=0, atol=1e-11
    )
    np.testing.assert_allclose(second.effort[:4], first.effort[order], atol=1e-8)
    for found, expected in (
        (second.condensed.W.aa, first.condensed.W.aa[np.ix_(order, order)]),
        (second.condensed.W.ea, turn @ first.condensed.W.ea[:, order]),
        (second.condensed.W.ee, turn @ first.condensed.W.ee @ turn),
    ):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_the_fingers_of_a_gripper_are_one_body(grippers):
    for name in GRIPPERS:
        robot, model = grippers(name)
        assert len(model.solids) == len(robot.placements)
        count = len(model.solids[0].nodes_used)
        for k, (turn, shift) in enumerate(robot.placements):
            alone = (model.nodes[k * count : (k + 1) * count] - shift) @ turn
            np.testing.assert_allclose(alone, model.nodes[:count], atol=1e-15)
            np.testing.assert_array_equal(model.solids[k].connectivity, model.solids[0].connectivity + k * count)
        assert [cable.name for cable in model.constraints["a"]] == [a.name for a in robot.actuators]
        np.testing.assert_allclose(robot.effector_rest, robot.object_rest(robot.design_space.baseline))


# -- cables that push, and those that cannot ------------------------------------------------------------------------


def test_unilateral_cables_go_slack_and_bilateral_ones_push(grippers):
    command = 1e-3 * np.array([6.0, 6.0, 0.0, 0.0, 0.0, 0.0])
    _, pulling = solved(grippers("three_finger_gripper"), command)
    _, both = solved(grippers("three_finger_gripper", unilateral=False), command)
    assert pulling.slack[2:].any()
    assert (pulling.effort[:6] >= 0.0).all()
    assert (pulling.effort[:6][pulling.slack] == 0.0).all()
    assert (pulling.delta[:6][pulling.slack] > command[pulling.slack]).all()
    assert (both.effort[:6] < 0.0).any()
    np.testing.assert_allclose(both.delta[:6], command, atol=1e-11)
    # The tensions of a unilateral state, given as efforts, lead a bilateral gripper to the same state.
    _, same = solved(grippers("three_finger_gripper", unilateral=False), pulling.effort[:6], "effort")
    np.testing.assert_allclose(same.condensed.delta.e, pulling.condensed.delta.e, atol=1e-10)


def test_reference_paths():
    assert make_robot("press_finger").reference_path().shape == (9, 3)
    pinch = make_robot("two_finger_gripper").reference_path()
    assert (pinch[:, 0].min(), pinch[:, 0].max()) == (-0.030, 0.030)
    for unilateral, radius in ((True, 1.0e-3), (False, 1.5e-3)):
        path = make_robot("three_finger_gripper", unilateral=unilateral).reference_path()
        assert path.shape == (20, 3)
        np.testing.assert_allclose(np.linalg.norm(path - path.mean(axis=0), axis=1), radius, rtol=1e-9)


# -- designs and options --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", GRIPPERS)
@pytest.mark.parametrize("unit", [-1.0, 1.0], ids=["lowest", "highest"])
def test_corners_of_the_design_space_build_and_solve(name, unit):
    robot = make_robot(name)
    space = robot.design_space
    # Baseline stiffness: the button's force is too large for soft fingers.
    design = {**space.from_unit(np.full(len(space), unit)), "young_modulus": space.baseline["young_modulus"]}
    model = robot.build(design)
    state = Statics(model).solve(0.5 * COMMANDS[name])
    assert state.stable
    # The eigenvalues need no scaling: cables and effector have the same units.
    assert np.linalg.eigvalsh(state.condensed.compliance)[0] > 0.0
    assert np.linalg.norm(state.condensed.delta.e - robot.object_rest(design)) < 0.03


@pytest.mark.parametrize("name", GRIPPERS)
def test_stiffness_scales_compliance_and_nothing_else(name):
    robot = make_robot(name, mesh_size=MESH_SIZE)
    soft, stiff = (Statics(robot.build({"young_modulus": E})).solve(0.3 * COMMANDS[name]) for E in (2e6, 6e6))
    same = np.allclose(soft.condensed.compliance, 3.0 * stiff.condensed.compliance, rtol=1e-6, atol=1e-9)
    # Against the constant force of the button, the kinematics depends on stiffness, too.
    assert same == (robot.learning.stiffness_variable == "young_modulus") == (name != "press_finger")


def test_the_bar_may_be_longer_or_shorter():
    robot = make_robot("two_finger_gripper", mesh_size=MESH_SIZE)
    for length in (0.030, 0.055):
        model = robot.build({"bar_length": length})
        state = Statics(model).solve(np.zeros(4), "effort")
        first, second = tips(model, state.x)
        np.testing.assert_allclose(second - first, [0.0, length, 0.0], atol=1e-9)
    with pytest.raises(DesignError, match=r"'bar_length' = 0.1 m is out of bounds"):
        robot.build({"bar_length": 0.1})


@pytest.mark.parametrize("name", GRIPPERS)
def test_mechanics_keys_distinguish_options(name):
    base = make_robot(name).mechanics_key
    assert make_robot(name).mechanics_key == base
    for options in ({"mesh_size": MESH_SIZE}, {"gravity": (0.0, 0.0, -9.81)}, {"material": "stable_neo_hookean"}):
        assert make_robot(name, **options).mechanics_key != base
    assert make_robot(name, unilateral=False).mechanics_key == base  # the same condensed model


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("press_finger", {"button_force": -1.0}, "button_force = -1.0 N must be finite and not negative"),
        ("press_finger", {"button_force": float("nan")}, "button_force"),
        ("two_finger_gripper", {"mesh_size": 0.0}, "mesh_size = 0.0 m must be positive"),
        ("two_finger_gripper", {"meshing": "magic"}, "meshing = 'magic' is unknown"),
        ("three_finger_gripper", {"material": "jelly"}, "unknown material 'jelly'"),
        ("three_finger_gripper", {"gravity": (0.0, 1.0)}, "gravity"),
        ("three_finger_gripper", {"fingers": 4}, "robot 'three_finger_gripper'.*fingers"),
    ],
    ids=str,
)
def test_wrong_options(name, options, message):
    with pytest.raises(ValueError, match=message):
        make_robot(name, **options)


def test_taut_cables_hold_a_gripper_that_would_buckle_under_their_tensions():
    robot = make_robot("two_finger_gripper")
    design = {"length": 0.0398, "height": 0.0214, "joint_height": 0.0052, "poisson_ratio": 0.307, "bar_length": 0.051}
    statics = Statics(robot.build(design))
    states = [statics.solve(np.array([0.016, 0.0025, 0.0195, 0.004]) * part) for part in np.linspace(0.0, 1.0, 21)]
    effector = np.array([state.condensed.delta.e for state in states])
    assert np.linalg.norm(np.diff(effector, axis=0), axis=1).max() < 8e-3  # no jump
    assert states[16].stable and not states[-1].stable
    negative = [(np.linalg.eigvalsh(state.condensed.W.aa) < 0.0).sum() for state in (states[16], states[-1])]
    assert negative == [0, 1] and statics.linearisation.negative_eigenvalues == 1
    assert states[-1].slack.tolist() == [False, True, False, True]
    assert (states[-1].condensed.lambda_.a[[0, 2]] > 0.0).all()
    # The same as with the taut cables held and the slack ones free.
    statics.restore(states[-2].x, states[-2].effort)
    statics.unilateral = np.zeros(4, dtype=bool)
    held = statics.solve([0.016, 0.0, 0.0195, 0.0], ["displacement", "effort"] * 2)
    np.testing.assert_allclose(states[-1].x, held.x, atol=1e-8)
