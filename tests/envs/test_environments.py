"""Every environment ID on every backend: the contracts of Gymnasium, stable-baselines3 and this suite."""

import copy
import pickle
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import softgym_envs
from softgym_envs import make_robot
from softgym_envs.backends.registry import BACKENDS as ALL_BACKENDS
from softgym_envs.envs.tasks.registry import make_task
from softgym_envs.errors import ConvergenceError, DesignError
from softgym_envs.extensions.walkers.tasks.locomotion import Locomotion
from softgym_envs.extensions.walkers.tasks.throw import Throw
from softgym_envs.robots.base import Robot

BACKENDS = [name for name in ALL_BACKENDS if name != "hardware"]  # which needs a bench
# Weights ship for the robots whose environments run on the surrogate unless told otherwise.
CASES = [
    (identifier, backend)
    for identifier, row in softgym_envs.ENVIRONMENTS.items()
    for backend in (("fem", "surrogate") if row.backend == "surrogate" else ("fem",))
]
# The hybrid backend consists of the other two, so one environment is enough.
CASES.append(("SoftGym/FingerReach-v0", "hybrid"))
assert {backend for _, backend in CASES} == set(BACKENDS)
# Coarse meshes for robots that have an option for them.
LIGHT = {
    "cable_trunk": {"layers": 10, "rings": 1},
    "grasping_finger": {"element": "linear", "mesh_size": 0.015},
    "contact_aided_gripper": {"element": "linear", "mesh_size": 0.015},
}
# Some bodies of a large space have no equilibrium under large pulls, which ends the episode.
SAMPLED = {
    "SoftGym/SensorizedFingerReach-v0": ["outer_radius", "joint_height", "bellow_height", "wall_thickness"],
}


def make(identifier, **options):
    """Make an environment with a coarse mesh."""
    robot = softgym_envs.ENVIRONMENTS[identifier].robot
    backend = options.get("backend", softgym_envs.ENVIRONMENTS[identifier].backend)
    light = (LIGHT.get(robot, {}) if backend == "fem" else {}) | options.pop("robot_options", {})
    return gymnasium.make(identifier, robot_options=light, **options)


def some_design(identifier):
    """A body that is not the baseline."""
    row = softgym_envs.ENVIRONMENTS[identifier]
    variable = make_robot(row.robot, **row.robot_options).design_space
    name = variable.names[0]
    return {name: float(variable[name].from_unit(0.5))}


def rollout(env, steps, seed):
    """Observations and rewards of a seeded random walk."""
    observation, _ = env.reset(seed=seed)
    env.action_space.seed(seed)
    rows = [observation]
    rewards = []
    for _ in range(steps):
        observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        rows.append(observation)
        rewards.append(reward)
        if terminated or truncated:
            rows.append(env.reset()[0])
    return np.stack(rows), np.array(rewards)


@pytest.mark.parametrize(("identifier", "backend"), CASES)
def test_gymnasium_checker(identifier, backend):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make(identifier, backend=backend)
        check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize(("identifier", "backend"), CASES)
def test_stable_baselines_checker(identifier, backend):
    from stable_baselines3.common.env_checker import check_env as sb3_check

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sb3_check(make(identifier, backend=backend), warn=True)


@pytest.mark.parametrize(("identifier", "backend"), CASES)
def test_same_seed_same_rollout_bit_for_bit(identifier, backend):
    names = make_robot(softgym_envs.ENVIRONMENTS[identifier].robot).design_space.names[:3:2]
    first = make(identifier, backend=backend, sample_design=names)
    second = make(identifier, backend=backend, sample_design=names)
    a, b, again = rollout(first, 6, 7), rollout(second, 6, 7), rollout(first, 6, 7)
    assert (a[0] == b[0]).all() and (a[1] == b[1]).all()
    assert (a[0] == again[0]).all() and (a[1] == again[1]).all()
    other = rollout(second, 6, 8)
    assert (other[0] != a[0]).any()


