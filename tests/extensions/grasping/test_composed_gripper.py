"""Grippers of one finger: against the gripper as one model, finite differences, symmetry, trust, the environment."""

from __future__ import annotations

import json
import shutil

import gymnasium
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.backends.surrogate import SurrogateBackend
from softgym_envs.control import InverseQP
from softgym_envs.errors import WeightsError
from softgym_envs.extensions.beams.pose import Pose
from softgym_envs.extensions.deployment.surrogate_c import export_c
from softgym_envs.extensions.fitting import within
from softgym_envs.extensions.fitting.cli import calibrate_trust
from softgym_envs.extensions.fitting.data.dataset import generate_dataset, lost
from softgym_envs.extensions.fitting.data.sampling import SamplingPlan
from softgym_envs.extensions.fitting.data.strata import draw_commands
from softgym_envs.extensions.fitting.within import calibrate_within
from softgym_envs.extensions.grasping.backends.fingers import FingersBackend, FingersHybridBackend
from softgym_envs.extensions.grasping.held_fingers import (
    Fingers,
    HeldFingers,
    LearnedFinger,
    LearnedFingers,
    SolvedFingers,
)
from softgym_envs.extensions.grasping.robots.composed_gripper import ARRANGEMENTS
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.frames import rotation_of
from softgym_envs.mechanics.solvers.learned_errors import possible_errors
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.surrogate.pretrained import pretrained_folder, pretrained_model

MESH_SIZE = 12e-3
COMMAND = 1e-3 * np.array([8.0, 6.0, 2.0, 7.0, 9.0, 0.0, 4.0, 1.0, -1.0, 2.0])
ID = "SoftGym/ComposedGripperManipulate-v0"


class Formula:
    """An analytic finger: a quadratic and a quartic function of scaled coordinates."""

    learned = False
    scale = np.array([0.01] * 5 + [0.3] * 3)
    origin = np.array([0.003, 0.02, -0.07])

    def __init__(self):
        rng = np.random.default_rng(0)
        root = rng.standard_normal((8, 8))
        self.quadratic = 0.02 * (root @ root.T / 8.0 + 2.0 * np.eye(8))
        self.directions = 0.5 * rng.standard_normal((5, 8))

    def evaluate(self, y):
        v = y / self.scale
        along = v @ self.directions.T
        stiffness = self.quadratic + 0.06 * np.einsum("bk,ki,kj->bij", along**2, self.directions, self.directions)
        effort = v @ self.quadratic + 0.02 * along**3 @ self.directions
        return Fingers(effort / self.scale, stiffness / self.scale[:, None] / self.scale)

    def knows(self, y):
        return True


def turned(count=3):
    """Placements around the origin without special directions."""
    turns = Rotation.random(count, random_state=5).as_matrix()
    return [(turn, 0.03 * np.array([np.cos(k), np.sin(k), 0.3 * k])) for k, turn in enumerate(turns)]


def held(placements, centre, axes=None):
    """The model of a rigid object that fingers of the formula hold, with all cables and the centre as rows."""
    builder = ModelBuilder()
    frame = builder.add_frame(centre, axes)
    own = [(False, False, True)] * len(placements)
    builder.add_element(HeldFingers, (frame,), own=own, energy=Formula(), placements=placements)
    model = builder.build()
    for finger in range(len(placements)):
        for cable in range(2):
            model.add("a", Pose(f"cable {finger} {cable}", frame + 4 + finger, cable, model.nodes))
    model.add("e", Point("centre", EmbeddedPoints.in_frame(frame, np.zeros(3), model.nodes)))
    return model


# -- the element ----------------------------------------------------------------------------------------------------


def test_coordinates_are_cables_displacements_and_sines():
    """Of an object whose axes at rest are not those of space, moved and turned by any amount below a quarter."""
    axes = Rotation.from_rotvec([0.4, -1.0, 2.0]).as_matrix()
    centre, places = np.array([0.01, 0.0, 0.02]), turned()
    block = held(places, centre, axes).blocks[0]
    turn, shift = Rotation.from_rotvec([0.5, 0.8, -0.3]).as_matrix(), np.array([0.004, -0.002, 0.01])
    x = np.vstack([[centre + shift], (turn @ axes).T, 1e-3 * np.arange(9).reshape(3, 3)])
    for k, (own, place) in enumerate(places):
        arm = own @ Formula.origin + place - centre
        moved = own.T @ (centre + shift + turn @ arm - (centre + arm))
        vector = Rotation.from_matrix(turn).as_rotvec()
        angle = np.linalg.norm(vector)
        expected = np.concatenate([x[4 + k, :2], moved, own.T @ vector * np.sin(angle) / angle])
        np.testing.assert_allclose(block.coordinates(x)[k], expected, atol=1e-15)


