"""The task Throw: its flight and gradients, what a payload does, and that nonsense wins nothing."""

from __future__ import annotations

import math

import gymnasium
import numpy as np
import pytest

import softgym_envs  # noqa: F401 - registers the IDs
from softgym_envs import make_robot
from softgym_envs.agents.baselines import make_baseline
from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.agents.evaluation import evaluate
from softgym_envs.backends.backend import Ground
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.codesign.metrics.metric import METRICS
from softgym_envs.codesign.metrics.sources import Outcome
from softgym_envs.envs.tasks.registry import make_task
from softgym_envs.extensions.walkers.learners.gait import GaitLearner
from softgym_envs.extensions.walkers.tasks.throw import landing

ID = "SoftGym/WhipThrow-v0"
FIXED = {"task_options": {"payload": 0.02}}
BEND = np.array([-1.0, 1.0, -1.0, 1.0])


def config(steps, seed=0, **gait):
    return TrainConfig(
        learner="gait",
        num_envs=1,
        steps=steps,
        report_every=steps,
        seed=seed,
        evaluation_episodes=1,
        environment={"id": ID},
        gait={"period": 30, "periods": 1} | gait,
    )


def throw(act, **options):
    """Rewards and infos of an episode, and the environment at its end."""
    env = gymnasium.make(ID, **(FIXED | options))
    observation, info = env.reset(seed=0)
    rewards, infos = [], [info]
    for k in range(30):
        observation, reward, terminated, _, info = env.step(np.asarray(act(k, env.unwrapped), dtype=np.float32))
        assert env.observation_space.contains(observation)
        assert not terminated
        rewards.append(reward)
        infos.append(info)
    return np.array(rewards), infos, env.unwrapped


def plain(k, env):
    return make_baseline("gait")(None, env)


@pytest.fixture(scope="module")
def thrown():
    return throw(plain)


# -- flight -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [-0.5, 0.0, 0.7, 1.5])
def test_the_flight_is_a_parabola(angle):
    place, speed, floor = np.array([0.1, -0.02, 0.3]), 2.0, -0.6
    velocity = speed * np.array([math.cos(angle), 0.1, math.sin(angle)])
    landed = landing(place, velocity, floor)
    time = (landed[0] - place[0]) / velocity[0]
    assert time > 0.0
    assert landed[1] == pytest.approx(place[1] + velocity[1] * time, abs=1e-14)
    assert place[2] + velocity[2] * time - 0.5 * 9.81 * time**2 == pytest.approx(floor, abs=1e-12)


def test_the_range_on_level_ground_is_that_of_galileo():
    for angle in (0.3, 0.25 * math.pi):
        landed = landing(np.zeros(3), 3.0 * np.array([math.cos(angle), 0.0, math.sin(angle)]), 0.0)
        assert landed[0] == pytest.approx(9.0 * math.sin(2.0 * angle) / 9.81, rel=1e-12)


# -- episodes ---------------------------------------------------------------------------------------------------------


def test_rewards_add_up_to_the_range(thrown):
    rewards, infos, env = thrown
    assert 0.25 * rewards.sum() == pytest.approx(infos[-1]["range"], abs=1e-12)
    state = env.state
    assert infos[-1]["measured"] == pytest.approx(landing(state.effector[0], state.velocity[0], -0.6))
    assert infos[-1]["range"] > 0.05
    assert infos[-1]["distance"] == pytest.approx(0.5 - infos[-1]["range"])
    assert abs(infos[0]["range"]) < 1e-9  # hanging still


def test_the_throw_has_no_more_energy_than_the_drives_gave(thrown):
    _, infos, env = thrown
    motion, rest, model = env.state.motion, env.backend.rest, env.backend.model
    speed, height = np.linalg.norm(env.state.velocity[0]), env.state.effector[0, 2] - rest.effector[0, 2]
    payload = 0.02 * (0.5 * speed**2 + 9.81 * height)
    hanging = model.elastic_energy(rest.nodes) - (model.loads * (rest.nodes - model.nodes)).sum()
    gained = motion.energy - hanging
    assert 0.0 < payload < gained < motion.work
    # Implicit Euler damps, by less than half of what the material does.
    assert 0.0 < motion.work - gained - motion.dissipated < 0.5 * motion.dissipated


