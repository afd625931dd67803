"""Bodies of learned parts in torch: the same states as the environments of single bodies."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from softgym_envs.extensions.beams.robots.tetrapod import Tetrapod

torch = pytest.importorskip("torch")
from softgym_envs.extensions.gpu.environment import TorchVectorEnv  # noqa: E402

REACH = "SoftGym/TetrapodReach-v0"


class WeakTetrapod(Tetrapod):
    """Tetrapod with servos that soon saturate."""

    def __init__(self, **options) -> None:
        super().__init__(**options)
        self.actuators = tuple(replace(actuator, max_effort=0.035) for actuator in self.actuators)


@pytest.mark.parametrize("dynamics", [False, True], ids=["statics", "motion"])
@pytest.mark.parametrize("robot", [None, WeakTetrapod], ids=["strong", "weak"])
def test_tensors_follow_the_same_path(dynamics, robot):
    options = {"backend_options": {"dynamics": dynamics}, **({} if robot is None else {"robot": robot})}
    tensors = TorchVectorEnv(REACH, 2, device="cpu", dtype=torch.float64, **options)
    arrays = gymnasium.make_vec(REACH, 2, backend="surrogate", **options)
    other = {"curvature_1": 3.0, "leg_width": 0.016} if robot is None else {"servo_radius": 0.104}
    start = {"goal": np.array([0.01, 0.02, -0.14]), "design": [{}, other]}
    (shown, info), (expected, known) = tensors.reset(seed=0, options=start), arrays.reset(seed=0, options=start)
    rng, largest = np.random.default_rng(0), 0.0
    for _ in range(4):
        assert shown.numpy() == pytest.approx(expected, abs=1e-6)
        assert info["effort"].numpy() == pytest.approx(known["effort"], abs=1e-7)
        assert info["uncertainty"].numpy() == pytest.approx(known["uncertainty"], abs=1e-9)
        assert info["trusted"].tolist() == known["trusted"].tolist()
        actions = rng.uniform(-1.0, 1.0, (2, 4)).astype(np.float32)
        (shown, reward, *_, info), (expected, rated, *_, known) = tensors.step(actions), arrays.step(actions)
        assert reward.numpy() == pytest.approx(rated, abs=1e-6)
        assert info["converged"].all()
        largest = max(largest, float(info["effort"].abs().max()))
    if robot is not None:
        assert largest == pytest.approx(0.035)


def test_drawn_bodies_end_their_episodes_with_others():
    env = TorchVectorEnv(
        REACH, 3, device="cpu", max_episode_steps=2, sample_design=True, backend_options={"dynamics": False}
    )
    env.reset(seed=1)
    before = env.designs.clone()
    for _ in range(2):
        _, _, _, truncated, info = env.step(torch.zeros(3, 4))
    assert truncated.all() and "final_obs" in info
    assert not torch.equal(env.designs, before)


def test_parts_that_touch_are_refused():
    with pytest.raises(ValueError, match="learned parts touch nothing"):
        TorchVectorEnv(REACH, 1, device="cpu", robot_options={"self_contact": True})
