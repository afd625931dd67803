"""Parallel evaluation of a function, in processes on this machine or on a Ray cluster."""

from __future__ import annotations

import os
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from softgym_envs.errors import ConfigError

EXECUTORS = ("processes", "ray")
"""``"processes"`` of this machine; ``"ray"``: a Ray cluster (the extra ``ray``)."""

PARENT_CHECK_INTERVAL = 0.2
"""Interval at which a worker process checks that its parent is still alive [s]."""


def parallel_map(
    function: Callable, arguments: Sequence[tuple], workers: int, executor: str = "processes"
) -> Iterator[Any]:
    """Yield ``function(*row)`` for each row of ``arguments``.

    Local processes yield results in the order in which they finish, and end when this process ends, even if it is
    killed. A Ray cluster yields all results at the end. With one local worker, this process does the work itself.

    Args:
        function: importable in a worker process.
        arguments: one tuple per call.
        workers: number of processes.
        executor: one of `EXECUTORS`.

    Raises:
        ValueError: for an unknown executor.
        ConfigError: if the executor is ``"ray"`` and Ray is not installed.
    """
    if executor not in EXECUTORS:
        raise ValueError(f"executor = {executor!r} is unknown; allowed: {', '.join(map(repr, EXECUTORS))}")
    if executor == "ray":
        yield from _map_on_ray(function, arguments, workers)
    elif workers <= 1 or len(arguments) <= 1:
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


@contextmanager
def ray_cluster() -> Iterator[Any]:
    """Yield the module ``ray``, connected to a cluster.

    The cluster is the one that this process is already connected to, else the one at ``RAY_ADDRESS``, else a new local
    one. A connection or cluster that this function opened is closed at the end.

    Raises:
        ConfigError: if Ray is not installed.
    """
    try:
        import ray
    except ImportError as error:
        raise ConfigError(f"executor = 'ray' needs Ray ({error}): pip install 'softgym-envs[ray]'") from None
    connect = not ray.is_initialized()
    if connect:
        ray.init(log_to_driver=False, configure_logging=False)
    try:
        yield ray
    finally:
        if connect:
            ray.shutdown()


def _map_on_ray(function: Callable, arguments: Sequence[tuple], workers: int) -> list[Any]:
    if not arguments:
        return []
    with ray_cluster():
        from joblib import Parallel, delayed, parallel_config
        from ray.util.joblib import register_ray

        register_ray()
        with parallel_config("ray", n_jobs=workers):
            return Parallel(batch_size=1)(delayed(function)(*row) for row in arguments)


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
