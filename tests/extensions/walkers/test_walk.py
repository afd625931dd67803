"""The task Walk: what its reward and tallies count, that nonsense wins nothing, pushes, and evaluations."""

from __future__ import annotations

import copy

import gymnasium
import numpy as np
import pytest

import softgym_envs  # noqa: F401 - registers the IDs
from softgym_envs import make_robot
from softgym_envs.agents.baselines import make_baseline
from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.agents.evaluation import Evaluation, evaluate
from softgym_envs.codesign.metrics.metric import METRICS
from softgym_envs.codesign.metrics.sources import Outcome
from softgym_envs.envs.tasks.registry import make_task

ID = "SoftGym/QuadrupedWalk-v0"
STAND = np.zeros(8, dtype=np.float32)


def episode(act, *, steps=100, seed=0, **options):
    """Rewards, places of the trunk and infos of an episode."""
    env = gymnasium.make(ID, **options)
    observation, info = env.reset(seed=seed)
    rewards, places, infos = [], [info["effector"]], [info]
    for k in range(steps):
        observation, reward, *_, info = env.step(act(k, env.unwrapped, observation))
        assert env.observation_space.contains(observation)
        rewards.append(reward)
        places.append(info["effector"])
        infos.append(info)
    return np.array(rewards), np.array(places), infos


def trot(k, env, observation):
    return make_baseline("gait")(observation, env)


@pytest.fixture(scope="module")
def walk():
    return episode(trot)


def test_the_common_gait_walks(walk):
    rewards, places, infos = walk
    assert places[-1, 0] > 0.1
    assert infos[-1]["speed"] == pytest.approx((places[100, 0] - places[50, 0]) / 2.5, rel=1e-9)
    assert infos[-1]["drift"] == pytest.approx(abs(places[100, 1] - places[50, 1]) / 2.5, abs=1e-12)
    assert 0.0 < infos[-1]["slip"] < 0.2 * infos[-1]["speed"]
    assert infos[-1]["distance"] == pytest.approx(np.hypot(0.04 - infos[-1]["speed"], infos[-1]["drift"]))
    assert (
        np.abs(rewards - [sum(v for n, v in i.items() if n.startswith("reward_")) for i in infos[1:]]) < 1e-12
    ).all()


def test_rewards_never_exceed_the_way_ahead(walk):
    """In sizes of the robot: rewards are speeds, for steps of 50 ms."""
    for rewards, places, infos in (walk, episode(lambda k, env, o: env.action_space.sample(), steps=40)):
        ways = (places[1:, 0] - places[0, 0]) / 0.1
        assert (0.05 * np.cumsum(rewards) <= ways + 1e-9).all()
        assert all(info[f"reward_{name}"] <= 0.0 for info in infos for name in ("slip", "drift", "work"))


NONSENSE = {
    "stands": lambda k: 0.0 * np.ones(8),
    "leans forwards and stays": lambda k: np.tile([-1.0, 1.0], 4) * (k < 2),
    "rocks": lambda k: np.tile([-1.0, 1.0], 4) * (1 if k % 4 in (0, 3) else -1),
    "hops": lambda k: np.ones(8) * (1 if k % 4 in (0, 3) else -1),
    "jerks forwards and creeps back": lambda k: np.tile([-1.0, 1.0], 4) * (1.0 if k % 8 in (0, 1) else -1.0 / 3.0),
}


@pytest.mark.parametrize("name", NONSENSE)
def test_nonsense_wins_nothing(walk, name):
    rewards, places, infos = episode(lambda k, env, o: NONSENSE[name](k).astype(np.float32))
    # A lean brings the trunk forward once, by less than a tenth of its size.
    assert 0.05 * rewards.sum() < 0.15
    assert rewards[50:].sum() < 0.1 * walk[0][50:].sum()
    assert infos[-1]["speed"] < 0.1 * walk[2][-1]["speed"]
    assert not infos[-1]["is_success"]


def test_slip_is_the_way_of_loaded_points():
    """On ground so slippery that a push moves the robot without its doing anything, it slips as far as it goes."""
    _, places, infos = episode(
        lambda k, env, o: STAND, robot_options={"friction": 0.05}, task_options={"push": 0.5, "push_steps": 4}, seed=3
    )
    way = np.linalg.norm(places[-1, :2] - places[0, :2])
    assert way > 5e-3
    env = gymnasium.make(ID, robot_options={"friction": 0.05}, task_options={"push": 0.5, "push_steps": 4}).unwrapped
    env.reset(seed=3)
    for _ in range(100):
        env.step(STAND)
    assert env.task._moments[-1].slip == pytest.approx(way, rel=0.15)


def test_a_payload_weighs_on_the_feet():
    rest = {}
    for payload in (0.0, 0.05):
        env = gymnasium.make(ID, task_options={"payload": payload}).unwrapped
        env.reset(seed=1)
        for _ in range(10):
            info = env.step(STAND)[4]
        rest[payload] = info["contact_force"][0, 2], 0.0 if env.task.load is None else env.task.load.carried[2]
    assert rest[0.05][1] < 0.0
    assert rest[0.05][0] - rest[0.0][0] == pytest.approx(-rest[0.05][1], rel=1e-6)


