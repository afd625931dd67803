"""A study in a real PostgreSQL server: several machines, dead workers, a server that goes away."""

from __future__ import annotations

import re
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import optuna
import pytest
import sqlalchemy as sql

from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.folder import StudyFolder
from softgym_envs.codesign.records import Account, Job, TrialResult
from softgym_envs.codesign.scheduling import worker
from softgym_envs.codesign.scheduling.jobs import missing_jobs, run_pending
from softgym_envs.codesign.scheduling.queue import TrialQueue
from softgym_envs.codesign.study import run_study
from softgym_envs.errors import ConfigError, DataError, SoftGymError
from softgym_envs.extensions.postgres.storage import HEARTBEAT, PostgresStorage
from tests.codesign.kills import Sweep, faults
from tests.extensions.postgres.postgres_server import find_programs, temporary_server
from tests.helpers import wait_until

GRACE = 2.0


@pytest.fixture(scope="module")
def server(require_program):
    require_program(find_programs(), "postgresql")
    with temporary_server() as running:
        yield running


@pytest.fixture
def machine(server, tmp_path, tiny, request):
    """Function ``machine(folder, **changes) -> StudyFolder``: the folder of one machine that takes part in a study."""
    study = re.sub(r"\W", "-", request.node.name)

    def make(folder="a", **changes):
        data = tiny(name=study, storage=server.address, heartbeat=GRACE, patience=30.0)
        return StudyFolder.create(tmp_path / folder, StudyConfig.model_validate({**data, **changes}))

    return make


@contextmanager
def doomed(folder):
    """A queue whose worker is killed at the end of the block: its heartbeats stop without notice."""
    queue = TrialQueue(folder)
    execute = queue.storage.execute

    def silent(statement, **parameters):
        return None if "codesign_workers" in statement else execute(statement, **parameters)

    with queue:
        yield queue
        queue.storage.execute = silent


def result(trial, score=0.5):
    return TrialResult(trial.number, origin="", process="", design={}, scores=[score])


def states(queue):
    return [trial.state.name for trial in queue.study.get_trials(deepcopy=False)]


def test_machines_share_the_budget_and_the_goals(machine):
    a, b = machine("a", trials=3), machine("b", trials=3)
    assert (a.path / "goals.json").read_bytes() == (b.path / "goals.json").read_bytes()
    assert (a.path / "study.json").read_bytes() == (b.path / "study.json").read_bytes()
    with TrialQueue(a) as one, TrialQueue(b) as two:
        bodies = [("baseline", {"height": 0.02, "joint_height": 0.006})]
        one.enqueue(bodies)
        two.enqueue(bodies)
        claimed = [one.claim(), two.claim(), one.claim()]
        assert [trial.number for trial in claimed] == [0, 1, 2]
        assert [trial.user_attrs["origin"] for trial in claimed] == ["baseline", "sampler 1", "sampler 2"]
        assert two.claim() is None
        for queue, trial in zip((one, two, one), claimed, strict=True):
            assert queue.finish(result(trial))
        assert one.left() == two.left() == 0
        for queue in (one, two):
            queue.mirror()
        assert a.results() == b.results() == [result(trial) for trial in claimed]


@pytest.mark.parametrize("call_lives", [False, True])
def test_worker_killed_with_its_call_does_not_blame_the_body(machine, call_lives):
    """The last heartbeat of the call came a little later: the call is not dead yet when the worker counts as dead."""
    folder = machine(trials=1)
    with TrialQueue(folder) as survivor:
        with doomed(folder) as call, doomed(folder) as victim:
            assert victim.call == call.worker
            lost = victim.claim()
        later = """
            UPDATE codesign_workers SET seen = victim.seen + make_interval(secs => :delay)
            FROM codesign_workers victim WHERE victim.worker = :victim AND codesign_workers.worker = :call
        """
        survivor.storage.execute(later, victim=victim.worker, call=call.worker, delay=GRACE / 8.0)

        def claimable():
            if call_lives:
                survivor.storage.execute(HEARTBEAT, worker=call.worker)
            return survivor.claimable()

        wait_until(claimable)
        again = survivor.claim()
    assert (again.number, again.params) == (1, lost.params)
    assert again.user_attrs["attempt"] == 1 + call_lives


