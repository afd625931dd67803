"""Agents on top of the QP, and the QPs themselves."""

import copy
import pickle

import numpy as np
import pytest

from softgym_envs.agents.baselines import BASELINES, InverseQPAgent, make_baseline
from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.agents.evaluation import Evaluation, evaluate, sample_goals


def on(identifier, **options):
    return EnvironmentConfig(id=f"SoftGym/{identifier}-v0", **options)


@pytest.mark.parametrize("identifier", ["FingerReach", "CableTrunkReach", "TrunkReach", "DiamondTrack"])
def test_the_batched_qp_agrees_with_the_single_one(identifier):
    config = on(identifier, residual_scale=0.25)
    envs = config.make_vec(3)
    goals = sample_goals(config, 3, seed=4)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (12, *envs.action_space.shape))
    envs.reset(seed=0, options={"goal": goals})
    states = []
    for action in actions:
        envs.step(action)
        states.append(envs.unwrapped.command.copy())
    for i, goal in enumerate(goals):
        env = config.make()
        env.reset(seed=0, options={"goal": goal})
        span = env.unwrapped.robot.upper - env.unwrapped.robot.lower
        for k, action in enumerate(actions):
            env.step(action[i])
            assert np.abs((env.unwrapped.state.command - states[k][i]) / span).max() < 1e-5


def test_the_qp_follows_a_path_closer_when_it_sees_the_next_goal():
    last, following = (on("DiamondTrack", task_options={"lookahead": steps}) for steps in (0, 1))
    path = sample_goals(last, 1, seed=0)
    late, ahead = (evaluate("qp", config, path) for config in (last, following))
    assert ahead.mean_tracking_distance < 0.6 * late.mean_tracking_distance
    assert ahead.mean_return > late.mean_return + 10.0


def test_the_executed_action_is_the_clipped_sum():
    config = on("FingerReach", residual_scale=0.5)
    env = config.make()
    env.reset(seed=3)
    qp = InverseQPAgent()
    for action in (np.array([1.0, -1.0]), np.array([-0.5, 0.25]), np.zeros(2)):
        expected = np.clip(qp(None, env.unwrapped) + 0.5 * action, -1, 1)
        before = env.unwrapped.state.command
        env.step(action)
        done = env.unwrapped.spaces.command(expected, before)
        assert np.abs(env.unwrapped.state.command - done).max() < 1e-9


def test_copies_correct_a_qp_of_their_own():
    env = on("FingerReach", residual_scale=0.5).make()
    env.reset(seed=3)
    env.step(np.zeros(2))
    twins = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    expected = [env.step(np.full(2, 0.5))[0] for _ in range(2)]
    for twin in twins:
        # The QP of a copy starts without the last solution; a unit in the last place of its displacement is 2e-7 here.
        np.testing.assert_allclose([twin.step(np.full(2, 0.5))[0] for _ in range(2)], expected, atol=5e-7)
    envs = on("FingerReach", residual_scale=0.5).make_vec(2)
    envs.reset(seed=3)
    twins = [pickle.loads(pickle.dumps(envs)), copy.deepcopy(envs)]
    expected = envs.step(np.full((2, 2), 0.5))[0]
    for twin in twins:
        np.testing.assert_allclose(twin.step(np.full((2, 2), 0.5))[0], expected, atol=1e-7)


def test_a_zero_action_leaves_the_qp_unchanged():
    plain, topped = on("DiamondReach"), on("DiamondReach", residual_scale=1.0)
    goal = sample_goals(plain, 1, seed=2)[0]
    env = topped.make()
    _, info = env.reset(options={"goal": goal})
    for _ in range(50):
        _, _, _, _, info = env.step(np.zeros(4))
    assert info["distance"] == pytest.approx(evaluate("qp", plain, goal[None]).distances[0], abs=1e-7)
    # Baselines are not added to themselves.
    assert evaluate("qp", topped, goal[None]).returns == pytest.approx(evaluate("qp", plain, goal[None]).returns)


def test_residual_agents_in_separate_processes():
    config = on("TrunkReach", residual_scale=0.3, backend="fem")
    envs = config.make_vec(2)
    single = config.make()
    goals = sample_goals(config.on("surrogate"), 1, seed=0)
    observation, _ = single.reset(seed=0, options={"goal": goals[0]})
    batch, _ = envs.reset(seed=0, options={"goal": goals[0]})
    for _ in range(3):
        action = np.full(6, 0.2)
        observation = single.step(action)[0]
        batch = envs.step(np.tile(action, (2, 1)))[0]
    assert np.abs(batch - observation).max() < 1e-5
    envs.close()


def test_pi_corrects_a_model_that_differs_from_the_plant():
    plant = on("TrunkReach", backend="fem")
    goals = sample_goals(on("TrunkReach"), 3, seed=11)
    distances = {name: evaluate(name, plant, goals).distances for name in ("qp", "qp_model", "qp_pi")}
    assert (distances["qp_model"] > 2e-5).all()  # the surrogate's own error
    assert (distances["qp_pi"] < 0.2 * distances["qp_model"]).all()
    # If the model is the plant, there is nothing to correct.
    own = on("TrunkReach")
    assert evaluate("qp_model", own, goals).distances == pytest.approx(evaluate("qp", own, goals).distances, abs=1e-6)


def test_pi_does_not_count_the_motion_of_the_goal_as_an_error():
    own = on("GripperPinch")
    path = sample_goals(own, 1, seed=0)
    corrected, plain = (evaluate(name, own, path).tracking_distances[0] for name in ("qp_pi", "qp_model"))
    # What a step leaves of the way to a moving goal (0.13 mm on average) is corrected as well: measured 1.6 times. With
    # the motion of the goal counted as an error it was 7 times.
    assert corrected < 2.0 * plain


def test_a_robot_without_a_surrogate_is_predicted_by_its_static_equilibrium():
    tetrapod = on("TetrapodReach")
    goal = sample_goals(tetrapod, 1, seed=0)
    env = tetrapod.make()
    model, static = make_baseline("qp_model"), make_baseline("qp_static")
    observation, _ = env.reset(seed=0, options={"goal": goal[0]})
    for _ in range(5):
        action = model(observation, env.unwrapped)
        assert np.abs(action - static(observation, env.unwrapped)).max() < 1e-5
        observation = env.step(action)[0]


def test_unknown_baseline():
    with pytest.raises(ValueError, match="unknown agent 'octopus'; allowed: .*qp, .*qp_static"):
        make_baseline("octopus")
    names = {"qp", "qp_static", "qp_model", "qp_pi", "qp_estimated", "close", "force", "random"}
    assert names <= set(BASELINES)


def test_the_qp_reaches_goals_together_as_it_reaches_each_alone():
    config = on("CableTrunkReach")
    goals = sample_goals(config, 3, seed=4)
    together = evaluate("qp", config, goals)
    alone = Evaluation.merge([evaluate("qp", config, goal[None]) for goal in goals])
    assert together.steps == alone.steps
    np.testing.assert_allclose(together.ends, alone.ends, atol=1e-6)
    np.testing.assert_allclose(together.efforts, alone.efforts, rtol=1e-4)
