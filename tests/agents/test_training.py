"""SAC training: files, resumption, warm start and damaged policies."""

import csv
import json
import resource
import time
from dataclasses import replace

import numpy as np
import pytest
from safetensors import safe_open

from softgym_envs.agents import training
from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.agents.evaluation import evaluate, sample_goals
from softgym_envs.agents.learners.sac import SACLearner
from softgym_envs.agents.policy import Policy
from softgym_envs.agents.training import train
from softgym_envs.config import load_config, shipped_configs
from softgym_envs.envs.parallel import cpu_seconds
from softgym_envs.errors import ConfigError, DataError, WeightsError
from softgym_envs.extensions.learners.cloning import CloningConfig, CloningLearner
from softgym_envs.storage import read_json, write_signed
from tests.agents.interruption import interrupted_at

CONFIG = TrainConfig.model_validate(
    {
        "environment": {"id": "SoftGym/FingerReach-v0"},
        "sac": {"net_arch": [16, 16], "batch_size": 32, "learning_starts": 64, "gradient_steps": 1},
        "steps": 400,
        "num_envs": 8,
        "evaluation_episodes": 5,
        "report_every": 200,
    }
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("train")
    return train(CONFIG, folder, progress=False)


def test_training_leaves_policy_curve_logs_and_provenance(trained):
    folder = trained.parent
    assert trained.name == "policy.safetensors"
    names = {p.name for p in folder.iterdir()}
    assert names == {
        "policy.safetensors",
        "policy.json",
        "curve.csv",
        "config.yaml",
        "provenance.json",
        "tensorboard",
        "locks",
    }
    with open(folder / "curve.csv") as stream:
        rows = list(csv.DictReader(stream))
    assert [int(r["step"]) for r in rows] == [200, 400]
    card = json.loads((folder / "policy.json").read_text())
    assert card["config"]["seed"] == 0 and card["steps"] == 400 and card["provenance"]["versions"]["torch"]
    assert list((folder / "tensorboard").iterdir())


def test_policy_is_the_mean_action_of_the_actor(trained, tmp_path):
    import torch

    learner = SACLearner(CONFIG)
    learner.load_weights(training.read_tensors(trained), trained)
    model = learner.model
    observation = np.random.default_rng(0).uniform(-1, 1, (6, 15)).astype(np.float32)
    with torch.no_grad():
        expected = model.policy._predict(torch.as_tensor(observation), deterministic=True).numpy()
    assert np.abs(Policy(trained)(observation) - expected).max() < 1e-5


def test_same_seed_same_policy(trained, tmp_path):
    again = train(CONFIG, tmp_path / "again", progress=False)
    assert again.read_bytes() == trained.read_bytes()
    other = train(CONFIG.model_copy(update={"seed": 1}), tmp_path / "other", progress=False)
    assert other.read_bytes() != trained.read_bytes()


@pytest.mark.parametrize("hindsight", [0.0, 0.8])
def test_interrupted_training_ends_as_an_uninterrupted_one(hindsight, tmp_path, monkeypatch):
    # 200 steps of 8 environments end in the middle of episodes.
    config = CONFIG.model_copy(update={"settings": CONFIG.settings.model_copy(update={"hindsight": hindsight})})
    uninterrupted = train(config, tmp_path / "uninterrupted", progress=False).read_bytes()
    folder = tmp_path / "interrupted"
    original = SACLearner.learn
    reached = []

    def learn(learner, target, progress):
        if learner.step >= 200 and not reached:
            reached.append(learner.step)
            raise KeyboardInterrupt
        original(learner, target, progress)

    monkeypatch.setattr(SACLearner, "learn", learn)
    with pytest.raises(KeyboardInterrupt):
        train(config, folder, progress=False)
    assert (folder / "checkpoint.safetensors").exists() and not (folder / "policy.safetensors").exists()
    with safe_open(folder / "checkpoint.safetensors", framework="numpy") as opened:
        spent = json.loads(opened.metadata()["training"])["cpu_seconds"]
    steps = []
    began = time.process_time()
    monkeypatch.setattr(
        SACLearner,
        "learn",
        lambda learner, target, progress: (steps.append(learner.step), original(learner, target, progress)),
    )
    train(config, folder, progress=False)
    own = time.process_time() - began
    assert steps == [200]  # continued from the checkpoint
    card = json.loads((folder / "policy.json").read_text())
    assert spent < card["cpu_seconds"] <= spent + own + 0.01  # of both processes
    with open(folder / "curve.csv") as stream:
        assert [int(r["step"]) for r in csv.DictReader(stream)] == [200, 400]
    assert (folder / "policy.safetensors").read_bytes() == uninterrupted
    before = (folder / "policy.safetensors").stat().st_mtime_ns
    train(config, folder, progress=False)
    assert (folder / "policy.safetensors").stat().st_mtime_ns == before  # a finished training is not repeated


def test_a_report_lost_with_its_process_is_repeated(trained, tmp_path):
    seen = []

    def report(step, outcome):
        seen.append((step, outcome.to_json()))
        if len(seen) == 1:
            raise KeyboardInterrupt
        return False

    with pytest.raises(KeyboardInterrupt):
        train(CONFIG, tmp_path, progress=False, report=report)
    policy = train(CONFIG, tmp_path, progress=False, report=report)
    assert [step for step, _ in seen] == [200, 200, 400] and seen[0] == seen[1] != seen[2]
    assert policy.read_bytes() == trained.read_bytes()


def test_a_training_that_should_stop_stops_on_resuming(tmp_path, monkeypatch):
    def lost(step, outcome):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(CONFIG, tmp_path, progress=False, report=lost)
    monkeypatch.setattr(SACLearner, "learn", lambda *_: pytest.fail("went on"))
    card = Policy(train(CONFIG, tmp_path, progress=False, report=lambda step, outcome: True)).card
    assert card["stopped_early"] and card["steps"] == 200


def test_damaged_checkpoint_is_named(tmp_path):
    with interrupted_at(SACLearner, 200):
        train(CONFIG, tmp_path, progress=False)
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(WeightsError, match=r"checkpoint\.safetensors.*damaged"):
        train(CONFIG, tmp_path, progress=False)


def test_a_folder_of_another_configuration_is_refused(trained):
    shown = CONFIG.environment.model_copy(update={"robot_options": {"cables": 1}})
    with pytest.raises(
        ConfigError, match=r"environment\.robot_options = \{\}, got \{'cables': 1\}.*change only: steps"
    ):
        train(CONFIG.model_copy(update={"environment": shown}), trained.parent, progress=False)


def test_a_training_that_cannot_be_extended_is_refused_and_left_as_it_is(trained):
    before = {path.name: path.read_bytes() for path in trained.parent.iterdir() if path.is_file()}
    with pytest.raises(DataError, match=r"of 400 steps, got steps = 300.*steps = 400 or more"):
        train(CONFIG.model_copy(update={"steps": 300}), trained.parent, progress=False)
    with pytest.raises(DataError, match=r"of 400 steps without 'checkpoint\.safetensors'.*to 800.*--initial"):
        train(CONFIG.model_copy(update={"steps": 800}), trained.parent, progress=False)
    assert before == {path.name: path.read_bytes() for path in trained.parent.iterdir() if path.is_file()}


LONG = CONFIG.model_copy(
    update={
        "steps": 600,
        "settings": CONFIG.settings.model_copy(update={"final_learning_rate": 1e-3, "hindsight": 0.8}),
    }
)
"""Its learning rate does not depend on the number of steps."""


@pytest.mark.parametrize("first", [200, 204])
def test_an_extended_training_goes_on_with_its_replay_buffer(first, tmp_path):
    """204 steps end after 208, which fill the buffer of the first training to the last row."""
    short = LONG.model_copy(update={"steps": first, "report_every": 208 if first == 204 else 200})
    long = short.model_copy(update={"steps": 624 if first == 204 else 600})
    uninterrupted = train(long, tmp_path / "uninterrupted", progress=False)
    folder = tmp_path / "extended"
    train(short, folder, progress=False, keep_checkpoint=True)
    assert train(long, folder, progress=False).read_bytes() == uninterrupted.read_bytes()


def test_an_interrupted_extension_keeps_the_policy_and_ends_as_an_uninterrupted_one(tmp_path):
    short = LONG.model_copy(update={"steps": 200})
    uninterrupted = train(LONG, tmp_path / "uninterrupted", progress=False).read_bytes()
    folder = tmp_path / "extended"
    policy = train(short, folder, progress=False, keep_checkpoint=True)
    before = policy.read_bytes()
    with interrupted_at(SACLearner, 400):
        train(LONG, folder, progress=False, keep_checkpoint=True)
    assert policy.read_bytes() == before and Policy(policy).card["steps"] == 200
    assert train(LONG, folder, progress=False).read_bytes() == uninterrupted
    assert load_config(folder / "config.yaml", TrainConfig) == LONG
    (extension,) = Policy(policy).card["extensions"]
    assert extension == json.loads((folder / "provenance.json").read_text())["extensions"][0]
    assert [extension[key] for key in ("from_steps", "to_steps", "at_step")] == [200, 600, 200]
    with open(folder / "curve.csv") as stream:
        assert [int(row["step"]) for row in csv.DictReader(stream)] == [200, 400, 600]


def test_a_training_that_other_code_continues_says_so(tmp_path, capfd):
    config = CONFIG.model_copy(
        update={"learner": "cloning", "settings": CloningConfig(), "steps": 16, "report_every": 8}
    )
    with interrupted_at(CloningLearner, 8):
        train(config, tmp_path, progress=False)
    path = tmp_path / "provenance.json"
    begun = json.loads(path.read_text())
    begun["versions"]["softgym-envs"] = "0.0.1"
    write_signed(path, begun)
    policy = train(config, tmp_path)
    assert capfd.readouterr().out.count("was begun with softgym-envs 0.0.1; continued with softgym-envs ") == 1
    assert len(Policy(policy).card["continued"]) == 1


def test_an_extension_with_too_many_steps_is_shortened(tmp_path):
    short, typo = (LONG.model_copy(update={"steps": steps}) for steps in (200, 60_000))
    uninterrupted = train(LONG, tmp_path / "uninterrupted", progress=False).read_bytes()
    folder = tmp_path / "extended"
    policy = train(short, folder, progress=False, keep_checkpoint=True)
    before = policy.read_bytes()
    with interrupted_at(SACLearner, 400):
        train(typo, folder, progress=False, keep_checkpoint=True)
    with pytest.raises(DataError, match=r"has made 400 of 60000 steps, got steps = 300; .* steps = 400 or more"):
        train(LONG.model_copy(update={"steps": 300}), folder, progress=False)
    assert train(short, folder, progress=False) == policy and policy.read_bytes() == before  # finished before
    with pytest.raises(DataError, match="holds a finished training of 200 steps, got steps = 100"):
        train(LONG.model_copy(update={"steps": 100}), folder, progress=False)
    assert train(LONG, folder, progress=False).read_bytes() == uninterrupted
    changes = Policy(policy).card["extensions"]
    assert [[each[key] for key in ("from_steps", "to_steps", "at_step")] for each in changes] == [
        [200, 60_000, 200],
        [60_000, 600, 400],
    ]


def test_a_training_ends_where_it_stands(tmp_path):
    with interrupted_at(SACLearner, 200):
        train(LONG, tmp_path, progress=False)
    assert Policy(train(LONG.model_copy(update={"steps": 200}), tmp_path, progress=False)).card["steps"] == 200


def test_a_damaged_configuration_of_a_folder_is_named(tmp_path):
    (tmp_path / "config.yaml").write_text("steps: [1, 2")
    with pytest.raises(DataError, match=r"config\.yaml' is damaged .* line 1, column 8.*; restore it from a copy"):
        train(CONFIG, tmp_path, progress=False)


@pytest.mark.parametrize("option", [{"backend": "foo"}, {"action_mode": "foo"}, {"task_options": {"foo": 1}}])
def test_a_wrong_environment_creates_no_folder(option, tmp_path):
    environment = CONFIG.environment.model_copy(update=option)
    with pytest.raises(ValueError, match="foo"):
        train(CONFIG.model_copy(update={"environment": environment}), tmp_path / "run", progress=False)
    assert not (tmp_path / "run").exists()


def test_a_training_that_would_learn_nothing_is_refused():
    with pytest.raises(ValueError, match=r"sac\.learning_starts = 1000 must be below steps = 1000.*allowed: 0 to 999"):
        TrainConfig.model_validate({"environment": {"id": "SoftGym/FingerReach-v0"}, "steps": 1000})


OTHER = {
    "residual_scale": ({"residual_scale": 0.5}, r"environment\.residual_scale = 0\.5 .*trained with 0\.0"),
    "action_mode": ({"action_mode": "absolute"}, r"environment\.action_mode = absolute .*trained with increment"),
    "order of the body": (
        {"design_in_observation": ["height", "length", "joint_height"]},
        r"design_in_observation = \['height', 'length', 'joint_height'\] .*\['length', 'height', 'joint_height'\]",
    ),
    "task": ({"id": "SoftGym/FingerTrack-v0"}, r"environment\.id = SoftGym/FingerTrack-v0 .*task track.*task reach"),
    "robot": (
        {"id": "SoftGym/DiamondReach-v0", "design_in_observation": False},
        r"environment\.id = .*robot diamond.*robot finger",
    ),
    "cables": ({"robot_options": {"cables": 1}}, r"environment\.robot_options = \{'cables': 1\} .*trained with \{\}"),
}


@pytest.mark.parametrize("name", OTHER)
def test_a_policy_refuses_an_environment_it_was_not_trained_for(name, tmp_path):
    changes, message = OTHER[name]
    bodies = ["length", "height", "joint_height"]
    known = {"id": "SoftGym/FingerReach-v0", "design_in_observation": bodies}
    environment = EnvironmentConfig.model_validate({**known, **changes})
    goals = np.array([[0.0, 0.066, -0.072]])
    with pytest.raises(ConfigError, match=message):
        evaluate("finger_reach_designs", environment, goals)
    if name == "task":
        return  # a training may start from it
    with pytest.raises(ConfigError, match=message):
        wide = CONFIG.settings.model_copy(update={"net_arch": [128, 128]})
        config = CONFIG.model_copy(update={"environment": environment, "sac": wide})
        train(config, tmp_path / "run", initial="finger_reach_designs", progress=False)
    assert not (tmp_path / "run").exists()


def test_a_policy_takes_other_backends_bodies_goals_and_physics():
    policy = Policy("finger_reach_designs")
    for changes in (
        {"backend": "fem"},
        {"design": {"height": 0.021}},
        {"design_in_observation": ["length", "height", "joint_height"], "sample_design": True},
        {"task_options": {"goals": [[0.0, 0.066, -0.072]]}},
    ):
        policy.check_environment(policy.environment.model_copy(update=changes))
    carry = Policy("tetrapod_carry_kilogram")
    carry.check_environment(carry.environment.model_copy(update={"robot_options": {"payload": 0.5}}))


def test_a_policy_refuses_goals_that_are_shown_earlier_or_later_than_in_training():
    policy = Policy("gripper_pinch_designs_analytic")
    other = policy.environment.model_copy(update={"task_options": {"lookahead": 0}})
    with pytest.raises(ConfigError, match=r"environment\.task_options\.lookahead = 0 does not fit .*trained with 1"):
        policy.check_environment(other)


def test_a_training_starts_from_a_policy_of_another_task_with_goals_of_the_same_kind():
    reach = Policy("tetrapod_reach_analytic")
    reach.check_environment(EnvironmentConfig(id="SoftGym/TetrapodTrack-v0"), any_task=True)
    with pytest.raises(ConfigError, match="robot tetrapod, task reach"):
        reach.check_environment(EnvironmentConfig(id="SoftGym/FingerReach-v0"), any_task=True)
    with pytest.raises(ConfigError, match="task track"):
        reach.check_environment(EnvironmentConfig(id="SoftGym/TetrapodTrack-v0"))


def test_warm_start_and_early_stop(trained, tmp_path):
    seen = []
    config = CONFIG.model_copy(
        update={
            "seed": 5,
            "settings": CONFIG.settings.model_copy(update={"learning_rate": 1e-12, "final_learning_rate": 1e-12}),
        }
    )

    def report(step, outcome):
        seen.append((step, outcome.success_rate))
        return True

    path = train(config, tmp_path, initial=trained, progress=False, report=report)
    assert [step for step, _ in seen] == [200]
    assert json.loads(path.with_suffix(".json").read_text())["stopped_early"] is True
    x = np.random.default_rng(0).uniform(-1, 1, (4, 15)).astype(np.float32)
    assert np.abs(Policy(path)(x) - Policy(trained)(x)).max() < 1e-4
    wider = CONFIG.model_copy(update={"settings": CONFIG.settings.model_copy(update={"net_arch": [32, 32]})})
    with pytest.raises(WeightsError, match="does not fit.*net_arch"):
        train(wider, tmp_path / "wider", initial=trained, progress=False)


def test_damaged_policies(trained, tmp_path):
    with pytest.raises(WeightsError, match=r"nothing\.safetensors.*does not exist"):
        Policy(tmp_path / "nothing.safetensors")
    broken = tmp_path / "policy.safetensors"
    broken.write_bytes(trained.read_bytes()[:100])
    with pytest.raises(WeightsError, match="damaged or truncated"):
        Policy(broken)
    broken.write_bytes(trained.read_bytes())
    with pytest.raises(WeightsError, match=r"policy\.json"):
        Policy(broken)
    card = broken.with_suffix(".json")
    for text, message in (
        ("{", "cannot be read"),
        ('{"format": 2}', "must have format 1"),
        ('{"format": 1}', r"lacks config\.environment"),
        ('{"format": 1, "config": {"environment": {"id": "Foo"}}}', "unknown environment 'Foo'"),
    ):
        card.write_text(text)
        with pytest.raises(WeightsError, match=rf"policy card '.*policy\.json' ?.*{message}"):
            Policy(broken)
    with pytest.raises(ValueError, match=r"size 15, got 20.*design_in_observation"):
        Policy(trained)(np.zeros(20))


@pytest.mark.parametrize("backend", ["surrogate", "fem"])
def test_qp_reaches_every_reachable_goal(backend):
    environment = EnvironmentConfig(id="SoftGym/FingerReach-v0", backend=backend)
    goals = sample_goals(environment, 4, seed=3)
    outcome = evaluate("qp", environment, goals)
    assert outcome.success_rate == 1.0 and outcome.worst_distance < 1e-4
    assert outcome.steps == 200
    assert outcome.mean_distance < evaluate("random", environment, goals).mean_distance


def test_batched_and_single_evaluation_agree(trained):
    environment = EnvironmentConfig(id="SoftGym/FingerReach-v0")
    goals = sample_goals(environment, 3, seed=1)
    design = {"length": 0.0395, "joint_height": 0.0074}
    batched = evaluate(trained, environment, goals, design=design)
    env = environment.make()
    policy = Policy(trained)
    for i, goal in enumerate(goals):
        observation, info = env.reset(options={"design": design, "goal": goal})
        total, truncated = 0.0, False
        while not truncated:
            observation, reward, _, truncated, info = env.step(policy(observation))
            total += reward
        assert batched.distances[i] == pytest.approx(info["distance"], abs=2e-5)
        assert batched.returns[i] == pytest.approx(total, abs=0.05)


def test_goals_repeat_and_belong_to_the_body():
    environment = EnvironmentConfig(id="SoftGym/FingerReach-v0")
    goals = sample_goals(environment, 5, seed=2)
    assert goals.shape == (5, 1, 3)
    assert (goals == sample_goals(environment, 5, seed=2)).all()
    assert (goals != sample_goals(environment, 5, seed=2, design={"length": 0.042})).any()
    track = EnvironmentConfig(id="SoftGym/FingerTrack-v0")
    assert sample_goals(track, 2, seed=0).shape == (2, 25, 3)


@pytest.mark.parametrize(
    "name",
    [
        "finger_reach",
        "finger_reach_designs",
        "tetrapod_carry",
        "tetrapod_carry_kilogram",
        "tetrapod_reach_analytic",
        "crawler_walk_gait",
        "quadruped_walk_gait",
        "quadruped_walk_winner",
        "quadruped_follow_horizon",
        "quadruped_climb_horizon",
        "whip_throw_gait",
    ],
)
def test_shipped_policies_were_made_by_the_shipped_configs(name):
    config = load_config(shipped_configs("agents")[name], TrainConfig)
    card = Policy(name).card
    assert TrainConfig.model_validate(card["config"]) == config
    assert card["steps"] == config.steps and not card["stopped_early"]
    with pytest.raises(WeightsError, match="unknown policy 'octopus'.*finger_reach"):
        Policy("octopus")


def test_each_goal_may_have_its_own_body(trained):
    environment = EnvironmentConfig(id="SoftGym/FingerReach-v0")
    designs = [{"length": 0.0385}, {"length": 0.0415, "height": 0.0215}]
    goals = sample_goals(environment, 2, seed=1)
    both = evaluate(trained, environment, goals, design=designs)
    for i, design in enumerate(designs):
        one = evaluate(trained, environment, goals[i : i + 1], design=design)
        assert both.distances[i] == pytest.approx(one.distances[0], abs=1e-6)


def test_the_best_policy_survives_an_interruption(tmp_path, monkeypatch):
    seen = []

    def worse_and_worse(policy, *arguments, **options):
        outcome = evaluate(policy, *arguments, **options)
        seen.append(training.read_tensors(policy))
        return replace(outcome, returns=np.full_like(outcome.returns, [10.0, 1.0, 2.0][len(seen) - 1]))

    monkeypatch.setattr(training, "evaluate", worse_and_worse)
    config = CONFIG.model_copy(update={"steps": 600})
    original = SACLearner.learn

    def learn(learner, target, progress):
        if len(seen) == 2 and learn.whole:
            learn.whole = False
            raise KeyboardInterrupt
        original(learner, target, progress)

    learn.whole = True
    monkeypatch.setattr(SACLearner, "learn", learn)
    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path, progress=False)
    policy = train(config, tmp_path, progress=False)
    kept, card = training.read_tensors(policy), Policy(policy).card
    assert card["best_step"] == 200 and card["steps"] == 600 and len(seen) == 3
    assert all((kept[name] == value).all() for name, value in seen[0].items())
    assert any((kept[name] != value).any() for name, value in seen[2].items())


@pytest.mark.parametrize("correction", [{}, {"residual_scale": 0.5}], ids=["plain", "residual"])
def test_a_card_counts_the_time_of_the_processes_of_its_environments(correction, tmp_path):
    def of_children():
        spent = resource.getrusage(resource.RUSAGE_CHILDREN)  # processes that have ended, as those of a training have
        return spent.ru_utime + spent.ru_stime

    environment = {"id": "SoftGym/TetrapodCarry-v0", "task_options": {"push": 1.0}, "robot_options": {"elements": 2}}
    data = {
        "environment": environment | correction,
        "learner": "ppo",
        "ppo": {"n_steps": 2, "batch_size": 2},
        "num_envs": 2,
    }
    config = TrainConfig.model_validate({**data, "steps": 16, "evaluation_episodes": 1, "report_every": 16})
    own, children, all_ = time.process_time(), of_children(), cpu_seconds()
    card = read_json(train(config, tmp_path / "run", progress=False).with_suffix(".json"))
    own, children, all_ = time.process_time() - own, of_children() - children, cpu_seconds() - all_
    assert 0.0 < all_ - own < children  # what they spend on ending is not known
    assert own < card["cpu_seconds"] < all_
