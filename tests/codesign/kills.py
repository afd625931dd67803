"""Worker processes of a study that are killed, and what is wrong with a folder afterwards."""

from __future__ import annotations

import multiprocessing
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from softgym_envs.codesign.folder import StudyFolder
from softgym_envs.codesign.records import TrialResult
from softgym_envs.codesign.scheduling.optuna_study import open_study
from softgym_envs.codesign.scheduling.storage import StudyStorage


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
        values = None if record is None or not record.scores else folder.config.signed(record.scores)
        if record is not None and (record.number, values) != (trial.number, trial.values):
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
                "softgym_envs.extensions.postgres.storage",
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
