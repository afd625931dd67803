"""The batched environment against the single one, and its adapter."""

import copy

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded

import softgym_envs
from softgym_envs.agents.vec_env import SB3VecEnv
from softgym_envs.envs.vector_env import SoftRobotVectorEnv
from softgym_envs.errors import DesignError, InfeasibleDesign


@pytest.mark.parametrize("identifier", [i for i, row in softgym_envs.ENVIRONMENTS.items() if row.robot == "finger"])
@pytest.mark.parametrize("cables", [1, 2])
def test_batch_equals_single(identifier, cables):
    design = {"length": 0.0411, "joint_height": 0.0068, "young_modulus": 2.0e6, "poisson_ratio": 0.41}
    options = {"design": design, "design_in_observation": True, "robot_options": {"cables": cables}}
    single = gymnasium.make(identifier, **options)
    batch = gymnasium.make_vec(identifier, num_envs=3, **options)
    goal = np.array([0.005, 0.05, -0.1])
    a, _ = single.reset(seed=0, options={"goal": goal})
    b, _ = batch.reset(seed=0, options={"goal": goal})
    assert np.abs(b - a).max() < 1e-6
    rng = np.random.default_rng(0)
    for _ in range(30):
        action = rng.uniform(-0.5, 1.0, cables).astype(np.float32)
        a, reward, _, _, info = single.step(action)
        b, rewards, terminated, truncated, infos = batch.step(np.tile(action, (3, 1)))
        # Slack cables are found to a micrometre, on a path that may differ in its last step.
        assert np.abs(b - a).max() < 5e-4
        assert np.abs(rewards - reward).max() < 5e-3
        assert np.abs(infos["effector"] - info["effector"]).max() < 1e-5
        assert not terminated.any() and not truncated.any()


def test_autoreset_and_final_info():
    env = gymnasium.make_vec("SoftGym/FingerReach-v0", num_envs=4, sample_design=True, design_in_observation=True)
    env.action_space.seed(0)
    first, _ = env.reset(seed=1)
    designs = env.unwrapped.designs.copy()
    assert len(np.unique(designs[:, 0])) == 4
    for step in range(50):
        observation, _, _, truncated, info = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)
        assert truncated.all() == (step == 49)
    assert len(info["final_obs"]) == 4 and info["_final_obs"].all()
    assert (info["final_obs"][0] != observation[0]).any()
    assert info["final_info"]["distance"].shape == (4,)
    assert (env.unwrapped.designs != designs).any()
    assert (info["displacement"] == 0.0).all()


def test_seeds_repeat():
    walks = []
    for _ in range(2):
        env = gymnasium.make_vec("SoftGym/FingerReach-v0", num_envs=5, sample_design=("length",))
        env.action_space.seed(4)
        rows = [env.reset(seed=4)[0]]
        rows += [env.step(env.action_space.sample())[0] for _ in range(55)]
        walks.append(np.stack(rows))
    assert (walks[0] == walks[1]).all()


def test_given_designs_hold_one_episode_at_least():
    env = gymnasium.make_vec("SoftGym/FingerReach-v0", num_envs=2)
    env.reset(seed=0, options={"design": {"length": 0.0385}})
    assert (env.unwrapped.designs[:, 0] == 0.0385).all()
    env.reset()
    assert (env.unwrapped.designs[:, 0] == 0.040).all()


def test_given_designs_do_not_stay_where_others_are_sampled():
    env = gymnasium.make_vec(
        "SoftGym/FingerReach-v0", num_envs=2, design={"height": 0.021}, sample_design=["joint_height"]
    )
    names = env.unwrapped.design_space.names
    length, height, joint = (names.index(name) for name in ("length", "height", "joint_height"))
    env.reset(seed=0, options={"design": {"length": 0.0385, "height": 0.0205}})
    given = env.unwrapped.designs.copy()
    env.reset()
    assert (env.unwrapped.designs[:, length] == 0.040).all() and (env.unwrapped.designs[:, height] == 0.021).all()
    assert (env.unwrapped.designs[:, joint] != given[:, joint]).all()


