"""One worker process of a study: ``python -m codesign.scheduling.worker FOLDER PHASE``; see `.processes`."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from codesign.folder import StudyFolder
from codesign.phases.finalists import fetch_policies, finalist_jobs
from codesign.phases.screen import screen_jobs
from codesign.phases.shared_policy import judge_jobs
from codesign.phases.trial import run_trial
from codesign.scheduling.jobs import run_jobs
from codesign.scheduling.queue import Ledger
from softgym_envs.errors import SoftGymError
from softgym_envs.storage import write_json

if TYPE_CHECKING:
    import optuna

__all__ = ["PHASES", "run_trials"]


def run_trials(folder: StudyFolder) -> None:
    """Run trials until the study has as many as were asked for."""
    from optuna.exceptions import UpdateFinishedTrialError

    with Ledger(folder) as ledger:
        while (trial := ledger.claim()) is not None:
            run = _give_up if trial.user_attrs.get("attempt", 1) > folder.config.attempts else run_trial
            # Where the storage goes away in the middle, training goes on from its last checkpoint.
            try:
                result = ledger.storage.patiently(partial(run, folder, trial))
            except UpdateFinishedTrialError:  # it was given away: this worker was out of reach, and counted as dead
                continue
            except SoftGymError:  # of the installation or the storage, not of the body
                raise
            except Exception:
                trial.set_user_attr("raised", True)  # the body is blamed, though the call ends as well
                raise
            ledger.finish(result)


def _give_up(folder: StudyFolder, trial: optuna.Trial) -> dict[str, Any]:
    """Write the ``result.json`` of a body that cost too many workers and return it; see `run_trial`."""
    reason = f"{folder.config.attempts} workers died of it"
    result: dict[str, Any] = {
        "number": trial.number,
        "origin": trial.user_attrs["origin"],
        "sampler_seed": trial.user_attrs.get("sampler_seed"),
        "process": trial.user_attrs["process"],
        "design": folder.config.space.complete({**folder.config.baseline, **trial.params}),
        "state": "infeasible",
        "score": None,
        "scores": None,
        "violations": None,
        "reason": reason,
        "agent": "qp",
        "evaluation": None,
        "qp": {"error": reason},
        "curve": [],
        "training_steps": 0,
        "seconds": 0.0,
        "cpu_seconds": 0.0,
        "finished_at": time.time(),
    }
    write_json(folder.trial(trial.number) / "result.json", result)
    return result


def _test_finalists(folder: StudyFolder) -> None:
    """Run the check on FEM, with the policies of trials that ran elsewhere."""
    fetch_policies(folder)
    run_jobs(folder, finalist_jobs(folder))


PHASES: dict[str, Callable[[StudyFolder], None]] = {
    "judge": lambda folder: run_jobs(folder, judge_jobs(folder)),
    "screen": lambda folder: run_jobs(folder, screen_jobs(folder)),
    "trials": run_trials,
    "finalists": _test_finalists,
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
