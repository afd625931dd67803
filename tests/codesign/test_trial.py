"""One trial, with fake training and evaluation."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

from softgym_envs.agents.evaluation import Evaluation
from softgym_envs.codesign.phases import trial as trial_module
from softgym_envs.codesign.phases.trial import run_trial
from softgym_envs.codesign.records import FinalistTest, TestGroup
from softgym_envs.codesign.scheduling.queue import TrialQueue
from softgym_envs.errors import ConvergenceError, InfeasibleDesign


def evaluation(distances, steps=50, **changes):
    """An evaluation with these final distances [m]."""
    distances = np.array(distances, dtype=float)
    ones = np.ones(len(distances))
    fields = {"tracking_distances": distances, "returns": ones, "successes": distances < 2e-3, "efforts": ones}
    fields["ends"] = np.zeros((len(distances), 3))
    return Evaluation(distances=distances, steps=steps, **{**fields, **changes})


@pytest.fixture
def pretend(monkeypatch):
    """Replace training and evaluation; return how they were called."""
    called = SimpleNamespace(train=[], evaluate=[], reports=[0.2, 0.4, 0.6], error=None)

    def train(config, folder, *, initial=None, report=None, progress=True):
        called.train.append((config, initial))
        folder.mkdir(parents=True, exist_ok=True)
        stopped = False
        for k, value in enumerate(called.reports):
            stopped = stopped or report((k + 1) * config.report_every, evaluation([-value]))
        policy = folder / "policy.safetensors"
        policy.write_bytes(b"")
        policy.with_suffix(".json").write_text(json.dumps({"stopped_early": stopped, "cpu_seconds": 0.0}))
        return policy

    def evaluate(agent, environment, goals, *, design=None, seed=0):
        if called.error is not None:
            raise called.error
        called.evaluate.append((agent, environment, goals, design))
        return evaluation(np.full(len(goals), 1e-3 if agent == "qp" else 3e-3))

    monkeypatch.setattr(trial_module, "train", train)
    monkeypatch.setattr(trial_module, "evaluate", evaluate)
    return called


TRAINED = {"strategy": "scratch", "training": {"steps": 300, "report_every": 100, "sac": {"learning_starts": 100}}}


def test_complete(study, pretend):
    folder = study(**{**TRAINED, "strategy": "warm_start", "policy": "start.safetensors"})
    with TrialQueue(folder) as queue:
        found = run_trial(folder, trial := queue.claim())
        queue.finish(found)
        assert queue.study.trials[0].value == -found.score == pytest.approx(3e-3)
    config, initial = pretend.train[0]
    assert str(initial) == "start.safetensors"
    assert config.environment.design == {**folder.config.baseline, **trial.params}
    np.testing.assert_array_equal(config.environment.task_options["goals"], folder.goals["training"])
    assert [call[0] for call in pretend.evaluate][0] == "qp"
    for _, _, goals, design in pretend.evaluate:
        np.testing.assert_array_equal(goals, folder.goals["selection"])
        assert design == config.environment.design
    assert found == folder.result(0)
    assert found.state == "complete"
    assert found.controller == "trials/0000/policy.safetensors"
    assert found.curve == [[100, 0.2], [200, 0.4], [300, 0.6]]
    assert (found.qp.mean_distance, found.qp_value, found.training_steps) == (1e-3, 1e-3, 300)
    assert [call[0] for call in pretend.evaluate][1] == "start.safetensors"
    assert (found.judge.mean_distance, found.judge_value) == (pytest.approx(3e-3), pytest.approx(3e-3))
    assert found.steps_of_scores == found.qp.steps + found.judge.steps + found.evaluation.steps
    assert found.values == {"mean_distance": pytest.approx(3e-3)}


@pytest.mark.parametrize("objective, score", [("success_rate", 0.0), ("mean_distance", -3e-3), ("mean_return", 1.0)])
def test_score_is_larger_for_better(objective, score, study, pretend):
    folder = study(**TRAINED, objective=objective)
    with TrialQueue(folder) as queue:
        assert run_trial(folder, queue.claim()).score == pytest.approx(score)


def test_pruned(study, pretend):
    folder = study(**TRAINED, pruner={"name": "threshold", "options": {"lower": 0.5}})
    with TrialQueue(folder) as queue:
        found = run_trial(folder, queue.claim())
        queue.finish(found)
    assert (found.state, found.score, found.evaluation) == ("pruned", None, None)
    assert "pruner after 100 steps" in found.reason


def test_baseline_is_never_pruned(study, pretend):
    folder = study(**TRAINED, pruner={"name": "threshold", "options": {"lower": 0.9}})
    with TrialQueue(folder) as queue:
        queue.enqueue([("baseline", {"height": 0.02, "joint_height": 0.006})])
        assert run_trial(folder, queue.claim()).state == "complete"


@pytest.mark.parametrize("error", [InfeasibleDesign("the notches meet"), ConvergenceError("no equilibrium")])
@pytest.mark.parametrize("strategy", ["qp", "scratch"])
def test_infeasible_is_a_result(error, strategy, study, pretend):
    pretend.error = error
    folder = study(**{**TRAINED, "strategy": strategy})
    with TrialQueue(folder) as queue:
        found = run_trial(folder, queue.claim())
        queue.finish(found)
        assert queue.left() == folder.config.trials - 1
    assert (found.state, found.score) == ("infeasible", None)
    assert str(error) in found.reason
    assert not pretend.train


def test_reports_of_a_continued_trial_are_not_repeated(study, pretend):
    folder = study(**TRAINED)
    with TrialQueue(folder) as queue:
        trial = queue.claim()
        trial.report(-0.15, 100)
        assert run_trial(folder, trial).curve == [[100, 0.15], [200, 0.4], [300, 0.6]]


def test_average_over_seeds():
    """Steps are whole numbers, as the report prints them."""

    def test(seed, distance):
        found = evaluation([distance], steps=2700, seconds=0.5)
        return FinalistTest(1, "policy", "fem", "unseen", seed, found, {"mean_distance": distance}, [distance])

    group = TestGroup([test(1, 1e-3), test(2, 3e-3)])
    assert group.mean.steps == 5400 and isinstance(group.mean.steps, int)
    assert (group.mean.seconds, group.worst_distance) == (1.0, 3e-3)
    assert group.mean.distances == [group.value("mean_distance")] == [pytest.approx(2e-3)]
    np.testing.assert_array_equal(group.objective_table, [[1e-3], [3e-3]])
    stored = group.to_json()
    assert (stored["seeds"], stored["worst_distance"]) == ([1, 2], 3e-3)
    assert stored["of_seeds"]["distances"] == [[1e-3], [3e-3]]


def test_an_error_that_is_a_bug_is_not_a_result(study, pretend):
    """Only InfeasibleDesign and ConvergenceError are."""
    pretend.error = ValueError("shapes (3,) and (4,) do not match")
    folder = study()
    with TrialQueue(folder) as queue, pytest.raises(ValueError, match="do not match"):
        run_trial(folder, queue.claim())
    assert folder.results() == []


def test_records_survive_their_files(study, pretend):
    folder = study(constraints={"mean_effort": 2.0})
    with TrialQueue(folder) as queue:
        found = run_trial(folder, queue.claim())
    assert folder.result(0) == found and folder.result(0) is not found
    assert found.violations == {"mean_effort": -1.0} and found.feasible
    assert folder.results() == [found]
