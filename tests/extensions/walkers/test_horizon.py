"""The analytic policy gradient over a short horizon: derivatives, symmetry, files, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.agents.evaluation import evaluate
from softgym_envs.agents.policy import Policy
from softgym_envs.agents.training import train
from softgym_envs.extensions.walkers.learners.horizon import HorizonLearner

FOLLOW = EnvironmentConfig(id="SoftGym/QuadrupedFollow-v0")


def config(steps=40, environment=FOLLOW, num_envs=1, **horizon):
    given = {"evaluation_episodes": 1, "report_every": steps, "horizon": horizon}
    return TrainConfig(environment=environment, learner="horizon", steps=steps, num_envs=num_envs, **given)


def test_the_gradient_of_a_gait_is_that_of_what_the_robot_gains():
    """Through motion, contact, friction, a push, ramps and limits of rate, where only commands are fed back."""
    pushed = {"friction": 0.7, "push": 0.4, "push_steps": 8}
    learner = HorizonLearner(config(environment=FOLLOW.model_copy(update={"task_options": pushed}), horizon=12))
    (env,) = learner._envs
    env.backend._dynamics.tolerance = 1e-11
    task, row = env.task, env.robot.body_frame

    def begin():
        observation, _ = env.reset(seed=3, options={"goal": [0.02, 0.03, 0.0]})
        task.load._first = 2
        return observation

    def gained():
        observation, start, steps = begin(), env.state.nodes[row].copy(), 12
        places, along = [start], env.goal / np.linalg.norm(env.goal)
        left = np.array([-along[1], along[0], 0.0])
        for k in range(steps):
            observation = env.step(learner._act(torch.from_numpy(observation), k % 10).detach().numpy())[0]
            places.append(env.state.nodes[row].copy())
        ways = np.diff(places, axis=0) / 0.1
        facing = env.state.nodes[row + 1] @ along
        return (ways @ along - task.charges["drift"] * np.abs(ways @ left)).sum() + facing

    window = learner._window(env, begin())[1]
    learner._loss([window]).backward()
    gradient, start = -learner._clock.grad.double(), learner._clock.detach().clone()
    rng = np.random.default_rng(0)
    for _ in range(2):
        direction, values = torch.tensor(rng.normal(size=start.shape), dtype=torch.float32), []
        for sign in (1.0, -1.0):
            learner._clock.data = start + sign * 1e-3 * direction
            values.append(gained())
        assert (gradient * direction).sum().item() == pytest.approx((values[0] - values[1]) / 2e-3, rel=1e-3)


def test_mirrored_states_have_mirrored_actions():
    learner = HorizonLearner(config(160, horizon=10))
    learner.learn(160, lambda count: None)
    order, signs = learner._mirror
    observation = np.random.default_rng(0).uniform(-0.3, 0.3, len(order)).astype(np.float32)
    mirrored = (signs * observation[order]).astype(np.float32)
    for k in range(10):
        one, two = (
            learner._act(torch.from_numpy(o), p).detach().numpy()
            for o, p in ((observation, k), (mirrored, (k + 5) % 10))
        )
        assert two[[2, 3, 0, 1, 6, 7, 4, 5]] == pytest.approx(one, abs=1e-4)


def test_the_mirrored_heading_shows_the_mirrored_observation():
    learner = HorizonLearner(config())
    (env,) = learner._envs
    order, signs = learner._mirror
    seen = []
    for side, swap in ((1.0, slice(None)), (-1.0, [2, 3, 0, 1, 6, 7, 4, 5])):
        env.reset(seed=0, options={"goal": [0.02, side * 0.03, 0.0]})
        env.task.load._force[:] = 0.0
        rng = np.random.default_rng(1)
        for _ in range(6):
            observation = env.step(rng.uniform(-1.0, 1.0, 8)[swap])[0]
        seen.append(observation)
    assert (signs * seen[0][order]) == pytest.approx(seen[1], abs=2e-3)


def test_it_learns_to_turn_and_trains_as_others_do(tmp_path):
    given = config(600, num_envs=2, learning_rate=0.1).model_copy(update={"initial": "quadruped_walk_gait"})
    path = train(given, tmp_path / "follow", progress=False)
    policy = Policy(path)
    assert policy.remembers and policy.clock.shape == (10, 8) and policy.gains.shape == (10, 8, 31)
    short, turn = FOLLOW.model_copy(update={"max_episode_steps": 80}), np.array([[0.0, 0.04, 0.0]])
    found, straight = (evaluate(agent, short, turn) for agent in (path, "gait"))
    assert found.tallies["speed"][0] > straight.tallies["speed"][0] + 5e-3


def test_what_it_refuses():
    with pytest.raises(ValueError, match="learner 'horizon' needs a task with a heading, got task 'reach'"):
        HorizonLearner(config(environment=EnvironmentConfig(id="SoftGym/TetrapodReach-v0")))
    with pytest.raises(ValueError, match="learner 'horizon' needs one body"):
        HorizonLearner(config(environment=FOLLOW.model_copy(update={"residual_scale": 0.5})))
