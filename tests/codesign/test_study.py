"""Whole studies in real processes: interrupted, killed, shared, continued."""

from __future__ import annotations

import csv
import json
import re
import signal
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest

from softgym_envs.agents.evaluation import Evaluation
from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.folder import SHARED_POLICY, SHARED_POLICY_RECORD, StudyFolder
from softgym_envs.codesign.records import FinalistTest, SharedPolicy, TrialResult
from softgym_envs.codesign.scheduling.optuna_study import open_study
from softgym_envs.codesign.scheduling.queue import TrialQueue
from softgym_envs.codesign.snapshot import load_study
from softgym_envs.codesign.statistics import kendall_tau, mean_interval, rank_correlation, rate_interval
from softgym_envs.codesign.study import run_study
from softgym_envs.errors import WeightsError
from softgym_envs.extensions.report.page import write_report
from tests.accessibility import defects
from tests.helpers import wait_until

TRIALS = 7


def results_in(folder):
    return {path.parent.name: path.read_bytes() for path in folder.glob("trials/[0-9]*/result.json")}


def wait_for(condition, process):
    wait_until(condition, interval=0.02, failed=lambda: None if process.poll() is None else process.stdout.read())


@pytest.fixture(scope="module")
def finished(tmp_path_factory, tiny, start_study):
    """A study that was interrupted, then shared by two calls of which one was killed, then continued."""
    folder = tmp_path_factory.mktemp("codesign") / "study"
    data = tiny(
        trials=TRIALS,
        workers=2,
        goals={"count": 12, "unseen_count": 5, "training_count": 2},
        screen={"enabled": True, "candidates": 3, "keep": 0.7, "goals": 2},
        finalists={"count": 1},
    )
    first = start_study(folder, data)
    wait_for(lambda: results_in(folder), first)
    first.send_signal(signal.SIGINT)
    output, _ = first.communicate()
    interrupted = results_in(folder)

    second, third = start_study(folder, data), start_study(folder, {**data, "workers": 1})
    wait_for(lambda: len(results_in(folder)) >= len(interrupted) + 2, second)
    second.kill()
    second.communicate()
    killed = results_in(folder)
    third.communicate()
    returned = run_study(StudyConfig.model_validate(data), folder, progress=False)
    return SimpleNamespace(
        folder=StudyFolder(folder), output=output, interrupted=interrupted, killed=killed, third=third, results=returned
    )


def test_interruption_says_how_to_continue(finished):
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
        scores = json.loads(now[f"{trial.number:04d}"])["scores"]
        assert finished.folder.config.signed(scores) == trial.values


def test_the_other_call_finished_the_study(finished):
    assert finished.third.returncode == 0


def test_continuing_a_finished_study_does_nothing(finished):
    before = {path: path.stat().st_mtime_ns for path in finished.folder.path.glob("*/**/*.json")}
    assert run_study(finished.folder.config, finished.folder.path, progress=False).trials["complete"] == TRIALS
    assert {path: path.stat().st_mtime_ns for path in finished.folder.path.glob("*/**/*.json")} == before


def test_winner_is_the_best_of_the_search(finished):
    best = max(finished.folder.results(), key=lambda result: result.score)
    assert finished.results.winner.trial == best.number
    assert finished.results.baseline.design == finished.folder.config.baseline
    # The inverse QP does about the same on both: the surrogate is accurate to a tenth of a millimetre.
    assert [row.objective for row in finished.results.transfer] == ["mean_distance", "success_rate"]
    assert finished.results.transfer[0].worst_gap < 5e-4
    assert [row.backend for row in finished.results.comparison] == ["fem", "surrogate"]


