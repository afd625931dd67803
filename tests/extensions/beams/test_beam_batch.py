"""Finite elements of many bodies of beams at once, against single environments."""

import pickle
from dataclasses import replace

import gymnasium
import numba
import numpy as np
import pytest

import softgym_envs  # noqa: F401 - registers the environments
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.envs.parallel import ParallelVectorEnv
from softgym_envs.envs.vector_env import SoftRobotVectorEnv
from softgym_envs.errors import InfeasibleDesign
from softgym_envs.extensions.beams import fem_batch
from softgym_envs.extensions.beams.fem_batch import FEMBatch
from softgym_envs.extensions.beams.robots.tetrapod import Tetrapod
from softgym_envs.extensions.beams.solver.batch import BeamBatch, thread_count
from softgym_envs.surrogate.domain import FOLDED

TETRAPOD, TRUNK = "SoftGym/TetrapodReach-v0", "SoftGym/TrunkReach-v0"
STEPS = 6
TABLE = {"obstacles": [{"kind": "plane", "point": [0.0, 0.0, -0.157], "normal": [0.0, 0.05, 1.0], "friction": 0.5}]}
"""A slope below the centre, which touches it as it moves."""


class WeakTetrapod(Tetrapod):
    """Tetrapod with servos that soon saturate."""

    def __init__(self, **options):
        super().__init__(**{"elements": 2, **options})
        self.actuators = tuple(replace(servo, max_effort=0.05) for servo in self.actuators)


def compare_with_singles(identifier, options, designs):
    """Assert that the rows of a batch are single environments; return the largest effort over its limit."""
    options = {**options, "backend": "fem", "design_in_observation": True}
    batch = gymnasium.make_vec(identifier, len(designs), max_episode_steps=STEPS, **options)
    assert isinstance(batch.unwrapped, SoftRobotVectorEnv) and isinstance(batch.unwrapped.backend, FEMBatch)
    goal = batch.unwrapped.robot.effector_rest + 0.01
    observation, _ = batch.reset(seed=0, options={"design": designs, "goal": goal})
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (STEPS, *batch.action_space.shape)).astype(np.float32)
    rows, models = [], []
    for action in actions:
        rows.append(batch.step(action))
        models.append(batch.unwrapped.condensed.compliance)
    share = 0.0
    for i, design in enumerate(designs):
        single = gymnasium.make(identifier, **options)
        first, _ = single.reset(seed=0, options={"design": design, "goal": goal})
        np.testing.assert_allclose(observation[i], first, atol=1e-6)
        for step, action in enumerate(actions[:, i]):
            seen, reward, _, _, info = single.step(action)
            end = step == STEPS - 1
            found = rows[step][4]["final_info"] if end else rows[step][4]
            np.testing.assert_allclose(rows[step][4]["final_obs"][i] if end else rows[step][0][i], seen, atol=1e-6)
            if not end:
                W = single.unwrapped.state.condensed.compliance
                np.testing.assert_allclose(models[step][i], W, atol=1e-7 * np.abs(W).max())
            np.testing.assert_allclose(found["effector"][i], info["effector"], atol=1e-8)
            assert rows[step][1][i] == pytest.approx(reward, abs=1e-6)
            largest = np.array([actuator.max_effort for actuator in single.unwrapped.robot.actuators])
            share = max(share, float((np.abs(info["effort"]) / largest).max()))
    return share


@pytest.mark.parametrize(
    ("identifier", "options", "designs"),
    [
        (TETRAPOD, {"robot_options": {"elements": 2, "payload": 0.2}}, [{"leg_length": 0.2}, {"curvature_2": 3.0}]),
        (
            TETRAPOD,
            {"robot_options": {"elements": 2}, "backend_options": {"dynamics": False}},
            [{}, {"leg_length": 0.2}],
        ),
        (TRUNK, {}, [{}, {"module_length": 0.056}]),
        (TETRAPOD, {"robot_options": {"elements": 2, **TABLE}}, [{}, {"leg_length": 0.2}]),
    ],
    ids=["payload and designs", "statics", "chambers", "contact"],
)
def test_rows_step_as_single_environments(identifier, options, designs):
    assert compare_with_singles(identifier, options, designs) < 0.999