def test_W_is_the_derivative_of_the_equilibrium():
    """Tensions one by one, then forces on the object, which turns by more than 20 degrees."""
    model = held(turned(), np.array([0.01, 0.0, 0.02]))
    model.nodal_loads[0] = [44.0, -33.0, 55.0]
    statics = Statics(model, tolerance=1e-12)
    here = statics.solve(np.array([9.0, -8.0, 5.0, 4.0, 9.0, -3.0]), "effort")
    turn = Rotation.from_matrix(rotation_of(here.x, 0)).as_rotvec()
    assert np.linalg.norm(turn) > np.radians(20.0)
    h, columns = 1e-3, []
    for k in range(9):
        ends = []
        for sign in (1, -1):
            step = sign * h * np.eye(9)[k]
            end = statics.solve(here.effort[:6] + step[:6], "effort", effector_force=step[6:])
            ends.append(end.delta[:9])
        columns.append((ends[0] - ends[1]) / (2.0 * h))
    W = here.condensed.compliance
    np.testing.assert_allclose(np.array(columns).T, W, rtol=0, atol=1e-8 * np.abs(W).max())


def test_rotating_everything_rotates_the_result():
    turn, shift = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix(), np.array([0.03, -0.02, 0.1])
    command, centre = np.array([0.004, 0.002, 0.003, -0.001, 0.005, 0.0]), np.array([0.01, 0.0, 0.02])
    here = Statics(held(turned(), centre)).solve(command)
    there = Statics(held([(turn @ R, turn @ t + shift) for R, t in turned()], turn @ centre + shift)).solve(command)
    np.testing.assert_allclose(there.condensed.delta.e, turn @ here.condensed.delta.e + shift, atol=1e-10)
    np.testing.assert_allclose(there.effort[:6], here.effort[:6], atol=1e-7)
    np.testing.assert_allclose(there.condensed.W.ea, turn @ here.condensed.W.ea, atol=1e-9)


def test_possible_errors_are_the_work_of_the_efforts_errors():
    """Along the motion that a unit force causes, they give the shift of the equilibrium by wrong efforts."""
    model = held(turned(), np.array([0.01, 0.0, 0.02]))
    statics = Statics(model, tolerance=1e-12)
    command = np.array([0.004, 0.002, 0.003, -0.001, 0.005, 0.0])
    here = statics.solve(command)
    block, wrong = model.blocks[0], 1e-3 * np.random.default_rng(1).standard_normal((1, 3, 8)) / Formula.scale * 1e-2
    block.energy.errors = lambda y: wrong
    W, linear = here.condensed.W, statics.linearisation
    efforts = np.zeros((3, len(here.effort)))
    efforts[:, 6:9] = np.eye(3)
    efforts[:, :6] = -np.linalg.solve(W.aa, W.ea.T).T
    fields = np.stack([model.kinematics.row_velocity(here.x, linear.response(effort)) for effort in efforts])
    predicted = block.possible_errors(here.x, fields)[0]
    right = block.energy.evaluate
    block.energy.evaluate = lambda y: Fingers(right(y).effort + wrong[0], right(y).stiffness)
    block._last = None
    moved = Statics(model, tolerance=1e-12).solve(command)
    np.testing.assert_allclose(moved.condensed.delta.e - here.condensed.delta.e, -predicted, rtol=1e-3, atol=1e-9)


def test_errors_of_the_efforts_move_slack_cables():
    """A slack cable holds its tension, not its length: errors shift the equilibrium by it, too."""
    model = held(turned(), np.array([0.01, 0.0, 0.02]))
    for cable in model.constraints["a"]:
        cable.unilateral = True
    statics = Statics(model, tolerance=1e-12)
    command = np.array([0.004, -0.008, 0.003, -0.008, 0.005, 0.0])
    here = statics.solve(command)
    assert here.slack.any() and not here.slack.all()
    block, wrong = model.blocks[0], 1e-5 * np.random.default_rng(1).standard_normal((1, 3, 8)) / Formula.scale
    block.learned, block.energy.errors = True, lambda y: wrong
    predicted = possible_errors(statics, ~here.slack)
    fixed = possible_errors(statics, np.ones(6, dtype=bool))
    right = block.energy.evaluate
    block.energy.evaluate = lambda y: Fingers(right(y).effort + wrong[0], right(y).stiffness)
    block._last = None
    moved = Statics(model, tolerance=1e-12).solve(command)
    np.testing.assert_array_equal(moved.slack, here.slack)
    shift = np.abs(moved.condensed.delta.e - here.condensed.delta.e)
    np.testing.assert_allclose(shift, predicted, rtol=1e-3, atol=1e-9)
    assert np.abs(fixed - shift).max() > 0.03 * shift.max()


