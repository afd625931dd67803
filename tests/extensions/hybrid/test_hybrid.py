"""The hybrid backend: which model answers when, how states pass between both, and what is learned between episodes."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import gymnasium
import numpy as np
import pytest

import softgym_envs  # noqa: F401  (registers the environments)
from softgym_envs import make_robot
from softgym_envs.backends import make_backend
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.backends.surrogate import SurrogateBackend, SurrogateBatch
from softgym_envs.errors import ConvergenceError, DataError, WeightsError
from softgym_envs.extensions.hybrid.backend import HybridBackend
from tests.helpers import train_small_surrogate

LIMIT = 8e-3  # largest displacement in the training of `weights` [m]


@pytest.fixture(scope="module")
def fem(robot):
    return FEMBackend(robot)


def assert_same(a, b):
    for name in ("command", "displacement", "effort", "effector", "slack"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-9, err_msg=name)


def test_no_finite_elements_are_built_while_the_surrogate_is_trusted(robot, weights, monkeypatch):
    monkeypatch.setattr(robot, "build", lambda design=None: pytest.fail("the body was built"), raising=False)
    backend = HybridBackend(robot, weights=weights)
    surrogate = SurrogateBackend(robot, weights=weights)
    for command in (0.002, 0.005, 0.0077):
        state, expected = backend.step(np.array([command])), surrogate.step(np.array([command]))
        assert state.trusted and state.nodes is None
        np.testing.assert_array_equal(state.effector, expected.effector)
    backend.reset()
    assert (backend.calls, backend.fem_calls) == (3, 0)


def test_finite_elements_answer_where_the_surrogate_is_not_trusted(robot, weights, fem):
    backend = HybridBackend(robot, weights=weights)
    fem.reset()
    state, expected = backend.step(np.array([0.015])), fem.step(np.array([0.015]))
    np.testing.assert_allclose(state.effector, expected.effector, atol=1e-7)
    np.testing.assert_allclose(state.condensed.compliance, expected.condensed.compliance, rtol=1e-4)
    assert state.trusted and state.uncertainty == 0.0 and state.nodes is not None
    assert backend.fem_calls == 2  # the body at rest, and this state
    assert_same(backend.step(np.array([0.015])), state)  # holding the command needs no new solution
    nearby, expected = backend.step(np.array([0.015015])), fem.step(np.array([0.015015]))
    assert backend.fem_calls == 2
    np.testing.assert_allclose(nearby.effector, expected.effector, atol=2e-7)
    np.testing.assert_allclose(nearby.effort, expected.effort, rtol=1e-5)
    assert nearby.displacement == pytest.approx(0.015015) and not nearby.slack.any()
    back = backend.step(np.array([0.004]))
    assert back.nodes is None and back.slack.tolist() == [False]
    np.testing.assert_allclose(back.effector, fem.step(np.array([0.004])).effector, atol=3e-4)
    again = backend.step(np.array([0.016]))
    np.testing.assert_allclose(again.effector, fem.step(np.array([0.016])).effector, atol=1e-7)
    assert (backend.calls, backend.fem_calls, backend.tangent_calls) == (5, 3, 2)


def test_states_of_a_body_are_kept_once(robot, weights, tmp_path):
    def episodes(backend):
        for _ in range(2):
            for command in (0.012, 0.015):
                backend.step(np.array([command]))
            backend.reset()
        return backend._store.count

    assert episodes(HybridBackend(robot, weights=weights, folder=tmp_path, retrain_after=0)) == 2
    again = HybridBackend(robot, weights=weights, folder=tmp_path, retrain_after=0)
    assert episodes(again) == 2
    again.reset({"length": 0.0405})
    assert episodes(again) == 4


def test_probe_and_restore_work_for_both_models(robot, weights):
    backend = HybridBackend(robot, weights=weights)
    near = backend.step(np.array([0.005]))
    far = backend.probe(np.array([0.016]))
    assert backend.state is near and far.nodes is not None
    backend.restore(far)
    assert backend.state is far
    assert backend.probe(np.array([0.006])).nodes is None and backend.state is far
    backend.restore(near)
    np.testing.assert_allclose(backend.step(np.array([0.016])).effector, far.effector, atol=1e-7)


def test_efforts(robot, weights, fem):
    backend = HybridBackend(robot, weights=weights)
    fem.reset()
    strong, weak = fem.step(np.array([0.015])).effort, fem.step(np.array([0.005])).effort
    assert np.abs(backend.step(weak, "effort").displacement - 0.005).max() < 1e-4 and backend.fem_calls == 0
    state = backend.step(strong, "effort")
    assert state.nodes is not None and np.abs(state.displacement - 0.015).max() < 1e-6
    calls = backend.fem_calls
    nearby, expected = backend.step(1.0005 * strong, "effort"), fem.step(1.0005 * strong, "effort")
    assert backend.fem_calls == calls and not nearby.slack.any()
    np.testing.assert_allclose(nearby.displacement, expected.displacement, atol=1e-8)
    with pytest.raises(ValueError, match="negative"):
        backend.step(-strong, "effort")


def test_slack_cables_across_both_models(weights, tmp_path):
    """Two cables on weights that were not trained for them: only finite elements and their condensed models answer."""
    robot = make_robot("finger")
    folder = tmp_path / "weights"
    train_small_surrogate(folder, robot, limit=0.002, states=6, members=2, width=8, steps=4)
    backend, fem = HybridBackend(robot, weights=folder, tolerance=1e-9), FEMBackend(robot)
    for command in ([0.015, 0.0], [0.015005, 0.0], [0.015005, 1e-5]):
        state, expected = backend.step(np.array(command)), fem.step(np.array(command))
        assert state.slack.tolist() == expected.slack.tolist() == [False, True]
        np.testing.assert_allclose(state.displacement, expected.displacement, atol=1e-7)
        np.testing.assert_allclose(state.effector, expected.effector, atol=1e-7)
        np.testing.assert_allclose(state.effort, expected.effort, rtol=1e-4, atol=1e-6)
    assert (backend.calls, backend.fem_calls) == (3, 2)


def test_finite_elements_answer_for_an_unknown_body(robot, weights):
    backend = HybridBackend(robot, weights=weights)
    state = backend.reset({"length": 0.041})
    assert state.nodes is not None and backend.fem_calls == 1
    np.testing.assert_allclose(state.effector, FEMBackend(robot, {"length": 0.041}).state.effector, atol=1e-9)
    assert backend.step(np.array([0.003])).nodes is not None
    assert backend.reset({}).nodes is None
    # The stiffness only scales efforts, so this body is in the domain.
    assert backend.reset({"young_modulus": 5e6}).nodes is None


def test_a_failed_step_keeps_the_state(robot, weights, monkeypatch):
    backend = HybridBackend(robot, weights=weights)
    kept = backend.step(np.array([0.012]))

    def fail(*arguments, **options):
        raise ConvergenceError("no")

    monkeypatch.setattr(backend._fem, "step", fail)
    with pytest.raises(ConvergenceError):
        backend.step(np.array([0.019]))
    assert backend.state is kept


def test_it_learns_between_episodes_and_resumes_from_its_folder(robot, weights, fem, tmp_path):
    options = {"weights": weights, "folder": tmp_path, "retrain_after": 20, "steps": 200}
    backend = HybridBackend(robot, **options)
    commands = np.linspace(0.0085, 0.015, 25)[:, None]
    first = backend.model
    for command in commands:
        assert backend.step(command).nodes is not None
    assert backend.model is first  # within an episode the physics does not change
    assert len(list(tmp_path.glob("states_*.npz"))) == 2  # an interruption would not lose these
    backend.reset()
    assert backend.retrainings == 1 and backend.retraining_seconds > 0.0
    before = backend.fem_calls
    for command in commands[2:-2]:
        state = backend.step(command)
        assert state.uncertainty < 2e-4
    saved = 1.0 - (backend.fem_calls - before) / len(commands[2:-2])
    assert saved > 0.7
    fem.reset()
    middle = fem.step(np.array([0.0118]))
    np.testing.assert_allclose(backend.step(np.array([0.0118])).effector, middle.effector, atol=5e-4)
    assert not SurrogateBackend(robot, weights=weights).step(np.array([0.0118])).trusted
    # Weights that learned are ordinary weights.
    assert SurrogateBackend(robot, weights=tmp_path / "weights").step(np.array([0.0118])).nodes is None
    resumed = HybridBackend(robot, **options)
    assert resumed.retrainings == 0
    assert all(np.array_equal(resumed.model.tensors[k], v) for k, v in backend.model.tensors.items())
    # With other options the kept states are learned again immediately.
    assert HybridBackend(robot, **{**options, "steps": 3}).retrainings == 1
    with pytest.raises(DataError, match="another robot"):
        HybridBackend(make_robot("finger", cables=1, mesh_size=0.01), weights=weights, folder=tmp_path)


def test_environment(weights, tmp_path):
    options = {"weights": str(weights), "folder": str(tmp_path), "retrain_after": 0}
    env = gymnasium.make(
        "SoftGym/FingerReach-v0", backend="hybrid", robot_options={"cables": 1}, backend_options=options
    )
    env.reset(seed=0, options={"goal": np.array([0.0, 0.05, -0.09])})
    for _ in range(12):
        *_, info = env.step(np.ones(1, dtype=np.float32))
    backend = env.unwrapped.backend
    assert info["trusted"] and info["uncertainty"] == 0.0
    assert backend.calls == 12 and backend.fem_calls > 2
    env.reset(seed=1)
    assert backend.retrainings == 0 and list(tmp_path.glob("states_*.npz"))
    env.close()


@pytest.mark.parametrize("calibrated", [False, True])
def test_the_limit_of_calibrated_weights_is_not_raised(robot, weights, tmp_path, calibrated):
    folder = shutil.copytree(weights, tmp_path / "weights")
    card = json.loads((folder / "model.json").read_text())
    card["domain"] |= {"limit": 1e-7} | ({"calibration": {"faces": 1.5}} if calibrated else {})
    (folder / "model.json").write_text(json.dumps(card))
    expected = 1e-7 if calibrated else 0.1 * robot.goal_tolerance
    assert HybridBackend(robot, weights=folder).model.domain.limit == expected
    assert HybridBackend(robot, weights=folder, tolerance=3e-4).model.domain.limit == 3e-4


def test_finite_elements_answer_where_an_actuator_is_too_weak(robot, weights):
    """The learned model does not know largest efforts; alone, it is refused."""
    full = SurrogateBackend(robot, weights=weights).step(np.array([0.005])).effort[0]
    weak = make_robot("finger", cables=1)
    weak.actuators = (replace(robot.actuators[0], max_effort=0.5 * full),)
    backend, fem = HybridBackend(weak, weights=weights), FEMBackend(weak)
    assert backend.step(np.array([0.001])).nodes is None
    state = backend.step(np.array([0.005]))
    np.testing.assert_allclose(state.effort, 0.5 * full, rtol=1e-6)
    np.testing.assert_allclose(state.displacement, fem.step(np.array([0.005])).displacement, rtol=1e-4)
    with pytest.raises(WeightsError, match=r"beyond their max_effort \(\w+\); use backend='fem' or 'hybrid'"):
        SurrogateBackend(weak, weights=weights)
    with pytest.raises(WeightsError, match="beyond their max_effort"):
        SurrogateBatch(weak, weak.design_space.baseline.array[None], weights=weights)


def test_errors(robot, weights):
    with pytest.raises(ValueError, match="retrain_after = -1"):
        make_backend("hybrid", robot, weights=weights, retrain_after=-1)
    with pytest.raises(ValueError, match=r"steps = 1\.5"):
        make_backend("hybrid", robot, weights=weights, steps=1.5)
    with pytest.raises(ValueError, match="tolerance"):
        make_backend("hybrid", robot, weights=weights, tolerance=0.0)
    with pytest.raises(WeightsError, match="2 or more"):
        make_backend("hybrid", robot, weights=weights, members=1)
    backend = make_backend("hybrid", robot, weights=weights)
    with pytest.raises(ValueError, match="force = .*fem"):
        backend.step(np.array([0.001]), force=np.ones(3))
    with pytest.raises(ValueError, match="finite"):
        backend.step(np.array([np.nan]))
    with pytest.raises(ValueError, match="mode"):
        backend.step(np.array([0.001]), mode="magic")
    assert backend.calls == 0
