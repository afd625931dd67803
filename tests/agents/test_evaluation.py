"""Records of evaluations: merged parts, averaged repeats and files."""

import json

import gymnasium
import numpy as np
import pytest

from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.agents.evaluation import SETTLED, Evaluation, evaluate, make_agent, sample_goals
from softgym_envs.agents.vec_env import SB3VecEnv
from softgym_envs.errors import DataError


def some(count, seed):
    rng = np.random.default_rng(seed)
    distances, means, returns, efforts = rng.random((4, count))
    successes, ends = rng.random(count) < 0.5, rng.random((count, 3))
    return Evaluation(
        distances, means, returns, successes, efforts, ends, steps=50 * count, seconds=1.5, cpu_seconds=1.25
    )


def test_merge_joins_goals_and_adds_costs():
    parts = some(3, 0), some(5, 1)
    whole = Evaluation.merge(parts)
    assert len(whole) == 8 and whole.steps == 400 and whole.seconds == 3.0 and whole.cpu_seconds == 2.5
    np.testing.assert_array_equal(whole.efforts[3:], parts[1].efforts)
    assert whole.successes.dtype == bool and whole.ends.shape == (8, 3)
    for name in ("success_rate", "mean_distance", "mean_tracking_distance", "mean_return", "mean_effort"):
        expected = np.average([getattr(part, name) for part in parts], weights=[3, 5])
        assert getattr(whole, name) == pytest.approx(expected, rel=1e-12)
    assert whole.worst_distance == max(part.worst_distance for part in parts)


def test_average_is_goal_by_goal():
    repeats = [some(4, seed) for seed in range(3)]
    mean = Evaluation.average(repeats)
    assert len(mean) == 4 and mean.steps == 600
    np.testing.assert_allclose(mean.distances, sum(repeat.distances for repeat in repeats) / 3, rtol=1e-12)
    assert mean.success_rate == pytest.approx(np.mean([repeat.success_rate for repeat in repeats]))
    with pytest.raises(ValueError, match=r"numbers of goals must be equal, got \[4, 5\]"):
        Evaluation.average([some(4, 0), some(5, 0)])


@pytest.mark.parametrize("evaluation", [some(3, 0), Evaluation.average([some(3, 0), some(3, 1)])])
def test_files_hold_everything(evaluation):
    data = json.loads(json.dumps(evaluation.to_json()))
    again = Evaluation.from_json(data)
    assert again.to_json() == evaluation.to_json()
    assert again.successes.dtype == evaluation.successes.dtype


def test_files_from_before_trust_and_largest_efforts_were_recorded_can_be_read():
    data = some(3, 0).to_json()
    for name in ("untrusted", "largest_efforts", "settled_distances", "largest_strains", "self_forces"):
        assert data.pop(name) == [None, None, None]
        assert np.isnan(getattr(Evaluation.from_json(data), name)).all()
    distances = data["mean_distances"] = data.pop("tracking_distances")  # its earlier name
    np.testing.assert_array_equal(Evaluation.from_json(data).tracking_distances, distances)


@pytest.mark.parametrize("backend", ["surrogate", "fem"])  # together and one by one
def test_largest_efforts_are_those_of_any_actuator_in_any_step(backend):
    environment = EnvironmentConfig(id="SoftGym/FingerReach-v0", backend=backend, max_episode_steps=4)
    goals = sample_goals(environment, 2, seed=0)
    found = evaluate("qp", environment, goals)
    env = environment.make()
    act, largest, means, strains = make_agent("qp"), [], [], []
    lengths = [cable.rest_length for cable in env.unwrapped.robot.build().constraints["a"]]
    for goal in goals:
        observation, _ = env.reset(seed=0, options={"goal": goal})
        efforts, pulled = [], []
        for _ in range(4):
            observation, _, _, _, info = env.step(act(observation, env.unwrapped))
            efforts.append(np.abs(info["effort"]))
            pulled.append(np.abs(info["displacement"]))
        strains.append(np.max(np.max(pulled, axis=0) / lengths))
        largest.append(np.max(efforts))
        means.append(np.mean(efforts))
    np.testing.assert_allclose(found.largest_efforts, largest, rtol=1e-3)
    np.testing.assert_allclose(found.efforts, means, rtol=1e-3)
    np.testing.assert_allclose(found.largest_strains, strains if backend == "fem" else np.full(2, np.nan), rtol=1e-3)
    assert np.isnan(found.self_forces).all()  # no surface touches another one


