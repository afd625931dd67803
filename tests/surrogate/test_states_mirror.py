"""Mirror images of the states of a symmetric robot."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.surrogate.data.states import with_mirror_images


def test_images_are_equilibria_of_the_exchanged_commands():
    robot = make_robot("finger", mesh="accurate", mesh_size=0.03, self_contact=False)
    model, rows = robot.build(), []
    for command in ([0.004, 0.008], [0.008, 0.004]):
        state = Statics(model).solve(command).condensed
        rows.append(
            {
                "design": robot.design_space.baseline.array,
                "displacement": state.delta.a,
                "effort": state.lambda_.a,
                "effector": state.delta.e,
                "compliance": state.compliance[np.triu_indices(5)],
                "rest": np.array(False),
            }
        )
    found = with_mirror_images(robot, {name: value[None] for name, value in rows[0].items()})
    for name, value in rows[1].items():
        assert found[name][1] == pytest.approx(value, rel=1e-9, abs=1e-12), name
    assert np.abs(rows[0]["effector"][0]) > 1e-3  # the finger turns sideways, to the other side in the image


@pytest.mark.parametrize("options", [{}, {"mesh": "accurate", "gravity": (1.0, 0.0, 0.0)}])
def test_a_robot_that_is_not_symmetric_has_no_images(options):
    robot = make_robot("finger", **options)  # the mesh of the published scene is not symmetric
    data = {"effort": np.zeros((1, 2)), "effector": np.zeros((1, 3))}
    assert with_mirror_images(robot, data) == data