def test_each_episode_draws_its_ground():
    """Where a robot slides downhill says its friction, and how it stands its slope; payloads hang along gravity."""
    env = gymnasium.make(ID, task_options={"friction": [0.3, 1.0], "slope": [0.0, 0.2], "payload": 0.03}).unwrapped
    grounds = []
    for seed in (0, 1):
        env.reset(seed=seed)
        for _ in range(10):
            info = env.step(STAND)[4]
        model, carried = env.backend.model, env.task.load.carried
        assert np.cross(model.gravity, carried) == pytest.approx(0.0, abs=1e-12)
        # What the ground carries is the weight of robot and payload along the slope's own axes.
        force, mass = info["contact_force"][0], 0.05 + 4.0 * 1070.0 * np.pi * 0.008**2 * 0.055
        assert force == pytest.approx(-mass * model.gravity - carried, abs=2e-3 * np.linalg.norm(force))
        grounds.append((model.contact.obstacles[0].friction, model.gravity[0]))
    (one, steep), (other, flat) = grounds
    assert one != other and steep != flat and np.linalg.norm(model.gravity) == pytest.approx(9.81)
    env.reset(seed=0)
    assert (env.backend.model.contact.obstacles[0].friction, env.backend.model.gravity[0]) == grounds[0]


def test_a_moment_can_be_restored():
    env = gymnasium.make(ID).unwrapped
    env.reset(seed=0)
    for k in range(5):
        env.step(trot(k, env, None))
    twin = copy.deepcopy(env)
    moment = env.get_state()
    following = [env.step(trot(k, env, None)) for k in range(5)]
    env.set_state(moment)
    again = [env.step(trot(k, env, None)) for k in range(5)]
    others = [twin.step(trot(k, twin, None)) for k in range(5)]
    for one, two, three in zip(following, again, others, strict=True):
        assert (one[0] == two[0]).all() and (one[0] == three[0]).all()
        assert one[1] == two[1] == three[1] and one[4]["speed"] == two[4]["speed"] == three[4]["speed"]


def test_metrics_read_the_evaluation(walk):
    config = EnvironmentConfig(id=ID, max_episode_steps=30)
    found = evaluate("gait", config, np.array([[0.04, 0.0, 0.0]] * 2))
    assert found.tallies["speed"].shape == (2,)
    stored = Evaluation.from_json(found.to_json())
    outcome = Outcome(stored, config.make_robot().design_space.baseline, config.make_robot())
    values = {
        name: METRICS[name].measure(outcome).value for name in ("forward_speed", "relative_slip", "cost_of_transport")
    }
    assert values["forward_speed"] == pytest.approx(found.tallies["speed"].mean())
    assert 0.0 < values["relative_slip"] < 0.3
    assert 0.1 < values["cost_of_transport"] < 2.0
    still = Evaluation.from_json(found.to_json() | {"tallies": {}})
    with pytest.raises(ValueError, match="needs episodes of a task that counts 'speed'"):
        METRICS["forward_speed"].measure(Outcome(still, {}, config.make_robot()))


def test_vector_environments_walk_alike():
    envs = gymnasium.make_vec(ID, num_envs=2, vectorization_mode="sync")
    envs.reset(seed=4)
    action = np.tile([1.0, -1.0], (2, 4)).astype(np.float32)
    for _ in range(4):
        *_, info = envs.step(action)
    single = gymnasium.make(ID)
    single.reset(seed=4)
    for _ in range(4):
        *_, own = single.step(action[0])
    assert (info["speed"] == own["speed"]).all()
    envs.close()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"pace": 0.0}, "pace = 0.0 sizes per second must be positive"),
        ({"slip": -1.0}, "slip = -1.0 must be finite and not negative"),
        ({"payload": -0.1}, "payload = -0.1 kg must be"),
        ({"push": -1.0}, "push = -1.0"),
        ({"push_steps": 0}, "push_steps = 0 is out of bounds; allowed: 1 to 99 control steps"),
        ({"push_steps": 100}, "push_steps = 100 is out of bounds"),
        ({"payload": 20.0}, r"payload = 20 kg is implausible, allowed: 0 to 2 kg"),
        ({"push": 100.0}, r"push = 100 N is implausible"),
        ({"friction": (1.0, 0.5)}, r"friction = \(1.0, 0.5\) must be a number or a range"),
        ({"friction": "icy"}, "friction = 'icy' must be a number or a list"),
        ({"slope": (0.0, 0.6)}, "allowed: -0.5 to 0.5 rad"),
        ({"slope": 0.4, "friction": (0.3, 1.0)}, "slope = 0.4 rad is too steep for friction"),
    ],
)
def test_wrong_options(options, words):
    with pytest.raises(ValueError, match=words):
        make_task("walk", make_robot("quadruped"), **options)


def test_mounted_robots_do_not_walk():
    with pytest.raises(
        ValueError, match="task 'walk' needs a robot that moves about on the ground; 'tetrapod' does not"
    ):
        make_task("walk", make_robot("tetrapod"))


@pytest.mark.parametrize("goal", [[0.0, 0.0, 0.0], [0.1, 0.1, 0.0], [np.nan, 0.0, 0.0], [[0.1, 0.0, 0.0]] * 2])
def test_wrong_goals(goal):
    env = gymnasium.make(ID)
    with pytest.raises(ValueError, match="goal must be a velocity"):
        env.reset(options={"goal": goal})
