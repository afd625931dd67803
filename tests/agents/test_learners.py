"""Learners other than SAC: what they learn, files, resumption, warm starts and what they refuse."""

import numpy as np
import pytest
import torch

from softgym_envs.agents.config import TrainConfig
from softgym_envs.agents.evaluation import evaluate, sample_goals
from softgym_envs.agents.learners import LEARNERS
from softgym_envs.agents.learners.ppo import PPOLearner
from softgym_envs.agents.policy import Policy, read_tensors, save_policy
from softgym_envs.agents.residual import BatchQP
from softgym_envs.agents.training import CHECKPOINT, _restore, train
from softgym_envs.errors import ConfigError, WeightsError
from softgym_envs.extensions.deployment.policy_onnx import exported_spaces
from softgym_envs.extensions.learners.analytic import AnalyticLearner
from softgym_envs.extensions.learners.cloning import CloningLearner
from softgym_envs.extensions.learners.evolution import EvolutionConfig, EvolutionLearner
from softgym_envs.extensions.learners.recurrent import RecurrentConfig, RecurrentLearner
from softgym_envs.extensions.modules.modular_arm import KINDS
from tests.agents.interruption import interrupted_at

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


def short(learner, **changes):
    """The configuration `SHORT` for another learner."""
    data = SHORT.model_dump()
    del data["analytic"]
    return TrainConfig.model_validate({**data, "learner": learner, **changes})


QUICK = {
    "analytic": SHORT,
    "cloning": short("cloning"),
    "ppo": short("ppo", ppo={"n_steps": 2, "n_epochs": 2}),
    "recurrent": short("recurrent", num_envs=1, recurrent={"gradient_steps": 1}),
    "evolution": short("evolution", num_envs=8, evolution={"net_arch": [3]}),
}


@pytest.mark.parametrize("name", QUICK)
def test_same_seed_same_policy_and_interruptions_change_nothing(name, tmp_path):
    config = QUICK[name]
    first = train(config, tmp_path / "first", progress=False).read_bytes()
    assert train(config, tmp_path / "again", progress=False).read_bytes() == first
    assert train(config.model_copy(update={"seed": 1}), tmp_path / "other", progress=False).read_bytes() != first
    with interrupted_at(LEARNERS[name], 512):
        train(config, tmp_path / "resumed", progress=False)
    torch.manual_seed(5)  # a new process would have other random states
    assert train(config, tmp_path / "resumed", progress=False).read_bytes() == first
    with pytest.raises(ConfigError, match="holds a training with learner"):
        train(short("sac", sac={"learning_starts": 100}), tmp_path / "resumed", progress=False)


def _without_plans(config):
    """Return a configuration whose learning does not depend on the number of steps."""
    learner = config.learner
    if learner == "evolution":
        return config
    options = config.settings
    changes = {"final_learning_rate": options.learning_rate}
    if hasattr(options, "lead"):
        changes["lead"] = 1e-9
    return config.model_copy(update={"settings": config.settings.model_copy(update=changes)})


@pytest.mark.parametrize("name", QUICK)
def test_an_extended_training_goes_on_from_its_last_state(name, tmp_path):
    long = _without_plans(QUICK[name])
    short = long.model_copy(update={"steps": 512})
    uninterrupted = train(long, tmp_path / "uninterrupted", progress=False)
    train(short, tmp_path / "extended", progress=False, keep_checkpoint=True)
    torch.manual_seed(5)  # a new process would have other random states
    extended = train(long, tmp_path / "extended", progress=False)
    assert extended.read_bytes() == uninterrupted.read_bytes()
    curves = [
        [(point["step"], point["mean_return"]) for point in Policy(path).card["curve"]]
        for path in (extended, uninterrupted)
    ]
    assert curves[0] == curves[1] and len(curves[0]) == 2


