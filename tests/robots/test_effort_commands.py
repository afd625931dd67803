"""Actuators that are commanded in effort, against twins that are commanded in displacement."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.agents.evaluation import make_agent
from softgym_envs.backends import make_backend
from softgym_envs.control import InverseQP
from softgym_envs.extensions.beams.robots.stiff_flop import StiffFlop
from softgym_envs.extensions.fitting.training import FitConfig, check_learnable
from softgym_envs.robots import Actuator

PRESSED: dict[str, Any] = {"robot_options": {"largest_pressure": 1e5}}


class Mixed(StiffFlop):
    """A trunk with valves on the base module and syringes on the tip module."""

    name = "mixed_trunk"

    def __init__(self, **options: Any) -> None:
        super().__init__(largest_pressure=1e5, **options)
        volumes = StiffFlop().actuators
        self.actuators = (*self.actuators[:3], *volumes[3:])


@pytest.fixture(scope="module")
def twins():
    return make_robot("trunk", largest_pressure=1e5), make_robot("trunk")


@pytest.mark.parametrize("backend", ["fem", "surrogate"])
def test_pressures_lead_to_the_equilibrium_of_the_volumes_that_they_pump(twins, backend):
    pressed, filled = (make_backend(backend, robot) for robot in twins)
    for pressure in np.random.default_rng(0).uniform(0.0, 5e4, (3, 6)):
        found = pressed.step(pressure)
        twin = filled.step(found.displacement)
        np.testing.assert_allclose(found.effort, pressure, rtol=1e-4)
        np.testing.assert_allclose(twin.effort, pressure, rtol=1e-4)
        np.testing.assert_allclose(found.effector, twin.effector, atol=1e-7)
        np.testing.assert_allclose(pressed.probe(pressure).effector, found.effector, atol=1e-7)


def test_both_kinds_of_commands_in_one_robot():
    backend, twin = make_backend("fem", Mixed()), make_backend("fem", make_robot("trunk"))
    command = np.array([2e4, 1e4, 3e4, 1e-8, 2e-8, 1.2e-8])
    found = backend.step(command)
    np.testing.assert_allclose([*found.effort[:3], *found.displacement[3:]], command, rtol=1e-6)
    np.testing.assert_allclose(twin.step(found.displacement).effector, found.effector, atol=1e-9)
    with pytest.raises(ValueError, match="all commanded in effort or all in displacement, but robot 'mixed_trunk'"):
        make_backend("surrogate", Mixed())
    with pytest.raises(ValueError, match=r"backend 'hybrid' takes actuators .* the effort of base_1, base_2, base_3"):
        make_backend("hybrid", Mixed())


def test_motion_ends_at_the_equilibrium_under_the_pressure(twins):
    backend = make_backend("fem", twins[0], dynamics=True, control_step=0.5, stiffness_damping=0.1)
    still = make_backend("fem", twins[0]).step(np.full(6, 2e4) * [1, 0, 0, 0, 1, 0])
    for _ in range(6):
        moved = backend.step(still.command)
    np.testing.assert_allclose(moved.effort, still.command, atol=1e-3)
    np.testing.assert_allclose(moved.effector, still.effector, atol=1e-4)


@pytest.mark.parametrize("backend", ["surrogate", "fem"])
def test_actions_are_shares_of_the_pressure(backend):
    env: Any = gym.make("SoftGym/TrunkReach-v0", backend=backend, **PRESSED)
    env.reset(seed=0)
    observation, _, _, _, info = env.step(np.array([1.0, 0.5, 0.0, 0.0, 0.0, 0.0], dtype=np.float32))
    np.testing.assert_allclose(info["effort"], [5e3, 2.5e3, 0.0, 0.0, 0.0, 0.0], atol=1.0)
    slices = env.unwrapped.spaces.slices
    np.testing.assert_allclose(observation[slices["command"]][:2], [-0.9, -0.95], atol=1e-6)
    expected = info["displacement"] / 15e-9 - 1.0
    np.testing.assert_allclose(observation[slices["displacement"]], np.maximum(expected, -1.0), atol=1e-5)
    for _ in range(25):
        _, _, _, _, info = env.step(np.ones(6, dtype=np.float32))
        assert (env.unwrapped.command <= 1e5).all()


@pytest.mark.parametrize("backend", ["surrogate", "fem"])
def test_the_inverse_qp_reaches_goals_by_pressures(backend):
    env: Any = gym.make("SoftGym/TrunkReach-v0", backend=backend, **PRESSED)
    act = make_agent("qp")
    observation, info = env.reset(seed=2)
    for _ in range(40):
        before = env.unwrapped.command
        observation, _, _, _, info = env.step(act(observation, env.unwrapped))
        assert (np.abs(env.unwrapped.command - before) <= 5e3 * (1 + 1e-6)).all()
    assert info["distance"] < 1e-4
    assert ((info["effort"] > -1.0) & (info["effort"] <= 1e5)).all()
    assert InverseQP.for_robot(env.unwrapped.robot).by_effort.all()


@pytest.mark.parametrize("backend", ["surrogate", "fem"])
@pytest.mark.parametrize("robot", ["trunk", Mixed])
def test_rewards_have_the_slopes_of_their_differences(robot, backend):
    if robot is Mixed and backend == "surrogate":
        pytest.skip("a surrogate takes one kind of commands")
    options: dict[str, Any] = {"robot_options": PRESSED["robot_options"] if robot == "trunk" else {}}
    if backend == "surrogate":
        options["backend_options"] = {"members": 1}
    made: Any = gym.make_vec("SoftGym/Reach-v0", num_envs=3, robot=robot, backend=backend, **options)

    def after(last):
        made.reset(seed=1)
        for k in range(4):
            made.step(np.full((3, 6), 0.6 if k else 0.9))
        *_, gradient = made.unwrapped.step_with_gradient(last, log=True)
        return gradient

    last = np.random.default_rng(0).uniform(-0.5, 0.5, (3, 6))
    found, task = after(last), made.unwrapped.task
    assert not found.slack.any() and not found.limited.any()

    def rewards(action):
        after(action)
        state = made.unwrapped._episodes.state
        share = made.unwrapped.spaces.effort_share(state.effort)
        distance = np.linalg.norm(made.unwrapped._episodes.goals() - state.effector[:, :3], axis=1)
        return task.log_reward(distance, share)

    for k in range(6):
        h = np.zeros_like(last)
        h[:, k] = 0.02
        slope = (rewards(last + h) - rewards(last - h)) / 0.04
        np.testing.assert_allclose(found.action[:, k], slope, atol=0.02 * np.abs(found.action).max())
    made.close()


def test_batches_of_beams_follow_pressures_as_single_bodies_do(twins):
    batch: Any = gym.make_vec("SoftGym/TrunkReach-v0", num_envs=2, backend="fem", **PRESSED)
    batch.reset(seed=0)
    for _ in range(3):
        batch.step(np.array([[1.0, 0.2, 0.0, 0.5, 0.0, 0.0], [0.0, 1.0, 1.0, 0.0, 0.3, 0.6]]))
    single = make_backend("fem", twins[0])
    for row, state in enumerate(batch.unwrapped.backend.effectors(np.arange(2), batch.unwrapped.backend.command)):
        expected = single.step(batch.unwrapped.backend.command[row]).effector[0]
        np.testing.assert_allclose(state, expected, atol=1e-8)
        np.testing.assert_allclose(batch.unwrapped.backend.state.effector[row], expected, atol=1e-8)
        np.testing.assert_allclose(batch.unwrapped.backend.state.effort[row], batch.unwrapped.backend.command[row])
    batch.close()


def test_a_model_is_learned_over_displacements(twins):
    # The largest effort of a commanded displacement is beyond a model; that of a commanded effort is a command.
    data = dict.fromkeys(("train", "validation", "test"), {"groups": 2, "states": 2})
    check_learnable(twins[0], FitConfig.model_validate({"robot": "trunk", "data": data}))
    assert twins[0].effort_limited == [] and twins[0].mechanics_key == twins[1].mechanics_key


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"effort_rate": 1e3}, "effort_rate = 1000 needs a finite max_effort"),
        ({"effort_rate": 2e4, "max_effort": 1e4}, "must be positive and not beyond it, got max_effort = 10000"),
        ({"effort_rate": 0.0, "max_effort": 1e4}, "effort_rate = 0 needs"),
        ({"effort_rate": "fast", "max_effort": 1e4}, "effort_rate = 'fast' must be a number"),
    ],
)
def test_wrong_rates(options, message):
    with pytest.raises(ValueError, match=message):
        Actuator("chamber", 0.0, 1e-6, 1e-7, unit="m3", **options)


def test_ranges_and_units_of_commands():
    pushing = Actuator("valve", 0.0, 1e-6, 1e-7, "m3", unilateral=False, max_effort=1e4, effort_rate=1e3)
    assert pushing.command_range == (-1e4, 1e4) and pushing.command_rate == 1e3 and pushing.command_unit == "Pa"
    weight = Actuator("weight", 0.0, 0.01, 1e-3, max_effort=5.0, effort_rate=0.5)
    assert weight.command_range == (0.0, 5.0) and weight.command_unit == "N"
    drum = Actuator("drum", 0.0, 0.01, 1e-3, max_effort=5.0)
    assert drum.command_range == (0.0, 0.01) and drum.command_unit == "m" and not drum.by_effort
