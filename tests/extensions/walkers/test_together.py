"""Body and gait together: both ways find bodies within the box that go farther than the first one with its gait."""

import numpy as np
import pytest

from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.extensions.walkers.learners.together import BodyAndGait

VARIABLES = ("length", "radius", "young_modulus")


def search(motions):
    return BodyAndGait(
        TrainConfig(
            environment=EnvironmentConfig(id="SoftGym/SwimmerSwim-v0"),
            learner="gait",
            steps=60 * motions,
            report_every=60 * motions,
            evaluation_episodes=1,
            num_envs=1,
            gait={"period": 20},
        ),
        VARIABLES,
    )


def test_the_slopes_of_variables_are_those_of_the_box():
    both = search(1)
    space = both.robot.design_space
    slopes = dict(zip(space.names, both._slopes(space.baseline), strict=True))
    assert slopes["length"] == pytest.approx(0.05, rel=1e-6)
    assert slopes["young_modulus"] == pytest.approx(1e5 * np.log(10.0) / 2.0, rel=1e-6)  # logarithmic
    corner = {name: variable.high for name, variable in zip(space.names, space, strict=True)}
    assert both._slopes(corner)[0] == pytest.approx(0.05, rel=1e-6)


@pytest.mark.parametrize("way", ["ascend", "evolve"])
def test_body_and_gait_go_farther(way):
    motions = {"ascend": 4, "evolve": 42}[way]
    both = search(motions)
    space, first = both.robot.design_space, both.learner.climb().way
    found = both.ascend() if way == "ascend" else both.evolve(0)
    assert found.steps <= 60 * motions and found.way > 1.5 * first
    assert found.design["length"] != space.baseline["length"]
    assert (found.design["taper"], found.design["tail"]) == (space.baseline["taper"], space.baseline["tail"])
    assert (np.abs(space.to_unit(space.complete(found.design))) <= 1.0 + 1e-9).all()


def test_a_variable_of_another_robot_is_refused():
    with pytest.raises(ValueError, match="variable 'width' is not a design variable of robot 'swimmer'"):
        BodyAndGait(search(1).learner.config, ["width"])
