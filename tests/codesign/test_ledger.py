"""Who runs which trial, with workers that die at every possible moment."""

from __future__ import annotations

from contextlib import nullcontext

import pytest
from optuna.trial import TrialState

from codesign.scheduling.queue import Ledger, open_study
from codesign.scheduling.storage import JOURNAL_LOCK
from softgym_envs.storage import write_json


def die(ledger):
    """What the operating system does when a worker is killed: its locks are free."""
    ledger._presence.__exit__(None, None, None)
    ledger._presence = nullcontext()


def result(trial, score=0.5, **changes):
    return {"number": trial.number, "state": "complete", "score": score, "scores": [score], **changes}


def states(ledger):
    return [trial.state.name for trial in ledger.study.get_trials(deepcopy=False)]


def test_budget_is_shared(study):
    folder = study(trials=3)
    with Ledger(folder) as one, Ledger(folder) as two:
        claimed = [one.claim(), two.claim(), one.claim()]
        assert [trial.number for trial in claimed] == [0, 1, 2]
        assert two.claim() is None
        for ledger, trial in zip((one, two, one), claimed, strict=True):
            ledger.finish(result(trial))
        assert one.left() == 0
        assert one.claim() is None


def test_bodies_are_queued_once_and_run_first(study):
    with Ledger(study(trials=4)) as ledger:
        bodies = [
            ("baseline", {"height": 0.02, "joint_height": 0.006}),
            ("screen 3", {"height": 0.021, "joint_height": 0.007}),
        ]
        ledger.enqueue(bodies)
        ledger.enqueue(bodies)
        origins = [ledger.claim().user_attrs["origin"] for _ in range(4)]
        assert origins == ["baseline", "screen 3", "sampler 2", "sampler 3"]
        assert ledger.claim() is None


def test_body_of_a_killed_worker_runs_again(study):
    folder = study(trials=2)
    with Ledger(folder) as survivor:
        with Ledger(folder) as victim:
            lost = victim.claim()
            lost.report(0.25, 10)
            folder.trial(0).mkdir(parents=True)
            (folder.trial(0) / "checkpoint").write_text("half")
            die(victim)
        again = survivor.claim()
        assert (again.number, again.params) == (1, lost.params)
        assert again.user_attrs["origin"] == lost.user_attrs["origin"]
        assert (folder.trial(1) / "checkpoint").read_text() == "half"
        assert survivor.study.trials[1].intermediate_values == {10: 0.25}
        survivor.finish(result(again))
        survivor.finish(result(survivor.claim()))
        assert survivor.claim() is None
        assert states(survivor) == ["FAIL", "COMPLETE", "COMPLETE"]


def test_result_of_a_killed_worker_is_kept(study):
    folder = study(trials=1)
    with Ledger(folder) as survivor:
        with Ledger(folder) as victim:
            trial = victim.claim()
            write_json(folder.trial(0) / "result.json", result(trial))
            die(victim)
        assert survivor.claim() is None
        assert states(survivor) == ["COMPLETE"]


def test_killed_while_claiming(study):
    folder = study(trials=1)
    with Ledger(folder) as ledger:
        open_study(folder).ask()  # running, but without a body and without a worker
        trial = ledger.claim()
        assert trial.number == 1
        ledger.finish(result(trial))
        assert ledger.claim() is None


def test_killed_while_recovering(study):
    folder = study(trials=1)
    with Ledger(folder) as ledger:
        with Ledger(folder) as victim:
            params = victim.claim().params
            die(victim)
        # queued again, but not yet written off
        ledger.study.enqueue_trial(params, user_attrs={"origin": "sampler 0", "replaces": 0})
        assert ledger.claim().number == 1
        assert ledger.claim() is None
        assert states(ledger) == ["FAIL", "RUNNING"]


def test_infeasible_body_is_pruned_without_a_value(study):
    with Ledger(study(trials=1)) as ledger:
        ledger.finish(result(ledger.claim(), state="infeasible", score=None))
        (trial,) = ledger.study.trials
        assert (trial.state, trial.value) == (TrialState.PRUNED, None)


def test_journal_with_a_torn_line(study):
    folder = study(trials=2)
    with Ledger(folder) as ledger:
        ledger.finish(result(ledger.claim()))
    journal = folder.path / "journal.log"
    whole = journal.read_bytes()
    journal.write_bytes(whole + b'{"op_code": 5, "worker')
    with Ledger(folder) as ledger:
        assert journal.read_bytes() == whole
        ledger.finish(result(ledger.claim()))
        assert states(ledger) == ["COMPLETE", "COMPLETE"]


def test_lock_left_by_a_killed_process_is_free(study):
    folder = study(trials=1)
    (folder.path / "locks" / f"{JOURNAL_LOCK}.lock").touch()
    with Ledger(folder) as ledger:
        assert ledger.claim() is not None


@pytest.mark.parametrize("sampler", ["tpe", "gp", "nsgaii", "qmc", "random"])
def test_bodies_do_not_depend_on_who_draws_them(sampler, tmp_path, study):
    def draw(folder, ledgers):
        bodies = []
        for k in range(5):
            ledger = ledgers[k % len(ledgers)]
            trial = ledger.claim()
            ledger.finish(result(trial, score=trial.params["height"]))
            bodies.append(tuple(trial.params.values()))
        return bodies

    found = []
    for count in (1, 2):
        folder = study(sampler={"name": sampler, "seed": 3})
        folder.path.rename(tmp_path / str(count))
        folder.path = tmp_path / str(count)
        ledgers = [Ledger(folder) for _ in range(count)]
        found.append(draw(folder, ledgers))
    assert found[0] == found[1]
    assert len(set(found[0])) == 5