def test_rates_of_an_extended_training_are_those_of_the_new_number_of_steps(tmp_path):
    train(SHORT, tmp_path, progress=False, keep_checkpoint=True)
    longer = SHORT.model_copy(update={"steps": 2048})
    train(longer, tmp_path, progress=False, report=lambda step, outcome: step > 1024, keep_checkpoint=True)
    learner = AnalyticLearner(longer)
    _restore(learner, tmp_path / CHECKPOINT)
    learner._set_learning_rate()
    first, last = SHORT.settings.learning_rate, SHORT.settings.final_learning_rate
    expected = first + (last - first) * learner.step / 2048
    assert learner.step == 1536 and learner._optimiser.param_groups[0]["lr"] == pytest.approx(expected, rel=1e-9)
    learner.close()


def test_policy_of_ppo_is_its_mean_action_and_weights_return(tmp_path):
    config = QUICK["ppo"]
    path = train(config, tmp_path / "ppo", progress=False)
    learner = PPOLearner(config.model_copy(update={"seed": 7}))
    learner.load_weights(read_tensors(path), path)
    for name, values in learner.weights().items():
        assert (values == read_tensors(path)[name]).all()
    observation = np.random.default_rng(0).uniform(-1, 1, (6, 15)).astype(np.float32)
    expected, _ = learner.model.predict(observation, deterministic=True)
    assert np.abs(Policy(path)(observation) - expected).max() < 1e-5
    assert np.abs(expected).max() > 1e-3
    learner.close()


def test_evolution_finds_linear_policies_that_reach_goals():
    gains = []
    for seed in range(4):  # a single search may get stuck, and rounding, which depends on the processor, decides which
        updates = {"steps": 16_000, "num_envs": 16, "seed": seed, "settings": EvolutionConfig()}
        learner = EvolutionLearner(QUICK["evolution"].model_copy(update=updates))
        first = learner._episode(learner._unpacked(np.zeros((16, 32), dtype=np.float32)), lambda steps: None)
        assert np.ptp(first[0]) == 0.0 and first[1] == 50  # every candidate has the same goal
        learner.learn(learner.config.steps, lambda steps: None)
        assert learner.weights()["actor.mu.weight"].shape == (2, 15)
        last = learner._episode({name: np.stack([value] * 16) for name, value in learner.weights().items()}, print)
        gains.append(last[0].mean() / first[0].mean())
        learner.close()
    assert np.median(gains) > 2.0


def test_evolution_acts_as_its_policy_and_needs_a_generation(tmp_path):
    config = QUICK["evolution"]
    path = train(config, tmp_path / "evolution", progress=False)
    learner = EvolutionLearner(config)
    observation = learner._reset()
    assert (observation == observation[0]).all()
    seen = []
    monkey = learner.env.step

    def step(actions):
        seen.append(actions)
        return monkey(actions)

    learner.env.step = step
    tensors = read_tensors(path)
    learner._episode({name: np.stack([value] * 8) for name, value in tensors.items()}, lambda steps: None)
    assert np.abs(seen[0] - Policy(path)(observation)).max() < 1e-6
    learner.close()
    with pytest.raises(ValueError, match="num_envs = 3 is too small"):
        EvolutionLearner(config.model_copy(update={"num_envs": 3}))


def test_rates_fall_over_the_whole_training(tmp_path):
    learner = PPOLearner(QUICK["ppo"])
    learner.learn(512, lambda steps: None)
    assert learner.model.lr_schedule(0.3) == pytest.approx(0.5 * (1e-3 + 1e-4))
    learner.close()


def test_a_clone_does_what_the_qp_does():
    config = QUICK["cloning"].model_copy(update={"steps": 3200, "num_envs": 32})
    learner = CloningLearner(config)
    learner.learn(config.steps, lambda steps: None)
    env = learner.env
    observation, _ = env.reset(seed=9)
    errors, sizes = [], []
    for _ in range(10):
        action, answer = learner.policy(observation).detach().numpy(), BatchQP(env)()
        errors.append(np.abs(action - answer).mean())
        sizes.append(np.abs(answer).mean())
        observation, *_ = env.step(action)
    assert np.mean(errors) < 0.2 * np.mean(sizes)
    learner.close()


