"""Killed workers and the dashboard, without a database."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace
from wsgiref.util import setup_testing_defaults

import optuna
import pytest
from optuna.trial import TrialState

from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.folder import StudyFolder
from softgym_envs.codesign.phases.trial import give_up
from softgym_envs.codesign.result_files import write_results
from softgym_envs.codesign.scheduling import worker
from softgym_envs.codesign.scheduling.optuna_study import open_study
from softgym_envs.codesign.scheduling.processes import WorkerError, run_workers
from softgym_envs.codesign.scheduling.queue import CALL, TrialQueue
from softgym_envs.codesign.scheduling.worker import run_trials
from softgym_envs.codesign.snapshot import load_study
from softgym_envs.codesign.study import run_study
from softgym_envs.errors import DataError, MeshingError, SoftGymError
from tests.codesign.kills import Sweep, faults
from tests.helpers import wait_until

SMALL = {"count": 2, "unseen_count": 2, "training_count": 2}


def test_sweep_with_killed_workers(study):
    """Forty trials on the journal by two workers, of which one is killed three times before all trials are finished."""
    folder = study(trials=40, goals={**SMALL, "count": 20})
    with Sweep([folder, folder], seed=1) as sweep:
        for _ in range(3):
            sweep.run_for(trials=2)
            sweep.kill()
        assert len(sweep.seen) < 40
        sweep.run_for(trials=40)
    assert len(sweep.seen) == 40
    assert faults(folder, sweep.seen) == []


def test_faults_are_seen(study):
    folder = study(trials=3, goals=SMALL)
    run_trials(folder)
    seen = {record.number: record for record in folder.results()}
    assert faults(folder, seen) == []
    assert faults(folder, {**seen, 7: seen[0]}) == ["trial 7 was lost or changed"]
    record = folder.trial(1) / "result.json"
    replace(seen[1], scores=[0.0]).write(record)
    assert faults(folder, seen) == ["trial 1 was lost or changed", "trial 1 has the result of another trial"]
    record.unlink()
    assert faults(folder, seen) == ["trial 1 was lost or changed", "trial 1 has no result, or its result has no trial"]


def test_worker_that_is_killed_is_replaced(study, monkeypatch, tmp_path):
    """The first two workers end by a signal as soon as they start."""
    marks = tmp_path / "deaths"
    marks.mkdir()
    (tmp_path / "sitecustomize.py").write_text(
        "import os, signal, sys\n"
        f"if len(os.listdir({str(marks)!r})) < 2:\n"
        f"    open(os.path.join({str(marks)!r}, str(os.getpid())), 'w').close()\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    folder = study(trials=1, goals=SMALL, attempts=2)
    assert run_workers(folder, "trials", 1) is None
    assert len(folder.results()) == 1
    for mark in marks.iterdir():
        mark.unlink()
    assert run_workers(study(trials=2, goals=SMALL, attempts=1), "trials", 1) == "killed by signal 9"


def test_given_up_body_has_the_record_of_a_trial(study):
    folder = study(trials=2, goals=SMALL)
    with TrialQueue(folder) as queue:
        given_up = give_up(folder, queue.claim())
        queue.finish(given_up)
    run_trials(folder)
    first, whole = folder.results()
    assert first == given_up
    assert whole.state == "complete"
    counts = write_results(load_study(folder)).trials
    assert (counts["complete"], counts["infeasible"]) == (1, 1)
    assert "evaluation crashed 5 workers" in (folder.path / "trials.csv").read_text()


def test_attempts_count_only_without_progress(study):
    folder = study(trials=1)
    attempts = []
    with TrialQueue(folder) as queue:
        for step in (0, 0, 100, 0):
            with TrialQueue(folder) as victim:
                trial = victim.claim()
                attempts.append(trial.user_attrs.get("attempt", 1))
                if step:
                    trial.report(0.5, step)
        attempts.append(queue.claim().user_attrs["attempt"])
    assert attempts == [1, 2, 3, 1, 2]


def test_attempts_do_not_count_workers_that_ended_with_their_call(study):
    """The call and its worker are interrupted, or killed together."""
    folder = study(trials=1)
    attempts = []
    for _ in range(3):
        with TrialQueue(folder), TrialQueue(folder) as victim:
            attempts.append(victim.claim().user_attrs.get("attempt", 1))
    assert attempts == [1, 1, 1]
    assert CALL not in os.environ


def test_exception_ends_every_call_until_it_is_fixed(study, monkeypatch):
    """An exception is a bug or a problem of the installation: it never makes a body infeasible."""
    folder = study(trials=1, goals=SMALL, attempts=1)
    with monkeypatch.context() as patch:
        for error in (ZeroDivisionError(), MeshingError(), ZeroDivisionError(), ZeroDivisionError()):

            def fail(folder, trial, error=error):
                raise error

            patch.setattr(worker, "run_trial", fail)
            with TrialQueue(folder), pytest.raises(type(error)):
                run_trials(folder)
            assert folder.results() == []
    with TrialQueue(folder):
        run_trials(folder)
    (found,) = folder.results()
    assert found.state == "complete"


def test_exception_next_to_other_workers(study, monkeypatch):
    """A worker that claims the trial while the call is still alive fails as well, and does not give the body up."""
    folder = study(trials=1, goals=SMALL, attempts=1)

    def fail(folder, trial):
        raise ZeroDivisionError

    monkeypatch.setattr(worker, "run_trial", fail)
    with TrialQueue(folder):
        for _ in range(3):
            with pytest.raises(ZeroDivisionError):
                run_trials(folder)
    assert folder.results() == []


def test_bug_in_the_file_of_a_robot_ends_a_study_with_its_traceback(study, monkeypatch, tmp_path):
    """It reaches the call from a worker process, and the process does not end with one line and status 2."""
    module = tmp_path / "site" / "sitecustomize.py"
    module.parent.mkdir()
    module.write_text(
        "import softgym_envs.robots.soft_finger as finger\n"
        "def assemble(self, design):\n"
        "    import numpy as np\n"
        "    return np.ones(3) @ np.ones(4)  # the bug\n"
        "finger.SoftFinger.assemble = assemble\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(module.parent))
    folder = study(trials=2, goals=SMALL, environment={"id": "SoftGym/FingerReach-v0", "backend": "fem"})
    with pytest.raises(WorkerError) as caught:
        run_study(folder.config, folder.path, progress=False)
    message = str(caught.value)
    assert not isinstance(caught.value, SoftGymError | ValueError)  # which the command line prints as one line
    assert message.startswith("a worker of phase 'trials' failed with exit status 1:")
    assert "Traceback (most recent call last):" in message and "sitecustomize.py" in message
    assert "# the bug" in message and "ValueError: matmul" in message
    assert folder.results() == []


def test_interrupted_baseline_is_not_given_up(tmp_path, tiny, start_study):
    """Although a single crash would be enough."""
    folder = tmp_path / "study"
    # On FEM a trial takes longer than it takes to notice and to stop it.
    environment = {"id": "SoftGym/FingerReach-v0", "backend": "fem"}
    goals = {"count": 300, "unseen_count": 2, "training_count": 2}
    data = tiny(trials=1, attempts=1, environment=environment, goals=goals)

    def running(number):
        try:
            trials = open_study(StudyFolder(folder)).get_trials(deepcopy=False)
        except DataError:
            return False
        return len(trials) > number and trials[number].state == TrialState.RUNNING

    for number, how in enumerate((signal.SIGINT, signal.SIGINT, signal.SIGKILL)):
        process = start_study(folder, data)
        wait_until(
            lambda number=number: running(number),
            interval=0.05,
            failed=lambda process=process: None if process.poll() is None else process.stdout.read(),
        )
        process.send_signal(how)
        process.communicate()
    with TrialQueue(StudyFolder(folder)), TrialQueue(StudyFolder(folder)) as queue:
        again = queue.claim()
        assert (again.number, again.user_attrs["origin"], again.user_attrs["attempt"]) == (3, "baseline", 1)


@pytest.mark.parametrize("marks", [0, 1, 2])
def test_worker_that_dies_while_it_claims_does_not_blame_the_body(study, monkeypatch, marks):
    """Although the call that started it is still alive: the worker has not looked at the body yet."""
    folder = study(trials=1, attempts=1)
    original, written = optuna.Trial.set_user_attr, []

    def set_user_attr(trial, key, value):
        if len(written) == marks:
            raise KeyboardInterrupt
        written.append(key)
        original(trial, key, value)

    with TrialQueue(folder) as call:
        call.enqueue([("baseline", {name: folder.config.baseline[name] for name in folder.config.variables})])
        monkeypatch.setattr(optuna.Trial, "set_user_attr", set_user_attr)
        with TrialQueue(folder) as queue, pytest.raises(KeyboardInterrupt):
            queue.claim()
        monkeypatch.undo()
        with TrialQueue(folder) as queue:
            again = queue.claim()
    assert (again.number, again.user_attrs["origin"], again.user_attrs["attempt"]) == (1, "baseline", 1)


@pytest.mark.parametrize("method", ["set_user_attr", "report"])
def test_reports_outlive_a_worker_that_dies_while_it_claims(study, monkeypatch, method):
    folder = study(trials=1, attempts=3)
    with TrialQueue(folder) as queue:
        queue.enqueue([("baseline", {name: folder.config.baseline[name] for name in folder.config.variables})])
        first = queue.claim()
        for step in (10, 20, 30):
            first.report(0.1 * step, step)
    original = getattr(optuna.Trial, method)

    def die(trial, *arguments):
        original(trial, *arguments)
        raise KeyboardInterrupt

    with TrialQueue(folder) as call:
        monkeypatch.setattr(optuna.Trial, method, die)
        with TrialQueue(folder) as queue, pytest.raises(KeyboardInterrupt):
            queue.claim()
        monkeypatch.undo()
        again = call.claim()
    trial = open_study(folder).get_trials()[again.number]
    assert trial.intermediate_values == {10: 1.0, 20: 2.0, 30: 3.0}
    assert (trial.number, trial.user_attrs["attempt"]) == (2, 1)


def test_worker_continues_when_its_trial_was_reassigned(study, monkeypatch):
    folder = study(trials=2, goals=SMALL)
    original = worker.run_trial

    def run_trial(folder, trial):
        if trial.number == 0:
            open_study(folder).tell(0, state=TrialState.FAIL)
            trial.report(0.5, 1)
        return original(folder, trial)

    monkeypatch.setattr(worker, "run_trial", run_trial)
    worker.run_trials(folder)
    assert [trial.state.name for trial in open_study(folder).trials] == ["FAIL", "COMPLETE", "COMPLETE"]
    assert [record.number for record in folder.results()] == [1, 2]


@pytest.mark.parametrize(
    "storage, message",
    [
        ("sqlite:///study.db", "allowed: journal, postgresql://"),
        ("postgresql://host", "allowed: journal, postgresql://"),
        ("somewhere", "allowed: journal, postgresql://"),
        ("postgresql://me:secret@host/studies", "remove the password"),
    ],
)
def test_wrong_storages(storage, message, tiny):
    with pytest.raises(ValueError, match=message):
        StudyConfig.model_validate(tiny(storage=storage))


def test_dashboard(study):
    """It opens the journal and shows scores and metrics."""
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend
    from optuna_dashboard import wsgi

    folder = study(trials=2, goals=SMALL)
    run_trials(folder)
    app = wsgi(JournalStorage(JournalFileBackend(str(folder.path / "journal.log"))))

    def get(path):
        environment = {"PATH_INFO": path}
        setup_testing_defaults(environment)
        status = []
        body = b"".join(app(environment, lambda line, headers, error=None: status.append(line)))
        assert status == ["200 OK"]
        return json.loads(body)

    (summary,) = get("/api/studies")["study_summaries"]
    trials = get(f"/api/studies/{summary['study_id']}")["trials"]
    assert summary["directions"] == ["minimize"] and summary["study_name"] == "tiny"
    assert [trial["values"] for trial in trials] == [[r.evaluation.mean_distance] for r in folder.results()]
    shown = {attribute["key"]: attribute["value"] for attribute in trials[0]["user_attrs"]}
    assert float(shown["mean_distance"]) == folder.result(0).evaluation.mean_distance
    assert {"origin", "process", "success_rate"} <= shown.keys()
