"""Objectives of one's own, options as variables, and a robot of one's own, without a change in the package."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.agents.evaluation import Evaluation
from softgym_envs.codesign import Metric, StudyConfig, load_study, run_study
from softgym_envs.codesign.metrics.metric import METRICS, find_metric, metric, metric_name
from softgym_envs.codesign.metrics.sources import Outcome
from softgym_envs.envs.tasks.reach import Reach
from softgym_envs.extensions.beams.robots.tetrapod import Tetrapod
from softgym_envs.extensions.grasping.tasks.grasp import Grasp
from softgym_envs.extensions.report import write_report
from softgym_envs.robots.soft_finger import SoftFinger

ROBOT = make_robot("finger")


def effort_per_reach(outcome):
    """Effort for each goal, larger where the goal is missed."""
    return outcome.evaluation.efforts * (1.0 + outcome.evaluation.distances / 1e-3)


@metric("1/m3", "maximize", "body")
def lightness(model):
    """Volume that would be as light as the body."""
    return 1.0 / model.volume


class StiffFinger(SoftFinger):
    """A robot of one's own."""

    name = "stiff_finger"


def outcome(distances, efforts):
    distances, efforts = np.array(distances), np.array(efforts)
    ones = np.ones(len(distances))
    ends = np.zeros((len(distances), 3))
    evaluation = Evaluation(distances, distances, ones, ones, efforts, ends, steps=1)
    return Outcome(evaluation, ROBOT.design_space.baseline, ROBOT)


def test_names_of_objectives():
    assert metric_name("mean_distance") == metric_name(METRICS["mean_distance"]) == "mean_distance"
    assert metric_name(effort_per_reach) == f"{__name__}:effort_per_reach"
    assert metric_name(lightness) == f"{__name__}:lightness"
    with pytest.raises(ValueError, match="cannot be imported by workers: define it at the top level of a module"):
        metric_name(lambda outcome: 0.0)


def test_units_of_efforts_are_those_of_the_robot():
    assert find_metric("mean_effort", ROBOT, Reach).text(2.0) == "2.00 N"
    assert find_metric("mean_effort", make_robot("trunk"), Reach).text(2e3) == "2.00 kPa"
    assert find_metric("mean_effort", Tetrapod(), Reach).text(2.0) == "2.00 N m"


@pytest.mark.parametrize("name, label", [("mean_distance", "Mean final"), ("mean_tracking_distance", "Mean tracking")])
def test_units_of_distances_are_those_of_the_task(name, label):
    lengths, errors = (find_metric(name, ROBOT, task) for task in (Reach, Grasp))
    assert (lengths.text(0.002), lengths.label) == ("2.00 mm", f"{label} distance")
    assert (errors.text(0.05), errors.text(-0.01, "+"), errors.label) == ("5.0 %", "-1.0 pp", f"{label} error")


def test_measurements():
    found = find_metric(f"{__name__}:effort_per_reach", ROBOT, Reach)
    assert (found.label, found.sign) == ("Effort per reach", -1)
    measured = found.measure(outcome([0.0, 1e-3], [1.0, 2.0]))
    assert (measured.value, measured.per_goal) == (2.5, [1.0, 4.0])
    body = find_metric(f"{__name__}:lightness", ROBOT, Reach).measure(outcome([0.0], [1.0]))
    assert body.per_goal is None and body.value == pytest.approx(1.0 / ROBOT.build().volume)


@pytest.mark.parametrize(
    "returned, message",
    [
        ("much", "returned .*much.*must return one number, or one for each of 2 goals"),
        (np.ones(3), "one for each of 2 goals"),
        (float("nan"), "is not finite for design .*length"),
    ],
)
def test_wrong_values_of_an_objective(returned, message):
    with pytest.raises(ValueError, match=message):
        Metric("my:own", lambda outcome: returned).measure(outcome([0.0, 0.0], [1.0, 1.0]))