def test_body_of_a_dead_worker_runs_again_on_another_machine(machine):
    a, b = machine("a", trials=1), machine("b", trials=1)
    with TrialQueue(b) as survivor:
        with doomed(a) as victim:
            lost = victim.claim()
            lost.report(0.25, 10)
            assert survivor.claim() is None  # its last heartbeat is recent
        wait_until(lambda: survivor.claimable())
        again = survivor.claim()
        assert (again.number, again.params) == (1, lost.params)
        assert again.user_attrs["origin"] == lost.user_attrs["origin"]
        assert survivor.study.trials[1].intermediate_values == {10: 0.25}
        # The worker was only out of reach; meanwhile its trial was reassigned.
        assert not victim.finish(result(lost, score=9.0))
        assert survivor.finish(result(again))
        assert states(survivor) == ["FAIL", "COMPLETE"]
        victim.mirror()
        assert a.results() == [result(again)]


def test_heartbeats_keep_a_trial(machine):
    folder = machine(trials=1)
    with TrialQueue(folder) as busy, TrialQueue(folder) as other:
        trial = busy.claim()
        time.sleep(2.5 * GRACE)
        assert not other.claimable()
        assert busy.finish(result(trial))


def test_time_without_the_server_does_not_count(machine, server):
    storage = machine(heartbeat=60.0).open_storage()
    assert not storage.lives("worker")
    storage.execute(HEARTBEAT, worker="worker")
    assert storage.lives("worker")
    storage.execute("UPDATE codesign_workers SET seen = now() - interval '1 hour'")
    storage.grace = 1e-3  # the server has run for longer
    assert not storage.lives("worker")
    server.restart()
    storage.grace = 60.0
    assert storage.lives("worker")


def test_transaction_is_atomic(machine):
    folder = machine(trials=2)
    with TrialQueue(folder) as queue:
        original, cut = queue._claim, []

        def claim(study):
            trial = original(study)
            if not cut:  # the server ends the connection at the last moment
                with queue.storage._engine.connect() as connection:
                    ended = connection.execute(
                        sql.text("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE state LIKE 'idle in%'")
                    )
                    cut.extend(ended.scalars())
            return trial

        queue._claim = claim
        trial = queue.claim()
        assert cut == [True]
        assert (trial.number, states(queue)) == (0, ["RUNNING"])
        assert queue.finish(result(trial))
        assert queue.claim().number == 1
        assert queue.claim() is None


def test_answers_that_got_lost(machine):
    folder = machine(trials=2)
    with TrialQueue(folder) as queue:
        first = queue._exclusively(queue._claim)  # done, but the answer got lost
        trial = queue.claim()
        assert (trial.number, trial.params) == (first.number, first.params)
        assert queue.finish(result(trial))
        assert queue.finish(result(trial))
        assert not queue.finish(result(trial, score=1.0))
        assert states(queue) == ["COMPLETE"]


def test_body_that_kills_its_workers_is_given_up(machine):
    folder = machine(trials=1, attempts=2)
    with TrialQueue(folder) as watcher:
        for number in range(2):
            wait_until(watcher.claimable)
            with doomed(folder) as victim:
                assert victim.claim().number == number
        wait_until(watcher.claimable)
        worker.run_trials(folder)
        watcher.mirror()
        (found,) = folder.results()
    assert (found.number, found.state, found.reason) == (2, "infeasible", "evaluation crashed 2 workers")


def test_jobs_are_shared(machine):
    a, b = machine("a"), machine("b")
    made = []

    def job(folder, name):
        return Job(folder.path / "screen" / f"{name}.json", lambda: made.append(name) or Account(name))

    run_pending(a, [job(a, "0")])
    assert missing_jobs(b, [job(b, "0")]) == []
    with a.open_storage().attempt("screen/1.json") as mine:
        assert mine
        thread = threading.Thread(target=run_pending, args=(b, [job(b, "1"), job(b, "2")]))
        thread.start()
        wait_until(lambda: (b.path / "screen" / "2.json").exists())
        assert not (b.path / "screen" / "1.json").exists()
    thread.join()
    assert made == ["0", "2", "1"]
    assert (b.path / "screen" / "1.json").exists()


def test_files_do_not_change(machine):
    storage = machine().open_storage()
    assert storage.fetch("trials/0000/policy.safetensors") is None
    storage.publish({"trials/0000/policy.safetensors": b"\x00\xff"})
    storage.publish({"trials/0000/policy.safetensors": b"other"})
    assert storage.fetch("trials/0000/policy.safetensors") == b"\x00\xff"