@pytest.mark.parametrize(("identifier", "backend"), CASES)
def test_pickle_deepcopy_and_spec(identifier, backend):
    env = make(identifier, backend=backend, design=some_design(identifier), design_in_observation=True)
    expected = rollout(env, 3, 1)
    for twin in (pickle.loads(pickle.dumps(env)), copy.deepcopy(env)):
        assert twin.unwrapped.design == env.unwrapped.design
        assert (rollout(twin, 3, 1)[0] == expected[0]).all()
    text = env.spec.to_json()
    revived = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(text))
    assert (rollout(revived, 3, 1)[0] == expected[0]).all()


def kinds(identifier):
    """Options with which the contracts of an environment are checked, and episodes: fewer on finite elements."""
    row = softgym_envs.ENVIRONMENTS[identifier]
    return [({"cables": 1}, 5), ({"cables": 2}, 5)] if row.robot == "finger" else [({}, 1)]


@pytest.mark.parametrize(
    ("identifier", "options", "episodes"), [(i, *kind) for i in softgym_envs.ENVIRONMENTS for kind in kinds(i)]
)
@pytest.mark.parametrize("action_mode", ["increment", "absolute"])
def test_bounds_time_limit_and_info(identifier, options, episodes, action_mode):
    env = make(
        identifier,
        action_mode=action_mode,
        robot_options=options,
        design_in_observation=True,
        sample_design=SAMPLED.get(identifier, True),
    )
    limit = softgym_envs.ENVIRONMENTS[identifier].max_episode_steps
    env.action_space.seed(3)
    for episode in range(episodes):
        observation, info = env.reset(seed=episode)
        shown = [variable.observe(env.unwrapped.design[variable.name]) for variable in env.unwrapped.design_space]
        np.testing.assert_array_equal(env.unwrapped._episodes.unit_designs[0], np.concatenate(shown))
        truncated = False
        steps = 0
        terminated = False
        while not (truncated or terminated):
            before = env.unwrapped.state.command
            observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
            steps += 1
            assert env.observation_space.contains(observation)
            assert terminated == info["is_failed"]
            assert 0.0 <= reward <= 1.0 or isinstance(env.unwrapped.task, Locomotion | Throw)  # a speed, a gain
            assert (np.abs(env.unwrapped.state.command - before) <= env.unwrapped.robot.rates + 1e-15).all()
        assert steps == limit or terminated
    assert set(info) >= {"effector", "goal", "distance", "is_success", "displacement", "effort"}
    task = env.unwrapped.task
    # Their distances count one side only, are relative, or velocities.
    if task.name not in ("carry", "grasp") and not isinstance(task, Locomotion | Throw):
        error = task.axes * (info["effector"] - info["goal"])
        assert info["distance"] == pytest.approx(np.linalg.norm(error), abs=1e-12)
    assert info["is_success"] == (info["distance"] < env.unwrapped.task.success_distance)
    assert info["converged"]
    check_info(info)
    terms = [value for name, value in info.items() if name.startswith("reward_")]
    combined = np.sum(terms) if isinstance(task, Locomotion | Throw) else np.prod(terms)
    assert len(terms) >= (1 if isinstance(task, Throw) else 2) and reward == pytest.approx(combined)
    unilateral = env.unwrapped.robot.unilateral
    assert (info["effort"][unilateral] >= 0.0).all()


def check_info(info):
    """TorchRL reads the dtype of every value; Gymnasium batches booleans only if they are arrays."""
    flags = ("is_success", "is_failed", "stable", "trusted", "converged")
    assert {name for name, value in info.items() if value.dtype == bool} == set(flags)
    assert info["distrust"].dtype == np.int64
    whole = ("distrust", "plant_delay")
    assert all(value.dtype == float for name, value in info.items() if name not in (*flags, *whole))


@pytest.mark.parametrize("backend", BACKENDS)
def test_information_is_flat_and_has_dtypes(backend):
    env = make("SoftGym/FingerReach-v0", backend=backend)
    infos = [env.reset(seed=0)[1], env.step(env.action_space.sample())[4]]
    for info in infos:
        check_info(info)
    assert infos[0].keys() == infos[1].keys()
    batched = gymnasium.vector.SyncVectorEnv([lambda: env])
    assert batched.reset()[1]["is_success"].dtype == bool


