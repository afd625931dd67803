"""Malformed studies give one clear line that names the thing and what is allowed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from softgym_envs.agents.evaluation import sample_goals
from softgym_envs.agents.policy import Policy, policy_path
from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.study import run_study
from softgym_envs.config import load_config
from softgym_envs.errors import ConfigError, WeightsError
from softgym_envs.storage import write_json

ROOT = Path(__file__).resolve().parents[2]
BAD = {
    "name that is not a folder": ({"name": "../x"}, "name", "pattern"),
    "unknown key": ({"colour": "red"}, "colour", "variables"),
    "unknown variable": ({"variables": ["width"]}, "width", "joint_height"),
    "repeated variable": ({"variables": ["height", "height"]}, "height", "twice"),
    "no variable": ({"variables": []}, "variables", "at least 1"),
    "unknown environment": ({"environment": {"id": "SoftGym/Nose-v0"}}, "Nose", "FingerReach"),
    "design out of bounds": (
        {"environment": {"id": "SoftGym/FingerReach-v0", "design": {"height": 1.0}}},
        "height",
        "0.02 to 0.022",
    ),
    "sampled design": (
        {"environment": {"id": "SoftGym/FingerReach-v0", "sample_design": True}},
        "sample_design",
        "false",
    ),
    "unknown sampler": ({"sampler": {"name": "magic"}}, "sampler", "tpe"),
    "unknown sampler option": ({"sampler": {"name": "tpe", "options": {"wings": 2}}}, "wings", "n_startup_trials"),
    "unknown pruner": ({"pruner": {"name": "shears"}}, "pruner.name", "'median'"),
    "missing pruner option": (
        {"pruner": {"name": "percentile"}, "strategy": "scratch"},
        "pruner 'percentile'",
        "percentile",
    ),
    "pruner without reports": ({"pruner": {"name": "median"}}, "median", "none"),
    "unknown objective": ({"objective": "beauty"}, "beauty", "success_rate"),
    "unknown secondary objective": ({"secondary_objectives": ["beauty"]}, "beauty", "success_rate"),
    "unknown constraint": ({"constraints": {"beauty": 1.0}}, "beauty", "success_rate"),
    "misspelt objective": ({"objective": "mean_distnace"}, "mean_distnace", "did you mean 'mean_distance'?"),
    "objective of a module that does not exist": ({"objective": "no_module:f"}, "no_module:f", "no module"),
    "objective that its module lacks": ({"objective": "math:beauty"}, "math:beauty", "has no 'beauty'"),
    "objective that is not a function": ({"objective": "math:pi"}, "math:pi", "a Metric or a function"),
    "constraint that is not a number": (
        {"constraints": {"mean_effort": float("nan")}},
        "constraints.mean_effort",
        "finite",
    ),
    "an objective twice": ({"secondary_objectives": ["mean_distance"]}, "mean_distance", "twice"),
    "constraints for a sampler that does not support them": (
        {"constraints": {"mean_effort": 1.0}, "sampler": {"name": "cmaes"}},
        "cmaes",
        "tpe",
    ),
    "pruner of several objectives": (
        {"secondary_objectives": ["mean_effort"], "pruner": {"name": "wilcoxon"}},
        "wilcoxon",
        "none",
    ),
    "body alone as objective": ({"objective": "material_volume"}, "material_volume", "secondary_objectives"),
    "zone in millimetres": (
        {"goals": {"source": "zone", "zone": {"center": [0, 66, -72], "half_size": [10, 3, 3]}}},
        "goals.zone.center = [0.0, 66.0, -72.0]",
        "did you mean metres?",
    ),
    "size of a zone in millimetres": (
        {"goals": {"source": "zone", "zone": {"center": [0, 0.066, -0.072], "half_size": [10, 3, 3]}}},
        "corner of goals.zone",
        "did you mean metres?",
    ),
    "option without bounds": ({"variables": ["height", "task.spread"]}, "task.spread", "'ranges'"),
    "option of a trained policy": (
        {
            "strategy": "warm_start",
            "policy": "finger_reach_designs",
            "variables": ["height", "task.spread"],
            "ranges": {"task.spread": {"low": 0.0, "high": 0.01, "baseline": 0.0}},
        },
        "task.spread",
        "allowed: qp, scratch",
    ),
    "points for a task of paths": (
        {"strategy": "scratch", "environment": {"id": "SoftGym/FingerTrack-v0"}},
        "goals.source",
        "task",
    ),
    "family without a surrogate": (
        {"environment": {"id": "SoftGym/TetrapodReach-v0"}, "variables": ["leg_length"]},
        "family",
        "zone",
    ),
    "shared policy that does not observe the body": (
        {"strategy": "policy", "policy": "finger_reach_designs"},
        "policy",
        "design_in_observation",
    ),
    "unknown strategy": ({"strategy": "luck"}, "strategy", "'scratch'"),
    "no policy": ({"strategy": "warm_start"}, "policy", "warm_start"),
    "useless policy": ({"policy": "a.safetensors"}, "a.safetensors", "qp"),
    "no trials": ({"trials": 0}, "trials", "greater than or equal to 1"),
    "infinite": ({"goals": {"command_low": float("nan")}}, "command_low", "0"),
    "too many finalists": ({"finalists": {"count": 6}}, "finalists.count = 6", "trials = 6"),
    "screen keeps too many": (
        {"screen": {"enabled": True, "candidates": 100, "keep": 0.5, "goals": 3}},
        "50 bodies",
        "trials = 6",
    ),
    "screen with too many goals": ({"screen": {"enabled": True, "goals": 9}}, "screen.goals = 9", "goals.count = 6"),
    "reports too rare": (
        {"strategy": "scratch", "training": {"steps": 100, "report_every": 200}},
        "report_every = 200",
        "steps = 100",
    ),
    "finalists of a strategy without policies": ({"finalists": {"count": 1, "seeds": 2}}, "finalists.seeds = 2", "qp"),
    "finalists trained on points for a task of paths": (
        {
            "strategy": "policy",
            "policy": "finger_reach_designs",
            "environment": {"id": "SoftGym/FingerTrack-v0"},
            "finalists": {"count": 1, "seeds": 1},
        },
        "goals.source",
        "task",
    ),
    "hindsight on top of the QP": (
        {
            "strategy": "scratch",
            "environment": {"id": "SoftGym/FingerReach-v0", "residual_scale": 0.5},
            "training": {"sac": {"hindsight": 0.8}},
        },
        "hindsight = 0.8",
        "allowed: 0",
    ),
    "trials that learn nothing": (
        {"strategy": "scratch", "training": {"steps": 1000, "report_every": 500}},
        "training.sac.learning_starts = 1000",
        "training.steps = 1000",
    ),
    "finalists that learn nothing": (
        {"strategy": "scratch", "training": {"steps": 2000}, "finalists": {"count": 1, "seeds": 1, "steps": 500}},
        "training.sac.learning_starts = 1000",
        "finalists.steps = 500",
    ),
    "more goals on the finer mesh than there are": (
        {"finalists": {"count": 1, "refinement": {"robot_options": {"mesh_size": 0.005}, "goals": 4}}},
        "finalists.refinement.goals = 4",
        "goals.unseen_count = 3",
    ),
    "a finer mesh without options": (
        {"finalists": {"count": 1, "refinement": {"robot_options": {}, "goals": 2}}},
        "finalists.refinement.robot_options",
        "at least 1",
    ),
    "a finer mesh with larger elements": (
        {"finalists": {"count": 1, "refinement": {"robot_options": {"mesh_size": 0.01}, "goals": 2, "ratio": 1.2}}},
        "finalists.refinement.ratio",
        "less than 1",
    ),
    "an unknown test": ({"finalists": {"count": 1, "test": "starts"}}, "finalists.test", "'episodes' or 'ends'"),
    "ends of paths": (
        {
            "environment": {"id": "SoftGym/FingerTrack-v0"},
            "goals": {"source": "task", "count": 2, "unseen_count": 2},
            "finalists": {"count": 1, "test": "ends"},
        },
        "task 'track'",
        "allowed: episodes",
    ),
    "ends without a surrogate": (
        {
            "environment": {"id": "SoftGym/TetrapodReach-v0"},
            "variables": ["leg_length"],
            "goals": {"source": "task", "count": 2, "unseen_count": 2},
            "finalists": {"count": 1, "test": "ends"},
        },
        "robot 'tetrapod'",
        "allowed: episodes",
    ),
    "ends of plants": (
        {
            "environment": {"id": "SoftGym/FingerReach-v0", "plant": {"stiffness": 1.1}},
            "finalists": {"count": 1, "test": "ends"},
        },
        "environment.plant",
        "allowed: episodes",
    ),
    "ends of motions": (
        {"finalists": {"count": 1, "test": "ends", "fem_options": {"dynamics": True}}},
        "'dynamics': True",
        "allowed: episodes",
    ),
    "ends of an objective of the path": (
        {"objective": "mean_return", "finalists": {"count": 1, "test": "ends"}},
        "'mean_return'",
        "allowed: episodes",
    ),
    "ends of policies with memory": (
        {
            "strategy": "scratch",
            "training": {"learner": "recurrent", "steps": 2000},
            "finalists": {"count": 1, "test": "ends"},
        },
        "training.learner = recurrent",
        "allowed: episodes",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_malformed(name, tmp_path, tiny):
    changes, thing, allowed = BAD[name]
    path = tmp_path / "study.yaml"
    path.write_text(yaml.safe_dump(tiny(**changes)))
    with pytest.raises(ConfigError) as caught:
        load_config(path, StudyConfig)
    message = str(caught.value)
    assert "\n" not in message
    assert thing in message
    assert allowed in message


@pytest.mark.parametrize("path", sorted((ROOT / "configs" / "codesign").glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_configs_and_their_policies(path):
    config = load_config(path, StudyConfig)
    assert config.name == path.stem
    if config.policy is not None:
        card = json.loads(policy_path(config.policy).with_suffix(".json").read_text())["config"]
        assert card["environment"]["id"] == config.environment.id
        seen = card["environment"]["design_in_observation"]  # True: the whole design
        assert seen is True or seen == list(config.variables)
        if config.plan.trains:  # trainings go on from its networks
            assert config.training.settings.net_arch == Policy(config.policy).widths


@pytest.mark.parametrize("path", sorted((ROOT / "configs" / "codesign").glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_studies_train_a_policy_for_each_body(path):
    config = load_config(path, StudyConfig)
    # FEM at every step, or a question about the body that training would blur; their headers say so.
    untrained = {"finger_grasp", "tetrapod_reach", "modular_reach"}
    if config.name in untrained:
        assert config.strategy == "qp"
    elif config.name == "modular_reach_policy":  # compares one policy with the inverse QP
        assert config.strategy == "policy"
    else:
        assert config.plan.trains
        # The gradient of a single step does not find the swing of the carrying Tetrapod, nor a way to an object.
        evolved = {"tetrapod_carry", "tetrapod_carry_wide", "finger_grasp_policy"}
        moving = {"crawler_walk", "quadruped_walk", "swimmer_swim", "whip_throw"}
        own = "evolution" if config.name in evolved else "gait" if config.name in moving else "analytic"
        learner = "sac" if config.name.endswith("_sac") else own
        assert config.training.learner == learner


def test_missing_policy(tmp_path, tiny):
    config = StudyConfig.model_validate(tiny(strategy="warm_start", policy=str(tmp_path / "none.safetensors")))
    with pytest.raises(WeightsError, match=r"none\.safetensors.*does not exist"):
        run_study(config, tmp_path / "study")
    config = StudyConfig.model_validate(tiny(strategy="warm_start", policy="nobody"))
    with pytest.raises(WeightsError, match=r"unknown policy 'nobody'.*finger_reach_designs"):
        run_study(config, tmp_path / "study")
    assert not (tmp_path / "study").exists()


SHOWN = {"id": "SoftGym/FingerReach-v0", "design_in_observation": ["length", "height", "joint_height"]}
SHARED = {"strategy": "policy", "policy": "finger_reach_designs"}


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"environment": {**SHOWN, "backend": "foo"}}, "unknown backend 'foo'.*surrogate"),
        ({"environment": {**SHOWN, "action_mode": "foo"}}, "action_mode = 'foo'.*'increment'"),
        ({"environment": {**SHOWN, "task_options": {"foo": 1}}}, "task 'reach'.*foo"),
        ({"sampler": {"name": "tpe", "options": {"n_startup_trials": "x"}}}, "sampler 'tpe'.*'n_startup_trials': 'x'"),
        ({"sampler": {"name": "tpe", "options": {"n_ei_candidates": "x"}}}, "sampler 'tpe'.*'n_ei_candidates': 'x'"),
        (
            {**SHARED, "environment": {**SHOWN, "residual_scale": 0.3}},
            r"environment\.residual_scale = 0\.3.*finger_reach_designs",
        ),
        (
            {**SHARED, "environment": {**SHOWN, "design_in_observation": ["height", "length", "joint_height"]}},
            r"environment\.design_in_observation = \['height'",
        ),
        (
            {**SHARED, "environment": {"id": SHOWN["id"]}},
            "strategy 'policy' needs a policy that reads the design: add h",
        ),
        (
            {**SHARED, "environment": {**SHOWN, "design_in_observation": True}, "variables": ["young_modulus"]},
            r"environment\.design_in_observation = .*'young_modulus'",
        ),
    ],
)
def test_wrong_values_are_found_before_the_folder_is_made(changes, words, tmp_path, tiny):
    with pytest.raises(ValueError, match=words):
        run_study(StudyConfig.model_validate(tiny(**changes)), tmp_path / "study", progress=False)
    assert not (tmp_path / "study").exists()


def test_a_shared_policy_was_trained_on_what_varies(tmp_path, tiny, monkeypatch):
    policy = Policy("finger_reach_designs")
    monkeypatch.setattr(policy, "environment", policy.environment.model_copy(update={"sample_design": ["length"]}))
    monkeypatch.setattr("softgym_envs.codesign.study.Policy", lambda name: policy)
    config = StudyConfig.model_validate(tiny(**SHARED, environment=SHOWN, variables=["length", "height"]))
    with pytest.raises(ConfigError, match="was trained without variation of height.*allowed variables: length"):
        run_study(config, tmp_path / "study", progress=False)
    assert not (tmp_path / "study").exists()


def test_folder_keeps_its_study(study):
    first = study()
    with pytest.raises(ConfigError, match="holds a study with variables"):
        study(variables=["length"])
    assert study(trials=7).config.trials == 7
    with pytest.raises(ConfigError, match="or change only: name, title, trials, .*attempts, finalists.count, "):
        study(sampler={"name": "random"})
    assert (first.goals["selection"].shape, first.goals["unseen"].shape) == ((6, 1, 3), (3, 1, 3))


def test_options_of_fem(study, tmp_path, tiny):
    """They are tried before the trials, and cannot change once there is a test."""

    def asked(**finalists):
        return study(finalists={"count": 1, **finalists})

    wrong = StudyConfig.model_validate(tiny(finalists={"count": 1, "fem_options": {"dinamics": True}}))
    with pytest.raises(ConfigError, match=r"finalists.fem_options = \{'dinamics': True\}: .*option 'dinamics'"):
        run_study(wrong, tmp_path / "study", progress=False)
    assert not (tmp_path / "study").exists()
    folder = asked(fem_options={"dynamics": True})
    assert asked(fem_options={"dynamics": False}).config.finalists.fem_options == {"dynamics": False}
    training = folder.path / "finalists" / "trial0000-seed1"
    training.mkdir(parents=True)
    assert asked(steps=7).config.finalists.steps == 7  # a training that has not ended binds nobody
    asked()
    (training / "policy.safetensors").touch()
    with pytest.raises(ConfigError, match="holds a study with finalists.steps"):
        asked(steps=9)
    write_json(folder.path / "finalists" / "trial0000-qp-fem-unseen.json", {})
    with pytest.raises(ConfigError) as caught:
        asked(fem_options={"dynamics": False})
    message = str(caught.value)
    assert (
        "holds a study with finalists.fem_options" in message and "use another folder, or change only: name" in message
    )
    assert message.endswith("finalists.count, finalists.choose, finalists.seeds, finalists.refinement")
    assert asked(count=2).config.finalists.count == 2


def test_goals_of_a_task_are_not_those_of_trainings(study):
    folder = study(goals={"source": "task", "count": 3, "unseen_count": 3})
    config = folder.config
    own = {tuple(path.ravel()) for name in ("selection", "unseen") for path in folder.goals[name]}
    assert len(own) == 6
    trained = {
        tuple(path.ravel())
        for seed in range(config.training.seed, config.training.seed + config.training.num_envs)
        for path in sample_goals(config.environment, 6, seed)
    }
    assert not own & trained


def test_goals_differ(study):
    goals = study().goals
    points = [tuple(point) for name in ("training", "selection", "unseen") for point in goals[name].reshape(-1, 3)]
    assert len(set(points)) == len(points) == 13
