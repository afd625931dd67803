"""Grasp and Lift: rewards, ends of episodes, and the agents that control forces."""

import gymnasium
import numpy as np
import pytest

import softgym_envs
from softgym_envs import make_robot
from softgym_envs.agents.baselines import make_baseline
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.envs import SoftRobotEnv
from softgym_envs.envs.options import EnvironmentOptions, set_up
from softgym_envs.envs.tasks.registry import make_task
from softgym_envs.envs.vector_env import SoftRobotVectorEnv
from softgym_envs.errors import InfeasibleDesign, WeightsError
from softgym_envs.extensions.grasping.tasks.grasp import Grasp
from softgym_envs.extensions.grasping.tasks.lift import Lift

BACKENDS = pytest.mark.parametrize("backend", ["fem", "surrogate"])
COARSE = {"element": "linear", "mesh_size": 0.015}


def grasp(**options):
    return gymnasium.make("SoftGym/FingerGrasp-v0", backend="fem", robot_options=COARSE, **options)


def lift(backend, **options):
    coarse = {"robot_options": COARSE} if backend == "fem" else {}
    return gymnasium.make("SoftGym/GripperLift-v0", backend=backend, **coarse, **options)


def episode(env, agent, steps, **reset):
    observation, info = env.reset(**reset)
    infos = []
    for _ in range(steps):
        observation, _, terminated, truncated, info = env.step(agent(observation, env.unwrapped))
        infos.append(info)
        if terminated or truncated:
            break
    return infos


def test_reward_of_a_grasp_follows_its_formula():
    env = grasp()
    env.reset(seed=0, options={"goal": (2.0, 0.0, 0.0)})
    for _ in range(20):
        _, reward, _, _, info = env.step(np.ones(1, dtype=np.float32))
    state = env.unwrapped.state
    force, torque, angle = -state.contacts.total[0, 0], state.effort[0], state.displacement[0]
    assert force > 0.5 and angle == pytest.approx(np.radians(40.0))
    np.testing.assert_allclose(info["measured"], -state.contacts.total[0])
    error = abs(force - 2.0) / 2.0
    assert info["distance"] == pytest.approx(error)
    resistance = abs(torque) / np.linalg.norm([force])
    expected = {
        "force": 0.5 / (1.0 + 9.0 * (error / 0.05) ** 2) + 0.5 / (1.0 + 9.0 * error**2),
        "effort": 1.0 - 0.05 * min(1.0, abs(torque) / 0.3),
        "resistance": 1.0 - 0.1 * resistance / (resistance + 0.2),
        "energy": 1.0 - 0.1 * abs(torque) * angle / (1.2 * np.radians(40.0)),
    }
    assert {name: info[f"reward_{name}"] for name in expected} == pytest.approx(expected)
    assert reward == pytest.approx(np.prod(list(expected.values())))


def test_force_control_reaches_the_wanted_force():
    """On another object than the baseline, with the contact of the finite-element model."""
    env = gymnasium.make(
        "SoftGym/FingerGrasp-v0",
        backend="fem",
        robot_options=COARSE | {"object": "horizontal_hexagon"},
        design={"friction": 0.4, "object_gap": 0.020},
    )
    infos = episode(env, make_baseline("force"), 25, options={"goal": (0.8, 0.0, 0.0)})
    assert infos[-1]["is_success"] and infos[-1]["distance"] < 0.01
    assert infos[-1]["measured"][0] == pytest.approx(0.8, rel=0.01)


def test_force_control_on_the_learned_chain():
    """Goals of the default task, on bodies and objects that are drawn."""
    env = gymnasium.make("SoftGym/FingerGrasp-v0", backend="surrogate", sample_design=["object_gap", "friction"])
    for seed in range(3):
        infos = episode(env, make_baseline("force"), 25, seed=seed)
        assert infos[-1]["is_success"] and infos[-1]["distance"] < 0.01
        assert infos[-1]["trusted"] and infos[-1]["converged"]


def test_all_backends_have_the_same_mesh():
    for identifier in ("SoftGym/FingerGrasp-v0", "SoftGym/GripperLift-v0"):
        row = softgym_envs.ENVIRONMENTS[identifier]
        robot = make_robot(row.robot, **row.robot_options)
        assert row.backend == "surrogate" and getattr(robot, "finger", robot).mesh_size == 0.008
    # Whatever the default is, boxes fall: on finite elements too.
    options = EnvironmentOptions.check({"robot_options": COARSE, "defaults": row.defaults["defaults"]})
    assert set_up(row.robot, row.task, "fem", options).backend_options == {"dynamics": True, "time_step": 0.05}
    with pytest.raises(WeightsError, match="mesh_size = 0.008, needed 0.02"):
        gymnasium.make("SoftGym/FingerGrasp-v0", backend="surrogate", robot_options={"mesh_size": 0.020})


