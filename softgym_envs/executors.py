"""Independent jobs on several processes, or on a Ray cluster: one call for both, by joblib."""

from __future__ import annotations

import os
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

__all__ = ["EXECUTORS", "run_jobs"]

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


def _run_on_ray(jobs: Sequence[tuple[Callable, tuple]], workers: int) -> list[Any]:
    try:
        import ray
        from ray.util.joblib import register_ray
    except ImportError as error:
        raise ValueError(f"executor = 'ray' needs Ray ({error}): pip install 'softgym-envs[ray]'") from None
    from joblib import Parallel, delayed, parallel_config

    if not jobs:
        return []
    register_ray()
    ours = not ray.is_initialized()
    try:
        with parallel_config("ray", n_jobs=workers):
            return Parallel(batch_size=1)(delayed(function)(*arguments) for function, arguments in jobs)
    finally:
        if ours:
            ray.shutdown()


def _follow(owner: int) -> None:
    """Make this worker end soon after the process ``owner`` that started it, of whose death nobody tells it.

    Its parent is asked, not whether ``owner`` lives: a dead process may wait long for somebody to take note of it.
    """

    def watch() -> None:
        while os.getppid() == owner:
            time.sleep(_WATCH)
        os._exit(1)

    threading.Thread(target=watch, name="owner", daemon=True).start()
