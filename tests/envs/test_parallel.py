"""Environments on finite elements in processes of their own."""

import os
import signal
import subprocess
import sys

import gymnasium
import numpy as np
import pytest

import softgym_envs  # noqa: F401 - registers the environments
from softgym_envs.agents import SB3VecEnv
from softgym_envs.envs.parallel import ParallelVectorEnv
from softgym_envs.envs.vector_env import SoftRobotVectorEnv
from softgym_envs.errors import DesignError, InfeasibleDesign
from tests.helpers import wait_until

FINGER = "SoftGym/FingerReach-v0"


def stepped(env, actions):
    return [env.step(action) for action in actions]


@pytest.mark.parametrize("backend", ["fem", "hybrid"])
def test_processes_step_as_single_environments(backend):
    designs = [{"length": 0.039}, {"length": 0.041}]
    goals = np.array([[[0.0, 0.05, -0.1]], [[0.0, 0.04, -0.11]]])
    env = gymnasium.make_vec(FINGER, 2, backend=backend, max_episode_steps=3)
    assert isinstance(env.unwrapped, ParallelVectorEnv) and env.metadata["autoreset_mode"].value == "SameStep"
    observation, info = env.reset(seed=3, options={"design": designs, "goal": goals})
    assert (info["goal"] == goals[:, 0]).all() and info["is_success"].dtype == bool
    actions = np.random.default_rng(0).uniform(-0.5, 1.0, (3, 2, 2)).astype(np.float32)
    rows = stepped(env, actions)
    env.close()
    for i in range(2):
        single = gymnasium.make(FINGER, backend=backend)
        first, _ = single.reset(seed=3 + i, options={"design": designs[i], "goal": goals[i]})
        np.testing.assert_array_equal(observation[i], first)
        for step, (expected, row) in enumerate(zip(stepped(single, actions[:, i]), rows, strict=True)):
            final = step == 2
            seen = row[4]["final_obs"][i] if final else row[0][i]
            np.testing.assert_allclose(seen, expected[0], atol=1e-7)
            assert row[1][i] == pytest.approx(expected[1], abs=1e-9) and row[3][i] == final
            effector = row[4]["final_info" if final else "effector"]
            effector = effector["effector"] if final else effector
            np.testing.assert_allclose(effector[i], expected[4]["effector"], atol=1e-9)


def test_resets_take_what_those_of_the_batch_take():
    """Integers of NumPy as seeds, and a list as a mask."""
    env = gymnasium.make_vec(FINGER, 2, backend="fem")
    goals = env.reset(seed=np.int64(3))[1]["goal"]
    assert (env.reset(seed=list(np.array([3, 4])))[1]["goal"] == goals).all()
    again = env.reset(seed=[4, None], options={"reset_mask": [True, False]})[1]
    assert (again["goal"][0] == goals[1]).all()
    env.close()


def test_the_batch_of_an_id_follows_backend_and_task():
    for identifier, options, kind in (
        (FINGER, {}, SoftRobotVectorEnv),
        (FINGER, {"backend": "fem"}, ParallelVectorEnv),
        ("SoftGym/FingerGrasp-v0", {"backend": "surrogate"}, ParallelVectorEnv),
    ):
        env = gymnasium.make_vec(identifier, 1, **options)
        assert type(env) is kind and env.spaces.action_space == env.single_action_space
        env.close()


def test_errors_of_a_process_keep_type_and_message():
    env = gymnasium.make_vec(FINGER, 2, backend="fem")
    env.reset(seed=0)
    with pytest.raises(DesignError, match="length"):
        env.reset(options={"design": [{"length": 0.04}, {"length": 1.0}]})
    assert env.closed and not any(process.is_alive() for process in env.unwrapped.processes)
    for wrong, words in (
        ({"design": [{}]}, "design must be one body or a list of 2, got 1"),
        ({"colour": 1}, "colour"),
    ):
        env = gymnasium.make_vec(FINGER, 2, backend="fem")
        with pytest.raises(ValueError, match=words):
            env.reset(options=wrong)
        env.close()
    with pytest.raises(ValueError, match="seed must be an integer, None or a list of 2, got 3 seeds"):
        env.reset(seed=[1, 2, 3])
    with pytest.raises(DesignError, match="lenght"):
        gymnasium.make_vec(FINGER, 2, backend="fem", design={"lenght": 0.04})


def fail(*args, **kwargs):
    raise InfeasibleDesign("the body cannot exist")


def test_an_infeasible_body_in_a_process_is_infeasible_here(monkeypatch):
    from softgym_envs.robots.base import Robot

    original = Robot.build
    monkeypatch.setattr(Robot, "build", lambda self, d=None: fail() if d["length"] > 0.041 else original(self, d))
    env = gymnasium.make_vec(FINGER, 2, backend="fem")
    with pytest.raises(InfeasibleDesign, match="the body cannot exist"):
        env.reset(options={"design": [{}, {"length": 0.0415}]})


def test_stable_baselines_trains_on_processes():
    env = SB3VecEnv(gymnasium.make_vec(FINGER, 2, backend="fem", max_episode_steps=2))
    env.reset()
    for _ in range(2):
        _, _, done, infos = env.step(np.ones((2, 2), dtype=np.float32))
    assert done.all() and all(info["episode"]["l"] == 2 and info["terminal_observation"].any() for info in infos)
    env.close()


PROGRAM = """
import gymnasium, numpy as np, signal, softgym_envs
signal.signal(signal.SIGINT, signal.default_int_handler)  # which shells take from processes in the background
env = gymnasium.make_vec("SoftGym/FingerReach-v0", 2, backend="fem")
env.reset(seed=0)
print(*(process.pid for process in env.unwrapped.processes), flush=True)
while True:
    env.step(np.zeros((2, 2), dtype=np.float32))
"""


def alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not os.path.isdir("/proc"), reason="needs /proc")
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_process_is_left_behind(end):
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as program:
        pids = [int(pid) for pid in program.stdout.readline().split()]
        assert len(pids) == 2 and all(map(alive, pids))
        os.killpg(program.pid, end) if end == signal.SIGINT else os.kill(program.pid, end)
        program.wait()
        wait_until(lambda: not any(map(alive, pids)))
        errors = program.stderr.read()
    assert errors.count("KeyboardInterrupt") <= (end == signal.SIGINT)