def test_rows_choose_the_backend_and_make_vec_follows():
    for identifier, row in softgym_envs.ENVIRONMENTS.items():
        spec = gymnasium.spec(identifier)
        assert spec.kwargs["backend"] == row.backend
        assert spec.vector_entry_point is not None
    env = gymnasium.make_vec("SoftGym/TetrapodReach-v0", num_envs=2, vectorization_mode="sync")
    assert isinstance(env, gymnasium.vector.SyncVectorEnv)
    observation, _ = env.reset(seed=0)
    assert observation.shape == (2, 24)
    observation, _, _, _, info = env.step(np.ones((2, 4), dtype=np.float32))
    assert env.observation_space.contains(observation)
    assert info["distance"].shape == (2,)
    env.close()


def test_a_surrogate_without_weights_names_the_shipped_ones():
    from softgym_envs.errors import WeightsError

    with pytest.raises(WeightsError, match=r"'silicone_beam_coarse'.*finger_1cable, finger_2cables"):
        gymnasium.make("SoftGym/Reach-v0", robot="silicone_beam", backend="surrogate")


@pytest.mark.parametrize("identifier", [i for i, row in softgym_envs.ENVIRONMENTS.items() if row.task == "track"])
def test_track_follows_the_reference_path_of_its_robot(identifier):
    env = make(identifier).unwrapped
    env.reset(seed=0)
    assert (env.path == env.robot.reference_path()).all()
    assert (np.abs(env.path) < 1.25 * env.robot.size).all()  # observations do not clip the goals


@pytest.mark.parametrize("kind", ["single", "batched", "torch"])
@pytest.mark.parametrize("lookahead", [0, 1, 3])
def test_a_track_shows_the_goal_that_a_later_step_is_rated_by(kind, lookahead):
    identifier, options = "SoftGym/DiamondTrack-v0", {"lookahead": lookahead}
    if kind == "single":
        env = gymnasium.make(identifier, task_options=options)
        spaces = env.unwrapped.spaces
    elif kind == "batched":
        env = gymnasium.make_vec(identifier, num_envs=1, task_options=options)
        spaces = env.unwrapped.spaces
    else:
        pytest.importorskip("torch")
        from softgym_envs.extensions.gpu.environment import TorchVectorEnv

        env = TorchVectorEnv(identifier, 1, device="cpu", task_options=options)
        spaces = gymnasium.make(identifier).unwrapped.spaces
    shown, rated = [], []
    observation, info = env.reset(seed=0)
    for _ in range(13):
        shown.append(spaces.observed_goal(np.asarray(observation).reshape(-1)))
        rated.append(np.asarray(info["goal"]).reshape(3))
        action = 0.0 * env.action_space.sample()
        observation, *_, info = env.step(action if kind != "torch" else np.asarray(action))
    np.testing.assert_allclose(shown[: len(shown) - lookahead], rated[lookahead:], atol=1e-7)
    assert np.ptp(rated, axis=0).max() > 1e-3  # the goal moves


@pytest.mark.parametrize("lookahead", [-1, 0.5, "1"])
def test_a_track_refuses_a_wrong_lookahead(lookahead):
    with pytest.raises(ValueError, match="lookahead = .*must be (0 or more|an integer)"):
        make_task("track", make_robot("diamond"), lookahead=lookahead)


def test_track_needs_a_path_or_a_reference_path(monkeypatch):
    robot = make_robot("finger")
    monkeypatch.setattr(type(robot), "reference_path", Robot.reference_path)
    with pytest.raises(ValueError, match="robot 'finger' has no reference path"):
        make_task("track", robot)
    assert make_task("track", robot, path=np.zeros((2, 3))).path.shape == (2, 3)
    monkeypatch.setattr(type(robot), "reference_path", lambda self, count=20: np.zeros((count, 2)))
    with pytest.raises(ValueError, match="reference_path of robot 'finger' must have shape"):
        make_task("track", robot)


