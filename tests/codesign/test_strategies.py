"""Whole tiny studies: strategies whose trials do not train, several objectives, and retrained finalists."""

from __future__ import annotations

import csv
import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from softgym_envs.agents.config import TrainConfig
from softgym_envs.agents.policy import Policy
from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.folder import SHARED_POLICY, StudyFolder
from softgym_envs.codesign.phases.finalists import _trained_policy
from softgym_envs.codesign.phases.trial import body_training
from softgym_envs.codesign.records import Finalist, FinalistTest
from softgym_envs.codesign.scheduling.optuna_study import open_study
from softgym_envs.codesign.snapshot import load_study
from softgym_envs.codesign.statistics import kendall_tau
from softgym_envs.codesign.study import run_study
from softgym_envs.extensions.report.page import write_report
from softgym_envs.runs import RunFolder

SHOWN = {"id": "SoftGym/FingerReach-v0", "design_in_observation": ["length", "height", "joint_height"]}
LIMIT = 3.5e-5  # m3; bodies of the test lie on both sides
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
QUICK = {"net_arch": [16], "learning_starts": 100, "batch_size": 32, "gradient_steps": 1}


@pytest.fixture
def run(tmp_path, tiny):
    """Function ``run(**changes) -> (StudyFolder, results)``."""

    def start(**changes):
        folder = tmp_path / "study"
        results = run_study(StudyConfig.model_validate(tiny(**changes)), folder, progress=False)
        return StudyFolder(folder), results

    return start


def test_shared_policy_with_pruning_by_goals(run):
    folder, results = run(
        strategy="policy",
        policy="finger_reach_designs",
        environment=SHOWN,
        trials=8,
        goals={"count": 24, "unseen_count": 2, "training_count": 4},
        pruner={"name": "wilcoxon", "options": {"p_threshold": 0.3}},
    )
    assert results.trials["infeasible"] == 0 and results.cost.training_steps == 0
    assert (folder.path / SHARED_POLICY).exists()
    for trial in folder.results():
        seen = len(trial.evaluation)
        assert trial.controller == SHARED_POLICY
        assert seen == 24 if trial.state == "complete" else seen in (6, 12, 18)
    states = [trial.state for trial in folder.results()]
    assert states[0] == "complete"  # the baseline is never pruned
    # Each goal was reported once, under its own number.
    for trial in open_study(folder).get_trials():
        record = folder.result(trial.number).evaluation.distances
        np.testing.assert_allclose([trial.intermediate_values[k] for k in range(len(record))], record)


def test_each_body_gets_a_policy_of_its_own_from_the_model(run):
    training = {"learner": "analytic", "steps": 256, "report_every": 128, "num_envs": 32, "evaluation_episodes": 2}
    folder, results = run(
        strategy="warm_start", policy="finger_reach_designs", environment=SHOWN, trials=3, training=training
    )
    complete = [trial for trial in folder.results() if trial.state == "complete"]
    assert len(complete) == 3 and results.cost.training_steps == 256 * len(complete)
    for trial in complete:
        assert trial.controller == f"trials/{trial.number:04d}/policy.safetensors"
        # The policy of the trial is that of the study, trained on: near it, but not the same.
        assert trial.judge_value != trial.values["mean_distance"]
        assert trial.judge_value == pytest.approx(trial.judge.mean_distance)
    own = [trial.values["mean_distance"] for trial in complete]
    tau = kendall_tau([trial.judge_value for trial in complete], own)
    text = write_report(folder.path).read_text()
    assert "the policy that all trainings start from and the controllers of the trials" in text
    assert f"{tau:.2f} (Kendall" in text


