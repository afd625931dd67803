"""Learners other than SAC: what they learn, files, resumption, warm starts and what they refuse."""

import numpy as np
import pytest
import torch

from agents.config import TrainConfig
from agents.evaluation import evaluate, sample_goals
from agents.learners.analytic import AnalyticLearner
from agents.policy import Policy, read_tensors
from agents.training import train
from softgym_envs.errors import DataError, WeightsError

CONFIG = TrainConfig.model_validate(
    {
        "environment": {"id": "SoftGym/FingerReach-v0"},
        "learner": "analytic",
        "steps": 40_960,
        "num_envs": 128,
        "evaluation_episodes": 5,
        "report_every": 20_480,
    }
)
SHORT = CONFIG.model_copy(update={"steps": 1024, "report_every": 512})


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return train(CONFIG, tmp_path_factory.mktemp("analytic"), progress=False)


def test_a_second_of_training_reaches_unseen_goals(trained):
    goals = sample_goals(CONFIG.environment, 60, seed=5)
    outcome = evaluate(trained, CONFIG.environment, goals)
    assert outcome.success_rate >= 0.95
    card = Policy(trained).card
    assert card["config"]["learner"] == "analytic" and card["curve"][-1]["learning_seconds"] > 0.0


def test_policy_is_the_network_of_the_learner(trained):
    learner = AnalyticLearner(CONFIG)
    learner.load_weights(read_tensors(trained), trained)
    observation = np.random.default_rng(0).uniform(-1, 1, (6, 15)).astype(np.float32)
    with torch.no_grad():
        expected = torch.tanh(learner._network(torch.from_numpy(observation))).numpy()
    assert np.abs(Policy(trained)(observation) - expected).max() < 1e-5
    learner.close()


def test_an_untrained_policy_keeps_still():
    learner = AnalyticLearner(CONFIG)
    assert (learner.weights()["actor.mu.weight"] == 0.0).all()
    learner.close()


def test_same_seed_same_policy_and_interruptions_change_nothing(tmp_path, monkeypatch):
    first = train(SHORT, tmp_path / "first", progress=False).read_bytes()
    assert train(SHORT, tmp_path / "again", progress=False).read_bytes() == first
    assert train(SHORT.model_copy(update={"seed": 1}), tmp_path / "other", progress=False).read_bytes() != first
    original = AnalyticLearner.learn

    def stop(learner, target, progress):
        if learner.step >= 512:
            raise KeyboardInterrupt
        original(learner, target, progress)

    with monkeypatch.context() as patch:
        patch.setattr(AnalyticLearner, "learn", stop)
        with pytest.raises(KeyboardInterrupt):
            train(SHORT, tmp_path / "resumed", progress=False)
    assert train(SHORT, tmp_path / "resumed", progress=False).read_bytes() == first
    with pytest.raises(DataError, match="learner"):
        train(SHORT.model_copy(update={"learner": "sac"}), tmp_path / "resumed", progress=False)


def test_training_starts_from_a_policy_of_the_same_widths(trained, tmp_path):
    warm = train(SHORT, tmp_path / "warm", initial=trained, progress=False)
    goals = sample_goals(CONFIG.environment, 20, seed=5)
    assert evaluate(warm, CONFIG.environment, goals).success_rate >= 0.95
    narrow = SHORT.model_copy(update={"analytic": SHORT.analytic.model_copy(update={"net_arch": [16]})})
    with pytest.raises(WeightsError, match="same net_arch"):
        train(narrow, tmp_path / "narrow", initial=trained, progress=False)


@pytest.mark.parametrize(
    "environment",
    [{"id": "SoftGym/FingerReach-v0", "backend": "fem"}, {"id": "SoftGym/FingerReach-v0", "residual_scale": 0.5}],
)
def test_environments_without_derivatives_are_refused(environment, tmp_path):
    config = TrainConfig.model_validate({**SHORT.model_dump(), "environment": environment})
    with pytest.raises(ValueError, match=r"learner 'analytic' needs environment\.backend = surrogate"):
        train(config, tmp_path / "new", progress=False)
    assert not (tmp_path / "new").exists()
