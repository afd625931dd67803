"""One worker process of a study: ``python -m codesign.worker FOLDER PHASE``, started by `codesign.processes`."""

from __future__ import annotations

import os
import signal
import sys
import threading
from pathlib import Path

from codesign.finalists import finalist_jobs
from codesign.folder import StudyFolder
from codesign.jobs import run_jobs
from codesign.ledger import Ledger
from codesign.screen import screen_jobs
from codesign.trial import run_trial
from softgym_envs.errors import SoftGymError

__all__ = ["PHASES", "run_trials"]


def run_trials(folder: StudyFolder) -> None:
    """Run trials until the study has as many as were asked for."""
    with Ledger(folder) as ledger:
        while (trial := ledger.claim()) is not None:
            ledger.finish(run_trial(folder, trial))


PHASES = {
    "screen": lambda folder: run_jobs(folder, screen_jobs(folder)),
    "trials": run_trials,
    "finalists": lambda folder: run_jobs(folder, finalist_jobs(folder)),
}
"""What a worker can be told to do."""


def _end_with_parent() -> None:
    """End this process at once when its standard input closes, which is when its parent is gone or wants it to."""

    def watch() -> None:
        while os.read(0, 1):  # not sys.stdin: its lock, held here, would abort the interpreter's own end
            pass
        os._exit(3)

    threading.Thread(target=watch, daemon=True).start()


def main(arguments: list[str]) -> int:
    """Work; errors of the suite are one line on standard error and exit status 2."""
    path, phase = arguments
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    _end_with_parent()
    try:
        PHASES[phase](StudyFolder(Path(path)))
    except SoftGymError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
