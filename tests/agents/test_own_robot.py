"""Environments of configurations: by ID, or your own robot and task, trained and evaluated."""

import json
import sys

import numpy as np
import pytest
import yaml

from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.agents.evaluation import evaluate, sample_goals
from softgym_envs.agents.policy import Policy
from softgym_envs.agents.training import train
from softgym_envs.config import load_config
from softgym_envs.errors import ConfigError
from softgym_envs.robots.soft_finger import SoftFinger

MODULE = """
from tests import helpers
from softgym_envs.envs.tasks.reach import Reach


class Spike(helpers.Spike):
    pass


class Dip(Reach):
    max_episode_steps = 5
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Name of a module with a robot and a task."""
    (tmp_path / "spiky.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    yield "spiky"
    sys.modules.pop("spiky", None)


def test_your_own_robot_is_trained_and_evaluated(module, tmp_path):
    config_file = tmp_path / "train.yaml"
    config_file.write_text(
        yaml.safe_dump(
            {
                "environment": {"robot": f"{module}:Spike", "task": f"{module}:Dip"},
                "sac": {"net_arch": [8], "batch_size": 8, "learning_starts": 4, "gradient_steps": 1},
                "steps": 20,
                "num_envs": 1,
                "evaluation_episodes": 2,
                "report_every": 10,
            }
        )
    )
    config = load_config(config_file, TrainConfig)
    environment = config.environment
    assert environment.backend == "fem" and not environment.has_surrogate
    assert environment.row.max_episode_steps == 5
    policy = Policy(train(config, tmp_path / "run", progress=False))
    assert json.loads((tmp_path / "run/policy.json").read_text())["config"]["environment"]["robot"] == "spiky:Spike"
    goals = sample_goals(environment, 2, seed=1)
    outcome = evaluate(policy.path, environment.model_copy(update={"design": {"length": 0.06}}), goals)
    assert outcome.steps == 10 and np.isfinite(outcome.distances).all()
    with pytest.raises(ConfigError, match=r"environment\.id = SoftGym/FingerReach-v0.*trained with spiky:Spike"):
        policy.check_environment(EnvironmentConfig(id="SoftGym/FingerReach-v0"))
    with pytest.raises(
        ConfigError, match=r"environment\.robot = spiky:Spike reach .*trained with spiky:Spike spiky:Dip"
    ):
        policy.check_environment(EnvironmentConfig(robot="spiky:Spike", task="reach"))


def test_weights_of_your_own_make_a_surrogate(module, tmp_path):
    own = EnvironmentConfig(robot=f"{module}:Spike", task="reach", backend_options={"weights": tmp_path})
    assert own.backend == "surrogate" and own.has_surrogate


def test_classes_are_stored_as_paths():
    environment = EnvironmentConfig(robot=SoftFinger, task="reach", max_episode_steps=3)
    assert environment.robot == "softgym_envs.robots.soft_finger:SoftFinger"
    assert environment.title == "softgym_envs.robots.soft_finger:SoftFinger reach"
    assert environment.backend == "surrogate" and environment.has_surrogate
    assert EnvironmentConfig.model_validate(environment.model_dump(mode="json")) == environment
    envs = environment.make_vec(2)
    assert envs.unwrapped.max_episode_steps == 3
    Policy("finger_reach").check_environment(environment)  # the same robot and task under other names


class Outer:
    class Inner(SoftFinger):
        pass


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "an environment needs an id, or a robot and a task"),
        ({"robot": "finger"}, "an environment needs an id, or a robot and a task"),
        (
            {"id": "SoftGym/FingerReach-v0", "task": "reach"},
            "an environment takes an id, or a robot and a task, not both",
        ),
        ({"id": "SoftGym/FingrReach-v0"}, "unknown environment 'SoftGym/FingrReach-v0'; did you mean"),
        ({"id": "SoftGym/Reach-v0"}, "environment 'SoftGym/Reach-v0' needs a robot: give robot and task"),
        ({"robot": "fingr", "task": "reach"}, "unknown robot 'fingr'; did you mean 'finger'"),
        ({"robot": "finger", "task": "reech"}, "unknown task 'reech'; did you mean 'reach'"),
        ({"robot": "nowhere:Arm", "task": "reach"}, "there is no module 'nowhere'"),
        ({"robot": Outer.Inner, "task": "reach"}, "Outer.Inner cannot be imported by other processes"),
    ],
)
def test_wrong_environments(options, message):
    with pytest.raises(ValueError, match=message):
        EnvironmentConfig(**options)