@BACKENDS
def test_a_box_that_is_left_behind_ends_the_episode(backend):
    env = lift(backend, design={"friction": 0.1, "object_mass": 0.5})
    infos = episode(env, make_baseline("close"), 30, seed=0, options={"goal": (0.0, 0.0, 0.035)})
    assert len(infos) < 30 and infos[-1]["is_failed"] and infos[-1]["converged"] and not infos[-1]["is_success"]
    assert not any(info["is_failed"] for info in infos[:-1])


@BACKENDS
def test_a_box_that_is_dropped_ends_the_episode(backend):
    env = lift(backend)
    hold = make_baseline("force")

    def drop(observation, unwrapped):
        if unwrapped.state.effector[0, 2] - 0.025 < 0.006 and not dropped:
            return hold(observation, unwrapped)
        dropped.append(True)
        return np.array([-1.0, -1.0, 0.0], dtype=np.float32)

    dropped: list[bool] = []
    infos = episode(env, drop, 30, seed=0, options={"goal": (0.0, 0.0, 0.033)})
    assert (
        dropped
        and len(infos) < 30
        and infos[-1]["is_failed"]
        and infos[-1]["reward_hold"] == pytest.approx(0.8, abs=0.01)
    )
    env.reset()
    assert not env.step(np.zeros(3, dtype=np.float32))[4]["is_failed"]  # the next episode begins anew


@BACKENDS
def test_force_control_lifts_the_box_and_holds_it(backend):
    env = lift(backend)
    infos = episode(env, make_baseline("force"), 30, seed=0, options={"goal": (0.0, 0.0, 0.033)})
    assert len(infos) == 30 and not infos[-1]["is_failed"]
    assert infos[-1]["is_success"] and infos[-1]["reward_hold"] == 1.0
    assert infos[0]["reward_hold"] == pytest.approx(0.8)


def test_agents_depend_on_the_task():
    assert Grasp.agents == Lift.agents == ("close", "force", "random")
    assert "qp" in make_task("carry", make_robot("finger")).agents


def test_infeasible_bodies_are_drawn_again(monkeypatch):
    env = grasp(sample_design=True)
    refused = []
    original = FEMBackend.reset

    def reset(self, design=None):
        if len(refused) < 3:
            refused.append(design)
            raise InfeasibleDesign("no")
        return original(self, design)

    monkeypatch.setattr(FEMBackend, "reset", reset)
    env.reset(seed=0)
    assert len(refused) == 3 and env.unwrapped.design not in refused
    monkeypatch.setattr(FEMBackend, "reset", lambda self, design=None: (_ for _ in ()).throw(InfeasibleDesign("never")))
    with pytest.raises(InfeasibleDesign, match="never"):
        env.reset(seed=0)


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        ("grasp", {"forces": (0.5, 0.1)}, "forces = .* N must be positive"),
        ("grasp", {"forces": (0.0, 0.1)}, "forces"),
        ("grasp", {"tolerance": 0.0}, "tolerance = 0.0 must be positive"),
        ("grasp", {"resistance": -1.0}, "resistance = -1.0 m"),
        ("lift", {}, "needs a robot that lifts; robot 'grasping_finger' does not"),
    ],
    ids=str,
)
def test_wrong_options_of_the_tasks(task, options, message):
    with pytest.raises(ValueError, match=message):
        make_task(task, make_robot("grasping_finger"), **options)


def test_wrong_heights_of_the_lift():
    with pytest.raises(ValueError, match="heights = .* m must be in increasing order"):
        make_task("lift", make_robot("contact_aided_gripper"), heights=(0.02, 0.01))


def test_goals_of_a_grasp_are_forces():
    task = make_task("grasp", make_robot("grasping_finger"))
    assert task.check_paths((0.3, 0.0, 0.0)).shape == (1, 3)
    for wrong in ((-0.3, 0.0, 0.0), (np.nan, 0.0, 0.0), (0.3, 0.0)):
        with pytest.raises(ValueError, match=r"goal must be a force \(F, 0, 0\) \[N\]"):
            task.check_paths(wrong)


def test_a_grasp_needs_contacts():
    with pytest.raises(ValueError, match="task 'grasp' needs contacts, but robot 'finger' touches nothing"):
        SoftRobotEnv("finger", "grasp", backend="fem").reset(seed=0)


def test_batches_step_tasks_that_read_states_row_by_row():
    batch = SoftRobotVectorEnv("grasping_finger", "grasp", 2, backend="surrogate")
    singles = [SoftRobotEnv("grasping_finger", "grasp", backend="surrogate") for _ in range(2)]
    observation, info = batch.reset(seed=6)
    for k, env in enumerate(singles):
        assert (env.reset(seed=6 + k)[0] == observation[k]).all()
    for _ in range(3):
        observation, reward, terminated, _, info = batch.step(np.ones((2, 1)))
        for k, env in enumerate(singles):
            expected, value, failed, _, alone = env.step(np.ones(1))
            np.testing.assert_allclose(observation[k], expected, atol=1e-6)
            assert reward[k] == pytest.approx(value, abs=1e-9) and terminated[k] == failed
            np.testing.assert_allclose(info["contact_force"][k], alone["contact_force"], atol=1e-9)
            assert info["reward_energy"][k] == pytest.approx(alone["reward_energy"])