# -- against one model of the gripper -------------------------------------------------------------------------------


@pytest.mark.parametrize("fingers", list(ARRANGEMENTS))
def test_fingers_around_an_object_agree_with_the_gripper(fingers):
    """Pose, tensions, slack cables and W of a composed finite-element finger, to 1e-7 of the whole gripper."""
    robot = make_robot("composed_gripper", mesh_size=MESH_SIZE)
    design = robot.design_space.complete({"fingers": fingers, "angle": 0.25, "length": 0.041, "young_modulus": 4e6})
    part = robot.one_part()
    parts = robot.of_parts(
        {"finger": lambda design, gravity: {"energy": SolvedFingers(part, design, tolerance=1e-13)}}
    ).build(design)
    model = robot.build(design)
    expected, found = Statics(model, tolerance=1e-12).solve(COMMAND), Statics(parts, tolerance=1e-11).solve(COMMAND)
    frames = model.frames.rows[0], parts.frames.rows[0]
    np.testing.assert_allclose(rotation_of(found.x, frames[1]), rotation_of(expected.x, frames[0]), atol=1e-8)
    assert expected.slack.any()
    np.testing.assert_array_equal(found.slack, expected.slack)
    np.testing.assert_allclose(found.delta[:13], expected.delta[:13], atol=1e-10)
    np.testing.assert_allclose(found.effort[:10], expected.effort[:10], atol=1e-7 * expected.effort[:10].max())
    for block in ("aa", "ea", "ee"):
        W = getattr(expected.condensed.W, block)
        np.testing.assert_allclose(getattr(found.condensed.W, block), W, rtol=0, atol=1e-7 * np.abs(W).max())


def test_the_baseline_is_the_published_gripper():
    robot, published = make_robot("composed_gripper"), make_robot("three_finger_gripper")
    for design in (robot.design_space.baseline, robot.design_space.complete({"height": 0.021})):
        for found, expected in zip(robot.arrangement(design), published.placements, strict=True):
            np.testing.assert_allclose(found[0], expected[0], atol=1e-15)
            np.testing.assert_allclose(found[1], expected[1], atol=1e-15)


def test_fingers_of_a_side_face_the_middle():
    robot = make_robot("composed_gripper")
    design = robot.design_space.complete({"fingers": "2+3", "angle": 0.3, "spacing": 0.05})
    middle = robot.object_rest(design)
    contacts = robot.finger.contact_points({n: design[n] for n in robot.finger.design_space.names}).mean(axis=0)
    places = [(turn @ contacts + shift, turn[:, 1]) for turn, shift in robot.arrangement(design)]
    assert len(places) == 5
    for point, normal in places:
        assert abs(point[1] - middle[1]) == pytest.approx(0.035 - design["height"])
        sideways = point[0] - middle[0]
        assert normal[0] * sideways < 0.0 or abs(sideways) < 1e-12
        assert normal[1] * (middle[1] - point[1]) > 0.0


