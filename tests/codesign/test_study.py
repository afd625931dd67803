"""Whole studies in real processes: interrupted, killed, shared, continued."""

from __future__ import annotations

import csv
import json
import signal
import time
from collections import Counter
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest

from codesign.config import StudyConfig
from codesign.folder import StudyFolder
from codesign.phases.finalists import choose_winner, evaluations, finalist_jobs
from codesign.report.page import write_report
from codesign.report.results import mean_interval, rank_correlation, rate_interval
from codesign.scheduling.queue import open_study
from codesign.study import run_study
from softgym_envs.errors import WeightsError
from softgym_envs.storage import write_json

TRIALS = 7


def results_in(folder):
    return {path.parent.name: path.read_bytes() for path in folder.glob("trials/[0-9]*/result.json")}


def wait_for(condition, process, seconds=120.0):
    end = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.stdout.read()
        assert time.monotonic() < end, "it takes too long"
        time.sleep(0.02)


@pytest.fixture(scope="module")
def finished(tmp_path_factory, tiny, start_study):
    """A study that was interrupted, then shared by two calls of which one was killed, then continued."""
    folder = tmp_path_factory.mktemp("codesign") / "study"
    data = tiny(
        trials=TRIALS,
        workers=2,
        goals={"count": 12, "unseen_count": 2, "training_count": 2},
        screen={"enabled": True, "candidates": 3, "keep": 0.7, "goals": 2},
        finalists={"count": 1},
    )
    first = start_study(folder, data)
    wait_for(lambda: results_in(folder), first)
    first.send_signal(signal.SIGINT)
    output, _ = first.communicate(timeout=120)
    interrupted = results_in(folder)

    second, third = start_study(folder, data), start_study(folder, {**data, "workers": 1})
    wait_for(lambda: len(results_in(folder)) >= len(interrupted) + 2, second)
    second.kill()
    second.communicate(timeout=120)
    killed = results_in(folder)
    third.communicate(timeout=120)
    returned = run_study(StudyConfig.model_validate(data), folder, progress=False)
    return SimpleNamespace(
        folder=StudyFolder(folder), output=output, interrupted=interrupted, killed=killed, third=third, results=returned
    )


def test_interruption_tells_how_to_go_on(finished):
    assert "run the same command again to continue" in finished.output
    assert 1 <= len(finished.interrupted) < TRIALS


def test_nothing_is_lost_or_duplicated(finished):
    now = results_in(finished.folder.path)
    assert len(now) == TRIALS
    for before in (finished.interrupted, finished.killed):
        assert before.items() <= now.items()
    trials = open_study(finished.folder).trials
    counted = [trial for trial in trials if trial.state.name != "FAIL"]
    assert [trial.state.name for trial in counted] == ["COMPLETE"] * TRIALS
    assert {f"{trial.number:04d}" for trial in counted} == set(now)
    origins = Counter(trial.user_attrs["origin"] for trial in counted)
    assert set(origins.values()) == {1}
    assert {"baseline"} < set(origins)
    assert sum(origin.startswith("screen") for origin in origins) == 2
    assert len({tuple(trial.params.values()) for trial in counted}) == TRIALS
    for trial in counted:
        assert json.loads(now[f"{trial.number:04d}"])["score"] == trial.value


def test_the_other_call_finished_the_study(finished):
    assert finished.third.returncode == 0


def test_continuing_a_finished_study_does_nothing(finished):
    before = {path: path.stat().st_mtime_ns for path in finished.folder.path.glob("*/**/*.json")}
    assert run_study(finished.folder.config, finished.folder.path, progress=False)["trials"]["complete"] == TRIALS
    assert {path: path.stat().st_mtime_ns for path in finished.folder.path.glob("*/**/*.json")} == before


def test_winner_is_the_best_of_the_search(finished):
    best = max(finished.folder.results(), key=lambda result: result["score"])
    assert finished.results["winner"]["trial"] == best["number"]
    assert finished.results["baseline"]["design"] == finished.folder.config.baseline
    # The inverse QP reads both physics alike: the surrogate is good to a tenth of a millimetre.
    for row in finished.results["transfer"]:
        if row["objective"] == "mean_distance":
            assert row["worst_gap"] < 5e-4
    assert [row["backend"] for row in finished.results["comparison"]] == ["fem", "surrogate"]