def test_policies_come_from_the_machine_that_trained_them(machine, monkeypatch):
    a, b = machine("a", trials=1), machine("b", trials=1)
    name = "trials/0000/policy.safetensors"
    a.trial(0).mkdir(parents=True)
    (a.path / name).write_bytes(b"weights")
    (a.path / name).with_suffix(".json").write_bytes(b"{}")
    tested = []
    monkeypatch.setattr(worker, "run_pending", lambda folder, jobs: tested.append(folder))
    snapshot = SimpleNamespace(folder=b, finalists=[SimpleNamespace(policy=name)], planned_tests=[], refinements=[])
    monkeypatch.setattr(worker, "load_study", lambda folder: snapshot)
    with TrialQueue(a) as queue:
        trial = queue.claim()
        with pytest.raises(DataError, match=f"policy '{name}' is neither in folder .* nor in storage"):
            worker.PHASES["finalists"](b)
        assert queue.finish(replace(result(trial), controller=name))
    worker.PHASES["finalists"](b)
    assert tested == [b]
    assert (b.path / name).read_bytes() == b"weights"
    assert (b.path / name).with_suffix(".json").read_bytes() == b"{}"


def test_other_studies_are_refused(machine, server, tmp_path, tiny):
    a = machine("a")
    with pytest.raises(ConfigError, match="with variables = .*; use another name, or change only: title, trials"):
        machine("b", variables=["height"])
    assert not (tmp_path / "b" / "config.yaml").exists()
    with pytest.raises(ConfigError, match="with name = .*; use another folder"):
        machine("a", name="other")
    with pytest.raises(ConfigError, match=r"holds a study with storage 'postgresql://.*', got 'journal'"):
        machine("a", storage="journal")
    machine("b", trials=9)
    storage = PostgresStorage(server.address, a.config.name)
    optuna.delete_study(study_name=a.config.name, storage=storage.optuna)
    with pytest.raises(ConfigError, match="is not in storage"):
        machine("a")
    with pytest.raises(DataError, match="has no study"):
        TrialQueue(a)
    machine("c")
    with pytest.raises(ConfigError, match="holds another study"):
        machine("a")


def test_options_of_tests_stay_once_there_is_one(machine):
    """Also on a machine without tests in its folder."""

    def on(folder, **options):
        return machine(folder, finalists={"count": 1, "fem_options": options})

    a = on("a", dynamics=True)
    on("b", dynamics=False)
    a = on("a", dynamics=False)
    a.open_storage().publish({"finalists/trial0000-qp-fem-unseen.json": b"{}"})
    with pytest.raises(ConfigError, match="with finalists.fem_options.*; use another name, or change only: title"):
        on("b", dynamics=True)
    on("b", dynamics=False)


def test_server_that_cannot_be_reached(tiny, tmp_path):
    data = tiny(storage="postgresql://nobody@127.0.0.1:1/none", patience=1.0)
    with pytest.raises(
        ConfigError, match=r"storage 'postgresql://nobody@127.0.0.1:1/none' cannot be opened: .*refused"
    ):
        run_study(StudyConfig.model_validate(data), tmp_path / "study", progress=False)
    assert not (tmp_path / "study" / "config.yaml").exists()
    with pytest.raises(SoftGymError, match=r"has not answered for 1 s: .*start the server and run the same command"):
        PostgresStorage(data["storage"], "tiny", patience=1.0, wait=True)


def test_sweep_with_killed_workers_and_a_restarted_server(machine, server):
    """Forty trials on two machines; two workers are killed, the server is restarted and crashes."""
    folders = [machine(name, trials=40, goals={"count": 20, "unseen_count": 2, "training_count": 2}) for name in "ab"]
    with Sweep(folders, seed=0) as sweep:
        for step in ("restart", "kill", "crash", "kill"):
            sweep.run_for(trials=2)
            if step == "kill":
                sweep.kill()
            else:
                server.restart("fast" if step == "restart" else "immediate")
        assert len(sweep.seen) < 40
        sweep.run_for(trials=40)
    for folder in folders:
        with TrialQueue(folder) as queue:
            queue.mirror()
        assert faults(folder, sweep.seen) == []
    assert folders[0].results() == folders[1].results()
