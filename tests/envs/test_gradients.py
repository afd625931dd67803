"""Derivatives of rewards in actions, against central differences."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import softgym_envs  # noqa: F401
from softgym_envs.envs.registration import ENVIRONMENTS
from softgym_envs.envs.tasks.registry import TASKS

IDS = [
    name
    for name, row in ENVIRONMENTS.items()
    if row.backend == "surrogate" and not TASKS.class_of(row.task).needs_state
]


ROWS = 48


@pytest.mark.parametrize("action_mode", ["increment", "absolute"])
@pytest.mark.parametrize("name", IDS)
def test_gradients_agree_with_differences(name, action_mode):
    # One member of the ensemble, so that steps of the search use the stiffness of the energy itself.
    env: Any = gym.make_vec(name, num_envs=ROWS, backend_options={"members": 1}, action_mode=action_mode)
    rng = np.random.default_rng(0)
    walk = rng.uniform(-0.4, 1.0, (12, *env.action_space.shape))  # mostly pulling, so that not all cables are slack
    env.reset(seed=3)
    for step in walk:
        env.step(step)
    # A last action that changes the commands by less than their rates
    wish = env.command + 0.8 * env.robot.rates * rng.uniform(-1.0, 1.0, env.command.shape)
    last = env.spaces.action(wish, env.command).astype(float)

    def after(action):
        """Return rewards, slack actuators and limited commands of a step after the same walk."""
        env.reset(seed=3)
        for step in walk:
            env.step(step)
        *_, gradient = env.step_with_gradient(action)
        return gradient.reward, gradient.slack, gradient.limited, gradient.action

    reward, slack, limited, found = after(last)
    assert (found[slack | (limited != 0.0)] == 0.0).all()
    env.reset(seed=3)
    for step in walk:
        env.step(step)
    assert np.array_equal(env.step(last)[1], reward)
    slope, _ = env.spaces.command_slope(last, np.zeros_like(last))
    h = 0.01 * (env.robot.rates / slope).min()  # the states have single precision
    compared = 0
    for i in range(found.shape[1]):
        shift = np.zeros_like(last)
        shift[:, i] = h
        (above, *contacts_above, _), (below, *contacts_below, _) = after(last + shift), after(last - shift)
        # Rewards have kinks where an actuator becomes slack or a command reaches a limit.
        sides = zip((slack, limited), contacts_above, contacts_below, strict=True)
        smooth = np.all([(a == b).all(axis=1) & (a == c).all(axis=1) for a, b, c in sides], axis=0)
        difference = (above - below) / (2.0 * h)
        error = np.abs(difference - found[:, i])[smooth]
        assert error.max() < 0.015 * np.abs(found).max()
        compared += smooth.sum()
    assert compared >= 0.5 * found.size
    env.close()


@pytest.mark.parametrize("name", ["SoftGym/TrunkReach-v0", "SoftGym/GripperPinch-v0"])
def test_the_logarithm_of_the_reward_has_the_slope_of_its_differences_everywhere(name):
    from softgym_envs.envs.gradients import RewardGradient

    env: Any = gym.make_vec(name, num_envs=60).unwrapped
    env.reset(seed=0)
    task, rng = env.task, np.random.default_rng(1)
    distances = np.geomspace(0.01 * task.success_distance, task.robot.workspace_scale, 60)
    direction = task.axes * rng.normal(size=(60, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    goal = np.zeros((60, 3))
    effector = distances[:, None] * direction
    effort = rng.uniform(0.1, 0.5, (60, env.action_space.shape[1])) * task.robot.effort_scale

    def value(effector, effort):
        share = env.spaces.effort_share(effort)
        return task.log_reward(task.distance(effector, goal), share)

    by_effector, by_effort = RewardGradient(task, env.spaces)(effector, effort, goal, log=True)
    for i in range(3):
        shift = np.zeros((60, 3))
        shift[:, i] = 1e-4 * distances
        difference = (value(effector + shift, effort) - value(effector - shift, effort)) / (2.0 * shift[:, i])
        np.testing.assert_allclose(by_effector[:, i], difference, rtol=1e-5, atol=1e-5 * np.abs(by_effector).max())
    h = 1e-5 * task.robot.effort_scale
    for i in range(effort.shape[1]):
        shift = np.eye(effort.shape[1])[i] * h
        difference = (value(effector, effort + shift) - value(effector, effort - shift)) / (2.0 * shift[i])
        np.testing.assert_allclose(by_effort[:, i], difference, rtol=1e-5)
    # The slope falls as 1 / distance; that of the plain logarithm falls with its cube.
    slope = -(by_effector * direction).sum(axis=1)
    outside = distances > 2.0 * task.success_distance
    assert (slope[outside] * distances[outside] > 0.4).all()
    # At the goal it is the logarithm of the reward.
    near = distances < 0.03 * task.success_distance
    share = env.spaces.effort_share(effort)
    reward = np.prod(list(task.reward_terms(task.distance(effector, goal), share).values()), axis=0)
    np.testing.assert_allclose(value(effector, effort)[near], np.log(reward)[near], atol=1e-5)
    env.close()


def test_the_weight_of_the_effort_changes_only_its_own_part_of_the_derivatives():
    env: Any = gym.make_vec("SoftGym/GripperPinch-v0", num_envs=4)
    actions = np.full(env.action_space.shape, 0.8)

    def derivatives(weight):
        env.reset(seed=0)
        for _ in range(8):  # all cables are taut
            env.step(actions)
        return env.step_with_gradient(actions, log=True, effort_weight=weight)[-1].action

    without, once, tenfold = derivatives(0.0), derivatives(1.0), derivatives(10.0)
    assert (once < without).all(), "pulling more raises the efforts"
    np.testing.assert_allclose(tenfold - without, 10.0 * (once - without), rtol=1e-6)
    env.close()


def test_derivatives_are_finite_at_the_goal():
    env: Any = gym.make_vec("SoftGym/FingerReach-v0", num_envs=2)
    _, info = env.reset(seed=0)
    env.reset(options={"goal": info["effector"][0]})
    *_, gradient = env.step_with_gradient(np.zeros((2, 2)))
    assert np.isfinite(gradient.action).all()
    env.close()


def test_steps_make_episodes_end_at_different_times():
    env: Any = gym.make_vec("SoftGym/FingerReach-v0", num_envs=3, max_episode_steps=5)
    env.reset(seed=0)
    env.steps = np.array([0, 3, 4])
    ended = [env.step(np.zeros((3, 2)))[3].tolist() for _ in range(2)]
    assert ended == [[False, False, True], [False, True, False]]
    for wrong in ([0, 1], [0, 1, -1], [0.0, 1.0, 2.0]):
        with pytest.raises(ValueError, match="non-negative integers"):
            env.steps = np.array(wrong)
    env.close()
