"""Symmetries of robots, and images of the states of symmetric ones."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.extensions.fitting.data.states import with_images
from softgym_envs.mechanics.solvers.statics import Statics

ROBOTS = {
    "finger": ({"mesh": "accurate", "mesh_size": 0.03, "self_contact": False}, [0.004, 0.008]),
    "diamond": ({}, [0.006, 0.011, -0.003, 0.002]),
    "cable_trunk": ({}, [0.008, 0.003, 0.0, 0.001, 0.002, 0.0, 0.005, 0.004]),
    "two_finger_gripper": ({}, [0.010, 0.0, 0.005, 0.003]),
}


@pytest.mark.parametrize("name", ROBOTS)
def test_images_are_equilibria_of_the_exchanged_commands(name):
    options, command = ROBOTS[name]
    robot = make_robot(name, **options)
    model, rows = robot.build(), []
    commands = [np.array(command), *(np.array(command)[symmetry.order] for symmetry in robot.learning.symmetries)]
    for each in commands:
        state = Statics(model).solve(each).condensed
        rows.append(
            {
                "design": robot.design_space.baseline.array,
                "displacement": state.delta.a,
                "effort": state.lambda_.a,
                "effector": state.delta.e,
                "compliance": state.compliance[np.triu_indices(len(each) + 3)],
                "rest": np.array(False),
            }
        )
    found = with_images(robot, {column: value[None] for column, value in rows[0].items()})
    assert len(found["rest"]) == len(rows) == {"finger": 2, "two_finger_gripper": 2}.get(name, 8)
    for k, row in enumerate(rows):
        for column, value in row.items():
            scale = np.abs(value).max()
            assert found[column][k] == pytest.approx(value, rel=1e-6, abs=1e-9 * scale), (k, column)
    ends = np.round(found["effector"], 6)
    assert len(np.unique(ends, axis=0)) == len(rows)  # no image is the state itself


@pytest.mark.parametrize(
    "name, options",
    [
        ("finger", {}),  # the mesh of the published scene is not symmetric
        ("finger", {"mesh": "accurate", "gravity": (1.0, 0.0, 0.0)}),
        ("diamond", {"gravity": (0.0, 1.0, 0.0)}),
        ("cable_trunk", {"gravity": (0.0, 1.0, 0.0)}),
        ("two_finger_gripper", {"gravity": (1.0, 0.0, 0.0)}),
    ],
)
def test_a_robot_that_is_not_symmetric_has_no_images(name, options):
    robot = make_robot(name, **options)
    data = {"effort": np.zeros((1, len(robot.actuators))), "effector": np.zeros((1, 3))}
    assert with_images(robot, data) == data


def test_weight_along_the_axis_keeps_the_symmetries():
    assert len(make_robot("diamond", gravity=(0.0, 0.0, -9.81)).learning.symmetries) == 7
