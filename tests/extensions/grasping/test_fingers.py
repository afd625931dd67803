"""Grippers from one finger: against the gripper as one model, finite differences, balance, slack cables, symmetry."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softgym_envs import make_robot
from softgym_envs.backends.surrogate import SurrogateBackend
from softgym_envs.control import InverseQP
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.deployment.surrogate_c import export_c
from softgym_envs.extensions.grasping import CoupledFingers, SurrogateFingers
from softgym_envs.extensions.grasping.control.finger_models import FEMFingers
from softgym_envs.mechanics.frames import rotation_of
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.surrogate.model import SurrogateModel
from softgym_envs.surrogate.pretrained import pretrained_model

MESH_SIZE = 12e-3
# Cables [m]. The second command of each leaves cables slack, or bends the finger by 30 degrees.
COMMANDS = {
    "three_finger_gripper": 1e-3 * np.array([[3.0, 2.0, 4.0, 1.0, 1.0, 5.0], [8.0, 6.0, 2.0, 7.0, 9.0, 0.0]]),
    "press_finger": 1e-3 * np.array([[5.0, 3.0], [8.0, 8.0]]),
}
LOADS = {"three_finger_gripper": np.zeros(6), "press_finger": np.array([0.0, -2.0, 0.0, 0.0, 0.0, 0.0])}


class Energy:
    """An analytic finger: a quadratic and a quartic function of scaled coordinates."""

    scale = np.array([0.01] * 5 + [0.3] * 3)

    def __init__(self, seed=0, limit=np.inf):
        rng = np.random.default_rng(seed)
        root = rng.standard_normal((8, 8))
        self.quadratic = 0.02 * (root @ root.T / 8.0 + 2.0 * np.eye(8))
        self.directions = 0.5 * rng.standard_normal((5, 8))
        self.tip = 0.5 * rng.standard_normal((3, 8)) / 8.0
        self.origin = np.array([0.003, 0.02, -0.07])
        self.span = 4.0 * self.scale
        self.limit = limit
        self.calls = []

    def evaluate(self, displacement):
        self.calls.append(len(displacement))
        if (np.abs(displacement / self.scale) > self.limit).any():
            raise ConvergenceError("too far")
        v = displacement / self.scale
        along = v @ self.directions.T
        effort = (v @ self.quadratic + 0.02 * along**3 @ self.directions) / self.scale
        hessian = self.quadratic + 0.06 * np.einsum("bk,ki,kj->bij", along**2, self.directions, self.directions)
        compliance = np.linalg.inv(hessian) * self.scale[:, None] * self.scale
        jacobian = 0.01 * self.tip / self.scale
        moved = jacobian @ compliance
        W = np.block([[compliance, moved.swapaxes(1, 2)], [moved, moved @ jacobian.T + 1e-6 * np.eye(3)]])
        return effort, W, displacement @ jacobian.T

    def trust(self, displacement):
        return np.zeros(len(displacement)), np.ones(len(displacement), dtype=bool)


def turned(count=3):
    """Placements around the origin without special directions."""
    turns = Rotation.random(count, random_state=5).as_matrix()
    return [(turn, 0.03 * np.array([np.cos(k), np.sin(k), 0.3 * k])) for k, turn in enumerate(turns)]


def made(fingers=None, **options):
    options = {"load": np.array([4.0, -3.0, 5.0, 0.3, -0.2, 0.3]), "tolerance": 1e-12, **options}
    return CoupledFingers(fingers or Energy(), turned(), np.array([0.01, 0.0, 0.02]), **options)


def vector(rotation):
    return Rotation.from_matrix(rotation).as_rotvec()


@pytest.fixture(scope="module")
def parts():
    """The finger as a robot, with the default cables."""
    return make_robot("contact_finger", mesh_size=MESH_SIZE)


# -- against one model of the gripper -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(COMMANDS))
def test_fingers_around_an_object_agree_with_the_gripper(parts, name):
    """Pose, tensions, slack cables and W of two states, to 1e-7 of the gripper in one finite-element model."""
    robot = make_robot(name, mesh_size=MESH_SIZE)
    model = robot.build()
    frame = model.frames.rows[0]
    whole = Statics(model, tolerance=1e-12)
    coupled = CoupledFingers.for_robot(robot, FEMFingers(parts, tolerance=1e-13), load=LOADS[name], tolerance=1e-11)
    for command in COMMANDS[name]:
        expected, found = whole.solve(command), coupled.solve(command)
        n = len(command)
        np.testing.assert_allclose(found.position, expected.x[frame], atol=1e-10)
        np.testing.assert_allclose(found.rotation, rotation_of(expected.x, frame), atol=1e-8)
        np.testing.assert_allclose(found.displacement, expected.delta[:n], atol=1e-10)
        np.testing.assert_allclose(found.effort, expected.effort[:n], atol=1e-7 * expected.effort[:n].max())
        np.testing.assert_array_equal(found.slack, expected.slack)
        for block in ("aa", "ea", "ee"):
            W = getattr(expected.condensed.W, block)
            np.testing.assert_allclose(getattr(found.condensed.W, block), W, rtol=0, atol=1e-7 * np.abs(W).max())
        np.testing.assert_allclose(found.condensed.delta.array[: n + 3], expected.condensed.delta.array, atol=1e-10)
        # The sum of the wrenches on the fingers is the load.
        forces = np.einsum("fij,fj->i", coupled.turns, found.wrenches[:, :3])
        np.testing.assert_allclose(forces, LOADS[name][:3], atol=1e-6)
    assert name != "three_finger_gripper" or found.slack.any()


def test_other_designs_agree_with_the_gripper_too(parts):
    robot = make_robot("three_finger_gripper", mesh_size=MESH_SIZE)
    design = {"length": 0.041, "height": 0.0215, "joint_height": 0.0055, "young_modulus": 5e6, "poisson_ratio": 0.4}
    command = COMMANDS[robot.name][0]
    expected = Statics(robot.build(design)).solve(command)
    found = CoupledFingers.for_robot(robot, FEMFingers(parts, design), design).solve(command)
    np.testing.assert_allclose(found.position, expected.condensed.delta.e, atol=1e-8)
    np.testing.assert_allclose(found.effort, expected.effort[:6], atol=1e-4)


def test_the_inverse_controller_moves_the_object(parts):
    """With the coupled model alone; the gripper as one model goes where it predicts."""
    robot = make_robot("three_finger_gripper", mesh_size=MESH_SIZE)
    coupled = CoupledFingers.for_robot(robot, FEMFingers(parts))
    controller = InverseQP.for_robot(robot)
    goal = coupled.centre + [0.0005, -0.0005, 0.004]
    command = np.zeros(6)
    state = coupled.solve(command)
    for _ in range(9):
        command = controller.solve(state.condensed, goal, command, state.slack)
        state = coupled.solve(command)
    np.testing.assert_allclose(state.position, goal, atol=1e-5)
    whole = Statics(robot.build()).solve(command)
    np.testing.assert_allclose(whole.condensed.delta.e, goal, atol=1e-5)


def test_one_learned_finger_makes_the_gripper():
    """Shipped weights, on commands and bodies that are in no dataset, against the gripper in one model."""
    robot, model = make_robot("three_finger_gripper"), pretrained_model(make_robot("contact_finger"))
    rng = np.random.default_rng(3)
    for design in (robot.design_space.baseline, robot.design_space.sample(rng)):
        whole = Statics(robot.build(design))
        learned = CoupledFingers.for_robot(robot, SurrogateFingers(model, design), design)
        for _ in range(2):
            command = rng.uniform(robot.lower, robot.upper)
            expected, found = whole.solve(command), learned.solve(command)
            assert np.linalg.norm(found.position - expected.condensed.delta.e) < 1e-3
            assert np.abs(found.effort - expected.effort[:6]).max() < 0.05 * expected.effort.max()
            np.testing.assert_array_equal(found.slack, expected.slack)
            assert found.trusted and 0.0 < found.uncertainty < 1e-3


def test_a_finger_out_of_its_domain_is_reported():
    model, gripper = pretrained_model(make_robot("contact_finger")), make_robot("three_finger_gripper")
    box = np.array(model.card["domain"]["displacement"])
    box[0, 1] = 2e-3  # of the first cable
    narrow = type(model)(
        model.robot, model.tensors, {**model.card, "domain": {**model.card["domain"], "displacement": box}}
    )
    fingers = CoupledFingers.for_robot(gripper, SurrogateFingers(narrow))
    command = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0]) * 1e-3
    assert fingers.solve(command).trusted
    command[2] = 4e-3
    assert not fingers.solve(command).trusted


def test_a_contact_finger_alone_is_not_an_environment():
    with pytest.raises(
        ValueError, match="'contact_finger' has a non-convex energy and cannot run on the surrogate alone"
    ):
        SurrogateBackend(make_robot("contact_finger"))
    with pytest.raises(ValueError, match="'contact_finger' cannot be exported: its energy is not convex"):
        export_c(pretrained_model(make_robot("contact_finger")), {}, "finger.h")


# -- algebra on the analytic finger ---------------------------------------------------------------------------------


def test_W_is_the_derivative_of_the_coupled_equilibrium():
    """Tensions one by one, then forces on the object, with a torque on it and the object turned by 37 degrees."""
    coupled = made(unilateral=False, load=np.array([4.0, -3.0, 5.0, 6.0, -4.0, 6.0]))
    here = coupled.solve(np.array([9.0, -8.0, 5.0, 4.0, 9.0, -3.0]), "effort")
    assert np.linalg.norm(vector(here.rotation)) > np.radians(20.0)
    assert np.abs(here.wrenches).max() > 0.1
    W = here.condensed.compliance
    np.testing.assert_array_equal(W, W.T)
    h, columns, load = 1e-3, [], coupled.load
    for k in range(9):
        ends = []
        for sign in (1, -1):
            step = sign * h * np.eye(9)[k]
            coupled.load = load + np.append(step[6:], np.zeros(3))
            end = coupled.solve(here.effort + step[:6], "effort")
            ends.append(np.append(end.displacement, end.position))
        columns.append((ends[0] - ends[1]) / (2.0 * h))
    np.testing.assert_allclose(np.array(columns).T, W, rtol=0, atol=1e-8 * np.abs(W).max())
    # The free displacement is consistent with W.
    np.testing.assert_allclose(here.condensed.delta.a, here.displacement, atol=1e-15)
    np.testing.assert_allclose(here.condensed.delta.e, here.position, atol=1e-15)


def test_the_equilibrium_is_where_the_energy_is_smallest():
    """Efforts in, efforts out; the forces on the object and their torque balance its load."""
    coupled = made(unilateral=False)
    tensions = np.array([3.0, 1.0, -2.0, 4.0, 0.0, 2.0])
    state = coupled.solve(tensions, "effort")
    np.testing.assert_allclose(state.effort, tensions, atol=1e-9)
    R, forces = state.rotation, np.einsum("fij,fj->fi", coupled.turns, state.wrenches[:, :3])
    np.testing.assert_allclose(forces.sum(axis=0), coupled.load[:3], atol=1e-9)
    sines = np.einsum("fij,fj->i", coupled.turns, state.wrenches[:, 3:]) - coupled.load[3:]
    torque = np.cross(coupled.offsets @ R.T, forces).sum(axis=0) + 0.5 * (np.trace(R) * np.eye(3) - R).T @ sines
    np.testing.assert_allclose(torque, 0.0, atol=1e-10)
    # Displacements lead back to the same state.
    again = made(unilateral=False).solve(state.displacement)
    np.testing.assert_allclose(again.position, state.position, atol=1e-10)
    np.testing.assert_allclose(again.effort, tensions, atol=1e-8)


def test_cables_that_cannot_push_hang_slack():
    command = np.array([0.008, -0.002, 0.004, -0.006, -0.004, 0.006])
    pulling, both = made().solve(command), made(unilateral=False).solve(command)
    assert (both.effort < 0.0).any()
    np.testing.assert_allclose(both.displacement, command, atol=1e-12)
    assert pulling.slack.any() and not pulling.slack.all()
    assert (pulling.effort[pulling.slack] == 0.0).all()
    assert (pulling.effort[~pulling.slack] > 0.0).all()
    assert (pulling.displacement >= command - 1e-12).all()
    np.testing.assert_allclose(pulling.displacement[~pulling.slack], command[~pulling.slack], atol=1e-12)
    same = made(unilateral=False).solve(pulling.effort, "effort")
    np.testing.assert_allclose(same.position, pulling.position, atol=1e-9)


def test_rotating_everything_rotates_the_result():
    turn, shift = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix(), np.array([0.03, -0.02, 0.1])
    command = np.array([0.004, 0.002, 0.003, -0.001, 0.005, 0.0])
    one = made()
    load = np.concatenate([turn @ one.load[:3], turn @ one.load[3:]])
    places = [(turn @ R, turn @ t + shift) for R, t in turned()]
    other = CoupledFingers(Energy(), places, turn @ one.centre + shift, load=load, tolerance=1e-12)
    here, there = one.solve(command), other.solve(command)
    np.testing.assert_allclose(there.position, turn @ here.position + shift, atol=1e-10)
    np.testing.assert_allclose(there.rotation, turn @ here.rotation @ turn.T, atol=1e-9)
    np.testing.assert_allclose(there.effort, here.effort, atol=1e-8)
    np.testing.assert_allclose(there.tips, here.tips @ turn.T + shift, atol=1e-10)
    np.testing.assert_allclose(there.condensed.W.ea, turn @ here.condensed.W.ea, atol=1e-9)
    np.testing.assert_allclose(there.condensed.W.aa, here.condensed.W.aa, atol=1e-9)


def test_earlier_states_can_be_restored():
    coupled = made()
    first = coupled.solve(np.full(6, 0.003))
    coupled.solve(np.array([0.006, 0.0, 0.004, 0.0, 0.0, 0.006]))
    coupled.restore(first)
    again = coupled.solve(first.command)
    np.testing.assert_allclose(again.position, first.position, atol=1e-12)
    coupled.reset()
    fresh = coupled.solve(first.command)
    np.testing.assert_allclose(fresh.condensed.compliance, first.condensed.compliance, atol=1e-9)


# -- learned fingers ------------------------------------------------------------------------------------------------


class Learned(SurrogateModel):
    """The formula in place of a network."""

    network = "formula"

    def __init__(self, robot):
        super().__init__(robot, {}, {})
        self.energy = Energy()

    def _prepare(self, design):
        return {"design": design}

    def _state(self, context, displacement):
        effort, _, tip = self.energy.evaluate(displacement)
        return effort, tip, np.full(len(tip), np.inf)

    def _compliance(self, context, displacement):
        return self.energy.evaluate(displacement)[1]


def test_learned_fingers_are_evaluated_together(parts):
    """One call of the model for all fingers, and the stiffness of the design's material."""
    model = Learned(parts)
    fingers = SurrogateFingers(model, {"young_modulus": 6e6})
    np.testing.assert_allclose(fingers.origin, parts.object_frame(parts.design_space.baseline))
    coupled = CoupledFingers(fingers, turned(), np.zeros(3))
    state = coupled.solve(np.full(6, 0.003))
    assert set(model.energy.calls) == {3}
    formula = Energy()
    formula.origin = fingers.origin
    expected = CoupledFingers(formula, turned(), np.zeros(3)).solve(np.full(6, 0.003))
    np.testing.assert_allclose(state.position, expected.position, atol=1e-8)
    np.testing.assert_allclose(state.effort, 2.0 * expected.effort, rtol=1e-5)
    np.testing.assert_allclose(state.condensed.compliance, 0.5 * expected.condensed.compliance, atol=1e-6)


