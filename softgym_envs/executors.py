"""Independent jobs on several processes, or on a Ray cluster: one call for both, by joblib."""

from __future__ import annotations

import os
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from softgym_envs.errors import ConfigError

EXECUTORS = ("loky", "ray")
"""``"loky"``: processes on this machine; ``"ray"``: a Ray cluster (the extra ``ray``)."""

_WATCH = 0.2  # seconds between two looks of a worker at its owner


def run_jobs(jobs: Sequence[tuple[Callable, tuple]], workers: int, executor: str = "loky") -> Iterator[Any]:
    """Run ``function(*arguments)`` of each job and yield the results.

    Processes of this machine give them as they come, in any order, and end when this process does, however it does; a
    cluster gives them together at the end. One worker on this machine is this very process. The cluster is that of
    ``RAY_ADDRESS``, or one that is started here and stopped at the end.

    Raises:
        ValueError: for an unknown executor, or Ray where it is not installed.
    """
    if executor not in EXECUTORS:
        raise ValueError(f"executor = {executor!r} is unknown; allowed: {', '.join(map(repr, EXECUTORS))}")
    if executor == "ray":
        yield from _run_on_ray(jobs, workers)
    elif workers <= 1 or len(jobs) <= 1:
        for function, arguments in jobs:
            yield function(*arguments)
    else:
        from joblib import Parallel, delayed, parallel_config

        # loky ends workers that were idle for minutes or grew large, and starts others: nothing to act on.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
        with parallel_config("loky", n_jobs=workers, initializer=_follow, initargs=(os.getpid(),)):
            yield from Parallel(return_as="generator_unordered", batch_size=1)(
                delayed(function)(*arguments) for function, arguments in jobs
            )


@contextmanager
def ray_cluster() -> Iterator[Any]:
    """Yield the module ``ray`` connected to a cluster: a running one, that of ``RAY_ADDRESS``, or a new local one.

    A cluster that this function connected to or started is left at the end.

    Raises:
        ConfigError: if Ray is not installed.
    """
    try:
        import ray
    except ImportError as error:
        raise ConfigError(f"executor = 'ray' needs Ray ({error}): pip install 'softgym-envs[ray]'") from None
    ours = not ray.is_initialized()
    if ours:
        ray.init(log_to_driver=False, configure_logging=False)
    try:
        yield ray
    finally:
        if ours:
            ray.shutdown()


def _run_on_ray(jobs: Sequence[tuple[Callable, tuple]], workers: int) -> list[Any]:
    if not jobs:
        return []
    with ray_cluster():
        from joblib import Parallel, delayed, parallel_config
        from ray.util.joblib import register_ray

        register_ray()
        with parallel_config("ray", n_jobs=workers):
            return Parallel(batch_size=1)(delayed(function)(*arguments) for function, arguments in jobs)


def _follow(owner: int) -> None:
    """Make this worker end soon after the process ``owner`` that started it, of whose death nobody tells it.

    Its parent is asked, not whether ``owner`` lives: a dead process may wait long for somebody to take note of it.
    """

    def watch() -> None:
        while os.getppid() == owner:
            time.sleep(_WATCH)
        os._exit(1)

    threading.Thread(target=watch, name="owner", daemon=True).start()
