"""The task Swim: what its reward and tallies count, and that nonsense wins nothing."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import softgym_envs  # noqa: F401 - registers the IDs
from softgym_envs import make_robot
from softgym_envs.agents.baselines import make_baseline
from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.agents.evaluation import evaluate
from softgym_envs.codesign.metrics.metric import METRICS
from softgym_envs.codesign.metrics.sources import Outcome
from softgym_envs.envs.tasks.registry import make_task

ID = "SoftGym/SwimmerSwim-v0"
BEND = np.tile([1.0, -1.0], 4)


def episode(act, steps=100, **options):
    """Rewards, places of the robot and infos of an episode."""
    env = gymnasium.make(ID, **options)
    observation, info = env.reset(seed=0)
    robot, backend = env.unwrapped.robot, env.unwrapped.backend
    rewards, places, infos = [], [robot.place(backend.model.nodes)], [info]
    for k in range(steps):
        observation, reward, *_, info = env.step(np.asarray(act(k, env.unwrapped, observation), dtype=np.float32))
        assert env.observation_space.contains(observation)
        rewards.append(reward)
        places.append(robot.place(backend.state.nodes))
        infos.append(info)
    return np.array(rewards), np.array(places), infos


@pytest.fixture(scope="module")
def swum():
    return episode(lambda k, env, observation: make_baseline("gait")(observation, env))


def test_the_common_gait_swims(swum):
    rewards, places, infos = swum
    assert infos[-1]["speed"] == pytest.approx((places[100, 0] - places[50, 0]) / 2.5, rel=1e-9)
    assert infos[-1]["speed"] > 2e-3
    assert infos[-1]["drift"] == pytest.approx(abs(places[100, 1] - places[50, 1]) / 2.5, abs=1e-12)
    assert infos[-1]["drift"] < 0.1 * infos[-1]["speed"]
    assert "slip" not in infos[-1]
    terms = [sum(v for n, v in i.items() if n.startswith("reward_")) for i in infos[1:]]
    assert rewards == pytest.approx(terms, abs=1e-12)
    # Rewards are speeds in sizes of the robot per second, for steps of 50 ms.
    assert (0.05 * np.cumsum(rewards) <= (places[1:, 0] - places[0, 0]) / 0.15 + 1e-9).all()
    assert all(info[f"reward_{name}"] <= 0.0 for info in infos for name in ("drift", "work"))


NONSENSE = {
    "lies still": lambda k: np.zeros(8),
    "stretches": lambda k: np.ones(8) * (1 if k % 10 in (0, 1, 2, 8, 9) else -1),
    "flaps fast and back slowly": lambda k: BEND * (1.0 if k % 10 in (0, 1) else -0.25),
    "curls up": lambda k: BEND,
}


@pytest.mark.parametrize("name", NONSENSE)
def test_nonsense_wins_nothing(swum, name):
    rewards, _, infos = episode(lambda k, env, o: NONSENSE[name](k))
    assert 0.05 * rewards.sum() < 0.02  # of its length
    assert infos[-1]["speed"] < 0.2 * swum[2][-1]["speed"]
    assert not infos[-1]["is_success"]


def test_strokes_that_retrace_themselves_need_a_tail_that_gives():
    """Purcell's scallop: without a soft tail and inertia nothing is left of them."""

    def flap(k, env, observation):
        return BEND * (1.0 if k % 10 in (0, 1, 2, 8, 9) else -1.0)

    stiff = {"robot_options": {"viscosity": 10.0}, "design": {"tail": 0.1, "taper": 1.0, "young_modulus": 5e5}}
    soft, scallop = (episode(flap, **options)[2][-1]["speed"] for options in ({}, stiff))
    assert soft > 5e-4
    assert abs(scallop) < 1e-4


def test_a_body_that_lets_go_only_loses_energy():
    """Bent by its chambers, then held at these volumes: what is left of its motion and of its bending is heat."""
    env = gymnasium.make(ID).unwrapped
    env.reset(seed=0)
    for k in range(10):
        env.step(np.where(np.arange(8) % 4 < 2, BEND, -BEND).astype(np.float32) * (k < 8))
    energies = []
    for _ in range(30):
        env.step(np.zeros(8, dtype=np.float32))
        motion = env.backend.state.motion
        energies.append(motion.potential + motion.kinetic)
    assert (np.diff(energies) <= 1e-12 * energies[0]).all()
    before = env.robot.place(env.backend.state.nodes)
    for _ in range(10):
        env.step(np.zeros(8, dtype=np.float32))
    assert np.abs(env.robot.place(env.backend.state.nodes) - before).max() < 1e-5


def test_metrics_read_the_evaluation():
    config = EnvironmentConfig(id=ID, max_episode_steps=40)
    found = evaluate("gait", config, np.array([[0.015, 0.0, 0.0]]))
    robot = config.make_robot()
    outcome = Outcome(found, robot.design_space.baseline, robot)
    assert METRICS["forward_speed"].measure(outcome).value == pytest.approx(found.tallies["speed"].mean())
    with pytest.raises(ValueError, match="needs episodes of a task that counts 'slip', such as walk"):
        METRICS["relative_slip"].measure(outcome)
    with pytest.raises(ValueError, match="cost_of_transport needs a robot with weight; 'swimmer' has none"):
        METRICS["cost_of_transport"].measure(outcome)


@pytest.mark.parametrize("name", ["quadruped", "tetrapod"])
def test_robots_that_do_not_swim(name):
    with pytest.raises(ValueError, match=f"task 'swim' needs a robot that moves about and touches nothing; '{name}'"):
        make_task("swim", make_robot(name))


def test_wrong_options():
    with pytest.raises(ValueError, match="drift = -1.0 must be finite and not negative"):
        make_task("swim", make_robot("swimmer"), drift=-1.0)
