"""One trial, with a training and an evaluation that are pretended."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

from codesign.objectives import OBJECTIVES
from codesign.phases.finalists import _mean
from codesign.phases.trial import run_trial
from codesign.scheduling.queue import Ledger
from softgym_envs.errors import ConvergenceError, InfeasibleDesign


def outcome_of(score):
    """An evaluation of which every objective has this score."""
    return SimpleNamespace(to_json=lambda: {key: score * objective.sign for key, objective in OBJECTIVES.items()})


@pytest.fixture
def pretend(monkeypatch):
    """Replace training and evaluation; the record tells how they were called."""
    import agents.evaluation
    import agents.training

    called = SimpleNamespace(train=[], evaluate=[], reports=[0.2, 0.4, 0.6], error=None)

    def train(config, folder, *, initial=None, report=None, progress=True):
        called.train.append((config, initial))
        folder.mkdir(parents=True, exist_ok=True)
        stopped = False
        for k, value in enumerate(called.reports):
            stopped = stopped or report((k + 1) * config.report_every, outcome_of(value))
        policy = folder / "policy.safetensors"
        policy.write_bytes(b"")
        policy.with_suffix(".json").write_text(json.dumps({"stopped_early": stopped, "cpu_seconds": 0.0}))
        return policy

    def evaluate(agent, environment, goals, *, design=None, seed=0):
        if called.error is not None:
            raise called.error
        called.evaluate.append((agent, environment, goals, design))
        distances = np.full(len(goals), 1e-3 if agent == "qp" else 3e-3)
        return SimpleNamespace(
            distances=distances,
            returns=np.ones(len(goals)),
            successes=distances < 2e-3,
            efforts=np.ones(len(goals)),
            success_rate=float((distances < 2e-3).mean()),
            mean_distance=float(distances.mean()),
            mean_distances=distances,
            worst_distance=float(distances.max()),
            mean_return=1.0,
            steps=50,
        )

    monkeypatch.setattr(agents.training, "train", train)
    monkeypatch.setattr(agents.evaluation, "evaluate", evaluate)
    return called


TRAINED = {"strategy": "scratch", "training": {"steps": 300, "report_every": 100, "sac": {"learning_starts": 100}}}


def test_complete(study, pretend):
    folder = study(**{**TRAINED, "strategy": "warm_start", "policy": "start.safetensors"})
    with Ledger(folder) as ledger:
        found = run_trial(folder, trial := ledger.claim())
        ledger.finish(found)
        assert ledger.study.trials[0].value == found["score"] == pytest.approx(-3e-3)
    config, initial = pretend.train[0]
    assert str(initial) == "start.safetensors"
    assert config.environment.design == {**folder.config.baseline, **trial.params}
    np.testing.assert_array_equal(config.environment.task_options["goals"], folder.goals["training"])
    assert [call[0] for call in pretend.evaluate][0] == "qp"
    for _, _, goals, design in pretend.evaluate:
        np.testing.assert_array_equal(goals, folder.goals["selection"])
        assert design == config.environment.design
    assert found == folder.result(0)
    assert found["state"] == "complete"
    assert found["agent"] == "trials/0000/policy.safetensors"
    assert found["curve"] == [[100, 0.2], [200, 0.4], [300, 0.6]]
    assert (found["qp"]["mean_distance"], found["training_steps"]) == (1e-3, 300)


@pytest.mark.parametrize("objective, score", [("success_rate", 0.0), ("mean_distance", -3e-3), ("mean_return", 1.0)])
def test_score_is_larger_for_better(objective, score, study, pretend):
    folder = study(**TRAINED, objective=objective)
    with Ledger(folder) as ledger:
        assert run_trial(folder, ledger.claim())["score"] == pytest.approx(score)


def test_pruned(study, pretend):
    folder = study(**TRAINED, pruner={"name": "threshold", "options": {"lower": 0.5}})
    with Ledger(folder) as ledger:
        found = run_trial(folder, ledger.claim())
        ledger.finish(found)
    assert (found["state"], found["score"], found["evaluation"]) == ("pruned", None, None)
    assert "pruner after 100 steps" in found["reason"]


def test_baseline_is_never_pruned(study, pretend):
    folder = study(**TRAINED, pruner={"name": "threshold", "options": {"lower": 0.9}})
    with Ledger(folder) as ledger:
        ledger.enqueue([("baseline", {"height": 0.02, "joint_height": 0.006})])
        assert run_trial(folder, ledger.claim())["state"] == "complete"


@pytest.mark.parametrize("error", [InfeasibleDesign("the notches meet"), ConvergenceError("no equilibrium")])
@pytest.mark.parametrize("strategy", ["qp", "scratch"])
def test_infeasible_is_a_result(error, strategy, study, pretend):
    pretend.error = error
    folder = study(**{**TRAINED, "strategy": strategy})
    with Ledger(folder) as ledger:
        found = run_trial(folder, ledger.claim())
        ledger.finish(found)
        assert ledger.left() == folder.config.trials - 1
    assert (found["state"], found["score"]) == ("infeasible", None)
    assert str(error) in found["reason"]
    assert not pretend.train


def test_reports_of_a_continued_trial_are_not_repeated(study, pretend):
    folder = study(**TRAINED)
    with Ledger(folder) as ledger:
        trial = ledger.claim()
        trial.report(0.15, 100)
        assert run_trial(folder, trial)["curve"] == [[100, 0.15], [200, 0.4], [300, 0.6]]


def test_mean_of_seeds():
    """Steps are whole numbers, as the report prints them."""

    def record(seed, steps, distance):
        told = {"trial": 1, "agent": "sac", "backend": "fem", "goals": "unseen", "seed": seed, "steps": steps}
        return {**told, "seconds": 0.5, "worst_distance": distance, "mean_distance": distance, "distances": [distance]}

    merged = _mean([record(1, 2700, 1e-3), record(2, 2700, 3e-3)])
    assert merged["steps"] == 5400 and isinstance(merged["steps"], int)
    assert (merged["seeds"], merged["seconds"], merged["worst_distance"]) == ([1, 2], 1.0, 3e-3)
    assert merged["distances"] == [merged["mean_distance"]] == [pytest.approx(2e-3)]