def test_bad_input():
    with pytest.raises(ValueError, match=r"vectorization_mode='sync'.*softgym rollout"):
        gymnasium.make_vec("SoftGym/FingerReach-v0", num_envs=2, render_mode="rgb_array")
    env = gymnasium.make_vec("SoftGym/FingerReach-v0", num_envs=2)
    env.reset(seed=0, options={"reset_mask": [True, False]})
    with pytest.raises(ResetNeeded, match=r"before reset of sub-environments \[1\]"):
        env.step(np.zeros((2, 2)))
    env.reset(seed=0)
    for actions in (np.zeros((3, 2)), np.zeros(2), np.full((2, 2), np.nan)):
        with pytest.raises(ValueError, match="action"):
            env.step(actions)
    with pytest.raises(ValueError, match="goal"):
        env.reset(options={"goal": np.zeros((5, 1, 3))})
    with pytest.raises(DesignError, match="height"):
        env.reset(options={"design": {"height": 3.0}})
    for design in (5, "long", [{}]):
        with pytest.raises(ValueError, match="design must be one body or a list of 2, got"):
            env.reset(options={"design": design})
    for seed in (1.5, -1, "abc", [1, 2.5]):
        with pytest.raises(ValueError, match="must be a non-negative integer, None or a list of 2 of them"):
            env.reset(seed=seed)
    for counts in ({"num_envs": 2.0}, {"num_envs": 2, "max_episode_steps": 2.5}):
        with pytest.raises(ValueError, match="must be an integer of at least 1"):
            gymnasium.make_vec("SoftGym/FingerReach-v0", **counts)


def test_bodies_are_the_fixed_ones_again_after_a_reset_that_failed(monkeypatch):
    env = gymnasium.make_vec("SoftGym/FingerReach-v0", num_envs=3, design_in_observation=True).unwrapped
    shown = env.spaces.slices["design"]
    expected = env.reset(seed=0)[0][:, shown]
    begin = env.backend.begin

    def refuse(index, designs):
        begin(index[1:], designs[1:])
        return {int(index[0]): InfeasibleDesign("the body cannot exist")}

    with monkeypatch.context() as patched:
        patched.setattr(env.backend, "begin", refuse)
        with pytest.raises(InfeasibleDesign):
            env.reset(options={"design": {"length": 0.042}})
    assert env.designs[:, 0].tolist() == [0.04, 0.042, 0.042]  # the first row keeps its body
    assert (env.reset(seed=0)[0][:, shown] == expected).all() and (env.designs == env.designs[0]).all()
    effectors = env.backend.state.effector
    assert (effectors == effectors[0]).all()


def test_stable_baselines_adapter():
    env = SB3VecEnv(gymnasium.make_vec("SoftGym/FingerReach-v0", num_envs=3))
    env.seed(0)
    observation = env.reset()
    assert observation.shape == (3, 15)
    rng = np.random.default_rng(0)
    for step in range(50):
        observation, reward, done, infos = env.step(rng.uniform(-1, 1, (3, 2)).astype(np.float32))
        assert reward.dtype == np.float32
        assert done.all() == (step == 49)
        if step < 49:
            state = env.env.unwrapped.state
            assert [info["effort"].tolist() for info in infos] == state.effort.tolist()
            assert all(set(info) >= {"distance", "is_success", "reward_effort"} for info in infos)
    for info in infos:
        assert info["TimeLimit.truncated"] is True and info["distance"] > 0.0
        assert info["is_success"] == (info["distance"] < env.env.unwrapped.task.success_distance)
        assert info["terminal_observation"].shape == (15,)
        assert info["episode"]["l"] == 50
    assert all(not info["displacement"].any() for info in env.reset_infos)


