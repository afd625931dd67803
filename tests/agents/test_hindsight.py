"""Hindsight goals: relabelled transitions are those that the environment itself gives for the new goal."""

import numpy as np
import pytest
from stable_baselines3.common.buffers import ReplayBuffer

from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.agents.hindsight import HindsightBuffer
from softgym_envs.envs.spaces import AgentSpaces
from softgym_envs.envs.tasks.registry import make_task
from softgym_envs.robots.registry import make_robot

REACH = EnvironmentConfig(id="SoftGym/DiamondReach-v0")


def make_buffer(env, share, size=400):
    return HindsightBuffer(
        size * env.num_envs,
        env.single_observation_space,
        env.single_action_space,
        "cpu",
        n_envs=env.num_envs,
        spaces=env.spaces,
        task=env.task,
        share=share,
    )


def fill(buffer, env, steps, seed=0):
    """Random actions; returns effectors [m] after each step (steps, num_envs, 3), and which steps ended an episode."""
    rng = np.random.default_rng(seed)
    observation, _ = env.reset(seed=seed)
    effectors, ends = [], []
    for _ in range(steps):
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        following, reward, _, done, info = env.step(action)
        last = info.get("final_info", info)
        true = np.stack(
            [o if f is None else f for o, f in zip(following, info.get("final_obs", [None] * 9), strict=False)]
        )
        buffer.add(observation, true, action, reward, done, [{"TimeLimit.truncated": bool(d)} for d in done])
        effectors.append(last["effector"].copy())
        ends.append(done.copy())
        observation = following
    return np.array(effectors), np.array(ends)


def test_a_relabelled_transition_is_what_the_environment_gives_for_that_goal():
    env = REACH.make_vec(3)
    buffer = make_buffer(env, share=1.0)
    rng = np.random.default_rng(5)
    actions = rng.uniform(-1, 1, (20, 3, 4)).astype(np.float32)

    def run(goals):
        observation, _ = env.reset(seed=0, options={"goal": goals})
        rows = []
        for action in actions:
            following, reward, _, _, info = env.step(action)
            rows.append((observation, following, reward, info["effector"]))
            observation = following
        return rows

    first = run(np.full((3, 1, 3), 0.1))
    reached = first[12][3]
    again = run(reached[:, None, :])
    for k in range(13):
        for part in (0, 1):
            shown = env.spaces.with_goal(first[k][part], reached)
            assert np.abs(shown - again[k][part]).max() < 2e-6
        distance = env.task.distance(env.spaces.observed_effector(first[k][1]), reached)
        terms = env.task.reward_terms(distance, env.spaces.observed_effort_share(first[k][1]))
        assert np.abs(np.prod(list(terms.values()), axis=0) - again[k][2]).max() < 1e-4
    assert buffer.share == 1.0


def test_new_goals_were_reached_at_or_after_the_transition_in_its_episode():
    env = REACH.make_vec(4)
    buffer = make_buffer(env, share=1.0)
    effectors, ends = fill(buffer, env, 130)
    np.random.seed(3)  # noqa: NPY002
    rows = np.random.randint(0, 130, 300)  # noqa: NPY002
    np.random.seed(4)  # noqa: NPY002
    samples = buffer._get_samples(rows)
    np.random.seed(4)  # noqa: NPY002
    columns = np.random.randint(0, 4, 300)  # noqa: NPY002
    goals = samples.next_observations.numpy()[:, buffer.spaces.slices["goal"]] * buffer.spaces.position_scale
    episodes = np.cumsum(np.vstack([np.zeros((1, 4), bool), ends[:-1]]), axis=0)
    ahead = []
    for goal, row, column in zip(goals, rows, columns, strict=True):
        rest = (np.arange(130) >= row) & (episodes[:, column] == episodes[row, column])
        away = np.linalg.norm(effectors[rest, column] - goal, axis=1)
        assert away.min() < 1e-7
        ahead.append(np.argmin(away))
    assert 10 < np.mean(ahead) < 15  # uniform over the rest of the episode: a quarter of 50 steps on average


def test_a_share_is_relabelled_and_the_rest_unchanged():
    env = REACH.make_vec(4)
    buffer = make_buffer(env, share=0.8)
    fill(buffer, env, 100)
    plain = {}
    for row in range(100):
        for column in range(4):
            plain[buffer.observations[row, column].tobytes()] = buffer.rewards[row, column]
    np.random.seed(0)  # noqa: NPY002
    samples = buffer.sample(4000)
    kept = [observation.tobytes() in plain for observation in samples.observations.numpy()]
    assert 0.18 < np.mean(kept) < 0.22
    for observation, reward, same in zip(samples.observations.numpy(), samples.rewards.numpy(), kept, strict=True):
        if same:
            assert reward[0] == plain[observation.tobytes()]
    assert samples.rewards[~np.array(kept)].mean() > 3 * samples.rewards[np.array(kept)].mean()
    assert (samples.dones == 0).all()  # a time limit is not a terminal state