class Balance(HTMLParser):
    """Fails on a tag that is not closed."""

    VOID = frozenset({"meta", "img", "br"})

    def __init__(self):
        super().__init__()
        self.open = []
        self.text = []
        self.sources = []

    def handle_starttag(self, tag, attrs):
        if tag not in self.VOID:
            self.open.append(tag)
        self.sources += [value for key, value in attrs if key in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def test_report(finished):
    path = write_report(finished.folder.path)
    page = Balance()
    page.feed(path.read_text())
    assert page.open == []
    assert len(page.sources) > 8
    beside = {path.name for path in finished.folder.path.glob("winner-trial*")}
    assert len(beside) == 2
    assert all(source.startswith("data:image/") or source in beside for source in page.sources)
    text = " ".join(page.text)
    row = finished.results["comparison"][0]
    for role in ("baseline", "winner"):
        assert f"{1e3 * row[role]['mean_distance']:.2f} mm" in text
        assert f"{100 * row[role]['success_rate']:.1f} %" in text
    for variable in finished.results["variables"][1:3]:
        assert f"{1e3 * variable['winner']:.2f} mm" in text
    assert "softgym codesign --config" in text
    assert "nan" not in text.lower().replace("nanmean", "").split()


def test_tables(finished):
    folder = finished.folder.path
    assert json.loads((folder / "results.json").read_text())["trials"]["complete"] == TRIALS
    with (folder / "trials.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == TRIALS
    assert float(rows[0]["height [m]"]) == pytest.approx(
        finished.folder.result(int(rows[0]["trial"]))["design"]["height"]
    )
    with (folder / "finalists.csv").open() as stream:
        assert {(row["role"], row["backend"]) for row in csv.DictReader(stream)} == {
            (role, backend) for role in ("baseline", "finalist") for backend in ("fem", "surrogate")
        }


def write_trial(folder, number, evaluation, violations):
    """Leave the result of a finished trial, each of another body."""
    result = {
        "number": number,
        "origin": "baseline" if number == 0 else f"sampler {number}",
        "state": "complete",
        "design": {**folder.config.baseline, "height": 0.020 + 1e-4 * number},
        "agent": "qp",
        "score": -evaluation["mean_distance"],
        "violations": violations,
        "evaluation": evaluation,
    }
    write_json(folder.trial(number) / "result.json", result)


@pytest.mark.parametrize("choose, winner", [("surrogate", 2), ("fem", 1)])
def test_who_names_the_winner(choose, winner, study):
    folder = study(finalists={"count": 2, "choose": choose})

    def record(distance):
        return {"success_rate": 0.5, "mean_distance": distance, "mean_return": 1.0}

    for number, (searched, tested) in enumerate([(3e-3, 3e-3), (2e-3, 1e-3), (1e-3, 2e-3)]):
        write_trial(folder, number, record(searched), [])
        path = folder.path / "finalists" / f"trial{number:04d}-qp-fem-selection.json"
        write_json(path, {"trial": number, "agent": "qp", "backend": "fem", "goals": "selection", **record(tested)})
    assert choose_winner(folder, evaluations(folder)).number == winner
    goals = {job.path.stem.rpartition("-")[2] for job in finalist_jobs(folder)}
    assert goals == ({"unseen", "selection"} if choose == "fem" else {"unseen"})


def test_error_of_a_worker_is_one_line(tmp_path, tiny):
    shown = {"id": "SoftGym/FingerReach-v0", "design_in_observation": ["length", "height", "joint_height"]}
    config = StudyConfig.model_validate(tiny(strategy="policy", policy="finger_reach_designs", environment=shown))
    folder = StudyFolder.create(tmp_path / "study", config)
    # The judge was damaged after it was made, so that only the trials find out.
    write_json(folder.path / "judge" / "judge.json", {})
    (folder.path / "judge" / "policy.safetensors").write_bytes(b"not a policy")
    (folder.path / "judge" / "policy.json").write_text("{}")
    with pytest.raises(WeightsError) as caught:
        run_study(config, folder.path, progress=False)
    assert "policy.safetensors" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_tests_of_former_finalists_stay_in_the_cost(study):
    folder = study(trials=3, finalists={"count": 2})
    before = run_study(folder.config, folder.path, progress=False)
    finalists = folder.config.finalists.model_copy(update={"count": 1})
    after = run_study(folder.config.model_copy(update={"finalists": finalists}), folder.path, progress=False)
    assert len(after["finalists"]) < len(before["finalists"])
    assert after["cost"]["test_steps_surrogate"] == before["cost"]["test_steps_surrogate"]
    assert after["cost"]["cpu_seconds"] == before["cost"]["cpu_seconds"]


def test_statistics(rng):
    values = rng.normal(1.0, 0.1, (1, 200))
    low, high = mean_interval(values)
    assert low < values.mean() < high
    assert high - low == pytest.approx(2 * 1.972 * values.std(ddof=1) / np.sqrt(200), rel=1e-3)
    assert mean_interval(np.full((1, 2), 2.0)) == (2.0, 2.0)
    assert mean_interval(np.ones((1, 1))) is None and mean_interval(np.ones((3, 1))) is None
    assert rate_interval(np.ones((1, 10)))[0] == pytest.approx(0.7225, abs=1e-3)
    low, high = rate_interval(np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 1.0]]))
    assert 0.0 <= low < 5.0 / 6.0 < high <= 1.0
    assert rank_correlation([1, 2, 3], [10, 20, 15]) == pytest.approx(0.5)
    assert rank_correlation([1, 1, 1], [1, 2, 3]) is None