def test_a_memory_is_that_of_torch_and_learns_the_answers_of_the_qp(tmp_path):
    config = QUICK["recurrent"].model_copy(update={"settings": RecurrentConfig(gradient_steps=8, batch_size=8)})
    learner = RecurrentLearner(config)
    learner.learn(1, lambda steps: None)
    seen, answers = learner._observations[:1], learner._answers[0]

    def actions():
        with torch.no_grad():
            return torch.tanh(learner._mean(learner._unit(torch.from_numpy(seen))[0])).numpy()[0]

    first = np.abs(actions() - answers).mean()
    for _ in range(80):
        learner._imitate(np.zeros(4, dtype=np.int64))
    assert np.abs(actions() - answers).mean() < 0.5 * first

    path = tmp_path / "policy.safetensors"
    save_policy(path, learner.weights(), {"config": config.model_dump(mode="json")})
    policy = Policy(path)
    for act in (policy.begin(), policy.begin()):  # each episode begins without memory
        found = np.array([act(row) for row in seen[0]])
        np.testing.assert_allclose(found, actions(), atol=1e-5)
    together = policy.begin()
    np.testing.assert_allclose([together(np.stack([row, row]))[1] for row in seen[0]], found, atol=1e-6)
    with pytest.raises(ValueError, match="has a memory: call what begin"):
        policy(seen[0, 0])
    with pytest.raises(ValueError, match="has a memory and cannot be exported"):
        exported_spaces(policy)
    learner.close()
    with pytest.raises(ValueError, match="learner 'recurrent' needs num_envs = 1"):
        RecurrentLearner(config.model_copy(update={"num_envs": 2}))


def test_training_starts_from_a_policy_of_the_same_widths(trained, tmp_path):
    warm = train(SHORT, tmp_path / "warm", initial=trained, progress=False)
    goals = sample_goals(CONFIG.environment, 20, seed=5)
    assert evaluate(warm, CONFIG.environment, goals).success_rate >= 0.95
    narrow = SHORT.model_copy(update={"settings": SHORT.settings.model_copy(update={"net_arch": [16]})})
    with pytest.raises(WeightsError, match="same net_arch"):
        train(narrow, tmp_path / "narrow", initial=trained, progress=False)


def test_a_clone_learns_on_any_environment():
    """Structures of superelements are solved one by one; the network's answers come close to the QP's."""
    environment = {"id": "SoftGym/ModularReach-v0", "max_episode_steps": 8, "robot_options": {"cells": 2}}
    config = TrainConfig.model_validate(
        {
            "environment": {**environment, "sample_design": ["kind_1"], "design_in_observation": ["kind_1"]},
            "learner": "cloning",
            "cloning": {"net_arch": [32, 32], "gradient_steps": 40},
            "steps": 160,
            "num_envs": 4,
        }
    )
    learner = CloningLearner(config)
    answers, observations = learner._answers, learner._observations
    assert observations.shape[1] == 2 + 2 + 2 + 3 + 3 + 3 + len(KINDS) + 1
    learner.learn(config.steps, lambda steps: None)
    learned = learner.policy(observations[:160]).detach().numpy()
    assert 0.0 < np.abs(answers[:160]).mean()
    assert np.abs(learned - answers[:160]).mean() < 0.5 * np.abs(answers[:160]).mean()
    learner.close()


@pytest.mark.parametrize(
    ("learner", "environment"),
    [
        ("analytic", {"id": "SoftGym/FingerReach-v0", "backend": "fem"}),
        ("analytic", {"id": "SoftGym/FingerReach-v0", "residual_scale": 0.5}),
        ("cloning", {"id": "SoftGym/FingerReach-v0", "residual_scale": 0.5}),
    ],
)
def test_environments_without_a_model_are_refused(environment, learner, tmp_path):
    config = short(learner, environment=environment)
    with pytest.raises(ValueError, match=rf"learner '{learner}' needs environment\.backend = surrogate"):
        train(config, tmp_path / "new", progress=False)
    assert not (tmp_path / "new").exists()
