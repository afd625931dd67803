"""Options of robot and task as variables."""

from __future__ import annotations

import pytest

from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.codesign.variables import OptionRange, make_variables, split_values, with_options

RANGE = OptionRange(low=0.0, high=0.02, baseline=0.01, unit="m")
ENVIRONMENT = EnvironmentConfig(id="SoftGym/FingerReach-v0", robot_options={"gravity": [0.0, 0.0, 0.0]})


def test_options_become_variables():
    space = ENVIRONMENT.make_robot().design_space
    found = make_variables(["length", "task.spread"], {"task.spread": RANGE}, space)
    assert list(found) == ["length", "task.spread"]
    assert found["length"] is space["length"]
    assert (found["task.spread"].low, found["task.spread"].baseline, found["task.spread"].unit) == (0.0, 0.01, "m")
    design, options = split_values({"length": 0.04, "task.spread": 0.015, "robot.gravity[2]": -9.81})
    assert design == {"length": 0.04}
    changed = with_options(ENVIRONMENT, options)
    assert changed.task_options == {"spread": 0.015}
    assert changed.robot_options == {"gravity": [0.0, 0.0, -9.81]}
    assert with_options(ENVIRONMENT, {}) == ENVIRONMENT


@pytest.mark.parametrize(
    "names, ranges, message",
    [
        (["length", "length"], {}, "'length' is named twice"),
        (["width"], {}, "width"),
        (["task.spread"], {}, "'task.spread' is an option: give its low, high and baseline in 'ranges'"),
        (["length"], {"task.spread": RANGE}, "'task.spread' is not in 'variables'"),
        (["length"], {"length": RANGE}, "'length' is a design variable; the robot defines its bounds"),
        (["colour.red"], {}, "must look like robot.option"),
        (["task.spread"], {"task.spread": RANGE.model_copy(update={"baseline": 1.0})}, "baseline 1.0 is outside"),
    ],
)
def test_wrong_variables(names, ranges, message):
    with pytest.raises(ValueError, match=message):
        make_variables(names, ranges, ENVIRONMENT.make_robot().design_space)


def test_entry_of_a_vector_that_is_not_given():
    with pytest.raises(ValueError, match=r"'robot.gravity\[2\]': give all of gravity in environment.robot_options"):
        with_options(EnvironmentConfig(id="SoftGym/FingerReach-v0"), {"robot.gravity[2]": 1.0})