def test_study_with_an_objective_of_ones_own(tmp_path, tiny):
    """As a function in Python; workers import it."""
    name = f"{__name__}:lightness"
    data = tiny(trials=3, finalists={"count": 1}, constraints={name: 1e4}, sampler={"name": "random"})
    config = StudyConfig.model_validate(data)
    results = run_study(config, tmp_path / "study", objective=effort_per_reach, progress=False)
    assert results.objective == f"{__name__}:effort_per_reach"
    snapshot = load_study(tmp_path / "study")
    for trial in snapshot.trials:
        each = trial.evaluation.efforts * (1.0 + trial.evaluation.distances / 1e-3)
        assert trial.score == pytest.approx(-each.mean())
        volume = config.robot.build(trial.design).volume
        assert trial.values[name] == pytest.approx(1.0 / volume)
        assert trial.violations[name] == pytest.approx(1e4 - 1.0 / volume)
    best = min((trial.values[results.objective], trial.number) for trial in snapshot.trials if trial.feasible)
    assert results.winner.trial == best[1]
    for row in results.comparison:
        assert row.objective_change == pytest.approx(row.winner.objective - row.baseline.objective)
    assert "Effort per reach" in write_report(tmp_path / "study").read_text()


def test_option_of_the_robot_as_a_variable(tmp_path, tiny):
    """Gravity on finite elements."""
    name = "robot.gravity[2]"
    data = tiny(
        environment={"id": "SoftGym/FingerReach-v0", "backend": "fem", "robot_options": {"gravity": [0.0, 0.0, 0.0]}},
        variables=["height", name],
        ranges={name: {"low": -9.81, "high": 0.0, "baseline": 0.0, "unit": "m/s2", "description": "gravity"}},
        goals={
            "source": "zone",
            "zone": {"center": [0.0, 0.0, -0.11], "half_size": [0.0, 0.01, 0.002]},
            "count": 1,
            "unseen_count": 2,
            "training_count": 1,
        },
        trials=2,
        sampler={"name": "random"},
    )
    config = StudyConfig.model_validate(data)
    assert config.test_backends == ("fem",)
    results = run_study(config, tmp_path / "study", progress=False)
    first, second = load_study(tmp_path / "study").trials
    assert first.options == {name: 0.0} and -9.81 < second.options[name] < 0.0
    assert set(second.design) == set(config.space.names)
    (variable,) = [variable for variable in results.variables if variable.name == name]
    assert variable.optimised and variable.unit == "m/s2"
    # The same body without gravity moves differently.
    from softgym_envs.codesign.phases.trial import assess

    goals = load_study(tmp_path / "study").folder.goals["selection"]
    same = assess("qp", config, config.environment_of(second.options), goals, second.design)
    other = assess("qp", config, config.environment_of({name: 0.0}), goals, second.design)
    assert same.evaluation.distances == pytest.approx(second.evaluation.distances, rel=1e-6)
    assert other.evaluation.distances != pytest.approx(second.evaluation.distances, rel=1e-6)


def test_robot_of_ones_own(tmp_path, tiny):
    """By its class; there are no weights, so everything runs on finite elements."""
    zone = {"center": [0.0, 0.0, -0.11], "half_size": [0.0, 0.01, 0.002]}
    data = tiny(
        environment={"robot": StiffFinger, "task": "reach"},
        goals={"source": "zone", "zone": zone, "count": 1, "unseen_count": 2, "training_count": 1},
        trials=2,
        finalists={"count": 1},
    )
    config = StudyConfig.model_validate(data)
    assert config.environment.robot == f"{__name__}:StiffFinger"
    results = run_study(config, tmp_path / "study", progress=False)
    assert results.trials["complete"] == 2
    assert {row.backend for row in results.comparison} == {"fem"}


def test_limits_of_drives_hold_at_the_worst_goal_not_in_the_mean():
    distances = np.array([1e-3, 3e-3])
    evaluation = Evaluation(
        distances, distances, distances, distances < 2e-3, distances, np.zeros((2, 3)), steps=2,
        largest_efforts=np.array([1.0, 9.0]), largest_strains=np.array([0.1, 0.3]), self_forces=np.array([0.0, 32.0]),
    )  # fmt: skip
    outcome = Outcome(evaluation, {}, make_robot("finger"))
    found = {name: METRICS[name].measure(outcome) for name in ("largest_effort", "largest_strain", "self_force")}
    assert [each.value for each in found.values()] == [9.0, 0.3, 32.0]
    assert found["largest_effort"].per_goal == [1.0, 9.0]
    assert METRICS["mean_distance"].measure(outcome).value == pytest.approx(2e-3)
    unknown = Outcome(replace(evaluation, self_forces=None), {}, outcome.robot)
    with pytest.raises(ValueError, match="'self_force' is known on finite elements, for bodies with self-contact"):
        METRICS["self_force"].measure(unknown)
