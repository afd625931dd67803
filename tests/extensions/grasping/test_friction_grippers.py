"""Grippers that hold an object by friction: they lift it, carry it along a path, and drop it."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.control.inverse_qp import InverseQP
from softgym_envs.mechanics.solvers.statics import Statics

GRIPPERS = ("two_finger_friction_gripper", "three_finger_friction_gripper")
WEIGHT = 0.050 * 9.81


def close(backend, pull, steps=6):
    """Shorten all cables to ``pull`` [m] in equal steps."""
    start = backend.state.command
    for share in np.arange(1, steps + 1) / steps:
        state = backend.step(start + share * (pull - start))
    return state


def lifted(state, robot):
    """Height of the object above its rest [m]."""
    return state.effector[0, 2] - robot.effector_rest[2]


@pytest.mark.parametrize("name", GRIPPERS)
def test_fingers_lift_the_object_and_put_it_down(name):
    robot = make_robot(name)
    backend = FEMBackend(robot)
    rest = backend.state
    np.testing.assert_allclose(rest.contacts.total[1], [0.0, 0.0, WEIGHT], atol=1e-4)  # on its stand
    held = close(backend, 3e-3)
    assert lifted(held, robot) > 1.5e-3 and held.contacts.smallest_gap > 0.0
    # The weight of the object pulls on the fingers; on the stand there is no force.
    np.testing.assert_allclose(held.contacts.total, [[0.0, 0.0, -WEIGHT], [0.0, 0.0, 0.0]], atol=1e-4)
    back = close(backend, 0.0)
    assert lifted(back, robot) < 1e-4
    by_stand, by_object = back.contacts.total[1], back.contacts.total[0]  # the second is on the fingers
    np.testing.assert_allclose(by_stand - by_object, [0.0, 0.0, WEIGHT], atol=1e-4)
    assert by_stand[2] > 0.5 * WEIGHT


@pytest.mark.parametrize("name", GRIPPERS)
def test_slippery_fingers_leave_the_object_on_its_stand(name):
    robot = make_robot(name, friction=0.02)
    found = close(FEMBackend(robot), 2e-3)
    stand = found.contacts.obstacles.index("stand")
    assert abs(lifted(found, robot)) < 1e-4
    assert 0.5 * WEIGHT < found.contacts.total[stand, 2] <= WEIGHT
    assert found.contacts.pressing.sum() > 1.5  # though they press it


def test_object_falls_when_friction_is_lost():
    """A held object of whose friction a tenth is left falls onto the stand; the same hold with friction stays."""
    name, still = "two_finger_friction_gripper", {"dynamics": True, "control_step": 0.03}
    holding = FEMBackend(make_robot(name))
    held = close(holding, 3e-3, 8)
    height = lifted(held, holding.robot)
    ends = []
    for friction in (0.6, 0.04):
        backend = FEMBackend(make_robot(name, friction=friction), **still)
        backend.restore(held)
        backend.step(held.command)
        ends.append(backend.step(held.command))
    assert lifted(ends[0], holding.robot) == pytest.approx(height, abs=2e-5)
    assert lifted(ends[1], holding.robot) < 0.1 * height
    assert ends[1].contacts.total[1, 2] > 0.5 * WEIGHT


def test_released_object_falls():
    robot = make_robot("two_finger_friction_gripper")
    backend = FEMBackend(robot, dynamics=True, control_step=0.03)
    statics = FEMBackend(robot)
    backend.restore(close(statics, 3e-3, 8))
    backend.step(np.zeros(4))
    end = backend.step(np.zeros(4))
    assert lifted(end, robot) < 1e-4
    np.testing.assert_allclose(end.contacts.total[0], 0.0, atol=1e-9)  # the fingers are open


def test_compliance_of_a_held_object():
    """W of the actuators and the object in the grip, where some points slide: right in the direction of loading."""
    robot = make_robot("two_finger_friction_gripper")
    statics = Statics(robot.build(), tolerance=1e-13, max_iterations=60)
    for pull in np.arange(0.5e-3, 3.1e-3, 0.5e-3):
        found = statics.solve(np.full(4, pull))
    W = found.condensed.W
    start, x, effort, command = statics.memory, statics.x, statics.effort, np.full(4, pull)

    def solved(change, force):
        statics.restore(x, effort, memory=start)
        return statics.solve(command + change, effector_force=force).delta[4:7]

    h = 1e-5
    by_force = np.column_stack(
        [(solved(np.zeros(4), h * e) - solved(np.zeros(4), -h * e)) / (2 * h) for e in np.eye(3)]
    )
    exact = W.ee - W.ea @ np.linalg.solve(W.aa, W.ae)
    assert np.abs(by_force - exact).max() < 1e-4 * np.abs(exact).max()
    h = 1e-8
    by_pull = np.column_stack([(solved(h * e, np.zeros(3)) - solved(-h * e, np.zeros(3))) / (2 * h) for e in np.eye(4)])
    exact = W.ea @ np.linalg.inv(W.aa)
    assert np.abs(by_pull - exact).max() < 1e-4 * np.abs(exact).max()


def test_inverse_control_moves_the_cube_along_its_circle():
    """Radius 1 mm, as for the gripper whose ball joints hold the cube; the fingers keep a grip of 1 N in each cable."""
    robot = make_robot("three_finger_friction_gripper")
    backend = FEMBackend(robot)
    state = close(backend, 2e-3, 4)
    controller = InverseQP.for_robot(robot, min_effort=np.ones(6), rates=np.full(6, 4e-4))
    circle = robot.reference_path(6)
    errors = []
    for goal in np.vstack([np.linspace(state.effector[0], circle[0], 5)[1:], circle]):
        for _ in range(3):
            state = backend.step(controller.solve(state.condensed, goal, state.command, state.slack))
        errors.append(np.linalg.norm(state.effector[0] - goal))
    assert max(errors[4:]) < 1e-5
    np.testing.assert_allclose(state.contacts.total[0], [0.0, 0.0, -WEIGHT], atol=1e-4)


@pytest.mark.parametrize("option", ["friction", "object_mass", "stand_friction"])
def test_wrong_options_are_named(option):
    with pytest.raises(ValueError, match=f"two_finger_friction_gripper.*{option} = -1"):
        make_robot("two_finger_friction_gripper", **{option: -1})


def test_object_without_mass_is_refused():
    with pytest.raises(ValueError, match="object_mass = 0 kg must be positive"):
        make_robot("three_finger_friction_gripper", object_mass=0.0)
