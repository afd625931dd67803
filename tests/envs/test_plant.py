"""A plant that differs from the model: stiffness, friction of cables, delay, noise; fixed or drawn at each reset."""

from __future__ import annotations

import copy

import gymnasium
import numpy as np
import pytest

import softgym_envs  # noqa: F401
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.envs.plant import Plant, Plants
from softgym_envs.robots.registry import make_robot

FINGER = "SoftGym/FingerReach-v0"
SENSORIZED = "SoftGym/SensorizedFingerReach-v0"


def play(env, actions, **options):
    """Observations and infos of an episode; ``env.reset`` takes the options."""
    found = [env.reset(**{"seed": 4, **options})]
    for action in actions:
        observation, *_, info = env.step(action)
        found.append((observation, info))
    return [pair[0] for pair in found], [pair[1] for pair in found]


@pytest.fixture
def actions():
    return np.random.default_rng(2).uniform(0.0, 1.0, (6, 2)).astype(np.float32)


@pytest.mark.parametrize("backend", ["surrogate", "fem"])
def test_stiffness_is_that_of_a_stiffer_body(backend, actions):
    """The plant scales efforts and W exactly as a body with 1.2 times the Young's modulus does."""
    plant = gymnasium.make(FINGER, backend=backend, plant={"stiffness": 1.2})
    young = plant.unwrapped.design["young_modulus"]
    body = gymnasium.make(FINGER, backend=backend, design={"young_modulus": 1.2 * young})
    goal = {"options": {"goal": np.array([0.0, 0.04, -0.1])}}
    for mine, theirs in zip(play(plant, actions, **goal)[1], play(body, actions, **goal)[1], strict=True):
        np.testing.assert_allclose(mine["effort"], theirs["effort"], rtol=2e-5, atol=1e-6)
        np.testing.assert_allclose(mine["effector"], theirs["effector"], atol=1e-7)
    first, second = (env.unwrapped.state.condensed for env in (plant, body))
    np.testing.assert_allclose(first.compliance, second.compliance, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(first.delta.array, second.delta.array, atol=1e-7)
    assert mine["plant_stiffness"] == 1.2


@pytest.mark.parametrize("backend", ["surrogate", "fem"])
def test_a_touch_deforms_a_stiffer_plant_as_a_stiffer_body(backend):
    """The force of a touch is given: it does not grow with the stiffness, as the forces of the body do."""
    touched = {"backend": backend, "task_options": {"force": 2.0, "window": 1}}
    plant = gymnasium.make(SENSORIZED, plant={"stiffness": 1.3}, **touched)
    young = plant.unwrapped.design["young_modulus"]
    body = gymnasium.make(SENSORIZED, design={"young_modulus": 1.3 * young}, **touched)
    goal, half = {"options": {"goal": np.array([0.0, 0.02, -0.06])}}, np.full((3, 1), 0.5)
    found, expected = (play(env, half, **goal)[1] for env in (plant, body))
    for mine, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(mine["effort"], theirs["effort"], rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(mine["effector"], theirs["effector"], atol=1e-6)
    first, second = (env.unwrapped.state.condensed.delta.s for env in (plant, body))
    np.testing.assert_allclose(first, second, rtol=1e-3)


@pytest.mark.parametrize("delay", [1, 3])
def test_commands_arrive_late(delay, actions):
    """The body is where it would have been ``delay`` steps ago, the observed command is the one just sent."""
    goal = {"options": {"goal": np.array([0.0, 0.04, -0.1])}}
    late, prompt = (gymnasium.make(FINGER, plant=plant) for plant in ({"delay": delay}, None))
    seen, infos = play(late, actions, **goal)
    expected, references = play(prompt, actions, **goal)
    for k in range(len(actions) + 1):
        np.testing.assert_allclose(infos[k]["effector"], references[max(k - delay, 0)]["effector"], atol=1e-12)
        part = late.unwrapped.spaces.slices["command"]
        np.testing.assert_allclose(seen[k][part], expected[k][part])
    np.testing.assert_allclose(late.unwrapped.command, prompt.unwrapped.command)
    assert not np.allclose(late.unwrapped.state.command, late.unwrapped.command)


def test_noise_is_in_the_sensors_only(actions):
    noisy, clean = (gymnasium.make(FINGER, plant=plant) for plant in ({"noise": 0.01}, None))
    robot, spaces = noisy.unwrapped.robot, noisy.unwrapped.spaces
    goal = {"options": {"goal": np.array([0.0, 0.04, -0.1])}}
    errors = []
    for seed in range(60):
        seen, infos = play(noisy, actions[:2], seed=seed, **goal)
        _, references = play(clean, actions[:2], seed=seed, **goal)
        np.testing.assert_array_equal(infos[2]["effector"], references[2]["effector"])
        errors.append(spaces.observed_effector(seen[2]) - infos[2]["effector"])
        np.testing.assert_allclose(noisy.unwrapped.sensed.effector, spaces.observed_effector(seen[2]), atol=1e-6)
    spread = np.std(errors) / robot.size
    assert 0.008 < spread < 0.012
    again, _ = play(noisy, actions[:2], seed=59, **goal)
    np.testing.assert_array_equal(seen, again)


def test_friction_on_finite_elements(actions):
    """Cables pull harder against friction, and the tip bends less; back at rest nothing is left of it."""
    rough, smooth = (gymnasium.make(FINGER, backend="fem", plant=plant) for plant in ({"cable_friction": 0.85}, None))
    goal = {"options": {"goal": np.array([0.0, 0.04, -0.1])}}
    _, infos = play(rough, np.ones((4, 2)), **goal)
    _, references = play(smooth, np.ones((4, 2)), **goal)
    assert (infos[-1]["effort"] > 1.02 * references[-1]["effort"]).all()
    assert np.linalg.norm(infos[-1]["effector"] - references[-1]["effector"]) > 1e-4
    _, again = play(rough, np.ones((4, 2)), **goal)
    np.testing.assert_allclose(again[-1]["effector"], infos[-1]["effector"], atol=1e-9)


def test_drives_that_do_something_else(actions):
    """Gain, offset and play: the body does what the drives do, and commands go on from what was commanded."""
    plant = {"gain": 0.9, "offset": {"cable_2": 0.001}, "backlash": 0.002}
    env, exact = gymnasium.make(FINGER, plant=plant), gymnasium.make(FINGER)
    goal = {"options": {"goal": np.array([0.0, 0.04, -0.1])}}
    commands, infos = [], []
    for made in (env, exact):
        made.reset(seed=0, **goal)
    there = np.zeros(2)
    for action in [*np.ones((8, 2)), *actions, *-np.ones((9, 2))]:
        info = env.step(action)[-1]
        exact.step(action)
        command = env.unwrapped.command
        np.testing.assert_allclose(command, exact.unwrapped.command, atol=1e-12)
        wanted = 0.9 * command + [0.0, 0.001]
        there = np.where(
            there > wanted + 0.001, wanted + 0.001, np.where(there < wanted - 0.001, wanted - 0.001, there)
        )
        np.testing.assert_allclose(env.unwrapped.backend.state.command, there, atol=1e-12)
        commands.append(command)
        infos.append(info)
    assert np.ptp(commands, axis=0).min() > 0.003  # far enough to leave the play on both sides
    np.testing.assert_array_equal(infos[-1]["plant_offset"], [0.0, 0.001])
    assert infos[-1]["plant_gain"] == 0.9


def test_cables_that_stretch():
    """The body lacks compliance times tension; a copy and an earlier moment have the same cables."""
    env = gymnasium.make(FINGER, backend="fem", plant={"cable_compliance": {"cable_1": 4e-4}})
    goal = {"options": {"goal": np.array([0.0, 0.04, -0.1])}}
    play(env, np.ones((3, 2)), **goal)
    state, command = env.unwrapped.backend.state, env.unwrapped.command
    np.testing.assert_allclose(state.displacement + [4e-4, 0.0] * state.effort, command, atol=1e-9)
    moment = env.unwrapped.get_state()
    after = env.step(np.ones(2))[-1]
    env.unwrapped.set_state(moment)
    np.testing.assert_allclose(env.step(np.ones(2))[-1]["effector"], after["effector"], atol=1e-9)


@pytest.mark.parametrize(
    "plant, message",
    [
        ({"offset": {"left": 0.001}}, "plant offset: .*left"),
        ({"gain": {"cable_1": 0.0}}, "plant gain = 0.0; allowed: one or two numbers from 0.1 to 10.0"),
        ({"cable_compliance": 1e-4}, "plant cable_compliance needs backend 'fem'"),
    ],
)
def test_wrong_drives(plant, message):
    with pytest.raises(ValueError, match=message):
        gymnasium.make(FINGER, plant=plant, backend="surrogate")


def test_drives_of_many_environments_are_drawn_in_each():
    envs = gymnasium.make_vec(FINGER, num_envs=2, plant={"gain": [0.8, 1.2]})
    _, info = envs.reset(seed=0)
    assert info["plant_gain"].std() > 0.0
    envs.close()


def test_a_copy_goes_on_with_the_same_plant(actions):
    env = gymnasium.make(FINGER, plant={"delay": (1, 3), "noise": 0.01, "stiffness": (0.8, 1.2)})
    play(env, actions[:3])
    other = copy.deepcopy(env)
    for action in actions[3:]:
        (mine, *_, info), (theirs, *_, other_info) = env.step(action), other.step(action)
        np.testing.assert_array_equal(mine, theirs)
        assert info["plant_delay"] == other_info["plant_delay"] > 0


RANGES = {"stiffness": (0.8, 1.2), "delay": (0, 2), "noise": (0.0, 0.02)}


def test_ranges_are_drawn_at_each_reset():
    env = gymnasium.make(FINGER, plant=RANGES)
    drawn = [{k: env.reset(seed=k)[1][f"plant_{name}"] for k in range(30)} for name in RANGES]
    for (low, high), values in zip(RANGES.values(), drawn, strict=True):
        found = np.array(list(values.values()), dtype=float)
        assert (found >= low).all() and (found <= high).all() and found.std() > 0.2 * (high - low)


def test_batched_environments_draw_and_delay_row_by_row():
    """Each row moves as a single environment with its plant does."""
    envs = gymnasium.make_vec(FINGER, num_envs=12, plant={**RANGES, "noise": 0.0})
    goal = np.array([0.0, 0.04, -0.1])
    _, info = envs.reset(seed=3, options={"goal": goal})
    assert len(set(info["plant_delay"].tolist())) > 1 and info["plant_stiffness"].std() > 0.01
    plants = [{name: float(info[f"plant_{name}"][i]) for name in ("stiffness", "delay")} for i in range(12)]
    singles = [gymnasium.make(FINGER, plant=plant) for plant in plants]
    for env in singles:
        env.reset(seed=0, options={"goal": goal})
    for action in np.random.default_rng(5).uniform(-0.2, 1.0, (5, 12, 2)).astype(np.float32):
        observation, reward, _, _, info = envs.step(action)
        for i, env in enumerate(singles):
            expected, value, *_, alone = env.step(action[i])
            np.testing.assert_allclose(observation[i], expected, atol=1e-4)
            np.testing.assert_allclose(info["effort"][i], alone["effort"], rtol=1e-3, atol=1e-4)
            assert abs(reward[i] - value) < 1e-3
    noisy = gymnasium.make_vec(FINGER, num_envs=500, plant={"noise": 0.01})
    observation, info = noisy.reset(seed=1)
    spaces = noisy.unwrapped.spaces
    error = spaces.observed_effector(observation) - info["effector"]
    assert 0.009 < error.std() / spaces.robot.size < 0.011


@pytest.mark.parametrize("mode", ["Disabled", "SameStep"])
def test_only_sensors_of_rows_that_are_reset_are_read_anew(mode):
    options = {"plant": {"noise": 0.01}, "autoreset_mode": mode, "max_episode_steps": 5}
    envs = gymnasium.make_vec(FINGER, num_envs=4, **options)
    action, mask = np.full((4, 2), 0.5, dtype=np.float32), np.array([False, True, True, False])
    drawn = []
    for _ in range(2):
        envs.reset(seed=3)
        envs.step(action)
        if mode == "Disabled":
            before = envs.step(action)[0]
            after = envs.reset(options={"reset_mask": mask})[0]
        else:
            envs.unwrapped.steps = np.where(mask, 4, 1)
            after, *_, info = envs.step(action)
            before = np.stack([info["final_obs"][i] if mask[i] else after[i] for i in range(4)])
        np.testing.assert_array_equal(after[~mask], before[~mask])
        assert (after[mask] != before[mask]).any(axis=1).all()
        drawn.append(np.concatenate([after, envs.step(action)[0]]))
    np.testing.assert_array_equal(*drawn)


def test_derivatives_know_the_stiffness_and_refuse_a_delay():
    envs = gymnasium.make_vec(FINGER, num_envs=3, plant={"stiffness": 1.3}).unwrapped
    goal, step = {"goal": np.array([0.0, 0.04, -0.1])}, 1e-3
    actions = np.full((3, 2), 0.5)

    def reward(actions):
        envs.reset(seed=1, options=goal)
        return envs.step_with_gradient(actions)

    *_, gradient = reward(actions)
    for k in range(2):
        change = step * np.eye(2)[k]
        ends = [reward(actions + sign * change)[1] for sign in (1.0, -1.0)]
        expected = (ends[0] - ends[1]) / (2.0 * step)
        np.testing.assert_allclose(gradient.command[:, k] * gradient.slope[:, k], expected, rtol=2e-2, atol=1e-5)
    late = gymnasium.make_vec(FINGER, num_envs=2, plant={"delay": 1}).unwrapped
    late.reset(seed=1)
    with pytest.raises(ValueError, match="plant delay"):
        late.step_with_gradient(np.zeros((2, 2)))


@pytest.mark.parametrize(
    ("id", "plant", "message"),
    [
        (FINGER, {"stiffnes": 1.1}, "did you mean 'stiffness'"),
        (FINGER, {"stiffness": -1.0}, "allowed: one or two numbers from 0.1 to 10.0"),
        (FINGER, {"noise": (0.02, 0.01)}, "rising"),
        (FINGER, {"delay": 0.5}, "one or two integers"),
        (FINGER, {"cable_friction": 0.3}, "needs backend 'fem'"),
        ("SoftGym/TetrapodReach-v0", {"stiffness": 1.2}, "do not scale"),
    ],
)
def test_wrong_plants_are_refused(id, plant, message):
    with pytest.raises(ValueError, match=message):
        gymnasium.make(id, plant=plant)


def test_friction_needs_cables():
    with pytest.raises(ValueError, match="robot 'trunk' has no cables"):
        gymnasium.make("SoftGym/TrunkReach-v0", backend="fem", plant={"cable_friction": 0.3}).reset(seed=0)


@pytest.mark.parametrize("name", ["trunk", "tetrapod"])
def test_friction_that_is_refused_changes_nothing(name):
    backend = FEMBackend(make_robot(name))
    with pytest.raises(ValueError, match="has no cables"):
        backend.cable_friction = 0.3
    assert backend.cable_friction == 0.0
    variable = next(iter(backend.robot.design_space))
    backend.reset({variable.name: variable.low})


def test_a_fixed_plant_draws_no_random_numbers():
    rng = np.random.default_rng(0)
    before = rng.bit_generator.state
    plants = Plants.check({"stiffness": 1.2, "delay": 2}, make_robot("finger"), "surrogate")
    assert plants.sample(rng) == Plant(stiffness=1.2, delay=2)
    assert rng.bit_generator.state == before


@pytest.mark.parametrize(("plant", "friction"), [(None, 0.4), ({"noise": 0.01}, 0.4), ({"cable_friction": 0.1}, 0.1)])
def test_friction_of_the_backend_stays_where_the_plant_says_nothing_of_it(plant, friction):
    env = gymnasium.make(FINGER, backend="fem", backend_options={"cable_friction": 0.4}, plant=plant).unwrapped
    env.reset(seed=0)
    assert env.backend.cable_friction == friction
    env.set_state(env.get_state())
    assert env.backend.cable_friction == friction and copy.deepcopy(env).backend.cable_friction == friction


def test_noise_of_a_measured_force_is_a_share_of_the_largest_wanted_force():
    """FingerGrasp measures a force [N] in place of the effector [m]."""
    env = gymnasium.make("SoftGym/FingerGrasp-v0", backend="surrogate", plant={"noise": 0.1}).unwrapped
    errors = [env.reset(seed=seed) and env.sensed.effector - env.task.measure(env.state) for seed in range(60)]
    assert np.std(errors) == pytest.approx(0.1 * env.task.forces[1], rel=0.2)


def test_the_plant_of_a_foreign_state_ends_with_its_episode():
    stiff, plain = (gymnasium.make(FINGER, plant=plant).unwrapped for plant in ({"stiffness": 1.2, "delay": 2}, None))
    stiff.reset(seed=0)
    plain.set_state(stiff.get_state())
    assert plain.plant == Plant(stiffness=1.2, delay=2)
    plain.reset(seed=0)
    assert plain.plant == Plant()
    plain.step(np.ones(2))
    assert (plain.state.command > 0.0).all()
