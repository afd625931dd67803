"""Emio: published dimensions and workspace, and a bench whose servos turn as the maker's program turns them."""

from __future__ import annotations

import math
import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import yaml

import softgym_envs
from softgym_envs.agents.baselines import make_baseline
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.extensions.beams.robots.emio import Emio
from softgym_envs.extensions.hardware.bench import BenchConfig
from softgym_envs.extensions.hardware.simulated_time import emulated_bench

PAGE = Path(softgym_envs.__file__).parents[1] / "docs" / "robots" / "emio.md"


def bench_of_the_page() -> BenchConfig:
    found = re.search(r'```yaml title="emio.yaml"\n(.*?)```', PAGE.read_text(), re.DOTALL)
    return BenchConfig.model_validate(yaml.safe_load(found[1]))


def test_rest_height_is_that_of_the_page_and_finer_meshes_agree():
    robots = [softgym_envs.make_robot("emio", mesh=mesh) for mesh in ("accurate", "reference")]
    heights = [FEMBackend(robot).state.effector[0, 2] for robot in robots]
    assert heights[0] == pytest.approx(-0.1480, abs=5e-5)
    assert heights[0] == pytest.approx(heights[1], abs=2e-5)


def test_the_effector_is_the_origin_of_the_connector():
    """It is 3 mm below the plane of the legs' tips and turns with the connector."""

    class Tips(Emio):
        effector_depth = 0.0

    robots = [softgym_envs.make_robot(kind, mesh="accurate") for kind in (Emio, Tips)]
    level = [FEMBackend(robot).state.effector[0] for robot in robots]
    np.testing.assert_allclose(level[1] - level[0], [0.0, 0.0, 0.003], atol=1e-9)
    tilted = [FEMBackend(robot).step(np.array([0.1, 0.0, -0.1, 0.0])).effector[0] for robot in robots]
    assert np.linalg.norm(tilted[1] - tilted[0]) == pytest.approx(0.003, abs=1e-9)
    assert abs(tilted[1][0] - tilted[0][0]) > 1e-5


@pytest.mark.parametrize("axis, sign", [(0, 1), (0, -1), (1, 1), (1, -1), (2, 1), (2, -1)])
def test_ends_of_the_published_ball_are_reached(axis, sign):
    """The maker validates on a ball with a radius of 40 mm about (0, 0, -130) mm."""
    goal = np.array([0.0, 0.0, -0.130])
    goal[axis] += 0.040 * sign
    env = gymnasium.make("SoftGym/Reach-v0", robot="emio", backend="fem")
    observation, _ = env.reset(seed=0, options={"goal": goal})
    act = make_baseline("qp")
    over = False
    while not over:
        observation, _, terminated, truncated, info = env.step(act(observation, env.unwrapped))
        over = terminated or truncated
    assert info["distance"] < 1e-4
    env.close()


@pytest.mark.parametrize("motor", range(4))
def test_servos_turn_as_the_makers_program_turns_them(motor):
    """`emioapi` sends 2048 - angle * 4096 / (2 pi); the axes of motors 0 and 2 point the other way than those of 1, 3.

    The maker's y is up: motor k stands at (sin, 0, cos) of k quarter turns, and turns about its own x axis, which is
    (-1)^(k + 1) times up x outwards: in the model this turn moves a hanging leg inwards, ours outwards.
    """
    config = bench_of_the_page()
    quarter = 0.5 * math.pi * motor
    theirs = np.array([math.sin(quarter), 0.0, math.cos(quarter)])
    ours = np.array([theirs[0], -theirs[2], theirs[1]])
    servo = round(math.atan2(ours[1], ours[0]) / (0.5 * math.pi)) % 4
    settings = config.settings.servos[f"servo_{servo + 1}"]
    assert settings.id == motor
    turn = math.radians([180.0, 90.0, 0.0, 270.0][motor])  # of the motor about y, in the maker's model
    axis = np.array([math.cos(turn), 0.0, -math.sin(turn)])
    outwards_by_their_angle = -float(axis @ np.cross([0.0, 1.0, 0.0], theirs))
    ticks_by_our_angle = -4096 / (2.0 * math.pi) / outwards_by_their_angle
    assert 1.0 / settings.per_tick == pytest.approx(ticks_by_our_angle)
    assert settings.zero == 2048


def test_the_bench_of_the_page_reaches_a_goal():
    config = bench_of_the_page()
    with emulated_bench(config) as bench:
        env = gymnasium.make("SoftGym/Reach-v0", robot="emio", backend="hardware", backend_options={"bench": bench})
        observation, _ = env.reset(seed=1)
        act = make_baseline("qp")
        over = False
        while not over:
            observation, _, terminated, truncated, info = env.step(act(observation, env.unwrapped))
            over = terminated or truncated
        assert info["is_success"] and info["distance"] < 2e-4
        assert env.unwrapped.backend.timing.lost == 0
        env.close()
