"""Who runs which trial.

Every change of it happens under one lock of the operating system, so no trial is lost, run twice or one too many. A
trial belongs to a worker, and a worker holds a lock of its own while it lives: a trial whose worker's lock is free was
left behind (``kill -9``, power cut). Its result is taken over if it was already written; else its body is queued again.
"""

from __future__ import annotations

import os
import socket
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from codesign.config import PRUNERS, SAMPLERS, StudyConfig, construct
from codesign.folder import StudyFolder

if TYPE_CHECKING:
    import optuna

__all__ = ["Ledger", "open_study"]

STUDY = "codesign"
JOURNAL_LOCK = "journal"


def make_sampler(config: StudyConfig, number: int) -> optuna.samplers.BaseSampler:
    """Sampler for one trial. Its seed follows from the trial's number, so it does not matter which worker draws it."""
    import optuna

    sampler = config.sampler
    # A quasi-random sequence has one seed, and counts its points in the journal.
    seed = sampler.seed if sampler.name == "qmc" else trial_seed(config, number)
    return construct(getattr(optuna.samplers, SAMPLERS[sampler.name]), {"seed": seed, **sampler.options})


def trial_seed(config: StudyConfig, number: int) -> int:
    """Seed of the sampler for one trial."""
    return int(np.random.SeedSequence([config.sampler.seed, number]).generate_state(1)[0])


def make_pruner(config: StudyConfig) -> optuna.pruners.BasePruner:
    """Pruner of a study; those that count resources count environment steps."""
    import optuna

    options = dict(config.pruner.options)
    if config.pruner.name in ("hyperband", "successive_halving"):
        options.setdefault("min_resource", config.training.report_every)
    if config.pruner.name == "hyperband":
        options.setdefault("max_resource", config.training.steps)
    return construct(getattr(optuna.pruners, PRUNERS[config.pruner.name]), options)


def distributions(config: StudyConfig) -> dict[str, optuna.distributions.BaseDistribution]:
    """Range of each optimised variable [SI]."""
    import optuna

    space = config.space
    return {
        name: optuna.distributions.FloatDistribution(space[name].low, space[name].high, log=space[name].log)
        for name in config.variables
    }


def open_storage(folder: StudyFolder) -> optuna.storages.BaseStorage:
    """Open Optuna's journal of a folder, and mend it if a crash cut off its last line."""
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    path = folder.path / "journal.log"
    lock = folder.lock(JOURNAL_LOCK)
    with lock:
        # Whoever held this lock is gone, so a line without an end was cut off by a crash and was never acted upon.
        if path.exists() and (data := path.read_bytes()) and not data.endswith(b"\n"):
            with path.open("rb+") as stream:
                stream.truncate(data.rfind(b"\n") + 1)
    # Unlike Optuna's own lock files, these are freed by the kernel when their holder is killed.
    return JournalStorage(JournalFileBackend(str(path), lock_obj=lock))  # type: ignore[arg-type]


