"""Starting and watching the worker processes of a study."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from codesign.folder import StudyFolder
from softgym_envs import errors

__all__ = ["run_workers"]

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def run_workers(
    folder: StudyFolder, phase: str, count: int, tick: Callable[[], None] = lambda: None, *, interval: float = 0.2
) -> str | None:
    """Run a phase of a study in worker processes of one thread each, and wait for all of them.

    The workers end when this process does, however it ends. A worker that was killed is reported only: another one may
    have finished its work.

    Args:
        folder: the study.
        phase: name in `codesign.worker.PHASES`.
        count: number of processes.
        tick: called every ``interval`` seconds, and once at the end.
        interval: [s].

    Returns:
        What ended a worker early, or None.

    Raises:
        SoftGymError: if a worker ended with an error of the suite, or with one that is a bug.
    """
    root = str(Path(__file__).resolve().parent.parent)
    paths = [root, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    environment = {**os.environ, **dict.fromkeys(THREADS, "1"), "PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-m", "codesign.worker", str(folder.path), phase]
    with tempfile.TemporaryFile("w+") as complaints:
        workers = [
            subprocess.Popen(command, stdin=subprocess.PIPE, stderr=complaints, env=environment) for _ in range(count)
        ]
        try:
            while any(worker.poll() is None for worker in workers):
                time.sleep(interval)
                tick()
                if any((worker.returncode or 0) > 0 for worker in workers):
                    break
            failed = [worker.returncode for worker in workers if worker.returncode]
        finally:
            # Closing its standard input ends a worker.
            for worker in workers:
                if worker.stdin is not None:
                    worker.stdin.close()
            for worker in workers:
                worker.wait()
        tick()
        for status in failed:
            if status > 0:
                complaints.seek(0)
                raise _failure(phase, status, complaints.read())
    return f"killed by signal {-failed[0]}" if failed else None


def _failure(phase: str, status: int, text: str) -> errors.SoftGymError:
    """The error of a worker, read back from its last line."""
    lines = [line for line in text.splitlines() if line.strip()]
    last = lines[-1].strip() if lines else "no message"
    kind, separator, message = last.partition(": ")
    if status == 2 and separator and kind in errors.__all__:
        return getattr(errors, kind)(message)
    sys.stderr.write(text)
    return errors.SoftGymError(f"a worker of phase '{phase}' stopped: {last}")