class Balance(HTMLParser):
    """Fails on a tag that is not closed."""

    VOID = frozenset({"meta", "img", "br"})

    def __init__(self):
        super().__init__()
        self.open = []
        self.text = []
        self.sources = []
        self.downloads = set()
        self.without_text = []

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        if tag not in self.VOID:
            self.open.append(tag)
        if tag == "img" and not given.get("alt") or tag == "figure" and not given.get("aria-label"):
            self.without_text.append((tag, given))
        if "download" in given:
            self.downloads.add(given["download"])
        self.sources += [value for key, value in attrs if key in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("script", "style"):
            self.text.append(data)


def test_report(finished):
    path = write_report(finished.folder.path)
    page = Balance()
    page.feed(path.read_text())
    assert page.open == []
    assert len(page.sources) > 8
    beside = {path.name for path in finished.folder.path.glob("winner-trial*")}
    assert {name.partition(".")[2] for name in beside} == {"stl", "step", "gif", "rrd"}
    sections = {source for source in page.sources if source.startswith("#")}
    assert all(source.startswith("data:") or source in beside | sections for source in page.sources)
    assert all(f'id="{section[1:]}"' in path.read_text() for section in sections)
    assert page.downloads >= beside | {"results.json", "trials.csv", "finalists.csv"}
    assert page.without_text == [] and defects(path.read_text()) == []
    text = " ".join(page.text)
    row = finished.results.comparison[0]
    for role in ("baseline", "winner"):
        assert f"{1e3 * getattr(row, role).mean_distance:.2f} mm" in text
        assert f"{100 * getattr(row, role).success_rate:.1f} %" in text
        for effort in (getattr(row, role).mean_effort, getattr(row, role).largest_effort):
            assert f"{effort:.2f} N" in text
    for variable in finished.results.variables[1:3]:
        assert f"{1e3 * variable.winner:.2f} mm" in text
        assert (f"at its {variable.at_limit} limit" in text) == bool(variable.at_limit)
    assert "softgym codesign --config" in text
    assert "nan" not in text.lower().replace("nanmean", "").split()


def test_tables(finished):
    folder = finished.folder.path
    assert json.loads((folder / "results.json").read_text())["trials"]["complete"] == TRIALS
    with (folder / "trials.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == TRIALS
    assert float(rows[0]["height [m]"]) == pytest.approx(finished.folder.result(int(rows[0]["trial"])).design["height"])
    with (folder / "finalists.csv").open() as stream:
        assert {(row["role"], row["backend"]) for row in csv.DictReader(stream)} == {
            (role, backend) for role in ("baseline", "finalist") for backend in ("fem", "surrogate")
        }


def evaluation(distance, effort=0.5):
    columns = (np.full(2, value) for value in (distance, distance, 1.0, 0.5, effort))
    return Evaluation(*columns, ends=np.zeros((2, 3)), steps=1)


def write_trial(folder, number, distance, effort=0.5):
    """Write the result of a finished trial, each of another body."""
    limits = folder.config.constraints
    TrialResult(
        number=number,
        origin="baseline" if number == 0 else f"sampler {number}",
        process="",
        design={**folder.config.baseline, "height": 0.020 + 1e-4 * number},
        values={"mean_distance": distance, "mean_effort": effort},
        scores=[-distance],
        violations={name: effort - limit for name, limit in limits.items()},
        evaluation=evaluation(distance, effort),
    ).write(folder.trial(number) / "result.json")


def write_test(folder, number, distance, effort=0.5):
    """Write the test of a body on FEM and the selection goals."""
    values = {"mean_distance": distance, "mean_effort": effort}
    test = FinalistTest(number, "qp", "fem", "selection", 0, evaluation(distance, effort), values, [distance] * 2)
    test.write(folder.path / "finalists" / f"trial{number:04d}-qp-fem-selection.json")


@pytest.mark.parametrize("choose, winner", [("surrogate", 2), ("fem", 1)])
def test_what_decides_who_wins(choose, winner, study):
    folder = study(finalists={"count": 2, "choose": choose})
    for number, (searched, tested) in enumerate([(3e-3, 3e-3), (2e-3, 1e-3), (1e-3, 2e-3)]):
        write_trial(folder, number, searched)
        write_test(folder, number, tested)
    snapshot = load_study(folder)
    assert snapshot.winner.trial == winner
    goals = {plan.goals for plan in snapshot.planned_tests}
    assert goals == ({"unseen", "selection"} if choose == "fem" else {"unseen"})


def test_error_of_a_worker_is_one_line(tmp_path, tiny):
    shown = {"id": "SoftGym/FingerReach-v0", "design_in_observation": ["length", "height", "joint_height"]}
    config = StudyConfig.model_validate(tiny(strategy="policy", policy="finger_reach_designs", environment=shown))
    folder = StudyFolder.create(tmp_path / "study", config)
    # The shared policy was damaged after it was made, so only the trials notice.
    (folder.path / "shared_policy").mkdir()
    SharedPolicy(SHARED_POLICY).write(folder.path / SHARED_POLICY_RECORD)
    (folder.path / SHARED_POLICY).write_bytes(b"not a policy")
    (folder.path / "shared_policy" / "policy.json").write_text("{}")
    with pytest.raises(WeightsError) as caught:
        run_study(config, folder.path, progress=False)
    assert "policy.safetensors" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_tests_of_former_finalists_stay_in_the_cost(study):
    folder = study(trials=3, finalists={"count": 2})
    before = run_study(folder.config, folder.path, progress=False)
    finalists = folder.config.finalists.model_copy(update={"count": 1})
    after = run_study(folder.config.model_copy(update={"finalists": finalists}), folder.path, progress=False)
    assert len(after.finalists) < len(before.finalists)
    assert after.cost.test_steps_surrogate == before.cost.test_steps_surrogate
    assert after.cost.cpu_seconds == before.cost.cpu_seconds


def test_statistics(rng):
    values = rng.normal(1.0, 0.1, (1, 200))
    low, high = mean_interval(values)
    assert low < values.mean() < high
    assert high - low == pytest.approx(2 * 1.972 * values.std(ddof=1) / np.sqrt(200), rel=1e-3)
    assert mean_interval(np.full((1, 5), 2.0)) == (2.0, 2.0)
    for goals in (1, 2, 4):  # too few
        assert mean_interval(np.ones((3, goals))) is None and rate_interval(np.ones((3, goals))) is None
    assert rate_interval(np.ones((1, 10)))[0] == pytest.approx(0.7225, abs=1e-3)
    low, high = rate_interval(np.array([[1.0, 1.0, 0.0, 1.0, 1.0], [1.0, 1.0, 1.0, 1.0, 1.0]]))
    assert 0.0 <= low < 9.0 / 10.0 < high <= 1.0
    assert rank_correlation([1, 2, 3], [10, 20, 15]) == pytest.approx(0.5)
    assert rank_correlation([1, 1, 1], [1, 2, 3]) is None
    assert kendall_tau([1, 2, 3, 4], [10, 20, 15, 30]) == pytest.approx((5 - 1) / 6)  # five pairs of six agree
    assert kendall_tau([1, 2], [1, 2]) is None and kendall_tau([1, 2, 3], [5, 5, 5]) is None


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


def test_constraints_decide_before_scores(study):
    folder = study(finalists={"count": 2, "choose": "fem"}, constraints={"mean_effort": 1.0})
    found = [(3e-3, 0.5, 0.5), (2e-3, 0.9, 1.2), (1e-3, 1.5, 1.5)]  # distance, effort in the search, effort on FEM
    for number, (distance, effort, _) in enumerate(found):
        write_trial(folder, number, distance, effort)
    assert load_study(folder).winner.trial == 1  # trial 2 violates the constraint in the search
    for number, (distance, _, effort) in enumerate(found):
        write_test(folder, number, distance, effort)
    assert load_study(folder).winner.trial == 0  # trial 1 violates it on FEM
    assert load_study(folder).best.number == 1


def test_no_winner_names_the_cause_and_the_nearest_miss(study):
    folder = study(finalists={"count": 1, "choose": "fem"}, constraints={"mean_effort": 1.0})
    assert load_study(folder).verdict.reason == "no trial is finished"
    for number, effort in enumerate((1.5, 1.31)):
        write_trial(folder, number, 1e-3, effort)
    verdict = load_study(folder).verdict
    assert verdict.winner is None
    assert verdict.reason == (
        "no body satisfies the constraints; nearest: trial 1, mean actuator effort 1.31 N exceeds 1.00 N by 0.31 N"
    )
    write_trial(folder, 2, 1e-3, 0.9)
    write_test(folder, 2, 1e-3, 1.2)
    assert load_study(folder).verdict.reason == (
        "no finalist satisfies the constraints on FEM; nearest: trial 2, mean actuator effort 1.20 N exceeds 1.00 N by "
        "0.20 N"
    )


def test_study_whose_constraints_nobody_satisfies(study, capsys):
    folder = study(trials=3, constraints={"mean_effort": 0.1, "success_rate": 1.0}, finalists={"count": 1})
    results = run_study(folder.config, folder.path)
    lines = capsys.readouterr().out.splitlines()
    finished = [line for line in lines if re.match(r"\[.*\] trial ", line)]
    assert len(finished) == 3
    for line in finished:
        assert re.search(
            r"violates a constraint: mean actuator effort \d+\.\d\d N exceeds 0\.10 N by \d+\.\d\d N", line
        )
        assert "success rate" in line and "is below 100.0 % by" in line
        assert "no body satisfies the constraints yet" in line
    assert results.winner is None and results.trials["feasible"] == 0
    assert lines[-1].startswith("no winner: no body satisfies the constraints; nearest: trial ")
    assert not any(trial.feasible for trial in folder.results())
    page = write_report(folder.path).read_text()
    assert "The study has no winner: no body satisfies the constraints; nearest: trial" in page
    assert "0 of 3 complete trials satisfy them" in page and page.count(">violated<") >= 3
    assert not list(folder.path.glob("winner-*"))


def test_objective_stands_in_terminal_and_report(study, capsys):
    folder = study(trials=2, objective="mean_effort", finalists={"count": 1})
    results = run_study(folder.config, folder.path)
    output = capsys.readouterr().out
    row = results.comparison[0]
    change = f"mean actuator effort {row.baseline.objective:.2f} N -> {row.winner.objective:.2f} N"
    assert change in output
    assert "Only 3 test goals: the difference may be chance." in output
    assert row.objective_change_interval is row.distance_change_interval is row.winner.success_interval is None
    assert re.search(r"  joint_height \d\.\d\d mm \(baseline 6\.00 mm\)", output)
    page = write_report(folder.path).read_text()
    assert f"{row.baseline.objective:.2f} → {row.winner.objective:.2f} N" in page
    assert "mean actuator effort [N] on 6 goals, as small as possible" in page
    assert "Only 3 test goals: the difference may be chance." in page


def test_a_study_that_goes_on_with_fewer_trials_counts_those_that_it_has(study, monkeypatch, capsys):
    def interrupt(*_):
        raise KeyboardInterrupt

    folder = study(trials=5)
    with TrialQueue(folder) as queue:
        queue.enqueue([("baseline", folder.config.baseline_values)])
        for _ in range(3):
            trial = queue.claim()
            write_trial(folder, trial.number, 1e-3 * trial.number)
            design, seed = folder.config.body(trial.params)[0], trial.user_attrs.get("sampler_seed")
            result = replace(folder.result(trial.number), design=design, sampler_seed=seed)
            result.write(folder.trial(trial.number) / "result.json")
            queue.finish(result)
        queue.claim()  # and does not finish
    monkeypatch.setattr("softgym_envs.codesign.study.run_workers", interrupt)
    config = folder.config.model_copy(update={"trials": 2})
    with pytest.raises(KeyboardInterrupt):
        run_study(config, folder.path, workers=3)
    out = capsys.readouterr().out
    assert "4 bodies of study 'tiny', 3 of them finished before" in out and "interrupted: 3 trials finished" in out
    page = write_report(folder.path).read_text()
    assert "3 bodies (3 complete, 0 pruned, 0 infeasible)" in page and "3; with several, the bodies" in page