def test_no_chamber_has_more_than_its_largest_pressure():
    _, infos, _ = throw(lambda k, env: BEND * (1.0 if k % 20 < 10 else -1.0))
    pressures = np.abs([info["effort"] for info in infos])
    assert pressures.max() == pytest.approx(1.0e5, rel=1e-6)


NONSENSE = {
    "hangs still": lambda k: np.zeros(4),
    "bobs": lambda k: np.ones(4) * (1.0 if k % 10 < 5 else -1.0),
    "bends and holds": lambda k: BEND,
    "shakes": lambda k: BEND * (1.0 if k % 2 else -1.0),
}


@pytest.mark.parametrize("name", NONSENSE)
def test_nonsense_throws_no_farther_than_the_arm_reaches(name):
    _, infos, _ = throw(lambda k, env: NONSENSE[name](k))
    assert infos[-1]["range"] < 0.25
    assert not infos[-1]["is_success"]


def test_half_the_time_step_and_twice_the_elements_hardly_change_the_range(thrown):
    ranges = [
        throw(plain, **options)[1][-1]["range"]
        for options in ({"backend_options": {"time_step": 0.001}}, {"robot_options": {"elements": 4}})
    ]
    assert ranges == pytest.approx(2 * [thrown[1][-1]["range"]], rel=0.05)


def test_a_payload_on_the_floor_ends_the_episode():
    env = gymnasium.make(ID, task_options={"floor": -0.26}).unwrapped
    env.reset(seed=0)
    ended = [env.step(-np.ones(4, dtype=np.float32) * (-1.0))[2] for _ in range(5)]
    assert ended[-1]


def test_each_episode_draws_a_payload_which_the_pressures_show():
    env = gymnasium.make(ID).unwrapped
    efforts = []
    for seed in (1, 2, 1):
        env.reset(seed=seed)
        efforts.append(env.step(0.5 * BEND.astype(np.float32))[4]["effort"])
    assert (efforts[0] == efforts[2]).all()
    assert np.abs(efforts[0] - efforts[1]).max() > 10.0


@pytest.mark.parametrize("name", ["whip", "tetrapod"])
def test_a_payload_that_is_drawn_is_that_of_a_robot_built_with_it(name):
    own, heavy = (FEMBackend(make_robot(name, payload=mass), dynamics=True) for mass in (0.01, 0.03))
    rest = own.rest
    assert own.stand_on(Ground(payload=0.03)).nodes == pytest.approx(heavy.rest.nodes, abs=1e-12)
    command = 0.4 * own.robot.rates * np.array([-1.0, 1.0, -1.0, 1.0])
    moved = [[backend.step(command).nodes for _ in range(3)][-1] for backend in (own, heavy)]
    assert moved[0] == pytest.approx(moved[1], abs=1e-9)
    other = FEMBackend(make_robot(name, payload=0.01), dynamics=True)
    other.resume(own.snapshot())
    assert (other.step(command).nodes == own.step(command).nodes).all()
    assert own.stand_on(Ground()).nodes == pytest.approx(rest.nodes, abs=1e-12)


def test_a_robot_without_a_rigid_part_carries_nothing():
    backend = FEMBackend(make_robot("finger"))
    with pytest.raises(ValueError, match="payload = 0.01 kg: the first effector is in no rigid part"):
        backend.stand_on(Ground(payload=0.01))
    with pytest.raises(ValueError, match="payload = -0.01 kg must not be negative"):
        Ground(payload=-0.01)


# -- learning ---------------------------------------------------------------------------------------------------------