def test_options_of_stable_baselines_hold_one_episode():
    env = SB3VecEnv(gymnasium.make_vec("SoftGym/FingerReach-v0", num_envs=2))
    designs = env.get_attr("designs")[0]
    env.set_options({"design": {"length": 0.0385}})
    env.reset()
    assert (designs[:, 0] == 0.0385).all()
    goals = [np.array([0.0, 0.05, -0.1]), np.array([0.0, 0.04, -0.11])]
    env.set_options(
        [{"design": {"length": length}, "goal": goal} for length, goal in zip((0.039, 0.041), goals, strict=True)]
    )
    env.reset()
    assert designs[:, 0].tolist() == [0.039, 0.041]
    assert [info["goal"].tolist() for info in env.reset_infos] == [goal.tolist() for goal in goals]
    env.reset()
    assert (designs[:, 0] == 0.040).all()
    for wrong in ([{"design": {"length": 0.039}}, {}], [{}]):
        env.set_options(wrong)
        with pytest.raises(ValueError, match="2 mappings with the same names"):
            env.reset()


def batch(mode, num_envs=3, **options):
    return gymnasium.make_vec(
        "SoftGym/FingerReach-v0", num_envs, autoreset_mode=mode, max_episode_steps=4, sample_design=True, **options
    )


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_autoreset_is_that_of_gymnasium(mode):
    """The same rewards and ends at the same steps as Gymnasium's own vector environment."""
    design = {"length": 0.041}
    env = gymnasium.make_vec("SoftGym/FingerReach-v0", 2, autoreset_mode=mode, max_episode_steps=4, design=design)
    sync = gymnasium.make_vec(
        "SoftGym/FingerReach-v0",
        2,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": env.metadata["autoreset_mode"]},
        max_episode_steps=4,
        design=design,
    )
    options = {"goal": np.array([0.0, 0.05, -0.1])}
    for each in (env, sync):
        each.reset(seed=0, options=options)
    action = np.full((2, 2), 0.5, dtype=np.float32)
    for step in range(12):
        (a, reward_a, *ends_a, info), (b, reward_b, *ends_b, _) = (each.step(action) for each in (env, sync))
        assert [end.tolist() for end in ends_a] == [end.tolist() for end in ends_b]
        parts = env.unwrapped.spaces.slices
        own = slice(0, parts["effort"].stop)  # later goals are random
        np.testing.assert_allclose(a[:, own], b[:, own], atol=1e-4)
        if step < 4:
            np.testing.assert_allclose(reward_a, reward_b, atol=1e-4)
        assert ((reward_a == 0.0) == (reward_b == 0.0)).all()
        assert info["displacement"].any() == (b[0, parts["displacement"]] > -1.0).any()
    assert ends_a[1].all() == (mode == "SameStep")


def test_next_step_resets_each_row_in_place_of_its_own_step():
    env = batch("NextStep")
    env.reset(seed=0)
    unwrapped = env.unwrapped
    unwrapped.steps = np.array([0, 1, 2])
    designs, action = unwrapped.designs.copy(), np.full((3, 2), 0.5, dtype=np.float32)
    for step in range(1, 7):
        _, reward, _, truncated, info, gradient = unwrapped.step_with_gradient(action)
        due = np.array([step == 5, step == 4, step == 3])
        assert (truncated == np.array([step == 4, step == 3, step == 2])).all()
        assert ((reward == 0.0) == due).all() and (~info["displacement"].any(axis=1) == due).all()
        assert (~gradient.held.any(axis=1) == due).all() and (gradient.reward == reward).all()
        assert ((unwrapped.designs != designs).any(axis=1) == (step >= np.array([5, 4, 3]))).all()
        assert "final_obs" not in info