@pytest.mark.parametrize("seeds", [1, 2, 3])
@pytest.mark.parametrize("rate", [0.5, 0.9, 0.99])
def test_intervals_of_rates_cover(rng, seeds, rate):
    """Goals differ in how hard they are, and seeds do in how good they are at them."""
    covered = 0
    for _ in range(300):
        hard = rng.beta(2.0 * rate, 2.0 * (1.0 - rate), 24)
        low, high = rate_interval((rng.random((seeds, 24)) < hard).astype(float))
        assert 0.0 <= low < high <= 1.0
        covered += low <= rate <= high
    assert covered / 300 > 0.91  # three standard deviations of the count below 0.95


def test_interval_of_a_difference_heeds_the_seeds(rng):
    """With one seed each it is over goals alone; a lucky seed of several widens it."""
    goals = rng.normal(0.0, 1.0, 40)
    baseline, winner = goals[None], goals[None] - 0.1
    assert mean_interval(winner, baseline) == pytest.approx((-0.1, -0.1))
    lucky = np.array([goals - 0.5, goals + 0.2, goals + 0.2])  # better by 0.03 on average
    low, high = mean_interval(lucky, np.tile(goals, (3, 1)))
    half = 4.303 * np.std([-0.5, 0.2, 0.2], ddof=1) / np.sqrt(3.0)  # Student's with 2 degrees of freedom
    assert (low, high) == pytest.approx((-0.1 / 3.0 - half, -0.1 / 3.0 + half), rel=1e-3)
    steady = np.tile(goals - 0.1, (3, 1))
    assert mean_interval(steady, np.tile(goals, (3, 1))) == pytest.approx((-0.1, -0.1))


@pytest.mark.parametrize("seeds", [2, 3])
@pytest.mark.parametrize("spread", [0.2, 1.0])
def test_intervals_over_seeds_and_goals_cover(rng, seeds, spread):
    """The true difference is 0; goals are shared, seeds are each body's own."""
    covered = 0
    for _ in range(400):
        goals = rng.normal(size=40)
        tables = (goals + rng.normal(size=(seeds, 1)) * spread + rng.normal(size=(seeds, 40)) for _ in range(2))
        low, high = mean_interval(*tables)
        covered += low <= 0.0 <= high
    assert covered / 400 > 0.915  # three standard deviations of the count below 0.95


def test_limits_decide_before_scores(study):
    folder = study(finalists={"count": 2, "choose": "fem"}, limits={"mean_effort": 1.0})

    def record(distance, effort):
        return {"success_rate": 0.5, "mean_distance": distance, "mean_return": 1.0, "mean_effort": effort}

    found = [(3e-3, 0.5, 0.5), (2e-3, 0.9, 1.2), (1e-3, 1.5, 1.5)]  # distance, effort in search, effort on FEM
    for number, (distance, effort, tested) in enumerate(found):
        write_trial(folder, number, record(distance, effort), [effort - 1.0])
        path = folder.path / "finalists" / f"trial{number:04d}-qp-fem-selection.json"
        test = {"trial": number, "agent": "qp", "backend": "fem", "goals": "selection", **record(distance, tested)}
        write_json(path, test)
    assert choose_winner(folder, evaluations(folder)).number == 0  # trial 1 breaks it on FEM, trial 2 in the search
    assert choose_winner(folder, []).number == 1
