"""The search for gaits along gradients through time: derivatives, what it finds, files, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.agents.evaluation import evaluate
from softgym_envs.agents.policy import Policy
from softgym_envs.agents.training import train
from softgym_envs.extensions.beams.rollout import roll_out_backend
from softgym_envs.extensions.walkers.learners.gait import GaitLearner

WALK = EnvironmentConfig(id="SoftGym/QuadrupedWalk-v0")
GOAL = np.array([[0.04, 0.0, 0.0]])


def config(steps, environment=WALK, **options):
    given = {"evaluation_episodes": 1, "report_every": steps, **options}
    return TrainConfig(environment=environment, learner="gait", steps=steps, num_envs=1, **given)


def test_the_gradient_is_that_of_the_way(monkeypatch):
    """Through motion, contact, friction, ramps, limits of rate and the period; the way sideways is charged too."""
    learner = GaitLearner(config(30, gait={"periods": 2}))
    # Converged so far that differences of ways are exact.
    monkeypatch.setattr(learner.backend._dynamics, "tolerance", 1e-11)
    start, gradient = learner.gait, learner.climb().by_gait
    row = learner.env.robot.body_frame

    def value(gait):
        learner.gait = gait
        learner.backend.reset()
        x = roll_out_backend(learner.backend, learner.commands(20)[0]).x[:, row]
        way = x[-1] - x[49]
        return way[0] - abs(way[1])

    rng = np.random.default_rng(0)
    for _ in range(3):
        direction = learner.straight(rng.normal(size=start.shape))
        difference = (value(start + 1e-6 * direction) - value(start - 1e-6 * direction)) / 2e-6
        assert (gradient * direction).sum() == pytest.approx(difference, rel=1e-4)


def test_the_gradient_is_that_of_the_charge_for_efforts(monkeypatch):
    swim = EnvironmentConfig(id="SoftGym/SwimmerSwim-v0")
    learner = GaitLearner(config(40, swim, gait={"period": 20, "periods": 2, "largest_effort": 3e4}))
    monkeypatch.setattr(learner.backend._dynamics, "tolerance", 1e-11)
    start, found = learner.gait, learner.climb()
    assert found.value < 0.0 < found.way  # the charge counts
    direction, values = learner.straight(np.random.default_rng(0).normal(size=start.shape)), []
    for sign in (1.0, -1.0):
        learner.gait = start + sign * 1e-6 * direction
        values.append(learner.move().value)
    assert (found.by_gait * direction).sum() == pytest.approx((values[0] - values[1]) / 2e-6, rel=1e-4)


def test_both_sides_do_the_same_in_turns():
    learner = GaitLearner(config(90, seed=1))
    learner.learn(90, lambda count: None)
    np.testing.assert_allclose(learner.gait, np.roll(learner.gait, 5, axis=0)[:, [2, 3, 0, 1, 6, 7, 4, 5]], atol=1e-12)
    assert len(learner.ways) == 3 and learner.ways[-1] > learner.ways[0]


def test_both_sides_do_the_same_at_once_where_the_reference_gait_does():
    crawl = EnvironmentConfig(id="SoftGym/CrawlerWalk-v0")
    learner = GaitLearner(config(225, crawl, seed=1, gait={"period": 25}))
    learner.learn(225, lambda count: None)
    np.testing.assert_allclose(learner.gait, learner.gait[:, [0, 2, 1, 4, 3]], atol=1e-12)
    assert max(learner.ways) > learner.ways[0] > 0.0


def test_the_environment_follows_the_commands_of_the_learner():
    learner = GaitLearner(config(30))
    weights = learner.weights()
    observation, _ = learner.env.reset(seed=0)
    for k, command in enumerate(learner.commands(25)[0]):
        action = np.tanh(observation @ weights["actor.mu.weight"].T + weights["actor.clock"][k % 10])
        observation = learner.env.step(action)[0]
        assert learner.env.command == pytest.approx(command, abs=1e-6 * 4.5e-8)


def test_it_walks_farther_than_the_common_gait_and_trains_as_others_do(tmp_path):
    path = train(config(300), tmp_path / "gait", progress=False)
    policy = Policy(path)
    assert policy.remembers and policy.clock.shape == (10, 8)
    with pytest.raises(ValueError, match="has a memory"):
        policy(np.zeros(policy.observation_size))
    found, common = (evaluate(agent, WALK, GOAL) for agent in (path, "gait"))
    assert found.tallies["speed"][0] > 1.2 * common.tallies["speed"][0]
    assert found.returns[0] > 1.2 * common.returns[0]  # charges for slip, drift and work included


def test_a_step_that_leads_to_a_worse_gait_is_taken_back():
    """A thin swimmer that folds: the first step from the reference gait is too long."""
    soft = {"length": 0.2, "radius": 0.0065, "taper": 0.8, "young_modulus": 5e4}
    swim = EnvironmentConfig(id="SoftGym/SwimmerSwim-v0", design=soft)
    learner = GaitLearner(config(480, swim, gait={"period": 20}))
    learner.learn(480, lambda count: None)
    ways = np.array(learner.ways)
    assert (np.diff(ways) < 0.0).any()
    assert ways.max() > 1.05 * ways[0]
    learner.gait = learner.best
    assert learner.climb().way == pytest.approx(ways.max(), rel=0.01)


def test_a_resumed_search_gives_the_same_gait():
    whole, first, second = (GaitLearner(config(90)) for _ in range(3))
    whole.learn(90, lambda count: None)
    first.learn(30, lambda count: None)
    second.load_weights(first.weights(), None)
    second.restore(*first.state())
    second.learn(90, lambda count: None)
    assert (whole.gait == second.gait).all() and whole.ways == second.ways


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sample_design": ["leg_length"]}, "needs one body"),
        ({"action_mode": "absolute"}, "got sample_design = False, absolute"),
        ({"backend_options": {"dynamics": False}}, "needs a motion on finite elements in compiled code: "),
    ],
)
def test_what_it_refuses(changes, words):
    with pytest.raises(ValueError, match=words):
        GaitLearner(config(30, WALK.model_copy(update=changes)))