def test_without_autoreset_ended_rows_must_be_reset():
    from gymnasium.error import ResetNeeded

    env = batch("Disabled")
    env.reset(seed=0)
    env.unwrapped.steps = np.array([2, 0, 2])
    action = np.ones((3, 2), dtype=np.float32)
    env.step(action)
    truncated = env.step(action)[3]
    assert truncated.tolist() == [True, False, True]
    with pytest.raises(ResetNeeded, match=r"sub-environments \[0, 2\]"):
        env.step(action)
    command, goals = env.unwrapped.command.copy(), env.unwrapped.goals.copy()
    options = {"reset_mask": truncated, "design": [{"length": 0.039}, {"length": 0.0395}, {"length": 0.041}]}
    observation, _ = env.reset(options=options)
    assert "reset_mask" in options  # unchanged
    assert env.unwrapped.steps.tolist() == [0, 2, 0] and env.unwrapped.designs[[0, 2], 0].tolist() == [0.039, 0.041]
    assert (env.unwrapped.command[1] == command[1]).all() and (env.unwrapped.goals[1] == goals[1]).all()
    assert (env.unwrapped.goals[[0, 2]] != goals[[0, 2]]).any(axis=1).all()
    assert (observation[1, :2] > observation[0, :2]).all()
    env.step(action)
    for mask in (np.zeros(3, bool), np.ones(2, bool), np.ones(3), [True, False]):
        with pytest.raises(ValueError, match="reset_mask must be 3 booleans"):
            env.reset(options={"reset_mask": mask})


def test_lists_of_seeds_may_hold_none():
    env = batch("SameStep")

    def goals(seed):
        env.reset(seed=seed)
        return env.unwrapped.goals.copy()

    assert (goals([1, 2, 3]) == goals(1)).all() and (goals([1, 2, 3]) != goals([1, 2, 4])).all(axis=1)[2]
    first, second = [(goals(5), goals([1, None, 3]))[1] for _ in range(2)]
    assert (first == second).all() and (goals([1, None, 3]) == first).all(axis=1).tolist() == [True, False, True]
    assert (goals([None] * 3) != goals([None] * 3)).all()
    with pytest.raises(ValueError, match="list of 3, got 2 seeds"):
        env.reset(seed=[1, 2])


def test_an_unknown_autoreset_mode_names_the_known_ones():
    with pytest.raises(ValueError, match="autoreset_mode = 'later' is unknown; allowed: 'NextStep', 'SameStep'"):
        batch("later")


SAME = {
    "bodies": ("SoftGym/FingerReach-v0", {"sample_design": True}),
    "plants": ("SoftGym/DiamondReach-v0", {"plant": {"noise": 0.01, "delay": (0, 2), "stiffness": (0.8, 1.2)}}),
    "paths": ("SoftGym/FingerTrack-v0", {"task_options": {"jitter": 0.002}}),
    "goals that are drawn again": ("SoftGym/GripperPinch-v0", {"task": "reach"}),
    "beams": ("SoftGym/TetrapodReach-v0", {"sample_design": True, "plant": {"noise": 0.01}}),
    "pushes": ("SoftGym/TetrapodCarry-v0", {"task_options": {"push": 2.0, "push_window": 2}}),
}


@pytest.mark.parametrize("case", SAME)
def test_every_way_of_stepping_gives_the_episodes_of_the_seeds(case):
    """Bodies, plants, goals, pushes and noise of row k are those of a single environment with its seed."""
    identifier, options = SAME[case]
    options = {"design_in_observation": True, **options}
    singles = [gymnasium.make(identifier, **options, max_episode_steps=2) for _ in range(3)]
    spec = gymnasium.spec(identifier)
    kwargs = {**spec.kwargs, **options}
    batch = SoftRobotVectorEnv(**kwargs, num_envs=3, max_episode_steps=2)
    for seeds in ([7, 8, 9], [3, None, 11]):
        alone = [env.reset(seed=seed) for env, seed in zip(singles, seeds, strict=True)]
        together, info = batch.reset(seed=7 if seeds[0] == 7 else seeds)
        for k, (observation, one) in enumerate(alone):
            np.testing.assert_allclose(together[k], observation, atol=2e-5)
            np.testing.assert_allclose(info["goal"][k], one["goal"], atol=1e-6)
    for _ in range(2):  # the second step ends the episodes, and begins the next ones
        action = np.full((3, batch.single_action_space.shape[0]), 0.4, dtype=np.float32)
        alone = [env.step(action[k]) for k, env in enumerate(singles)]
        together, reward, _, truncated, info = batch.step(action)
        np.testing.assert_allclose(reward, [one[1] for one in alone], atol=2e-4)
    assert truncated.all() and all(one[3] for one in alone)
    for k, env in enumerate(singles):
        np.testing.assert_allclose(info["final_obs"][k], alone[k][0], atol=5e-4)
        observation, one = env.reset()
        np.testing.assert_allclose(together[k], observation, atol=2e-5)
        np.testing.assert_allclose(info["goal"][k], one["goal"], atol=1e-6)