def test_missing_fingers_have_cables_that_move_nothing():
    robot = make_robot("composed_gripper", mesh_size=MESH_SIZE)
    statics = Statics(robot.build({"fingers": "1+1"}))
    state = statics.solve(np.append(np.full(4, 0.004), [0.010, 0.0, -0.002, 0.004, 0.0, 0.0]))
    np.testing.assert_allclose(state.effort[4:10], [10.0, 0.0, 0.0, 4.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_array_equal(state.slack[4:], [False, False, True, False, False, False])
    np.testing.assert_array_equal(state.condensed.W.ea[:, 4:], 0.0)
    np.testing.assert_allclose(state.condensed.W.aa[4:, 4:], 1e-3 * np.eye(6), atol=1e-15)


# -- states from which a finger is learned --------------------------------------------------------------------------


def test_states_of_fingers_on_paths_of_grippers(tmp_path):
    """They are equilibria of one finger, apart from each other; an interrupted dataset is the same when it is read."""
    robot = make_robot("composed_gripper", mesh_size=MESH_SIZE)
    part, span = robot.one_part(), robot.one_part().upper - robot.one_part().lower
    plan = SamplingPlan(2, 2, "random", seed=3, boundary=0.5, within="composed_gripper")
    folder, options = tmp_path / "data", {"mesh_size": MESH_SIZE}
    data = generate_dataset(folder, "contact_finger", plan, robot_options=options, groups_per_shard=1, progress=False)
    assert data["rest"].sum() == 2 and data["rest"][0]
    assert (data["displacement"] >= part.lower - 1e-8).all() and (data["displacement"] <= part.upper + 1e-8).all()
    first = np.flatnonzero(data["rest"])[1]
    statics = Statics(part.build(dict(zip(part.design_space.names, data["design"][0], strict=True))))
    statics.unilateral = np.zeros(8, dtype=bool)
    steps = np.abs(np.diff(data["displacement"][:first], axis=0)) / span
    assert (steps.max(axis=1) > 0.0099).all()
    for row in (1, first // 2, first - 1):
        state = statics.solve(data["displacement"][row])
        np.testing.assert_allclose(state.condensed.lambda_.a, data["effort"][row], atol=1e-4)
        np.testing.assert_allclose(state.condensed.delta.e, data["effector"][row], atol=1e-7)
    again = generate_dataset(folder, "contact_finger", plan, robot_options=options, groups_per_shard=1, progress=False)
    np.testing.assert_array_equal(again["effort"], data["effort"])
    assert lost(folder).bodies == 0


def test_paths_of_fingers_lead_to_the_equilibrium_of_the_gripper():
    robot, command = make_robot("composed_gripper", mesh_size=MESH_SIZE), np.tile([0.003, 0.001, 0.004, 0.002, 0.0], 2)
    design = robot.design_space.complete({"fingers": "1+2", "spacing": 0.05})
    paths, given_up = robot.part_states(design, command[None])
    found = np.array([path[-1].condensed.delta.a[:2] for path in paths]).ravel()
    expected = Statics(robot.build(design)).solve(command)
    assert given_up == 0 and expected.slack[:6].any()
    np.testing.assert_allclose(found, expected.delta[:6], atol=2e-4)


def test_a_command_that_a_finger_cannot_follow_is_lost_after_few_tries(monkeypatch):
    robot = make_robot("composed_gripper", mesh_size=MESH_SIZE)
    solve, tries = SolvedFingers.evaluate, []

    def evaluate(self, y):
        beyond = y[:, 0].max() > 0.005
        tries.append(beyond)
        return solve(self, y + 1.0 if beyond else y)

    monkeypatch.setattr(SolvedFingers, "evaluate", evaluate)
    commands = np.array([np.full(10, 0.004), np.full(10, 0.006), np.full(10, 0.003)])
    paths, given_up = robot.part_states(robot.design_space.baseline, commands)
    assert given_up == 1 and sum(tries) == 3 and len(paths) == 3
    assert paths[0][-1].condensed.delta.a[0] == pytest.approx(0.003, abs=2e-4)


# -- learned fingers ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def model():
    return pretrained_model(make_robot("composed_gripper").one_part())


@pytest.mark.parametrize("fingers", list(ARRANGEMENTS))
def test_one_learned_finger_makes_every_gripper(fingers):
    """Shipped weights, on a body that is in no dataset, against the gripper in one model."""
    robot = make_robot("composed_gripper")
    design = {"fingers": fingers, "spacing": 0.055, "angle": 0.2, "length": 0.0395, "poisson_ratio": 0.42}
    learned, whole = FingersBackend(robot, design), FEMBackend(robot, design)
    expected, found = whole.step(0.6 * COMMAND), learned.step(0.6 * COMMAND)
    assert np.linalg.norm(found.effector - expected.effector) < 2e-4
    assert np.abs(found.effort - expected.effort).max() < 0.02 * expected.effort.max()
    np.testing.assert_array_equal(found.slack, expected.slack)
    assert 0.0 < found.uncertainty < 5e-4 and found.trusted


def test_the_stiffness_of_the_material_scales_efforts(model):
    soft, stiff = LearnedFingers(model, {"young_modulus": 3e6}), LearnedFingers(model, {"young_modulus": 6e6})
    y = np.array([[0.004, 0.003, 0.0, 0.001, 0.004, 0.1, 0.0, 0.0]])
    np.testing.assert_allclose(stiff.evaluate(y).effort, 2.0 * soft.evaluate(y).effort, rtol=1e-6)
    np.testing.assert_allclose(stiff.errors(y), 2.0 * soft.errors(y), rtol=1e-6)


def test_efforts_and_stiffness_of_learned_fingers_belong_together(model):
    fingers = LearnedFingers(model)
    y = np.array([[0.004, 0.003, 0.0, 0.001, 0.004, 0.1, 0.02, -0.01]])
    stiffness = fingers.evaluate(y).stiffness[0]
    steps = np.array([2e-4] * 5 + [5e-3] * 3)
    differences = np.array(
        [
            (fingers.evaluate(y + s * e).effort - fingers.evaluate(y - s * e).effort)[0] / (2 * s)
            for s, e in zip(steps, np.eye(8), strict=True)
        ]
    )
    scale = np.sqrt(np.abs(np.diag(stiffness)))
    np.testing.assert_allclose(differences / scale / scale[:, None], stiffness / scale / scale[:, None], atol=0.01)


def test_a_finger_out_of_its_domain_is_not_trusted(model):
    domain = {**model.card["domain"], "displacement": np.array(model.card["domain"]["displacement"])}
    domain["displacement"][0, 1] = 2e-3  # of the first cable
    narrow = LearnedFingers(type(model)(model.robot, model.tensors, {**model.card, "domain": domain}))
    y = np.zeros((3, 8))
    assert narrow.knows(y)
    y[1, 0] = 4e-3
    assert not narrow.knows(y)
    assert LearnedFingers(model).knows(y)


def test_the_factor_of_errors_stands_in_the_card(model):
    y = np.array([[0.004, 0.003, 0.0, 0.001, 0.004, 0.1, 0.0, 0.0]])
    plain, twice = (
        LearnedFingers(type(model)(model.robot, model.tensors, {**model.card, "calibration": {"inflation": factor}}))
        for factor in (1.0, 2.0)
    )
    np.testing.assert_allclose(twice.errors(y), 2.0 * plain.errors(y), rtol=1e-12)


def test_slack_corners_have_a_factor_of_their_own(tmp_path):
    """It grows with the share of the commands at their bounds, of the fingers that a body has."""
    robot = make_robot("composed_gripper")
    design, corner = {"fingers": "1+1"}, np.full(10, 0.009)
    corner[:4] = [-0.002, 0.020, 0.020, 0.020]
    found = []
    for factor in (1.0, 3.0):
        folder = tmp_path / str(factor)
        shutil.copytree(pretrained_folder(robot.one_part()), folder)
        card = json.loads((folder / "model.json").read_text())
        card["calibration"]["slack_corners"] = factor
        (folder / "model.json").write_text(json.dumps(card))
        backend = FingersBackend(robot, design, folder)
        states = [backend.step(command) for command in (np.full(10, 0.009), corner)]
        assert not states[0].slack.any() and states[1].slack.any()
        found.append([state.uncertainty for state in states])
    np.testing.assert_allclose(np.divide(*found[::-1]), [1.0, 3.0], rtol=1e-6)


def test_calibration_by_whole_grippers_covers_their_errors(tmp_path, monkeypatch):
    """Also by the command line; the states of finite elements are kept and not solved again."""
    robot, strata = make_robot("composed_gripper"), ("inside", "corners")
    monkeypatch.setattr(within, "strata_of", lambda robot, buckles: strata)  # slack corners take minutes
    shutil.copytree(pretrained_folder(robot.one_part()), tmp_path / "weights")
    options = {"bodies": 2, "states": 2, "seed": 5, "state_folder": tmp_path / "states"}
    found = calibrate_within(tmp_path / "weights", robot, **options)
    card = json.loads((tmp_path / "weights" / "model.json").read_text())["calibration"]
    assert card["within"] == "composed_gripper" and card["inflation"] > 0.0
    assert set(found) == set(card["strata"]) == set(strata)
    # The factor of so few states is the largest ratio: that of one state, which rounding may leave uncovered.
    assert sum((1.0 - row.coverage) * row.states for row in found.values()) < 1.5
    arguments = ["--weights", str(tmp_path / "weights"), "--folder", str(tmp_path / "states"), "--seed", "5"]
    sizes = ["--bodies", "2", "--states", "2"]
    result = CliRunner().invoke(calibrate_trust, ["composed_gripper", *arguments, *sizes])
    assert result.exit_code == 0, result.output
    assert json.loads(result.output)["corners"]["mean"] == pytest.approx(found["corners"].mean, rel=1e-6)
    same = CliRunner().invoke(calibrate_trust, ["composed_gripper", "--test", *arguments, *sizes])
    assert "seed = 5 is that of the calibration" in str(same.exception)
    card = json.loads((tmp_path / "weights" / "model.json").read_text())
    card["calibration"]["seed"] = 4  # as if these states were new
    (tmp_path / "weights" / "model.json").write_text(json.dumps(card))
    for tolerance, share in (("1.0", 1.0), ("1e-9", 0.0)):
        tested = CliRunner().invoke(
            calibrate_trust, ["composed_gripper", "--test", "--tolerance", tolerance, *arguments, *sizes]
        )
        assert tested.exit_code == 0, tested.output
        rows = json.loads(tested.output)
        assert rows["inside"]["mean"] == pytest.approx(found["inside"].mean, rel=1e-6)
        assert rows["inside"]["trusted"] == share
        by_number = [row["states"] for name, row in rows.items() if name.startswith("inside, fingers ")]
        assert sum(by_number) == rows["inside"]["states"]
    refused = CliRunner().invoke(calibrate_trust, ["finger", "--test", "--tolerance", "1e-4"])
    assert "--tolerance is for --test of robots of equal parts" in refused.output


def test_bodies_at_corners_have_any_number_of_fingers():
    robot = make_robot("composed_gripper")
    drawn, space = draw_commands(robot, "corners", 40, 1), robot.design_space
    column = space.names.index("fingers")
    assert {space["fingers"].choice(value) for value in drawn.design[:, column]} == set(ARRANGEMENTS)
    for k, name in enumerate(space.names):
        if name not in ("fingers", "young_modulus"):
            assert set(drawn.design[:, k]) == {space[name].low, space[name].high}


def test_models_of_other_robots_are_rejected():
    with pytest.raises(ValueError, match="must be of robot 'contact_finger', got one of robot 'finger'"):
        LearnedFinger(pretrained_model(make_robot("finger")))({}, np.zeros(3))


def test_a_contact_finger_alone_is_not_an_environment():
    with pytest.raises(
        ValueError, match="'contact_finger' has a non-convex energy and cannot run on the surrogate alone"
    ):
        SurrogateBackend(make_robot("contact_finger"))
    with pytest.raises(ValueError, match="'contact_finger' cannot be exported: its energy is not convex"):
        export_c(pretrained_model(make_robot("contact_finger")), {}, "finger.h")


@pytest.mark.parametrize("backend", [FingersBackend, FingersHybridBackend])
def test_what_learned_fingers_cannot_do_is_refused(backend):
    with pytest.raises(WeightsError, match="learned fingers touch nothing, got obstacles or self_contact"):
        backend(make_robot("composed_gripper", self_contact=True))
    with pytest.raises(WeightsError, match="no weights ship for 'contact_finger_accurate': use backend='fem'"):
        backend(make_robot("composed_gripper", mesh="accurate"))
    with pytest.raises(WeightsError, match="gravity"):
        backend(make_robot("composed_gripper", gravity=(0.0, 0.0, -9.81)))


# -- the environment ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fingers", list(ARRANGEMENTS))
def test_the_inverse_controller_moves_the_object(fingers):
    """From goal to goal of the reference path, as far as cables that only pull can go."""
    env = gymnasium.make(ID, backend="surrogate", disable_env_checker=True).unwrapped
    env.reset(seed=0, options={"design": {"fingers": fingers, "spacing": 0.05}})
    controller = InverseQP.for_robot(env.robot)
    state = env.backend.state
    goal = state.effector[0] + [0.0, 0.0, 0.004]
    command = np.zeros(10)
    for _ in range(18):
        command = controller.solve(state.condensed, goal, command, state.slack)
        state = env.backend.step(command)
    assert np.linalg.norm(state.effector[0] - goal) < 2e-4


def test_hybrid_states_are_those_of_finite_elements_where_fingers_are_not_trusted():
    robot = make_robot("composed_gripper")
    hybrid, whole = FingersHybridBackend(robot), FEMBackend(robot)
    far = np.full(10, 0.0195)
    found, expected = hybrid.step(far), whole.step(far)
    assert hybrid.fem_calls
    np.testing.assert_allclose(found.effector, expected.effector, atol=1e-8)
