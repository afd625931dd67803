"""Joint training of body and policy."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest

from softgym_envs.agents.config import TrainConfig
from softgym_envs.agents.learners.sac import make_model
from softgym_envs.agents.training import train
from softgym_envs.agents.vec_env import SB3VecEnv
from softgym_envs.extensions.leaderboard.proposers import (
    PROPOSERS,
    CriticProposer,
    DistributionProposer,
    critic_values,
)

ENVIRONMENT = {
    "id": "SoftGym/FingerReach-v0",
    "sample_design": ["length", "height"],
    "design_in_observation": ["length", "height"],
}


def config(**changes):
    return TrainConfig.model_validate(
        {
            "environment": ENVIRONMENT,
            "steps": 480,
            "num_envs": 4,
            "evaluation_episodes": 2,
            "report_every": 240,
            "sac": {"net_arch": [16], "learning_starts": 100, "batch_size": 32, "gradient_steps": 1},
            **changes,
        }
    )


def proposer_of(kind):
    return PROPOSERS[kind](warmup=240, **({"batch": 2} if kind == "distribution" else {"candidates": 16}))


@pytest.fixture
def alone():
    """A distribution over two variables, without a training."""
    proposer = DistributionProposer(components=3, batch=16)
    proposer.size, proposer.names, proposer._warm = 2, ("a", "b"), True
    rng = np.random.default_rng(0)
    proposer.logits = np.zeros(3)
    proposer.means, proposer.spreads = rng.uniform(-0.5, 0.5, (3, 2)), np.full((3, 2), 0.5)
    return proposer


@pytest.mark.parametrize("target", [(0.6, -0.7), (-0.8, 0.1)])
def test_distribution_moves_to_the_better_bodies(alone, target, rng):
    for _ in range(1500):
        for body in alone.draw(rng, 1):
            alone.episode(body, -float(((body - target) ** 2).sum()))
    assert np.abs(alone.means[np.argmax(alone.weights)] - target).max() < 0.1
    assert alone.spreads[np.argmax(alone.weights)].max() < 0.2


def test_distribution_stays_where_no_body_is_better(alone, rng):
    """Ranks of pure noise have no direction: over many steps the mean wanders, but it stays in the box."""
    for _ in range(400):
        alone.episode(alone.draw(rng, 1)[0], float(rng.normal()))
    assert np.abs(alone.means).max() <= 1.0 and alone.weights.min() > 0.02


def test_an_episode_is_reported_with_its_own_body(tmp_path):
    told = []

    class Listener(CriticProposer):
        def episode(self, body, total):
            told.append((body, total))

    model = make_model(config())
    env = model.get_env()
    listener = Listener()
    listener.attach(model, config(), tmp_path)
    vector = env.env.unwrapped
    env.reset()
    space = vector.design_space
    wanted = []
    for step in range(120):
        before = vector.designs.copy()
        env.step_async(np.zeros((4, 2), dtype=np.float32))
        _, _, done, infos = env.step_wait()
        for i in np.flatnonzero(done):
            unit = [float(space[n].to_unit(before[i, space.names.index(n)])) for n in listener.names]
            wanted.append((unit, infos[i]["episode"]["r"]))
        assert step < 49 or wanted
    assert len(told) == len(wanted) == 8
    for (body, total), (unit, expected) in zip(told, wanted, strict=True):
        np.testing.assert_allclose(body, unit, atol=1e-9)
        assert total == pytest.approx(expected)
    assert len({tuple(body) for body, _ in told}) == 8
    env.close()


@pytest.mark.parametrize("kind", PROPOSERS)
def test_a_stopped_training_ends_as_an_uninterrupted_one(kind, tmp_path):
    train(config(), tmp_path / "whole", proposer=proposer_of(kind), progress=False)

    class Stop(Exception):
        pass

    def stop(step, outcome):
        raise Stop

    with pytest.raises(Stop):
        train(config(), tmp_path / "parts", proposer=proposer_of(kind), report=stop, progress=False)
    train(config(), tmp_path / "parts", proposer=proposer_of(kind), progress=False)
    whole, parts = (json.loads((tmp_path / name / "bodies.json").read_text()) for name in ("whole", "parts"))
    assert whole == parts
    assert whole["names"] == ["length", "height"]
    bodies = np.array(whole["bodies"])
    assert bodies.shape[1] == 2 and np.abs(bodies).max() <= 1.0


def test_critic_values_rank_bodies_as_the_critic_does(monkeypatch, tmp_path):
    """With a critic that only rewards length, values must not depend on the height."""

    model = make_model(config())
    names, bodies = ("length", "height"), np.array([[-0.5, 0.3], [0.5, 0.3], [0.5, -0.9]])
    monkeypatch.setattr(
        type(model.critic), "forward", lambda self, states, actions: (states[:, -2:-1], states[:, -2:-1] + 1.0)
    )
    values = critic_values(model, config().environment, names, bodies, goals=3)
    np.testing.assert_allclose(values, bodies[:, 0], atol=1e-6)
    model.get_env().close()


def test_needs_sampled_bodies(tmp_path):
    plain = config(environment={"id": "SoftGym/FingerReach-v0"})
    model = make_model(plain)
    with pytest.raises(ValueError, match="sample_design"):
        CriticProposer().attach(model, plain, tmp_path)
    assert isinstance(model.get_env(), SB3VecEnv)
    model.get_env().close()


def test_needs_a_batched_environment(tmp_path):
    grasp = config(environment={"id": "SoftGym/FingerGrasp-v0", "backend": "surrogate", "sample_design": ["e1"]})
    one_by_one: Any = SimpleNamespace(get_env=lambda: SimpleNamespace(env=gymnasium.make("SoftGym/FingerReach-v0")))
    with pytest.raises(ValueError, match="needs a batched environment, but SoftGym/FingerGrasp-v0 on backend"):
        CriticProposer().attach(one_by_one, grasp, tmp_path)
