"""The clock of the benchmark: CPU time without that of compiling numerical kernels, which a machine does once."""

from __future__ import annotations

import time

from numba.core import event

from softgym_envs.envs.parallel import cpu_seconds


class _Compilations(event.Listener):
    """Adds up the CPU seconds in which this process compiles kernels, each with those that it needs."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._nested = 0
        self._began = 0.0

    def on_start(self, event: event.Event) -> None:
        if self._nested == 0:
            self._began = time.process_time()
        self._nested += 1

    def on_end(self, event: event.Event) -> None:
        self._nested -= 1
        if self._nested == 0:
            self.seconds += time.process_time() - self._began


_COMPILATIONS = _Compilations()
event.register("numba:compile", _COMPILATIONS)


def working_seconds() -> float:
    """Return the CPU seconds [s] of `cpu_seconds`, without those of compilation in this process."""
    return cpu_seconds() - _COMPILATIONS.seconds
