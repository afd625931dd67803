"""Where the inverse QP settles, against the way that it takes step by step."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.control import InverseQP
from softgym_envs.control.settling import settle
from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.solvers.statics import Statics


@pytest.mark.parametrize("goal", [(0.004, 0.050, -0.098), (0.010, 0.067, -0.070)])  # in reach, and out of it
def test_it_is_the_end_of_the_path(goal):
    robot, goal = make_robot("finger"), np.array(goal)
    statics, controller, command = Statics(robot.build()), InverseQP.for_robot(robot), np.zeros(2)
    for _ in range(60):
        state = statics.solve(command)
        command = controller.solve(state.condensed, goal, command, state.slack)
    distance = np.linalg.norm(state.condensed.delta.e - goal)
    found = settle(Statics(robot.build()), robot, goal, np.array([0.008, 0.008]), equilibria=20)
    assert found.distance == pytest.approx(distance, abs=2e-5)
    assert found.equilibria < 20 and found.change <= 1e-3
    assert np.linalg.norm(found.effector - goal) == found.distance


def test_a_first_command_without_an_equilibrium_is_an_error():
    robot = make_robot("finger")
    statics = Statics(robot.build())
    statics.solve = lambda command: (_ for _ in ()).throw(ConvergenceError("no equilibrium"))
    with pytest.raises(ConvergenceError, match="no equilibrium"):
        settle(statics, robot, np.zeros(3), np.zeros(2))
