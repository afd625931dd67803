"""Starting and watching the workers of a study, which are processes of this machine."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import softgym_envs
from softgym_envs import errors
from softgym_envs.codesign.folder import StudyFolder

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


class WorkerError(RuntimeError):
    """An exception ended a worker, for example a bug in the file of a robot. The message has the worker's traceback."""


def run_workers(
    folder: StudyFolder, phase: str, count: int, tick: Callable[[], None] = lambda: None, *, interval: float = 0.2
) -> str | None:
    """Run a phase of a study in workers of one thread each, and wait for all of them.

    The workers end with this process, however it ends. A worker that was killed is replaced, at most ``attempts`` times
    for each of them.

    Args:
        folder: the study.
        phase: name in `softgym_envs.codesign.scheduling.worker.PHASES`.
        count: number of workers.
        tick: called every ``interval`` seconds, and once at the end.
        interval: [s].

    Returns:
        How a worker ended that was not replaced, or None.

    Raises:
        SoftGymError: if an error of the suite ended a worker.
        WorkerError: if any other exception ended a worker.
    """
    environment = {**os.environ, **dict.fromkeys(THREADS, "1"), "PYTHONPATH": _search_path()}
    command = [sys.executable, "-m", "softgym_envs.codesign.scheduling.worker", str(folder.path), phase]
    with tempfile.TemporaryFile("w+") as output:

        def start() -> subprocess.Popen[bytes]:
            return subprocess.Popen(command, stdin=subprocess.PIPE, stderr=output, env=environment)

        workers = [start() for _ in range(count)]
        spare = folder.config.attempts * count
        try:
            while any(worker.poll() is None for worker in workers):
                time.sleep(interval)
                tick()
                for index, worker in enumerate(workers):
                    if (worker.poll() or 0) < 0 and spare > 0:
                        _release(worker)
                        workers[index] = start()
                        spare -= 1
                if any((worker.returncode or 0) > 0 for worker in workers):
                    break
            failed = [worker.returncode for worker in workers if worker.returncode]
        finally:
            for worker in workers:
                _release(worker)
        tick()
        for status in failed:
            if status > 0:
                output.seek(0)
                raise _failure(phase, status, output.read())
    return f"killed by signal {-failed[0]}" if failed else None


def _search_path() -> str:
    """``PYTHONPATH`` with which workers find the same modules as this process, those next to its script included."""
    own = [str(Path(softgym_envs.__file__).resolve().parents[1])]
    installed = tuple({os.path.join(prefix, "") for prefix in (sys.prefix, sys.base_prefix)})
    given = [os.path.abspath(entry) for entry in sys.path if not entry.startswith(installed)]
    return os.pathsep.join(
        dict.fromkeys([*own, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep)), *given])
    )


def _release(worker: subprocess.Popen[bytes]) -> None:
    """End a worker by closing its standard input, and wait until it has ended."""
    if worker.stdin is not None:
        worker.stdin.close()
    worker.wait()


def _failure(phase: str, status: int, text: str) -> Exception:
    """Return the error of a worker, read from what it wrote to standard error."""
    lines = [line for line in text.splitlines() if line.strip()]
    kind, separator, message = (lines[-1].strip() if lines else "").partition(": ")
    error = getattr(errors, kind, None)
    if status == 2 and separator and isinstance(error, type) and issubclass(error, errors.SoftGymError):
        return error(message)
    return WorkerError(f"a worker of phase '{phase}' failed with exit status {status}:\n\n{text.strip()}")