def test_only_the_rows_of_a_mask_take_their_seeds():
    env = gymnasium.make_vec("SoftGym/FingerReach-v0", num_envs=3)
    first = env.reset(seed=[4, 5, 6])[1]["goal"]
    again = env.reset(seed=[4, 4, 4], options={"reset_mask": np.array([False, True, False])})[1]["goal"]
    assert (again[[0, 2]] == first[[0, 2]]).all() and (again[1] == first[0]).all()


def test_backends_without_a_batch_step_one_by_one():
    """Any robot, task and backend in one process: here finite elements, as single environments give them."""
    options = {"backend": "fem", "robot_options": {"element": "linear", "mesh_size": 0.015}}
    env = SoftRobotVectorEnv("finger", "reach", 2, **options)
    singles = [gymnasium.make("SoftGym/FingerReach-v0", **options) for _ in range(2)]
    action, design = np.full((2, 2), 0.5), [{"length": 0.041}, {"length": 0.04}]
    observation, _ = env.reset(seed=1, options={"design": design})
    expected = [one.reset(seed=k + 1, options={"design": design[k]})[0] for k, one in enumerate(singles)]
    np.testing.assert_allclose(observation, expected, atol=1e-7)
    twin = copy.deepcopy(env)
    observation, reward, *_, gradient = env.step_with_gradient(action)
    expected = [one.step(action[k]) for k, one in enumerate(singles)]
    np.testing.assert_allclose(observation, [one[0] for one in expected], atol=1e-7)
    assert gradient.reward == pytest.approx(reward) and reward == pytest.approx([one[1] for one in expected])
    ends = []
    for change in (1e-3, -1e-3):
        ends.append(copy.deepcopy(twin).step(action + np.array([change, 0.0]))[1])
    np.testing.assert_allclose(gradient.action[:, 0], (ends[0] - ends[1]) / 2e-3, rtol=1e-3)
    np.testing.assert_allclose(twin.step(action)[0], observation, atol=1e-7)


def test_wrappers_that_change_observations_need_next_step():
    from gymnasium.wrappers.vector import NormalizeObservation, NormalizeReward, RecordEpisodeStatistics

    for mode, wrappers in (
        ("NextStep", (NormalizeObservation, NormalizeReward, RecordEpisodeStatistics)),
        ("SameStep", (NormalizeReward, RecordEpisodeStatistics)),
    ):
        for wrapper in wrappers:
            env = wrapper(batch(mode))
            env.reset(seed=0)
            for _ in range(6):
                env.step(env.action_space.sample())
    with pytest.raises(ValueError, match="NEXT_STEP"):
        NormalizeObservation(batch("SameStep"))


def test_a_synchronous_batch_is_drawn():
    env = gymnasium.make_vec(
        "SoftGym/FingerReach-v0", num_envs=2, vectorization_mode="sync", render_mode="rgb_array", render_size=(64, 48)
    )
    env.reset(seed=0)
    first, second = env.render()
    assert first.shape == (48, 64, 3) and (first != second).any()
    env.close()
