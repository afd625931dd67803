"""Copies, pickles and states of environments in mid-episode."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest

from softgym_envs import make_robot

COARSE = {"element": "linear", "mesh_size": 0.015}
CASES = {
    "surrogate": ("SoftGym/FingerReach-v0", {"sample_design": True, "design_in_observation": True}),
    "fem": ("SoftGym/FingerReach-v0", {"backend": "fem", "sample_design": ["length"]}),
    "hybrid": ("SoftGym/FingerReach-v0", {"backend": "hybrid"}),
    "path": ("SoftGym/FingerTrack-v0", {}),
    "pushed, moving": ("SoftGym/TetrapodCarry-v0", {"task_options": {"push": 1.0, "push_window": 3}}),
    "alpha": (
        "SoftGym/TetrapodReach-v0",
        {"backend_options": {"dynamics": True, "scheme": "generalised_alpha"}, "design_in_observation": True},
    ),
    "contact": ("SoftGym/FingerGrasp-v0", {"backend": "fem", "robot_options": COARSE}),
    "chain": ("SoftGym/FingerGrasp-v0", {"backend": "surrogate"}),
}


def walk(env, actions):
    """Observations, rewards and infos of some steps."""
    return [env.step(action) for action in actions]


def check_equal(first, second):
    for (a, reward_a, *ends_a, info_a), (b, reward_b, *ends_b, info_b) in zip(first, second, strict=True):
        # Finite elements start from the same state, but what they keep to save time differs.
        np.testing.assert_allclose(a, b, rtol=0, atol=2e-7)
        assert reward_a == pytest.approx(reward_b, abs=1e-7) and ends_a == ends_b
        assert (info_a["goal"] == info_b["goal"]).all()
        np.testing.assert_allclose(info_a["effort"], info_b["effort"], rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("case", CASES)
def test_copies_go_on_in_mid_episode(case):
    identifier, options = CASES[case]
    env = gymnasium.make(identifier, **options)
    env.reset(seed=3)
    env.action_space.seed(5)
    walk(env, [env.action_space.sample() for _ in range(3)])
    kept = env.unwrapped.get_state()
    twins = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    actions = [env.action_space.sample() for _ in range(3)]
    expected = walk(env, actions)
    first_goal = env.reset()[1]["goal"]
    for twin in twins:
        assert (np.stack([twin.action_space.sample() for _ in range(3)]) == actions).all()
        assert twin.unwrapped.design != env.unwrapped.design or not options.get("sample_design")
        check_equal(expected, walk(twin, actions))
        assert (twin.reset()[1]["goal"] == first_goal).all()  # the next random numbers

    body = env.unwrapped
    observation, info = body.set_state(kept)
    assert body.observation_space.contains(observation)
    check_equal(expected, walk(body, actions))
    assert body.state.displacement == pytest.approx(expected[-1][4]["displacement"], abs=1e-9)
    check_equal(
        expected, [body.set_state(pickle.loads(pickle.dumps(kept))) and body.step(actions[0])] + walk(body, actions[1:])
    )


def test_hybrid_copies_answer_with_the_same_models(weights):
    env = gymnasium.make(
        "SoftGym/FingerReach-v0",
        backend="hybrid",
        robot_options={"cables": 1},
        backend_options={"weights": str(weights), "retrain_after": 1, "steps": 2},
    )
    actions = [np.ones(1, dtype=np.float32)] * 12  # to 12 mm; the weights know 8 mm
    for _ in range(2):
        env.reset(seed=0)
        walk(env, actions)
    backend = env.unwrapped.backend
    assert backend.retrainings == 1 and len(backend._known) > 1
    twins = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    actions = [actions[0], *(-action for action in actions)]
    expected = walk(env, actions)
    for twin in twins:
        check_equal(expected, walk(twin, actions))


def test_environments_of_a_robot_object_are_copied():
    robot = make_robot("finger")
    robot.build({"length": 0.041})
    env = gymnasium.make("SoftGym/Reach-v0", robot=robot, backend="fem")
    env.reset(seed=0)
    for twin in (pickle.loads(pickle.dumps(env)), copy.deepcopy(env)):
        assert twin.unwrapped.robot is not robot
        assert (twin.unwrapped.goal == env.unwrapped.goal).all()


def test_copies_before_the_first_episode_and_time_limits():
    env = gymnasium.make("SoftGym/FingerReach-v0", max_episode_steps=5)
    twin = copy.deepcopy(env)
    assert (twin.reset(seed=1)[0] == env.reset(seed=1)[0]).all()
    action = np.ones(2, dtype=np.float32)
    walk(env, [action] * 3)
    ends = [truncated for _, _, _, truncated, _ in walk(copy.deepcopy(env), [action] * 2)]
    assert ends == [False, True]


def test_a_state_of_another_environment_is_refused():
    env = gymnasium.make("SoftGym/FingerReach-v0", backend="fem").unwrapped
    for other, words in (
        (gymnasium.make("SoftGym/DiamondReach-v0"), "robot 'diamond', but the environment has robot 'finger'"),
        (gymnasium.make("SoftGym/FingerTrack-v0"), "task 'track'"),
        (gymnasium.make("SoftGym/FingerReach-v0"), "state of SurrogateBackend cannot continue in FEMBackend"),
    ):
        with pytest.raises(ValueError, match=words):
            env.set_state(other.unwrapped.get_state())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"task_options": {"command_low": 0.5}}, "a task with command_low = 0.5, but the environment has 0.0"),
        (
            {"task_options": {"goals": [[0.0, 0.04, -0.1]]}},
            "a task with fixed_goals = .*, but .* has null",
        ),
        ({"robot_options": {"element": "averaged"}}, 'a robot with element = "averaged", but .* has its default'),
    ],
)
def test_a_state_of_other_options_is_refused(options, words):
    env, other = (gymnasium.make("SoftGym/FingerReach-v0", backend="fem", **each).unwrapped for each in ({}, options))
    env.reset(seed=0)
    other.reset(seed=0)
    before = vars(env.task).copy()
    with pytest.raises(ValueError, match=words):
        env.set_state(other.get_state())
    assert vars(env.task) == before


@pytest.mark.parametrize("identifier", ["SoftGym/FingerReach-v0", "SoftGym/TetrapodReach-v0"])
def test_batches_are_copied_in_mid_episode(identifier):
    env = gymnasium.make_vec(identifier, num_envs=3, sample_design=True, max_episode_steps=5)
    env.reset(seed=0)
    shape = (8, *env.action_space.shape)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, shape).astype(np.float32)
    walk(env, actions[:3])
    twins = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    expected = [row[0] for row in walk(env, actions[3:])]
    for twin in twins:
        assert (np.stack([row[0] for row in walk(twin, actions[3:])]) == expected).all()


def test_batches_of_tensors_are_copied_in_mid_episode():
    import torch

    from softgym_envs.extensions.gpu import TorchVectorEnv

    env = TorchVectorEnv("SoftGym/FingerReach-v0", 3, device="cpu", sample_design=True, max_episode_steps=5, seed=0)
    env.reset()
    actions = 2.0 * torch.rand(8, 3, 2, generator=torch.Generator().manual_seed(0)) - 1.0
    walk(env, actions[:3])
    twins = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    expected = torch.stack([row[0] for row in walk(env, actions[3:])])
    for twin in twins:
        assert (torch.stack([row[0] for row in walk(twin, actions[3:])]) == expected).all()


def test_copies_know_their_specification():
    env = gymnasium.make("SoftGym/FingerReach-v0")
    for twin in (pickle.loads(pickle.dumps(env)), copy.deepcopy(env)):
        assert twin.unwrapped.spec == env.unwrapped.spec and twin.spec.id == "SoftGym/FingerReach-v0"