def test_strains_of_chambers_of_beams_are_known_on_the_surrogate():
    environment = EnvironmentConfig(id="SoftGym/TrunkReach-v0", max_episode_steps=6)
    goals = sample_goals(environment, 3, seed=0)
    for design in ({}, {"chamber_radius": 0.0006}):
        found = [evaluate("qp", environment.on(backend), goals, design=design) for backend in ("surrogate", "fem")]
        np.testing.assert_allclose(found[0].largest_strains, found[1].largest_strains, rtol=2e-2)
    # The chambers are smaller by 0.6^2 / 0.719^2, and stretch more.
    assert found[0].largest_strains.min() > 0.02


@pytest.mark.parametrize("backend", ["surrogate", "fem"])  # together and one by one
def test_settled_distances_are_means_over_the_last_steps(backend):
    steps = SETTLED + 3
    environment = EnvironmentConfig(id="SoftGym/FingerReach-v0", backend=backend, max_episode_steps=steps)
    goals = sample_goals(environment, 2, seed=0)
    env, act, expected = environment.make(), make_agent("qp"), []
    for goal in goals:
        observation, _ = env.reset(seed=0, options={"goal": goal})
        distances = []
        for _ in range(steps):
            observation, _, _, _, info = env.step(act(observation, env.unwrapped))
            distances.append(info["distance"])
        expected.append(np.mean(distances[-SETTLED:]))
    found = evaluate("qp", environment, goals).settled_distances
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-7)


def test_untrusted_states_are_counted():
    """An inverse QP that folds legs of the published mesh under a payload, in a batch and alone; random actions."""
    options = {"mesh": "published", "payload": 1.0, "servo_range": 0.5 * np.pi}
    environment = EnvironmentConfig(id="SoftGym/TetrapodCarry-v0", robot_options=options)
    goals = sample_goals(environment, 2, seed=0)
    folding = evaluate("qp", environment, goals)
    assert 0.2 < folding.untrusted[0] < 1.0
    env = environment.make()
    act = make_agent("qp")
    observation, _ = env.reset(seed=0)
    distrusted = []
    for _ in range(100):
        observation, _, _, _, info = env.step(act(observation, env.unwrapped))
        distrusted.append(not info["trusted"])
    assert folding.untrusted[0] == pytest.approx(np.mean(distrusted), abs=0.02)
    assert 0.0 <= evaluate("random", environment, goals).untrusted[0] <= 1.0


def test_a_damaged_file_is_named():
    data = some(3, 0).to_json()
    for change, message in (
        ({"efforts": None}, "numbers for each goal"),
        ({"efforts": [1.0]}, "numbers for each goal"),
        ({"ends": [0.0, 0.1, 0.2]}, "numbers for each goal"),
        ({"steps": "many"}, "ValueError"),
    ):
        with pytest.raises(DataError, match=message):
            Evaluation.from_json({**data, **change})
    del data["returns"]
    with pytest.raises(DataError, match="KeyError 'returns'"):
        Evaluation.from_json(data)


@pytest.mark.parametrize("agent", ["finger_reach", "qp"])  # as a batch, and one episode after the other
def test_ends_are_as_far_from_the_goals_as_the_distances_say(agent):
    environment = EnvironmentConfig(id="SoftGym/FingerReach-v0")
    goals = sample_goals(environment, 3, seed=1)
    outcome = evaluate(agent, environment, goals)
    np.testing.assert_allclose(np.linalg.norm(outcome.ends - goals[:, -1], axis=1), outcome.distances, atol=1e-9)


def test_tasks_that_read_states_run_one_environment_at_a_time():
    grasp = EnvironmentConfig(id="SoftGym/FingerGrasp-v0", backend="surrogate")
    assert not grasp.batched and EnvironmentConfig(id="SoftGym/FingerReach-v0").batched
    envs = SB3VecEnv(grasp.make_vec(1))
    envs.reset()
    _, rewards, done, infos = envs.step(np.ones((1, 1), dtype=np.float32))
    assert rewards.shape == done.shape == (1,) and infos[0]["distance"] == 1.0