def test_saturated_servos_stop_as_in_single_environments():
    options = {"robot": WeakTetrapod}
    assert compare_with_singles(TETRAPOD, options, [{}, {"leg_width": 0.012}]) == pytest.approx(1.0, abs=1e-9)


def test_rows_that_the_compiled_solver_leaves_go_to_the_general_one(monkeypatch):
    march = BeamBatch.march

    def fails_first(self, bodies, states, *args, **options):
        kept = states.copy()
        solved, stable = march(self, bodies, states, *args, **options)
        for array, before in zip(states, kept, strict=True):
            if array is not None and len(array):
                array[0] = before[0]
        solved[0] = False
        return solved, stable

    monkeypatch.setattr(BeamBatch, "march", fails_first)
    assert compare_with_singles(TETRAPOD, {"robot_options": {"elements": 2}}, [{}, {}]) < 0.999


def test_factors_serve_the_next_step_of_the_same_motion_only():
    env = gymnasium.make_vec(TETRAPOD, 3, robot_options={"elements": 2}, max_episode_steps=10**6)
    env.reset(seed=0)
    backend = env.unwrapped.backend
    states = backend._present
    assert not states.is_factored.any()
    env.step(np.full((3, 4), 0.5, dtype=np.float32))
    assert states.is_factored.all()
    backend._step_alone(2, backend.command[2])
    env.reset(options={"reset_mask": np.array([True, False, False])})
    np.testing.assert_array_equal(states.is_factored, [False, True, False])
    start, command = states.copy(), backend.command + 0.1
    backend.step(command)
    found = states.copy()
    for array, kept in zip(states, start, strict=True):
        if array is not None:  # there are no anchors
            array[:] = kept
    states.is_factored[:] = False
    backend.command = command - 0.1
    backend.step(command)
    np.testing.assert_allclose(found.x, states.x, atol=1e-9)
    np.testing.assert_allclose(found.compliance, states.compliance, atol=1e-7 * np.abs(states.compliance).max())
    assert (found.x[1] != states.x[1]).any() and (found.x[[0, 2]] == states.x[[0, 2]]).all()


def test_rows_with_folded_legs_are_not_trusted():
    options = {"mesh": "published", "servo_range": 0.5 * np.pi}
    env = gymnasium.make_vec("SoftGym/TetrapodCarry-v0", 2, robot_options=options)
    env.reset(seed=0)
    right = np.array([[1.0, 1.0, -1.0, 1.0], [1.0, 0.0, -1.0, 0.0]], dtype=np.float32)
    for _ in range(12):
        info = env.step(right)[4]
    np.testing.assert_array_equal(info["trusted"], [False, True])
    np.testing.assert_array_equal(info["distrust"], [FOLDED, 0])


def test_rows_in_contact_are_single_bodies():
    """With friction, after a reset of one row, and in copies; up to round-off, which two compilations may differ by."""
    robot, names = Tetrapod(elements=2, **TABLE), Tetrapod(elements=2).design_space.names
    bodies = np.array([robot.design_space.baseline.array, robot.design_space.complete({"leg_length": 0.2}).array])
    batch = FEMBatch(robot, bodies, dynamics=True)
    singles = [FEMBackend(robot, dict(zip(names, body, strict=True)), dynamics=True) for body in bodies]
    commands = np.random.default_rng(0).uniform(-0.6, -0.2, (8, 2, 4))
    touching = sliding = 0

    def compare(rows, command):
        nonlocal touching, sliding
        rows.step(command)
        assert rows.state.converged.all()
        for i, single in enumerate(singles):
            state = single.step(command[i])
            np.testing.assert_allclose(rows.state.effector[i], state.effector.ravel(), rtol=0.0, atol=1e-12)
            np.testing.assert_allclose(rows.condensed.compliance[i], state.condensed.compliance, rtol=1e-9, atol=1e-15)
            touching += state.contacts.count
            sliding += int(state.contacts.sliding.sum())

    for command in commands[:5]:
        compare(batch, command)
    assert touching > 10 and sliding > 0
    batch.rest(np.array([1]))
    singles[1].reset()
    copied = pickle.loads(pickle.dumps(batch))
    for command in commands[5:]:
        compare(batch, command)
        copied.step(command)
        np.testing.assert_array_equal(copied.state.effector, batch.state.effector)
    with pytest.raises(ValueError, match="robot 'tetrapod' touches obstacles: its equilibria have no gradient"):
        batch.gradient(np.zeros((2, 3)), np.zeros((2, 4)))


