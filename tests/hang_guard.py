"""Timeout of tests that hang, which allows for slow and busy machines."""

from __future__ import annotations

import faulthandler
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

LIMIT = 900.0
"""Time that a test may take on a machine with a free core [s]; the slowest tests take a minute.

The load average follows the true load only slowly, hence the wide margin: it ends tests that hang, not slow ones.
"""

INTERVAL = 5.0
"""Interval between measurements of the load of the machine [s]."""


def slowdown() -> float:
    """Return how many processes share a core, at least 1."""
    return max(1.0, os.getloadavg()[0] / len(os.sched_getaffinity(0)))


@contextmanager
def end_if_hung(stream: TextIO | int, limit: float = LIMIT, interval: float = INTERVAL) -> Iterator[None]:
    """End this process with the stacks of all threads on ``stream`` if the block takes too long.

    The clock runs slower while the machine is busy. The timer itself is faulthandler's, which also ends a block that
    never releases the interpreter.

    Args:
        stream: where the stacks are written: a file or its descriptor.
        limit: time that the block may take on an idle machine [s].
        interval: time between measurements of the load [s].
    """
    done = threading.Event()

    def watch() -> None:
        used = 0.0
        while not done.is_set():
            share = slowdown()
            faulthandler.dump_traceback_later(max(limit - used, 1e-3) * share, exit=True, file=stream)
            done.wait(interval)
            used += interval / share

    watcher = threading.Thread(target=watch, name="hang-guard", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        done.set()
        watcher.join()
        faulthandler.cancel_dump_traceback_later()