def test_without_hindsight_it_is_the_plain_buffer():
    env = REACH.make_vec(2)
    buffer = make_buffer(env, share=0.0)
    plain = ReplayBuffer(800, env.single_observation_space, env.single_action_space, "cpu", n_envs=2)
    fill(buffer, env, 60)
    fill(plain, env, 60)
    for a in (buffer, plain):
        np.random.seed(0)  # noqa: NPY002
        a.drawn = a._get_samples(np.arange(60))
    for one, other in zip(buffer.drawn[:5], plain.drawn[:5], strict=True):
        assert (one == other).all()


def test_overwritten_and_cut_episodes():
    env = REACH.make_vec(2)
    buffer = make_buffer(env, share=1.0, size=70)
    fill(buffer, env, 120)  # episodes end at 49 and 99; positions 0 to 49 hold steps 70 to 119
    assert buffer.full and buffer.pos == 50
    steps = np.concatenate([np.arange(70, 120), np.arange(50, 70)])
    expected = np.where(steps < 100, 99 % 70, -1)
    assert (buffer.ends == expected[:, None]).all()
    buffer.cut()
    assert (buffer.ends[30:50] == 49).all() and (buffer.ends[:30] == 29).all() and (buffer.ends[50:] == 29).all()


def test_a_step_without_equilibrium_has_no_reward_for_any_goal():
    env = REACH.make_vec(2)
    buffer = make_buffer(env, share=1.0)
    fill(buffer, env, 10)
    buffer.rewards[3] = 0.0
    samples = buffer._get_samples(np.full(50, 3))
    assert (samples.rewards == 0.0).all()


def test_hindsight_on_top_of_the_qp_is_refused():
    config = {"environment": {"id": REACH.id, "residual_scale": 0.3}, "sac": {"hindsight": 0.8}}
    with pytest.raises(ValueError, match=r"sac\.hindsight = 0\.8 .*environment\.residual_scale = 0\.3.* allowed: 0"):
        TrainConfig.model_validate(config)
    assert TrainConfig.model_validate({**config, "sac": {}}).environment.residual_scale == 0.3
    assert TrainConfig.model_validate({**config, "environment": {"id": REACH.id}}).settings.hindsight == 0.8


def test_a_moving_goal_is_refused():
    env = EnvironmentConfig(id="SoftGym/DiamondTrack-v0").make_vec(2)
    with pytest.raises(ValueError, match=r"hindsight = 0\.5 needs a fixed goal, but task 'track'"):
        make_buffer(env, share=0.5)


def test_a_hidden_effector_is_refused():
    env = EnvironmentConfig(id="SoftGym/SensorizedFingerReach-v0", backend="surrogate").make_vec(1)
    with pytest.raises(ValueError, match="needs the effector, but task 'sensed_reach' hides it"):
        make_buffer(env, share=0.5, size=10)
    env.close()


def test_a_force_reached_later_is_a_goal_and_factors_of_the_state_stay():
    task = make_task("grasp", make_robot("grasping_finger"))
    spaces = AgentSpaces(
        task.robot,
        action_mode="increment",
        design_names=(),
        axes=task.axes,
        goal_scale=task.goal_scale,
        error_scale=task.error_scale,
    )
    buffer = HindsightBuffer(
        4, spaces.observation_space, spaces.action_space, "cpu", spaces=spaces, task=task, share=1.0
    )
    wanted = np.array([0.5, 0.0, 0.0])
    forces = np.array([[0.0, 0.0, 0.0], [0.05, -0.02, 0.0], [0.3, -0.1, 0.0], [0.3, -0.1, 0.0]])
    for k, force in enumerate(forces):
        zero, effort = np.zeros(1), np.array([0.01 * k])
        observation = spaces.observe(zero, zero, effort, force, wanted, np.zeros(0))
        reward = 0.9 * task.rate(force, wanted, spaces.effort_share(effort))[2]  # 0.9: a factor of the state
        done = np.array([k == 3])
        buffer.add(observation[None], observation[None], np.zeros((1, 1)), np.array([reward]), done, [{}])
    np.random.seed(0)  # noqa: NPY002
    samples = buffer._get_samples(np.array([2, 3]))
    goals = spaces.observed_goal(samples.next_observations.numpy())
    assert np.abs(goals - [0.3, 0.0, 0.0]).max() < 1e-6  # a goal is a force along x
    expected = 0.9 * task.rate(forces[2], goals[0], spaces.effort_share(np.array([[0.02], [0.03]])))[2]
    assert np.abs(samples.rewards.numpy()[:, 0] - expected).max() < 1e-5
    # Without contact, or with less than the smallest wanted force, a state is no goal.
    assert task.hindsight_goals(forces)[1].tolist() == [False, False, True, True]


def test_a_height_reached_later_is_a_goal():
    task = make_task("lift", make_robot("contact_aided_gripper", mesh_size=0.02))
    rest = task.robot.effector_rest
    goals, allowed = task.hindsight_goals(rest + np.array([[1e-4, -2e-4, 0.010], [0.0, 0.0, 0.001], [0.0, 0.0, 0.03]]))
    assert np.abs(goals[0] - (rest + [0.0, 0.0, 0.010])).max() < 1e-12
    assert allowed.tolist() == [True, False, False]