@pytest.mark.parametrize("kind", ["NextStep", "Disabled", "sync"])
def test_stable_baselines_sees_the_same_episodes_in_every_autoreset_mode(kind):
    """Whatever resets the environments, and whenever: the last observation, its information and the next episode."""
    options = {"max_episode_steps": 4}
    whole = gymnasium.make_vec("SoftGym/FingerReach-v0", 3, **options)
    if kind == "sync":  # Gymnasium's own, which resets in the next step
        other = gymnasium.make_vec("SoftGym/FingerReach-v0", 3, vectorization_mode="sync", **options)
    else:
        other = gymnasium.make_vec("SoftGym/FingerReach-v0", 3, autoreset_mode=kind, **options)
    pair = [SB3VecEnv(whole), SB3VecEnv(other)]
    for envs in pair:
        envs.seed(3)
    np.testing.assert_allclose(*(envs.reset() for envs in pair), atol=1e-6)
    rng, ended = np.random.default_rng(0), 0
    for _ in range(10):
        actions = rng.uniform(-1.0, 1.0, (3, 2)).astype(np.float32)
        (seen, reward, done, infos), (*others, other_infos) = (envs.step(actions) for envs in pair)
        for one, two in zip((seen, reward, done), others, strict=True):
            np.testing.assert_allclose(two, one, atol=1e-6)
        for i in np.flatnonzero(done):
            one, two = infos[i], other_infos[i]
            np.testing.assert_allclose(two["terminal_observation"], one["terminal_observation"], atol=1e-6)
            assert two["episode"] == pytest.approx(one["episode"]) and two["TimeLimit.truncated"]
            assert two["distance"] == pytest.approx(one["distance"], abs=1e-9)
            ended += 1
    assert ended == 6


@pytest.mark.parametrize("agent", ["finger_reach", "qp", "random"])
def test_processes_share_goals_and_give_the_same_numbers(agent):
    environment = EnvironmentConfig(id="SoftGym/FingerReach-v0", backend="fem")
    goals = sample_goals(environment, 3, seed=5)
    one, two = (evaluate(agent, environment, goals, seed=1, workers=workers) for workers in (1, 2))
    for name in ("distances", "tracking_distances", "returns", "successes", "efforts", "ends"):
        np.testing.assert_array_equal(getattr(two, name), getattr(one, name))
    assert two.steps == one.steps == 150 and two.cpu_seconds > 0.0
    assert len(set(one.returns)) == 3  # episodes differ


@pytest.mark.parametrize("agent", ["finger_reach", "qp"])
def test_episodes_that_run_together_are_not_shared_by_processes(agent):
    environment = EnvironmentConfig(id="SoftGym/FingerReach-v0", max_episode_steps=3)
    goals = sample_goals(environment, 4, seed=5)
    one, two = (evaluate(agent, environment, goals, workers=workers) for workers in (1, 2))
    assert len(two) == 4 and two.steps == 12
    np.testing.assert_array_equal(two.distances, one.distances)


def test_wrong_arguments_are_refused():
    environment = EnvironmentConfig(id="SoftGym/FingerReach-v0")
    with pytest.raises(ValueError, match="workers = 0 must be 1 or more"):
        evaluate("qp", environment, np.zeros((1, 3)), workers=0)
    for shape in ((3,), (0, 3), (2, 2), (2, 0, 3)):
        with pytest.raises(ValueError, match="goals must have shape"):
            evaluate("qp", environment, np.zeros(shape))
    with pytest.raises(ValueError, match="one for each of 2 goals, got 1"):
        evaluate("random", environment, np.zeros((2, 3)), design=[{}])


def test_the_body_of_an_environment_can_be_evaluated():
    environment = EnvironmentConfig(id="SoftGym/FingerReach-v0", max_episode_steps=2)
    body = environment.make(design={"length": 0.041}).unwrapped.design
    goals = sample_goals(environment, 1, seed=0, design=body)
    given = evaluate("qp", environment, goals, design=body)
    np.testing.assert_array_equal(given.ends, evaluate("qp", environment, goals, design=dict(body)).ends)
