"""The environment in torch against the batched one in NumPy, step by step."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded

import softgym_envs
from softgym_envs.errors import DesignError, WeightsError
from softgym_envs.extensions.gpu import surrogates
from softgym_envs.extensions.gpu.environment import TorchVectorEnv
from softgym_envs.mechanics.solvers.complementarity import solve_complementarity

IDENTIFIERS = [
    name
    for name, row in softgym_envs.ENVIRONMENTS.items()
    if row.backend == "surrogate" and row.task not in ("grasp", "lift")  # which read whole states
]
FINGER = "SoftGym/FingerReach-v0"


def pair(identifier, count, **options):
    """Return both environments in the same episodes, after checking that bodies, goals and observations agree."""
    reference = gymnasium.make_vec(identifier, num_envs=count, **options).unwrapped
    env = TorchVectorEnv(identifier, count, device="cpu", **options)
    expected, _ = reference.reset(seed=0)
    observation, info = env.reset(options={"design": reference.designs, "goal": reference.paths})
    assert env.single_observation_space == reference.single_observation_space
    assert env.single_action_space == reference.single_action_space
    assert observation.shape == expected.shape
    np.testing.assert_allclose(observation, expected, atol=2e-5)
    return reference, env


def compare(reference, env, actions):
    """Step both environments; return the result of the reference."""
    expected, reward, _, truncated, info = reference.step(actions)
    observation, rewards, terminated, truncations, infos = env.step(torch.as_tensor(actions))
    np.testing.assert_allclose(infos["effector"], info["effector"], atol=1e-6)
    # Near the goal a reward falls by 1 within about the goal tolerance, and effectors agree within 2e-7 m there.
    np.testing.assert_allclose(rewards, reward, atol=2e-7 / env.robot.goal_tolerance)
    np.testing.assert_allclose(observation, expected, atol=1e-4)
    np.testing.assert_array_equal(truncations, truncated)
    np.testing.assert_array_equal(infos["converged"], info["converged"])
    np.testing.assert_allclose(infos["uncertainty"], info["uncertainty"], rtol=2e-2, atol=1e-7)
    assert (infos["trusted"].numpy() != info["trusted"]).sum() <= 1  # one row may be at the limit
    np.testing.assert_allclose(infos["displacement"], info["displacement"], atol=1e-3 * env.robot.rates.max())
    assert not terminated.any()
    return expected, reward, truncated, info


@pytest.mark.parametrize("identifier", IDENTIFIERS)
@pytest.mark.parametrize("sampled", [False, True])
def test_agrees_with_numpy(identifier, sampled):
    reference, env = pair(identifier, 8, sample_design=sampled, design_in_observation=sampled)
    rng = np.random.default_rng(1)
    slack = 0
    for _ in range(25):
        compare(reference, env, rng.uniform(-1.0, 1.0, env_shape(env)).astype(np.float32))
        slack += (reference.slack & env._state["slack"].numpy()).sum()
        np.testing.assert_array_equal(env._state["slack"], reference.slack)
    if env.robot.unilateral.any():
        assert slack > 20
    else:
        assert slack == 0


def env_shape(env):
    return env.num_envs, env.single_action_space.shape[0]


def test_absolute_actions_one_member_and_options():
    options = {
        "action_mode": "absolute",
        "design": {"length": 0.0411},
        "robot_options": {"cables": 1},
        "task_options": {"command_low": 0.5, "spread": 1e-3},
    }
    reference = gymnasium.make_vec(FINGER, num_envs=3, backend_options={"members": 1}, **options).unwrapped
    env = TorchVectorEnv(FINGER, 3, device="cpu", backend_options={"members": 1}, **options)
    goal = [0.005, 0.05, -0.1]
    expected, _ = reference.reset(seed=0, options={"goal": goal})
    observation, info = env.reset(options={"goal": goal})
    np.testing.assert_allclose(observation, expected, atol=2e-5)
    assert torch.isinf(info["uncertainty"]).all() and info["trusted"].all()
    rng = np.random.default_rng(0)
    for _ in range(10):
        compare(reference, env, rng.uniform(-1.0, 1.0, (3, 1)).astype(np.float32))


@pytest.mark.parametrize("sampled", [False, True])
def test_autoreset(sampled):
    env = TorchVectorEnv(FINGER, 4, device="cpu", seed=1, sample_design=sampled, max_episode_steps=3)
    env.reset()
    designs, goal = env.designs.clone(), env._state["paths"].clone()
    action = torch.ones(4, 2)
    for step in range(3):
        observation, _, _, truncated, info = env.step(action)
        assert bool(truncated.all()) == (step == 2)
        assert ("final_obs" in info) == (step == 2)
    assert info["_final_obs"].all() and info["final_obs"].shape == observation.shape
    # three steps of pulling, and a body that has not been pulled
    assert (info["final_obs"][:, 2:4] > observation[:, 2:4]).all()
    assert (info["final_info"]["displacement"] > 0.0).all()
    torch.testing.assert_close(info["displacement"], torch.zeros(4, 2), atol=1e-8, rtol=0.0)
    assert (env._state["steps"] == 0).all()
    assert (env._state["paths"] != goal).any(dim=2).all()
    assert bool((env.designs != designs).any()) == sampled


def test_rows_end_independently_and_get_their_own_bodies():
    env = TorchVectorEnv(FINGER, 5, device="cpu", seed=1, sample_design=True, design_in_observation=True)
    env.reset()
    designs = env.designs.clone()
    env._state["steps"][2] = 49
    observation, _, _, truncated, info = env.step(torch.ones(5, 2))
    assert truncated.tolist() == [False, False, True, False, False]
    changed = (env.designs != designs).any(dim=1)
    assert changed.tolist() == truncated.tolist()
    kept = ~truncated
    torch.testing.assert_close(info["final_obs"][kept], observation[kept], rtol=0.0, atol=0.0)
    # the new body is the one that its design makes
    alone = TorchVectorEnv(FINGER, 1, device="cpu", design_in_observation=True)
    design = dict(zip(env.design_space.names, env.designs[2].tolist(), strict=True))
    expected, _ = alone.reset(options={"design": design, "goal": info["goal"][2]})
    torch.testing.assert_close(observation[2:3], expected, rtol=0.0, atol=1e-6)


def test_rows_without_a_state_end_where_they_were(monkeypatch):
    env = TorchVectorEnv(FINGER, 3, device="cpu", seed=0)
    env.reset()
    _, _, _, _, before = env.step(torch.ones(3, 2))
    search = env._model.search

    def lose(bodies, target, *arguments, **options):
        u, gradient, found = search(bodies, target, *arguments, **options)
        if len(target) == 3:  # the first search of all rows
            return u, gradient, torch.tensor([True, False, True])
        return u * torch.nan, gradient, torch.zeros_like(found)

    monkeypatch.setattr(env._model, "search", lose)
    monkeypatch.setattr(env._task, "sample", lambda rng, count, kinematics: torch.zeros(count, 1, 3))
    _, reward, terminated, truncated, info = env.step(torch.ones(3, 2))
    assert truncated.tolist() == [False, True, False] and not terminated.any()
    final = info["final_info"]
    assert final["converged"].tolist() == [True, False, True]
    assert reward[1] == 0.0 and (reward[[0, 2]] > 0.0).all()
    assert (final["effector"][1] == before["effector"][1]).all()
    assert (final["displacement"][1] == before["displacement"][1]).all()
    assert (final["displacement"][0] > before["displacement"][0]).all()
    assert info["converged"].all() and torch.isfinite(info["effector"]).all()


def test_rows_that_take_longer_are_finished(monkeypatch):
    """With a single Newton step for all rows, most rows are finished separately and reach the same states."""
    monkeypatch.setattr(surrogates, "NEWTON_STEPS", 1)
    reference, env = pair("SoftGym/DiamondReach-v0", 8, sample_design=True)
    finish, calls = env._finish, []
    monkeypatch.setattr(env, "_finish", lambda result: calls.append(1) or finish(result))
    rng = np.random.default_rng(3)
    for _ in range(10):
        _, _, truncated, _ = compare(reference, env, rng.uniform(-1.0, 1.0, (8, 4)).astype(np.float32))
        assert not truncated.any()
    assert len(calls) > 5


def test_goals_have_the_same_distribution():
    count = 3000
    reference = gymnasium.make_vec("SoftGym/DiamondReach-v0", num_envs=count).unwrapped
    reference.reset(seed=0)
    env = TorchVectorEnv("SoftGym/DiamondReach-v0", count, device="cpu", seed=0)
    _, info = env.reset()
    a, b = reference.paths[:, 0], info["goal"].numpy()
    spread = a.std(axis=0)
    # means and quantiles within four standard errors
    assert (np.abs(a.mean(axis=0) - b.mean(axis=0)) < 4.0 * spread * np.sqrt(2.0 / count)).all()
    shares = np.stack([(b < np.quantile(a, q, axis=0)).mean(axis=0) for q in (0.1, 0.5, 0.9)])
    assert (np.abs(shares - np.array([[0.1], [0.5], [0.9]])) < 4.0 * np.sqrt(0.25 * 2.0 / count)).all()


def test_fixed_goals_and_jittered_paths():
    goals = np.array([[0.0, 0.05, -0.10], [0.01, 0.04, -0.11]])
    env = TorchVectorEnv(FINGER, 40, device="cpu", seed=0, task_options={"goals": goals})
    _, info = env.reset()
    nearest = torch.cdist(info["goal"].double(), torch.as_tensor(goals)).min(dim=1)
    assert nearest.values.max() < 1e-6 and len(nearest.indices.unique()) == 2
    env = TorchVectorEnv("SoftGym/FingerTrack-v0", 40, device="cpu", seed=0, task_options={"jitter": 1e-3})
    env.reset()
    shift = env._state["paths"] - torch.as_tensor(env.task.path, dtype=torch.float32)
    assert 0.5e-3 < shift.abs().max() <= 1e-3 + 1e-7
    torch.testing.assert_close(shift, shift[:, :1].expand_as(shift), rtol=0.0, atol=1e-7)


def test_seeds_repeat():
    walks = []
    for seed in (4, 4, 5):
        env = TorchVectorEnv(FINGER, 5, device="cpu", seed=seed, sample_design=("length",), max_episode_steps=4)
        actions = torch.rand(9, 5, 2, generator=torch.Generator().manual_seed(0)) * 2.0 - 1.0
        walks.append(torch.stack([env.reset()[0]] + [env.step(a)[0] for a in actions]))
        names = list(env.design_space.names)
        assert (env.designs[:, names.index("height")] == env.designs[0, names.index("height")]).all()
    assert (walks[0] == walks[1]).all() and (walks[0] != walks[2]).any()
    env = TorchVectorEnv(FINGER, 5, device="cpu")
    assert (env.reset(seed=7)[0] == env.reset(seed=7)[0]).all()
    assert (env.reset(seed=7)[0] != env.reset()[0]).any()


def test_given_bodies_hold_one_episode():
    env = TorchVectorEnv(FINGER, 3, device="cpu", design={"height": 0.021}, seed=0)
    env.reset(options={"design": {"length": 0.0385}})
    assert env._bodies["rest"].shape[0] == 1
    assert (env.designs[:, 0] == 0.0385).all()
    env._state["steps"][1] = 49
    env.step(torch.zeros(3, 2))
    assert env.designs[:, 0].tolist() == [0.0385, 0.040, 0.0385]
    assert (env.designs[:, list(env.design_space.names).index("height")] == 0.021).all()
    env.reset()
    assert (env.designs[:, 0] == 0.040).all()
    env.reset(options={"design": [{"length": 0.0385}, {}, {"length": 0.0415}]})
    assert env.designs[:, 0].tolist() == [0.0385, 0.040, 0.0415]
    with pytest.raises(ValueError, match="design must be one body or a list of 3, got 1"):
        env.reset(options={"design": [{}]})


def test_given_bodies_do_not_stay_where_others_are_sampled():
    env = TorchVectorEnv(FINGER, 3, device="cpu", design={"height": 0.021}, sample_design=["joint_height"], seed=0)
    length, height, joint = (env.design_space.names.index(name) for name in ("length", "height", "joint_height"))
    env.reset(options={"design": {"length": 0.0385, "height": 0.0205}})
    given = env.designs.clone()
    env._state["steps"][1] = 49
    env.step(torch.zeros(3, 2))
    assert env.designs[:, length].tolist() == [0.0385, 0.040, 0.0385]
    assert env.designs[:, height].tolist() == [0.0205, 0.021, 0.0205]
    assert (env.designs[:, joint] != given[:, joint]).tolist() == [False, True, False]


def test_single_precision_is_enough():
    walks = []
    for dtype in (torch.float32, torch.float64):
        env = TorchVectorEnv("SoftGym/CableTrunkTrack-v0", 4, device="cpu", dtype=dtype, seed=0)
        observation, _ = env.reset()
        assert observation.dtype == dtype
        actions = torch.rand(15, 4, 8, generator=torch.Generator().manual_seed(0)) * 2.0 - 1.0
        walks.append(torch.stack([env.step(a)[4]["effector"] for a in actions]).double())
    assert (walks[0] - walks[1]).abs().max() < 1e-6


@pytest.mark.parametrize("identifier", [FINGER, "SoftGym/DiamondTrack-v0"])
def test_a_step_is_one_graph(identifier):
    """Waiting for the host inside the step would break the graph, which the compiler reports."""
    env = TorchVectorEnv(identifier, 3, device="cpu", seed=0, sample_design=True)
    env.reset()
    actions = torch.ones(3, len(env.robot.actuators))
    traced = torch.compile(env._advance, backend="eager", fullgraph=True)(env._bodies, env._state, actions)
    observation, reward, _, _, _ = env.step(actions)
    torch.testing.assert_close(traced["observation"], observation)
    torch.testing.assert_close(traced["reward"], reward)


@pytest.mark.parametrize("n", [1, 2, 4, 6])
def test_complementarity(n, monkeypatch):
    monkeypatch.setattr(surrogates, "PIVOT_PASSES", 8)
    rng = np.random.default_rng(n)
    root = rng.normal(size=(500, n, n))
    K = root @ root.swapaxes(1, 2) + 0.3 * np.eye(n)
    q = rng.normal(size=(500, n))
    unilateral = np.arange(n) != 2
    guess = torch.as_tensor((rng.random((500, n)) < 0.5) & unilateral)
    z, effort, slack, solved = surrogates.complementarity(
        torch.as_tensor(K), torch.as_tensor(q), guess, tuple(unilateral.tolist())
    )
    W = np.linalg.inv(K)
    expected = solve_complementarity(W, -np.einsum("bij,bj->bi", W, q), unilateral)
    assert solved.float().mean() > 0.99
    found = solved.numpy()
    np.testing.assert_allclose(effort.numpy()[found], expected[found], atol=1e-8)
    np.testing.assert_allclose((np.einsum("bij,bj->bi", K, z.numpy()) + q)[found], expected[found], atol=1e-8)
    assert slack[solved].any() and not slack[solved].all()


def test_bad_input():
    for options, message in (
        ({"id": "SoftGym/ModularReach-v0"}, "ModularReach.*allowed.*FingerReach.*TetrapodReach"),
        ({"num_envs": 0}, "num_envs = 0"),
        ({"dtype": torch.float16}, "float16.*float32"),
        ({"backend_options": {"members": 9}}, "members = 9.*1 to 5"),
        ({"cuda_graph": True}, "cuda_graph.*cpu"),
        ({"action_mode": "up"}, "action_mode = 'up'"),
        ({"sample_design": ["weight"]}, "weight"),
        ({"task_options": {"radius": 1.0}}, "radius"),
    ):
        with pytest.raises((ValueError, WeightsError), match=message):
            TorchVectorEnv(**{"id": FINGER, "num_envs": 2, "device": "cpu", **options})
    env = TorchVectorEnv(FINGER, 2, device="cpu")
    with pytest.raises(ResetNeeded, match="reset"):
        env.step(torch.zeros(2, 2))
    env.reset(seed=0)
    before = {name: value.clone() for name, value in env._state.items()}
    for actions in (torch.zeros(3, 2), torch.zeros(2), torch.full((2, 2), torch.nan)):
        with pytest.raises(ValueError, match="actions"):
            env.step(actions)
    assert all((env._state[name] == value).all() for name, value in before.items())
    with pytest.raises(ValueError, match="goal"):
        env.reset(options={"goal": np.zeros((5, 1, 3))})
    with pytest.raises(ValueError, match="wind"):
        env.reset(options={"wind": 1.0})
    with pytest.raises(ValueError, match="design"):
        env.reset(options={"design": np.zeros((3, 5))})
    with pytest.raises(DesignError, match="height"):
        env.reset(options={"design": {"height": 3.0}})
    values = env.designs.numpy().copy()
    values[1, 0] = np.nan
    with pytest.raises(DesignError, match="length"):
        env.reset(options={"design": values})


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_missing_device():
    with pytest.raises(ValueError, match="cuda.*cpu"):
        TorchVectorEnv(FINGER, 2)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("sampled", [False, True])
@pytest.mark.parametrize("cuda_graph", [False, True])
def test_device_agrees_with_host(sampled, cuda_graph):
    host = TorchVectorEnv(FINGER, 16, device="cpu", seed=0, sample_design=sampled)
    device = TorchVectorEnv(FINGER, 16, device="cuda", cuda_graph=cuda_graph, sample_design=sampled)
    _, info = host.reset()
    device.reset(options={"design": host.designs, "goal": info["goal"][:, None]})
    actions = torch.rand(20, 16, 2, generator=torch.Generator().manual_seed(0)) * 2.0 - 1.0
    for action in actions:
        expected, reward, _, _, _ = host.step(action)
        observation, rewards, _, _, _ = device.step(action)
        torch.testing.assert_close(observation.cpu(), expected, atol=1e-4, rtol=0.0)
        torch.testing.assert_close(rewards.cpu(), reward, atol=1e-4, rtol=0.0)


def test_it_is_a_vector_environment():
    env = TorchVectorEnv("SoftGym/FingerReach-v0", 3, device="cpu")
    twin = gymnasium.make_vec("SoftGym/FingerReach-v0", 3)
    assert isinstance(env, gymnasium.vector.VectorEnv)
    for name in ("num_envs", "render_mode", "action_space", "observation_space", "single_action_space", "metadata"):
        assert getattr(env, name) == getattr(twin, name), name
    assert env.spec.id == "SoftGym/FingerReach-v0" and env.unwrapped is env and not env.closed
    env.close()
    assert env.closed


def test_a_missing_gpu_points_to_the_faster_environment():
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    with pytest.raises(ValueError, match="'cuda' is not available here; allowed: 'cpu', on which gymnasium.make_vec"):
        TorchVectorEnv("SoftGym/FingerReach-v0", 3)


@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
def test_other_autoreset_modes_are_those_of_the_batch_in_numpy(mode):
    options = {"max_episode_steps": 4, "autoreset_mode": mode}
    env = TorchVectorEnv("SoftGym/FingerReach-v0", 3, device="cpu", dtype=torch.float64, **options)
    twin = gymnasium.make_vec("SoftGym/FingerReach-v0", 3, **options)
    start = {"goal": np.array([0.0, 0.05, -0.1])}
    for each in (env, twin):
        each.reset(seed=0, options=start)
        masked = start | {"reset_mask": np.array([False, True, False])}
        each.step(np.full((3, 2), 0.5))
        each.reset(options=masked | {"design": {"length": 0.039}})
    assert env.designs[:, 0].tolist() == [0.04, 0.039, 0.04]
    for step in range(9):
        action = np.full((3, 2), 0.1 * step)
        (_, *row, info), (_, *expected, expected_info) = env.step(action), twin.step(action)
        for a, b in zip(row, expected, strict=True):
            np.testing.assert_allclose(a.numpy(), b, atol=1e-5)
        np.testing.assert_allclose(info["displacement"].numpy(), expected_info["displacement"], atol=1e-6)
        truncated = row[-1]
        assert "final_obs" not in info
        if mode == "Disabled" and truncated.any():
            with pytest.raises(ResetNeeded, match=r"are over; reset them"):
                env.step(action)
            for each in (env, twin):
                each.reset(options=start | {"reset_mask": truncated.numpy()})
        elif truncated.any():
            # The next step resets these rows, to goals that differ; another row may end in it.
            env.step(action)
            over = truncated.numpy() | twin.step(action)[3]
            for each in (env, twin):
                each.reset(options=start | {"reset_mask": over})


def test_lists_of_seeds():
    env = TorchVectorEnv("SoftGym/FingerReach-v0", 2, device="cpu")
    first, second, other = (env.reset(seed=seed)[1]["goal"] for seed in ([1, 2], [1, 2], [1, None]))
    assert (first == second).all() and (first != other).any(axis=1).all()
    with pytest.raises(ValueError, match="list of 2, got 1 seeds"):
        env.reset(seed=[1])
