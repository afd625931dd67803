"""The modular arm on superelements against finite elements of its whole body."""

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.errors import DesignError
from softgym_envs.mechanics.solvers.statics import Statics


def test_the_modular_arm_follows_finite_elements_of_the_whole_body():
    found = {}
    for body in ("superelements", "solid"):
        robot = make_robot("modular_arm", cells=["leaf_x", "leaf_y"], body=body)
        found[body] = Statics(robot.build()).solve(np.array([0.002, 0.001])).condensed
    moved = found["solid"].delta.e - robot.effector_rest
    assert np.linalg.norm(moved) > 0.002
    assert np.linalg.norm(found["superelements"].delta.e - found["solid"].delta.e) < 0.01 * np.linalg.norm(moved)


def test_superelements_of_the_arm_have_no_weight():
    with pytest.raises(ValueError, match="superelements have no mass"):
        make_robot("modular_arm", gravity=(0.0, 0.0, -9.81))


def test_the_compliance_of_the_arm_is_the_derivative_of_its_equilibria():
    model = make_robot("modular_arm").build()
    solver, command, step = Statics(model), np.array([0.004, 0.001]), 1e-6
    W = solver.solve(command).condensed.W
    moves = [solver.solve(command + s * step * np.eye(2)[0]).condensed.delta.e for s in (1.0, -1.0)]
    held = W.ea @ np.linalg.inv(W.aa)
    np.testing.assert_allclose((moves[0] - moves[1]) / (2.0 * step), held[:, 0], rtol=1e-3, atol=1e-4)


def test_cells_are_an_option_and_their_dimensions_the_design():
    robot = make_robot("modular_arm", cells=["block", "leaf_y", "leaf_x"])
    assert "depth_1" in robot.design_space.names and "thickness_3" in robot.design_space.names
    model = robot.build({"length_1": 0.03})
    assert model.constraints["e"][0].value(model.nodes)[2] == pytest.approx(robot.effector_rest[2] + 0.01)
    assert robot.mechanics_key["cells"] == ["block", "leaf_y", "leaf_x"]
    with pytest.raises(DesignError, match="leaf_length_2"):
        robot.build({"leaf_length_2": 0.05})


@pytest.mark.parametrize(
    ("options", "message"),
    [({"cells": ["leaf_z"]}, "unknown cell 'leaf_z'"), ({"cells": []}, "list of names"), ({"body": "fem"}, "'fem'")],
)
def test_wrong_options_of_the_arm_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        make_robot("modular_arm", **options)
