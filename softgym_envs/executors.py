"""Parallel evaluation of a function, in processes of this machine."""

from __future__ import annotations

import os
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

PARENT_CHECK_INTERVAL = 0.2
"""Interval at which a worker process checks that its parent is still alive [s]."""


def parallel_map(function: Callable, arguments: Sequence[tuple], workers: int) -> Iterator[Any]:
    """Yield ``function(*row)`` for each row of ``arguments``.

    Results come in the order in which they are finished. The processes end when this one ends, even if it is killed.
    With one worker, this process does the work itself.

    Args:
        function: importable in a worker process.
        arguments: one tuple per call.
        workers: number of processes.
    """
    if workers <= 1 or len(arguments) <= 1:
        for row in arguments:
            yield function(*row)
    else:
        from joblib import Parallel, delayed, parallel_config

        # loky replaces workers that were idle for minutes or use much memory; the warning needs no action.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
        with parallel_config("loky", n_jobs=workers, initializer=_begin_worker, initargs=(os.getpid(),)):
            yield from Parallel(return_as="generator_unordered", batch_size=1)(
                delayed(function)(*row) for row in arguments
            )


def _begin_worker(parent: int) -> None:
    """Prepare a worker process: it ends soon after its parent, since a killed parent cannot stop its workers.

    Progress bars get a lock of this process. Their own is shared between processes, and Python warns of its semaphore
    when Ctrl-C has ended the worker.

    The thread compares the parent's ID instead of checking whether ``parent`` exists, because a killed process exists
    as a zombie until its own parent collects it.
    """
    from tqdm import tqdm

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_CHECK_INTERVAL)
        os._exit(1)

    tqdm.set_lock(threading.RLock())
    threading.Thread(target=watch, name="parent-watch", daemon=True).start()