def test_the_gradient_of_a_throw_is_that_of_differences():
    learner = GaitLearner(config(30, spread=0.3))
    found = learner.climb()
    assert found.value < found.way  # pressures are charged
    rng = np.random.default_rng(0)
    for _ in range(3):
        change = rng.standard_normal(learner.gait.shape)
        start, values = learner.gait, []
        for sign in (1.0, -1.0):
            learner.gait = start + sign * 1e-5 * change
            values.append(learner.climb().value)
        learner.gait = start
        assert np.vdot(found.by_gait, change) == pytest.approx((values[0] - values[1]) / 2e-5, rel=1e-4)


def test_gradients_lead_to_a_farther_throw_that_the_environment_repeats(thrown):
    learner = GaitLearner(config(30 * 12, learning_rate=0.2))
    learner.learn(30 * 12, lambda steps: None)
    gait = learner.best

    def act(k, env):
        return np.tanh(env.spaces.half_range / env.robot.rates * (gait[k] - (env.command / env.spaces.half_range)))

    rewards, infos, _ = throw(act)
    assert infos[-1]["range"] > 1.3 * thrown[1][-1]["range"]


def test_a_gait_counts_after_its_first_period():
    walk = TrainConfig(
        learner="gait", num_envs=1, steps=10, report_every=10, evaluation_episodes=1,
        environment={"id": "SoftGym/SwimmerSwim-v0"}, gait={"period": 20, "periods": 1},
    )  # fmt: skip
    with pytest.raises(ValueError, match="periods must be at least 2"):
        GaitLearner(walk).climb()


def test_a_task_that_does_not_rate_motions_has_no_gait():
    carry = TrainConfig(
        learner="gait", num_envs=1, steps=30, report_every=30, evaluation_episodes=1,
        environment={"id": "SoftGym/TetrapodCarry-v0"},
    )  # fmt: skip
    with pytest.raises(ValueError, match="learner 'gait' needs a task that rates whole motions by `gain`, got 'carry'"):
        GaitLearner(carry)


# -- tools ------------------------------------------------------------------------------------------------------------


def test_the_metric_reads_the_evaluation():
    environment = EnvironmentConfig(id=ID)
    found = evaluate("gait", environment, np.array([[0.5, 0.0, -0.6]]))
    robot = environment.make_robot()
    outcome = Outcome(found, robot.design_space.baseline, robot)
    assert METRICS["throw_range"].measure(outcome).value == pytest.approx(found.tallies["range"].mean())


def test_pictures_show_the_flight(thrown):
    env = thrown[2]
    path, goal = env.task.drawn_goals(env.state, env.path, env.goal)
    assert path[0] == pytest.approx(env.state.effector[0])
    assert path[-1] == pytest.approx(env.task.measure(env.state), abs=1e-12)
    assert goal == pytest.approx([0.5, 0.0, -0.6])


@pytest.mark.parametrize(
    ("robot", "options", "words"),
    [
        ("quadruped", {}, "task 'throw' needs a mounted robot with gravity = \\(0, 0, -9.81\\), got 'quadruped'"),
        ("trunk", {}, "task 'throw' needs a mounted robot with gravity"),
        ("whip", {"floor": 0.1}, "floor = 0.1 m is out of bounds"),
        ("whip", {"distance": [0.5, 0.2]}, "distance = \\[0.5, 0.2\\] m must be a number or a range"),
        ("whip", {"payload": -1.0}, "payload = -1.0 kg must be a number or a range"),
    ],
)
def test_wrong_options(robot, options, words):
    with pytest.raises(ValueError, match=words):
        make_task("throw", make_robot(robot), **options)


def test_wrong_goals():
    task = make_task("throw", make_robot("whip"))
    assert task.check_paths([0.4, 0.0, -0.6]).shape == (1, 3)
    for goal in ([0.4, 0.0, 0.0], [-0.4, 0.0, -0.6], [np.nan, 0.0, -0.6], [0.4, 0.0]):
        with pytest.raises(ValueError, match="goal must be a place"):
            task.check_paths(goal)