@pytest.mark.parametrize("backend", BACKENDS)
def test_design_in_make_and_reset(backend):
    env = gymnasium.make("SoftGym/FingerReach-v0", backend=backend, design={"length": 0.041})
    env.reset(seed=0)
    unwrapped = env.unwrapped
    assert unwrapped.design["length"] == 0.041
    assert unwrapped.design["height"] == unwrapped.design_space["height"].baseline
    assert unwrapped.state.effector[0, 2] == pytest.approx(-3 * 0.041, abs=2e-4)
    env.reset(options={"design": {"length": 0.039, "height": 0.021}})
    assert (unwrapped.design["length"], unwrapped.design["height"]) == (0.039, 0.021)
    env.reset()
    assert unwrapped.design["length"] == 0.041
    goal = np.array([0.0, 0.05, -0.1])
    _, info = env.reset(options={"goal": goal})
    assert (info["goal"] == goal).all()


def test_an_environment_works_after_a_first_reset_that_refused_its_design():
    env = gymnasium.make("SoftGym/FingerReach-v0")
    with pytest.raises(DesignError, match="length"):
        env.reset(options={"design": {"length": 1.0}})
    env.reset(seed=0)
    env.step(env.action_space.sample())


def test_reset_does_not_rebuild_the_same_design(monkeypatch):
    env = gymnasium.make("SoftGym/FingerReach-v0", backend="fem")
    built = []
    original = Robot.build
    monkeypatch.setattr(Robot, "build", lambda self, design=None: built.append(design) or original(self, design))
    model = env.unwrapped.backend.model
    for seed in range(3):
        env.reset(seed=seed)
    assert built == [] and env.unwrapped.backend.model is model
    env.reset(options={"design": {"length": 0.0405}})
    assert len(built) == 1


