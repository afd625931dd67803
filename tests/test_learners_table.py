"""The table of learners: what its cells say of trainings that end early or never get there."""

import pytest

from benchmarks import learners, tables
from benchmarks.learners import LearnerRow, config_path, spread
from benchmarks.recorded import results


@pytest.fixture(autouse=True)
def forget_results():
    """Results are read once; those of the made-up rows here must not reach the tests of pages."""
    results.cache_clear()
    yield
    results.cache_clear()


def row(seed, seconds_90, *, stopped=False, task="finger_reach", learner="sac"):
    return LearnerRow(task, learner, seed, seconds_90, None, 150.5, 40_000, 0.925, 0.9, stopped, "abc1234")


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([1.0, 3.0, 2.0], "2 (1 to 3)"),
        ([1.0, 2.0], "1.5 (1 to 2)"),
        ([4.0], "4"),
        (["> 150", 80.0, "> 150"], "> 150 (80 to > 150)"),
        (["never", 80.0, 90.0], "90 (80 to never)"),
    ],
)
def test_seeds_are_summed_up_by_the_median_and_the_range(values, text):
    assert spread(values) == text


def test_a_training_that_the_budget_stopped_is_told_from_one_that_never_got_there(monkeypatch):
    monkeypatch.setattr(learners, "rows", lambda: [row(0, 60.0), row(1, None, stopped=True), row(2, None)])
    found = learners.learners()
    assert found["finger_reach, sac: CPU seconds to 90 %"] == [60.0, "> 150", "never"]
    assert found["finger_reach, ppo"] == "not run"
    line = next(line for line in tables.learners().splitlines() if line.startswith("| finger_reach | SAC"))
    assert "| 3 | > 150 (60 to never) |" in line and line.endswith("| 92.5 | 90 |")


def test_paths_are_scored_by_their_return(monkeypatch):
    monkeypatch.setattr(learners, "rows", lambda: [row(0, 5.0, task="trunk_track", learner="analytic")])
    assert learners.learners()["trunk_track, analytic: return on FEM [% of the QP's]"] == [90.0]


@pytest.mark.parametrize("task", learners.TASKS)
def test_every_task_has_configurations_of_sac_and_of_the_analytic_gradient(task):
    assert config_path(task, "sac").exists() and config_path(task, "analytic").exists()
