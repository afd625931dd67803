"""One worker process of a study: ``python -m softgym_envs.codesign.scheduling.worker FOLDER PHASE``."""

from __future__ import annotations

import errno
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from softgym_envs.codesign.folder import StudyFolder
from softgym_envs.codesign.phases.finalists import fetch_policies, finalist_jobs
from softgym_envs.codesign.phases.screen import screen_jobs
from softgym_envs.codesign.phases.shared_policy import shared_policy_jobs
from softgym_envs.codesign.phases.trial import give_up, run_trial
from softgym_envs.codesign.records import TrialResult
from softgym_envs.codesign.scheduling.jobs import run_pending
from softgym_envs.codesign.scheduling.queue import TrialQueue
from softgym_envs.codesign.search import run_search
from softgym_envs.codesign.snapshot import load_study
from softgym_envs.errors import SoftGymError

if TYPE_CHECKING:
    import optuna


def run_trials(folder: StudyFolder) -> None:
    """Run trials until the study has as many as its configuration says."""
    from optuna.exceptions import UpdateFinishedTrialError

    def evaluate(trials: Sequence[optuna.Trial]) -> Iterator[tuple[optuna.Trial, TrialResult]]:
        for trial in trials:
            run = give_up if trial.user_attrs.get("attempt", 1) > folder.config.attempts else run_trial
            try:
                # If the connection to the storage breaks, training continues from its last checkpoint.
                yield trial, queue.storage.patiently(partial(run, folder, trial))
            except UpdateFinishedTrialError:  # reassigned after missed heartbeats
                continue
            except SoftGymError:  # a problem of the installation or the storage
                raise
            except Exception:
                trial.set_user_attr("raised", True)
                raise

    with TrialQueue(folder) as queue:
        run_search(queue, evaluate)


def _test_finalists(folder: StudyFolder) -> None:
    """Run the check on FEM; policies of trials that ran on other machines are copied first."""
    snapshot = load_study(folder)
    fetch_policies(snapshot)
    run_pending(folder, finalist_jobs(snapshot))


STORAGE_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES)
"""Errors of the file system that the user can solve: no space, quota exceeded, read-only, not permitted."""

PHASES: dict[str, Callable[[StudyFolder], None]] = {
    "shared_policy": lambda folder: run_pending(folder, shared_policy_jobs(folder)),
    "screen": lambda folder: run_pending(folder, screen_jobs(folder)),
    "trials": run_trials,
    "finalists": _test_finalists,
}
"""Phases that workers can run."""


def _end_with_parent() -> None:
    """End this process as soon as its standard input closes: its parent has ended or wants it to end."""

    def watch() -> None:
        while os.read(0, 1):  # not sys.stdin, whose lock would abort the interpreter when it exits
            pass
        os._exit(3)

    threading.Thread(target=watch, daemon=True).start()


def main(arguments: list[str]) -> int:
    """Run a phase. Errors of the suite are one line on standard error and exit status 2; others are tracebacks."""
    path, phase = arguments
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    _end_with_parent()
    try:
        PHASES[phase](StudyFolder(Path(path)))
    except SoftGymError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        if error.errno not in STORAGE_ERRORS:
            raise
        print(f"DataError: '{error.filename or path}': {error.strerror}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
