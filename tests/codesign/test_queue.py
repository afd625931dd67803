"""Queue of trials, with workers that die at every possible moment."""

from __future__ import annotations

from contextlib import nullcontext

import optuna
import pytest
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from softgym_envs.codesign.records import TrialResult
from softgym_envs.codesign.scheduling.journal import JOURNAL_LOCK, open_journal
from softgym_envs.codesign.scheduling.optuna_study import open_study
from softgym_envs.codesign.scheduling.queue import TrialQueue
from softgym_envs.errors import DataError


def die(queue):
    """Free the locks of a worker, as the operating system does when it is killed."""
    queue._presence.__exit__(None, None, None)
    queue._presence = nullcontext()


def result(trial, score=0.5, **changes):
    fields = {"origin": "", "process": "", "design": {}, "scores": [] if score is None else [score], **changes}
    return TrialResult(trial.number, **fields)


def states(queue):
    return [trial.state.name for trial in queue.study.get_trials(deepcopy=False)]


def test_budget_is_shared(study):
    folder = study(trials=3)
    with TrialQueue(folder) as one, TrialQueue(folder) as two:
        claimed = [one.claim(), two.claim(), one.claim()]
        assert [trial.number for trial in claimed] == [0, 1, 2]
        assert two.claim() is None
        for queue, trial in zip((one, two, one), claimed, strict=True):
            queue.finish(result(trial))
        assert one.left() == 0
        assert one.claim() is None


def test_optunas_own_tools_find_names_and_results(study):
    folder = study(trials=2, secondary_objectives=["success_rate", "mean_effort"])
    with TrialQueue(folder) as queue:
        for scores in ([-0.004, 0.5, -3.0], [-0.002, 0.25, -2.0]):
            queue.finish(result(queue.claim(), None, scores=scores, values={"success": 0.5}, design={"height": 0.02}))
    journal = JournalStorage(JournalFileBackend(str(folder.path / "journal.log")))
    optunas = optuna.load_study(study_name="tiny", storage=journal)
    assert optunas.metric_names == ["mean_distance [m]", "success_rate", "mean_effort [N]"]
    assert [direction.name for direction in optunas.directions] == ["MINIMIZE", "MAXIMIZE", "MINIMIZE"]
    assert [trial.values for trial in optunas.trials] == [[0.004, 0.5, 3.0], [0.002, 0.25, 2.0]]
    assert [trial.number for trial in optunas.best_trials] == [0, 1]
    described = {"environment": folder.config.environment.id, "strategy": folder.config.strategy}
    begun = {"config": folder.config.model_dump(mode="json"), "goals": folder.stored_goals}
    assert optunas.user_attrs == {**described, **begun}
    kept = optunas.trials[0].user_attrs
    assert (kept["values"], kept["design"], kept["controller"]) == ({"success": 0.5}, {"height": 0.02}, "qp")


def test_bodies_are_queued_once_and_run_first(study):
    with TrialQueue(study(trials=4)) as queue:
        bodies = [
            ("baseline", {"height": 0.02, "joint_height": 0.006}),
            ("screen 3", {"height": 0.021, "joint_height": 0.007}),
        ]
        queue.enqueue(bodies)
        queue.enqueue(bodies)
        origins = [queue.claim().user_attrs["origin"] for _ in range(4)]
        assert origins == ["baseline", "screen 3", "sampler 2", "sampler 3"]
        assert queue.claim() is None


def test_body_of_a_killed_worker_runs_again(study):
    folder = study(trials=2)
    with TrialQueue(folder) as survivor:
        with TrialQueue(folder) as victim:
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
    with TrialQueue(folder) as survivor:
        with TrialQueue(folder) as victim:
            trial = victim.claim()
            result(trial).write(folder.trial(0) / "result.json")
            die(victim)
        assert survivor.claim() is None
        assert states(survivor) == ["COMPLETE"]


def test_killed_while_claiming(study):
    folder = study(trials=1)
    with TrialQueue(folder) as queue:
        open_study(folder).ask()  # running, but without a body and without a worker
        trial = queue.claim()
        assert trial.number == 1
        queue.finish(result(trial))
        assert queue.claim() is None


def test_killed_while_recovering(study):
    folder = study(trials=1)
    with TrialQueue(folder) as queue:
        with TrialQueue(folder) as victim:
            params = victim.claim().params
            die(victim)
        # queued again, but not yet marked as failed
        queue.study.enqueue_trial(params, user_attrs={"origin": "sampler 0", "replaces": 0})
        assert queue.claim().number == 1
        assert queue.claim() is None
        assert states(queue) == ["FAIL", "RUNNING"]


def test_infeasible_body_is_pruned_without_a_value(study):
    with TrialQueue(study(trials=1)) as queue:
        queue.finish(result(queue.claim(), state="infeasible", score=None))
        (trial,) = queue.study.trials
        assert (trial.state, trial.value) == (TrialState.PRUNED, None)


def test_journal_with_a_torn_line(study):
    folder = study(trials=2)
    with TrialQueue(folder) as queue:
        queue.finish(result(queue.claim()))
    journal = folder.path / "journal.log"
    whole = journal.read_bytes()
    journal.write_bytes(whole + b'{"op_code": 5, "worker')
    with TrialQueue(folder) as queue:
        assert journal.read_bytes() == whole
        queue.finish(result(queue.claim()))
        assert states(queue) == ["COMPLETE", "COMPLETE"]


@pytest.mark.parametrize("line", [b"{", b"3", b"{}", b"\xff"])
def test_a_damaged_line_of_the_journal_is_named(line, tmp_path):
    path = tmp_path / "journal.log"
    optuna.create_study(study_name="any", storage=open_journal(path)).set_user_attr("name", "value")
    first, *rest = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(first + line + b"\n" + b"".join(rest))
    with pytest.raises(DataError, match=r"journal\.log' cannot be read: line 2 is damaged"):
        open_journal(path)


def test_lock_left_by_a_killed_process_is_free(study):
    folder = study(trials=1)
    (folder.path / "locks" / f"{JOURNAL_LOCK}.lock").touch()
    with TrialQueue(folder) as queue:
        assert queue.claim() is not None


@pytest.mark.parametrize("sampler", ["tpe", "gp", "nsgaii", "qmc", "random"])
def test_bodies_do_not_depend_on_who_draws_them(sampler, tmp_path, study):
    def draw(folder, queues):
        bodies = []
        for k in range(5):
            queue = queues[k % len(queues)]
            trial = queue.claim()
            queue.finish(result(trial, score=trial.params["height"]))
            bodies.append(tuple(trial.params.values()))
        return bodies

    found = []
    for count in (1, 2):
        folder = study(sampler={"name": sampler, "seed": 3})
        folder.path.rename(tmp_path / str(count))
        folder.path = tmp_path / str(count)
        queues = [TrialQueue(folder) for _ in range(count)]
        found.append(draw(folder, queues))
    assert found[0] == found[1]
    assert len(set(found[0])) == 5