def test_threads_share_the_rows_and_change_nothing(monkeypatch):
    robot = Tetrapod(elements=2, **TABLE)
    bodies = np.tile(robot.design_space.baseline.array, (3, 1))
    batches = [FEMBatch(robot, bodies, threads=count, dynamics=True) for count in (1, 2, 4)]
    for command in np.random.default_rng(0).uniform(-0.6, -0.2, (3, 3, 4)):
        for batch in batches:
            batch.step(command)
        one, *others = [(b.state.effector, b.state.effort, b.condensed.compliance, b._present.anchors) for b in batches]
        for found in others:
            assert all((a == b).all() for a, b in zip(one, found, strict=True))
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    assert thread_count() == 1
    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 2)
    assert thread_count() == 2


def test_tasks_that_push_step_in_processes():
    env = gymnasium.make_vec("SoftGym/TetrapodCarry-v0", 1, task_options={"push": 1.0}, robot_options={"elements": 2})
    assert isinstance(env.unwrapped, ParallelVectorEnv)
    env.close()


def test_bodies_that_cannot_exist_are_drawn_again(monkeypatch):
    class Fussy(FEMBackend):
        def reset(self, design=None):
            if design is not None and design["leg_length"] > 0.21:
                raise InfeasibleDesign("the legs are too long")
            return super().reset(design)

    monkeypatch.setattr(fem_batch, "FEMBackend", Fussy)
    env = gymnasium.make_vec(TETRAPOD, 3, robot_options={"elements": 2}, sample_design=["leg_length"])
    env.reset(seed=0)
    lengths = env.unwrapped.designs[:, 0]
    assert (lengths <= 0.21).all() and len(set(lengths)) == 3
    with pytest.raises(InfeasibleDesign, match="too long"):
        env.reset(options={"design": {"leg_length": 0.22}})


def test_a_mask_resets_some_rows_only():
    env = gymnasium.make_vec(TETRAPOD, 2, robot_options={"elements": 2}, autoreset_mode="Disabled", max_episode_steps=9)
    env.reset(seed=0)
    for _ in range(2):
        before = env.step(np.full((2, 4), 0.3, dtype=np.float32))[4]
    _, after = env.reset(options={"reset_mask": np.array([True, False])})
    assert not after["displacement"][0].any()
    np.testing.assert_array_equal(after["effector"][1], before["effector"][1])
    assert (env.unwrapped.backend.velocity[0] == 0.0).all() and (env.unwrapped.backend.velocity[1] != 0.0).any()


def test_gradients_are_those_of_the_equilibria_under_the_commands():
    """Against differences of the reward where the commands lead, for two bodies in motion."""
    env = gymnasium.make_vec(TETRAPOD, 2, robot_options={"elements": 2}).unwrapped
    designs, goal = [{}, {"leg_length": 0.2}], env.robot.effector_rest + np.array([0.01, 0.005, 0.02])
    rng = np.random.default_rng(1)
    actions = rng.uniform(-0.5, 0.5, (4, 2, 4))

    def last(action):
        env.reset(seed=0, options={"design": designs, "goal": goal})
        for before in actions[:-1]:
            env.step(before)
        return env.step_with_gradient(action)[-1]

    found = last(actions[-1])
    for k in range(4):
        shift = 1e-4 * np.eye(4)[k]
        slope = (last(actions[-1] + shift).reward - last(actions[-1] - shift).reward) / 2e-4
        np.testing.assert_allclose(found.action[:, k], slope, rtol=1e-4, atol=1e-6)
