"""A line on standard error when compiled kernels are not in Numba's cache yet, so that the wait is understood."""

from __future__ import annotations

import os
import sys

from numba.core import event

ANNOUNCED = "SOFTGYM_COMPILATION_ANNOUNCED"
"""Environment variable that is set once the line has been printed; worker processes inherit it."""


class _Announcement(event.Listener):
    """Prints one line before the first kernel of the package is compiled."""

    def on_start(self, event: event.Event) -> None:
        module = getattr(event.data["dispatcher"].py_func, "__module__", "")
        if module.startswith("softgym_envs.") and ANNOUNCED not in os.environ:
            os.environ[ANNOUNCED] = "1"
            print(
                "softgym-envs: compiling numerical kernels (up to a minute); later runs load them from a cache",
                file=sys.stderr,
                flush=True,
            )

    def on_end(self, event: event.Event) -> None:
        pass


def announce_compilation() -> None:
    """Print a line when the first kernel of the package is compiled, in this process or one that it starts."""
    event.register("numba:compile", _Announcement())