def test_several_objectives_and_constraints(run):
    folder, results = run(
        secondary_objectives=["material_volume"],
        constraints={"material_volume": LIMIT},
        sampler={"name": "nsgaii"},
        trials=10,
    )
    trials = folder.results()
    study = open_study(folder)
    assert len(study.directions) == 2
    for trial in trials:
        volume = trial.values["material_volume"]
        assert trial.scores == [-trial.evaluation.mean_distance, -volume]
        assert trial.violations == pytest.approx({"material_volume": volume - LIMIT})
        assert study.get_trials()[trial.number].values == [trial.evaluation.mean_distance, volume]
        assert study.get_trials()[trial.number].constraints == trial.violations
        assert volume == pytest.approx(folder.config.robot.build(trial.design).volume, rel=1e-12)
    allowed = [trial for trial in trials if trial.feasible]
    assert 0 < len(allowed) < len(trials)
    assert results.trials["feasible"] == len(allowed)
    for trial in allowed:
        beaten = any(
            all(a >= b for a, b in zip(other.scores, trial.scores, strict=True)) and other.scores != trial.scores
            for other in allowed
        )
        assert beaten != (trial.number in results.pareto)
    page = write_report(folder.path).read_text()
    assert "Pareto" in page
    assert f"{len(allowed)} of 10 complete trials satisfy them" in page
    assert f"material volume at most {1e6 * LIMIT:.2f} cm3" in page
    with (folder.path / "trials.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["feasible"] for row in rows] == [str(trial.feasible) for trial in trials]
    for row, trial in zip(rows, trials, strict=True):
        assert float(row["material_volume [SI]"]) == trial.values["material_volume"]
        assert float(row["violation of material_volume [SI]"]) == trial.violations["material_volume"]
        assert bool(row["reason"]) != trial.feasible


def test_finalists_are_trained_anew_with_several_seeds(run):
    folder, results = run(
        strategy="scratch",
        trials=2,
        training={"steps": 160, "report_every": 80, "evaluation_episodes": 2, "sac": QUICK},
        finalists={"count": 1, "seeds": 2, "steps": 240},
    )
    names = {path.name for path in (folder.path / "finalists").iterdir()}
    for body in (0, 1):
        for seed in (1, 2):
            card = json.loads((folder.path / "finalists" / f"trial000{body}-seed{seed}" / "policy.json").read_text())
            assert card["config"]["seed"] == seed and card["steps"] == 240
            assert f"trial000{body}-policy-seed{seed}-fem-unseen.json" in names
    both = [group for group in load_study(folder).tests if (group.agent, group.backend) == ("policy", "surrogate")]
    assert len(both) == 2
    for group in both:
        files = (f"trial{group.trial:04d}-policy-seed{seed}-surrogate-unseen.json" for seed in (1, 2))
        parts = [FinalistTest.read(folder.path / "finalists" / name).evaluation.distances for name in files]
        np.testing.assert_allclose(group.mean.distances, np.mean(parts, axis=0))
        np.testing.assert_array_equal(group.table("distances"), parts)
    assert {row.agent for row in results.comparison} == {"policy", "qp"}
    assert results.cost.retraining_steps == 2 * 2 * 240
    assert results.cost.retraining_report_steps == 2 * 2 * 3 * 2 * 50
    curves = {(training.trial, training.seed): training.curve for training in results.trainings}
    assert sorted(curves) == [(0, 1), (0, 2), (1, 1), (1, 2)]
    for (number, seed), curve in curves.items():
        card = json.loads((folder.path / "finalists" / f"trial{number:04d}-seed{seed}" / "policy.json").read_text())
        assert curve == [[row["step"], -row["mean_distance"]] for row in card["curve"]]
    assert "Learning of the finalists" in write_report(folder.path).read_text()
    winner = f"winner-trial{results.winner.trial:04d}"
    assert (folder.path / f"{winner}.stl").stat().st_size > 10_000
    assert (folder.path / f"{winner}.rrd").read_bytes()[:3] == b"RRF"


def test_finalists_of_a_warm_start_begin_with_the_networks_of_its_policy(study, monkeypatch):
    training = {
        "steps": 160,
        "report_every": 80,
        "evaluation_episodes": 2,
        "sac": {"net_arch": [16], "learning_starts": 100},
    }
    finalists = {"count": 1, "seeds": 1}
    policy = "finger_reach_designs"
    folder = study(strategy="warm_start", policy=policy, environment=SHOWN, training=training, finalists=finalists)
    begun = []

    def train(config, where, **options):
        begun.append((config, options["initial"]))
        raise KeyboardInterrupt

    monkeypatch.setattr("softgym_envs.codesign.phases.finalists.train", train)
    finalist = Finalist(0, "baseline", folder.config.baseline, {}, 0.0, "trials/0000/policy.safetensors")
    with pytest.raises(KeyboardInterrupt):
        _trained_policy(folder, finalist, 1)
    (config, initial), widths = begun[0], Policy(policy).widths
    assert initial == policy and config.settings.net_arch == widths != [16]
    assert config.settings.learning_starts == 100


def test_a_training_of_a_finalist_with_other_steps_begins_again(study, monkeypatch):
    training = {"steps": 160, "report_every": 80, "evaluation_episodes": 2, "sac": QUICK}
    folder = study(strategy="scratch", training=training, finalists={"count": 1, "seeds": 1, "steps": 240})
    finalist = Finalist(0, "baseline", folder.config.baseline, {}, 0.0, "trials/0000/policy.safetensors")
    place = folder.path / "finalists" / "trial0000-seed1"
    began = []

    def train(config, where, **_):
        began.append((config.steps, where.exists()))
        raise KeyboardInterrupt

    monkeypatch.setattr("softgym_envs.codesign.phases.finalists.train", train)
    for steps in (240, 90_000):  # the second one was begun by mistake
        RunFolder(place, TrainConfig, "a training").begin(
            body_training(folder, finalist.design, {}).model_copy(update={"steps": steps})
        )
        with pytest.raises(KeyboardInterrupt):
            _trained_policy(folder, finalist, 1)
    assert began == [(240, True), (240, False)]


def test_report_opens_in_a_browser(run, tmp_path, require_program):
    require_program(CHROMIUM, "chromium")
    folder, results = run(finalists={"count": 1})
    page = write_report(folder.path)
    picture = tmp_path / "report.png"
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    wide = [*options, "--window-size=1100,2400", f"--screenshot={picture}", page.as_uri()]
    subprocess.run([CHROMIUM, *wide], check=True, capture_output=True)
    shown = np.asarray(Image.open(picture).convert("L"), dtype=float)
    assert shown.shape == (2400, 1100)
    # Bodies, tables and plots all the way down: no stretch of half a screen is empty.
    assert all(part.std() > 3.0 for part in np.array_split(shown, 6))
    dumped = subprocess.run(
        [CHROMIUM, *options, "--dump-dom", page.as_uri()], check=True, capture_output=True, text=True
    ).stdout
    assert f"winner-trial{results.winner.trial:04d}.stl" in dumped
    assert dumped.count("data:image/webp") >= 4
    assert dumped.count('class="main-svg"') >= 3  # plotly has drawn
    text = re.sub(r"<script.*?</script>", "", dumped, flags=re.DOTALL)
    assert 'src="http' not in text and 'href="http' not in text  # self-contained


def test_every_strategy_is_described():
    from softgym_envs.codesign.parts import STRATEGIES
    from softgym_envs.extensions.report.sentences import CONTROLLERS

    assert set(CONTROLLERS) == set(STRATEGIES)


def test_a_body_that_was_proposed_twice_is_one_finalist(run):
    folder, _ = run(trials=5, finalists={"count": 3})
    snapshot = load_study(folder)
    before = snapshot.finalists
    assert len({tuple(body.design.values()) for body in before}) == len(before) == 4
    trials = {trial.number: trial for trial in snapshot.trials}
    trials[before[3].trial] = replace(trials[before[1].trial], number=before[3].trial)
    after = replace(snapshot, trials=list(trials.values())).finalists
    assert len({tuple(body.design.values()) for body in after}) == len(after) == 4
    first = min(before[1].trial, before[3].trial)
    assert [body.trial for body in after[:2]] == [0, first]