def open_study(
    folder: StudyFolder, storage: optuna.storages.BaseStorage | None = None, number: int = 0
) -> optuna.Study:
    """Open the Optuna study of a folder; it always maximises the score, see `codesign.objectives`.

    Args:
        folder: the study.
        storage: an open journal, opened anew by default.
        number: trial that the sampler is for.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    storage = open_storage(folder) if storage is None else storage
    sampler, pruner = make_sampler(folder.config, number), make_pruner(folder.config)
    if STUDY in optuna.get_all_study_names(storage):
        return optuna.load_study(study_name=STUDY, storage=storage, sampler=sampler, pruner=pruner)
    return optuna.create_study(study_name=STUDY, storage=storage, direction="maximize", sampler=sampler, pruner=pruner)


class Ledger:
    """The trials of a study, as one worker sees them. Use it as a context: the worker lives as long as it is open.

    Args:
        folder: the study.
    """

    def __init__(self, folder: StudyFolder) -> None:
        self.folder = folder
        self.worker = f"worker-{uuid.uuid4().hex[:12]}"
        self._alive = folder.lock(self.worker)
        self._lock = folder.lock("study")
        with self._lock:
            self._storage = open_storage(folder)
            self.study = open_study(folder, self._storage)

    def __enter__(self) -> Ledger:
        self._alive.acquire()
        return self

    def __exit__(self, *exception: object) -> None:
        Path(self._alive.lock_file).unlink(missing_ok=True)
        self._alive.release()

    def enqueue(self, bodies: list[tuple[str, dict[str, float]]]) -> None:
        """Queue bodies, each once however often this is called.

        Args:
            bodies: unique origin (such as ``"baseline"``) and value of each optimised variable [SI].
        """
        with self._lock:
            known = {trial.user_attrs.get("origin") for trial in self.study.get_trials(deepcopy=False)}
            for origin, values in bodies:
                if origin not in known:
                    self.study.enqueue_trial(values, user_attrs={"origin": origin})

    def claim(self) -> optuna.Trial | None:
        """Take the next trial, or None if the study has as many as were asked for."""
        config = self.folder.config
        with self._lock:
            if not self._claimable():
                return None
            number = len(self.study.get_trials(deepcopy=False))
            trial = open_study(self.folder, self._storage, number).ask(distributions(config))
            trial.set_user_attr("worker", self.worker)
            trial.set_user_attr("process", f"{socket.gethostname()}:{os.getpid()}")
            if "origin" not in trial.user_attrs:
                trial.set_user_attr("origin", f"sampler {trial.number}")
                trial.set_user_attr("sampler_seed", trial_seed(config, trial.number))
            self._inherit(trial)
        return trial

    def finish(self, result: dict[str, Any]) -> None:
        """Enter the result of a trial."""
        with self._lock:
            self._tell(result)

    def left(self) -> int:
        """Number of trials still to be finished, running ones included."""
        from optuna.trial import TrialState

        with self._lock:
            trials = self.study.get_trials(deepcopy=False)
        done = sum(trial.state in (TrialState.COMPLETE, TrialState.PRUNED) for trial in trials)
        queued = sum(trial.state in (TrialState.WAITING, TrialState.RUNNING) for trial in trials)
        return max(self.folder.config.trials - done, queued)

    def claimable(self) -> bool:
        """Tell whether there is a trial to take, after taking over what dead workers left behind."""
        with self._lock:
            return self._claimable()

    # -- under the lock ---------------------------------------------------------------------------------------------

    def _claimable(self) -> bool:
        from optuna.trial import TrialState

        self._recover()
        trials = self.study.get_trials(deepcopy=False)
        counted = sum(trial.state != TrialState.FAIL for trial in trials)
        return counted < self.folder.config.trials or any(trial.state == TrialState.WAITING for trial in trials)

    def _tell(self, result: dict[str, Any]) -> None:
        from optuna.trial import TrialState

        if result["state"] == "complete":
            self.study.tell(result["number"], result["score"])
        else:
            # An infeasible body is pruned without a value: samplers then rank it last, while failures teach nothing.
            self.study.tell(result["number"], state=TrialState.PRUNED)

    def _recover(self) -> None:
        from optuna.trial import TrialState

        trials = self.study.get_trials(deepcopy=False)
        replaced = {trial.user_attrs.get("replaces") for trial in trials}
        for trial in trials:
            if trial.state != TrialState.RUNNING or self._lives(trial.user_attrs.get("worker")):
                continue
            result = self.folder.result(trial.number)
            if result is not None:
                self._tell(result)
                continue
            # Queued before it is written off: a crash between the two does not lose it, and the mark keeps it single.
            if trial.number not in replaced:
                complete = set(trial.params) == set(self.folder.config.variables)
                values = trial.params if complete else trial.system_attrs.get("fixed_params")
                if values:  # else it died before its body was drawn: the next one is drawn in its place
                    marks: dict[str, Any] = {"origin": f"sampler {trial.number}", "replaces": trial.number}
                    for key in ("origin", "sampler_seed"):
                        if key in trial.user_attrs:
                            marks[key] = trial.user_attrs[key]
                    self.study.enqueue_trial(values, user_attrs=marks)
            self.study.tell(trial.number, state=TrialState.FAIL)

    def _lives(self, worker: str | None) -> bool:
        from filelock import Timeout

        if worker is None:  # killed while it held the lock that we hold now
            return False
        if worker == self.worker:
            return True
        lock = self.folder.lock(worker)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            return True
        Path(lock.lock_file).unlink(missing_ok=True)
        lock.release()
        return False

    def _inherit(self, trial: optuna.Trial) -> None:
        """Give a queued-again trial the training folder and the reports of the one that it replaces."""
        number = trial.user_attrs.get("replaces")
        if number is None:
            return
        old, new = self.folder.trial(number), self.folder.trial(trial.number)
        if old.exists() and not new.exists():
            old.rename(new)
        for step, value in self.study.get_trials(deepcopy=False)[number].intermediate_values.items():
            trial.report(value, step)