def test_only_models_of_the_contact_finger_make_a_gripper():
    with pytest.raises(ValueError, match="must be of robot 'contact_finger', got one of robot 'finger'"):
        SurrogateFingers(Learned(make_robot("finger")))


# -- clear errors ---------------------------------------------------------------------------------------------------


def test_unreachable_commands_are_reported_and_nothing_moves():
    coupled = made(Energy(limit=1.5))
    kept = coupled.solve(np.full(6, 0.003))
    with pytest.raises(ConvergenceError, match=r"no equilibrium for cables .* \(displacement\): stopped at") as caught:
        coupled.solve(np.full(6, 0.05))
    assert 0.0 < caught.value.fraction < 1.0
    np.testing.assert_allclose(coupled.solve(kept.command).position, kept.position, atol=1e-12)


def test_an_object_turned_over_is_reported():
    """Beyond 90 degrees, the sines no longer determine the rotation."""
    coupled = made(load=np.zeros(6))
    coupled.load = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 5.0e4])
    with pytest.raises(ConvergenceError):
        coupled.solve(np.zeros(6))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"placements": []}, "needs at least one finger"),
        ({"placements": [(np.diag([1.0, 1.0, -1.0]), np.zeros(3))]}, "right-handed"),
        ({"placements": [(2.0 * np.eye(3), np.zeros(3))]}, "orthonormal"),
        ({"placements": [(np.eye(3), [0.0, np.nan, 0.0])]}, "shifts must be finite"),
        ({"centre": [0.0, 0.0]}, "centre must be finite with shape"),
        ({"load": np.zeros(3)}, "load must be finite with shape"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_malformed_grippers_are_rejected(options, message):
    with pytest.raises(ValueError, match=message):
        CoupledFingers(**{"fingers": Energy(), "placements": turned(), "centre": np.zeros(3), **options})


def test_malformed_commands_are_rejected(parts):
    coupled = made()
    for command, mode, message in [
        (np.zeros(5), "displacement", "must be 6 finite numbers"),
        (np.full(6, np.nan), "displacement", "must be 6 finite numbers"),
        (np.zeros(6), "force", "mode = 'force' is unknown"),
        (np.full(6, -1.0), "effort", "cannot push"),
    ]:
        with pytest.raises(ValueError, match=message):
            coupled.solve(command, mode)
    with pytest.raises(ValueError, match="'two_finger_gripper' do not hold a rigid object"):
        CoupledFingers.for_robot(make_robot("two_finger_gripper", mesh_size=MESH_SIZE), Energy())