def test_backends_agree():
    """The surrogate agrees with FEM along a rollout, slack cables included, to a fraction of a millimetre."""
    envs = [
        gymnasium.make("SoftGym/FingerReach-v0", backend=b, design={"joint_height": 0.007})
        for b in ("fem", "surrogate")
    ]
    goal = np.array([0.0, 0.06, -0.09])
    for env in envs:
        env.reset(seed=0, options={"goal": goal})
    rng = np.random.default_rng(0)
    saw_slack = False
    for _ in range(30):
        action = np.array([1.0, rng.uniform(-1, 1)], dtype=np.float32)
        infos = [env.step(action)[4] for env in envs]
        saw_slack |= bool(envs[0].unwrapped.state.slack.any())
        assert np.linalg.norm(infos[0]["effector"] - infos[1]["effector"]) < 1e-3
        assert np.abs(infos[0]["effort"] - infos[1]["effort"]).max() < 1.0
    assert saw_slack


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"backend": "magic"}, ValueError, ["magic", "fem", "surrogate"]),
        ({"design": {"lenght": 0.04}}, DesignError, ["lenght", "length", "joint_height"]),
        ({"design": {"length": 0.1}}, DesignError, ["length", "0.1", "0.038", "0.042", "m"]),
        ({"design": {"length": float("nan")}}, DesignError, ["length", "nan", "finite"]),
        ({"design": {"length": "long"}}, DesignError, ["length", "long", "number"]),
        ({"sample_design": ["wing"]}, DesignError, ["wing", "length"]),
        ({"action_mode": "torque"}, ValueError, ["torque", "increment", "absolute"]),
        ({"robot_options": {"cables": 7}}, ValueError, ["cables", "7", "1, 2"]),
        ({"robot_options": {"legs": 7}}, ValueError, ["legs"]),
        ({"task_options": {"goals": "easy"}}, ValueError, ["easy", "reachable"]),
        ({"backend_options": {"weights": "/nowhere"}}, ValueError, None),
        ({"render_mode": "hologram"}, ValueError, ["hologram", "rgb_array"]),
        ({"render_size": (0, 480)}, ValueError, ["render_size", "(0, 480)", "pixels"]),
        ({"render_size": 480}, ValueError, ["render_size", "480", "two"]),
        ({"sample_design": 1}, DesignError, ["1", "True, False or a list of names", "length"]),
        ({"design_in_observation": ["length", "length"]}, DesignError, ["length", "differ"]),
        ({"robot_options": 5}, ValueError, ["robot_options", "5", "mapping"]),
        ({"plant": 0.1}, ValueError, ["plant", "0.1", "mapping"]),
        ({"plant": {"noise": "low"}}, ValueError, ["plant noise", "low", "from 0.0 to 1.0"]),
    ],
)
def test_bad_options_are_named(options, error, words):
    if words is None:
        from softgym_envs.errors import WeightsError as error  # noqa: N813

        words = ["nowhere", "does not exist"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Gymnasium warns about an unknown render mode before we refuse it
        with pytest.raises(error) as caught:
            gymnasium.make("SoftGym/FingerReach-v0", **options)
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message


@pytest.mark.parametrize("backend", BACKENDS)
def test_bad_actions_and_reset_options(backend):
    env = gymnasium.make("SoftGym/FingerReach-v0", backend=backend).unwrapped
    env.reset(seed=0)
    before = env.state
    for action in ([np.nan, 0.0], [np.inf, 0.0], [0.0], [[0.0, 0.0]]):
        with pytest.raises(ValueError, match="action"):
            env.step(np.array(action))
    assert env.state is before
    with pytest.raises(ValueError, match="colour.*design, goal"):
        env.reset(options={"colour": "red"})
    with pytest.raises(ValueError, match="goal"):
        env.reset(options={"goal": [0.0, np.nan, 0.0]})
    with pytest.raises(ValueError, match="one goal per episode, got a path of 5"):
        env.reset(options={"goal": np.zeros((5, 3))})
    with pytest.raises(DesignError, match="length"):
        env.reset(options={"design": {"length": 1.0}})
    with pytest.raises(ValueError, match="goal"):
        env.reset(options={"design": {"length": 0.041}, "goal": [0.0, np.nan, 0.0]})
    assert env.state is before and env.design["length"] == 0.04
    env.reset()
    assert np.isfinite(env.step(np.array([5.0, -5.0]))[0]).all()  # values out of range are clipped


@pytest.mark.parametrize("backend", BACKENDS)
def test_every_field_of_a_state_can_be_read_and_copied(backend):
    env = gymnasium.make("SoftGym/FingerReach-v0", backend=backend).unwrapped
    env.reset(seed=0)
    env.step(np.array([1.0, -1.0]))
    state = env.state
    assert state.velocity.shape == (1, 3) and not state.velocity.any()
    np.testing.assert_array_equal(state.row_effort, state.condensed.effort if backend == "fem" else [])
    assert repr(state).startswith(type(state).__name__)
    for twin in (pickle.loads(pickle.dumps(state)), copy.deepcopy(state)):
        assert (twin.effector == state.effector).all() and twin.stable == state.stable
        np.testing.assert_array_equal(twin.condensed.compliance, state.condensed.compliance)


def test_unsolvable_step_ends_the_episode(monkeypatch):
    env = gymnasium.make("SoftGym/FingerReach-v0", backend="fem")
    env.reset(seed=0)
    backend = env.unwrapped.backend

    def fail(command, mode="displacement", *, force=None):
        raise ConvergenceError("no equilibrium", fraction=0.5)

    monkeypatch.setattr(backend, "step", fail)
    before = env.unwrapped.state
    observation, reward, terminated, truncated, info = env.step(np.ones(2, dtype=np.float32))
    assert truncated and not terminated and reward == 0.0
    assert not info["converged"] and np.isfinite(observation).all()
    assert env.unwrapped.state is before


@pytest.mark.parametrize("backend", BACKENDS)
def test_render(backend):
    env = gymnasium.make("SoftGym/FingerReach-v0", backend=backend, render_mode="rgb_array", render_size=(160, 120))
    env.reset(seed=0)
    first = env.render()
    assert first.shape == (120, 160, 3) and first.dtype == np.uint8 and first.std() > 5
    for _ in range(8):
        env.step(np.array([1.0, 1.0], dtype=np.float32))
    assert (env.render() != first).any()
    env.close()


def test_a_window_without_a_display_is_refused(monkeypatch):
    for variable in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    with pytest.raises(ValueError, match=r"needs a display, .* softgym rollout --video"):
        gymnasium.make("SoftGym/FingerReach-v0", render_mode="human")
