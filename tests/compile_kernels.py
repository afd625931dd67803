"""Compile the numerical kernels before tests start in several processes: ``python -m tests.compile_kernels``.

Processes that compile the same kernels at the same time need not get the same machine code: what one of them compiles,
the other may load, and then inlines nothing of it. Their results then differ in the last bits, and tests that compare
runs of several processes bit by bit fail. One process compiles all, and later ones load the same code.
"""

from __future__ import annotations

import sys
from typing import Any

import gymnasium
from numba import types
from numba.core.dispatcher import Dispatcher

import softgym_envs  # noqa: F401 - registers the IDs
from softgym_envs import make_robot
from softgym_envs.envs.registration import ENVIRONMENTS
from softgym_envs.mechanics.solvers.statics import Statics


def has_arrays(kind: Any) -> bool:
    """Return whether values of a compiled type are arrays or tuples with arrays."""
    return isinstance(kind, types.Array) or any(map(has_arrays, getattr(kind, "types", ())))


def check_reference_counts() -> None:
    """Raise if a kernel that counts no references returns arrays, whose memory would be freed too early.

    Of kernels that are loaded from a cache, only those that Python has called are known.
    """
    for module in [module for name, module in sys.modules.items() if name.startswith("softgym_envs.")]:
        for kernel in vars(module).values():
            if isinstance(kernel, Dispatcher) and kernel.targetoptions.get("_nrt") is False:
                if any(has_arrays(signature.return_type) for signature in kernel.nopython_signatures):
                    raise TypeError(
                        f"{kernel.py_func.__module__}.{kernel.py_func.__name__} returns arrays: compile it with counts"
                    )


def main() -> None:
    """Reset and step each robot of an environment on finite elements, and solve for equilibria of beams."""
    seen = set()
    for identifier, row in ENVIRONMENTS.items():
        if row.robot not in seen:
            seen.add(row.robot)
            env = gymnasium.make(identifier, backend="fem")
            env.reset(seed=0)
            env.step(env.action_space.sample())
            env.close()
    for name in ("trunk", "tetrapod"):
        robot = make_robot(name)
        Statics(robot.build()).solve(0.3 * robot.upper)
    check_reference_counts()


if __name__ == "__main__":
    main()
