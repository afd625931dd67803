"""Studies whose processes are killed and whose database is restarted, and how the time of a study is spent.

``softgym bench codesign_kills codesign_profile`` (ten minutes).
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.postgres_server import PostgresServer, temporary_server
from softgym_envs.codesign.config import JOURNAL, StudyConfig
from softgym_envs.codesign.folder import StudyFolder
from softgym_envs.codesign.records import TrialResult
from softgym_envs.codesign.scheduling.optuna_study import open_study
from softgym_envs.codesign.scheduling.storage import StudyStorage

TRIALS = 200
WORKERS = 2
KILLS = 10

PLAIN = {
    "name": "sweep",
    "environment": {"id": "SoftGym/FingerReach-v0"},
    "variables": ["height", "joint_height"],
    "workers": WORKERS,
    # TPE proposes no body twice, so a repeated body reveals a trial that ran twice; a Gaussian process repeats corners.
    "sampler": {"name": "tpe"},
    "heartbeat": 10.0,
    "finalists": {"count": 0},
}
SCORED = {"strategy": "qp", "trials": TRIALS, "goals": {"count": 30, "unseen_count": 2, "training_count": 2}}
TRAINED = {"strategy": "scratch", "trials": 8, "goals": {"count": 40, "unseen_count": 40, "training_count": 300}}


def finished(folder: StudyFolder, storage: StudyStorage) -> dict[int, Any]:
    """Result of every finished trial, by number, from the database, or for a journal from the folder."""
    trials = storage.patiently(lambda: open_study(folder, storage).get_trials(deepcopy=False))
    ended = [trial for trial in trials if trial.state.name in ("COMPLETE", "PRUNED")]
    return {
        trial.number: TrialResult.from_json(trial.user_attrs["result"])
        if storage.shared
        else folder.result(trial.number)
        for trial in ended
    }


def faults(folder: StudyFolder, seen: dict[int, Any]) -> list[str]:
    """Return the faults of a finished sweep; empty if every finished trial was kept exactly once.

    Args:
        folder: the study.
        seen: results that were finished at some point during the sweep, by number.
    """
    trials = open_study(folder).get_trials(deepcopy=False)
    counted = [trial for trial in trials if trial.state.name != "FAIL"]
    records = {record.number: record for record in folder.results()}
    found = []
    if len(counted) != folder.config.trials:
        found.append(f"{len(counted)} trials instead of {folder.config.trials}")
    found += [f"trial {t.number} is {t.state.name}" for t in counted if t.state.name not in ("COMPLETE", "PRUNED")]
    found += [f"trial {number} was lost or changed" for number, r in seen.items() if records.get(number) != r]
    unpaired = set(records) ^ {trial.number for trial in counted}
    found += [f"trial {number} has no result, or its result has no trial" for number in unpaired]
    for trial in counted:
        record = records.get(trial.number)
        if record is not None and (record.number, record.scores) != (trial.number, trial.values):
            found.append(f"trial {trial.number} has the result of another trial")
    for what, keys in (
        ("origin", [trial.user_attrs["origin"] for trial in counted]),
        ("body", [tuple(trial.params.values()) for trial in counted]),
    ):
        found += [f"{what} {key} ran {count} times" for key, count in Counter(keys).items() if count > 1]
    return found


class Sweep:
    """Worker processes, one for each folder of a study, which are killed at random moments.

    Args:
        folders: of one study; several if its storage is a database.
        seed: seed of the moments of the kills.

    Attributes:
        seen: finished results, by number.
    """

    def __init__(self, folders: Sequence[StudyFolder], seed: int) -> None:
        self.folders = folders
        self.seen: dict[int, Any] = {}
        self._storage = folders[0].open_storage()
        self._rng = np.random.default_rng(seed)
        self._context = multiprocessing.get_context("forkserver")  # imports of the workers run once
        self._context.set_forkserver_preload(
            [
                "softgym_envs.codesign.scheduling.worker",
                "softgym_envs.codesign.scheduling.postgres",
                "softgym_envs.agents.evaluation",
                "optuna",
                "psycopg",
                "sqlalchemy.orm",
            ]
        )
        self._processes: dict[int, multiprocessing.process.BaseProcess] = {}

    def __enter__(self) -> Sweep:
        return self

    def __exit__(self, *exception: object) -> None:
        for process in self._processes.values():
            process.kill()
            process.join()

    def run_for(self, trials: int) -> None:
        """Run until this many more trials, or all trials, are finished, and for a random moment longer."""
        total = self.folders[0].config.trials
        goal = min(len(self.seen) + trials, total)
        while len(self.seen) < goal:
            for index, folder in enumerate(self.folders):  # start again any that ended because there was no trial left
                if index not in self._processes or not self._processes[index].is_alive():
                    self._processes[index] = self._context.Process(target=_work, args=(str(folder.path),), daemon=True)
                    self._processes[index].start()
            time.sleep(0.2)
            self.seen |= finished(self.folders[0], self._storage)
        time.sleep(self._rng.uniform(0.0, 0.5))

    def kill(self) -> None:
        """Kill one of the workers."""
        process = self._processes.pop(int(self._rng.choice(sorted(self._processes))))
        process.kill()
        process.join()
        self.seen |= finished(self.folders[0], self._storage)


def _work(path: str) -> None:
    from softgym_envs.codesign.scheduling.worker import run_trials

    run_trials(StudyFolder(path))


def _command(folder: Path, config: dict[str, Any]) -> list[str]:
    path = folder.with_suffix(".yaml")
    path.write_text(yaml.safe_dump(config))
    return [sys.executable, "-m", "softgym_envs.cli", "codesign", "--config", str(path), "--folder", str(folder)]


@contextmanager
def _storage(name: str) -> Iterator[PostgresServer | None]:
    with ExitStack() as stack:
        yield stack.enter_context(temporary_server()) if name != JOURNAL else None


def _killed_sweep(storage: str, seed: int) -> dict[str, object]:
    """Kill a sweep ten times with all its processes; with PostgreSQL, restart the server twice in between."""
    rng = np.random.default_rng(seed)
    started, restarts = time.perf_counter(), 0
    seen: dict[int, Any] = {}
    moments: list[int] = []
    with tempfile.TemporaryDirectory() as place, _storage(storage) as server:
        config = {**PLAIN, **SCORED, "storage": server.address if server else JOURNAL}
        folder = StudyFolder.create(Path(place) / "sweep", StudyConfig.model_validate(config))
        command, trials = _command(folder.path, config), folder.open_storage()
        for attempt in range(KILLS + 1):
            last = attempt == KILLS
            goal = TRIALS if last else len(seen) + int(rng.integers(0, 20))
            # If enough trials are already finished, the kill hits processes that are starting.
            pause = rng.uniform(0.0, 8.0 if goal == len(seen) else 1.0)
            with subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True) as process:
                while process.poll() is None and len(seen) < goal:
                    time.sleep(0.2)
                    before = len(seen)
                    seen |= finished(folder, trials)
                    if server and len(seen) > before and attempt in (KILLS // 2, KILLS) and restarts <= last:
                        server.restart("fast")
                        restarts += 1
                if not last:
                    time.sleep(pause)
                    if process.poll() is None:
                        os.killpg(process.pid, signal.SIGKILL)
                        moments.append(len(seen))
            seen |= finished(folder, trials)
        found = faults(folder, seen)
        if process.returncode:
            found.append(f"the last run ended with status {process.returncode}")
        states = Counter(trial.state.name for trial in open_study(folder).get_trials(deepcopy=False))
    if found or len(moments) < KILLS:
        raise AssertionError(f"sweep with storage '{storage}', {len(moments)} kills: {'; '.join(found)}")
    return {
        f"{storage}: trials, workers": f"{TRIALS}, {WORKERS}",
        f"{storage}: kills, restarts of the server": f"{len(moments)}, {restarts}",
        f"{storage}: trials finished at each kill": ", ".join(map(str, moments)),
        f"{storage}: trials under way that were killed and ran again": states["FAIL"],
        f"{storage}: finished trials kept once, lost or twice": f"{len(seen)}, {len(found)}",
        f"{storage}: wall time [s]": time.perf_counter() - started,
    }


def kills() -> dict[str, object]:
    """Studies of 200 trials, killed ten times and continued, with a journal and with a restarted PostgreSQL."""
    return {**_killed_sweep(JOURNAL, seed=0), **_killed_sweep("postgresql", seed=1)}


def _timed_worker(path: str, output: str, started: str) -> None:
    """Run a worker and write how long it was inside training, evaluation and the queue [s]."""
    import softgym_envs.codesign.phases.trial
    import softgym_envs.codesign.scheduling.worker

    spent = Counter[str]()

    def timed(module: Any, name: str) -> None:
        function = getattr(module, name)

        def wrapper(*arguments: Any, **options: Any) -> Any:
            started = time.perf_counter()
            try:
                return function(*arguments, **options)
            finally:
                spent[name] += time.perf_counter() - started

        setattr(module, name, wrapper)

    timed(softgym_envs.codesign.phases.trial, "train")
    timed(softgym_envs.codesign.phases.trial, "assess")
    for name in ("claim", "finish"):
        timed(softgym_envs.codesign.scheduling.worker.TrialQueue, name)
    spent["start"] = time.time() - float(started)
    softgym_envs.codesign.scheduling.worker.run_trials(StudyFolder(path))
    Path(output).write_text(json.dumps(spent))


def profile() -> dict[str, object]:
    """How the time of a plain sweep is spent (training from scratch, 8 trials, 2 workers)."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    with tempfile.TemporaryDirectory() as place:
        folder = StudyFolder.create(Path(place) / "sweep", StudyConfig.model_validate({**PLAIN, **TRAINED}))
        outputs = [Path(place) / f"{index}.json" for index in range(WORKERS)]
        started = time.perf_counter()
        code = "import sys; from benchmarks.codesign_scale import _timed_worker as work; work(*sys.argv[1:])"
        command = [sys.executable, "-c", code, str(folder.path)]
        workers = [
            subprocess.Popen([*command, str(output), str(time.time())], env={**os.environ, **threads})
            for output in outputs
        ]
        for worker in workers:
            if worker.wait():
                raise RuntimeError(f"a worker of the profile ended with status {worker.returncode}")
        wall = time.perf_counter() - started
        spent = sum((Counter(json.loads(output.read_text())) for output in outputs), Counter())
        trials, steps = len(folder.results()), folder.config.training.steps
    total = WORKERS * wall
    parts = {"training": spent["train"], "evaluation": spent["assess"], "start of the workers": spent["start"]}
    parts["claiming and finishing trials"] = spent["claim"] + spent["finish"]
    parts["the rest, idle at the end included"] = total - sum(parts.values())
    return {
        "trials, environment steps of each": f"{trials}, {steps}",
        "wall time [s]": wall,
        **{f"share of {name} [%]": 100.0 * seconds / total for name, seconds in parts.items()},
        "share inside training or evaluation [%]": 100.0 * (spent["train"] + spent["assess"]) / total,
    }
