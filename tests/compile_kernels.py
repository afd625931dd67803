"""Compile the numerical kernels before tests start in several processes: ``python -m tests.compile_kernels``.

Processes that compile the same kernels at the same time need not get the same machine code: what one of them compiles,
the other may load, and then inlines nothing of it. Their results then differ in the last bits, and tests that compare
runs of several processes bit by bit fail. One process compiles all, and later ones load the same code.
"""

from __future__ import annotations

import gymnasium

import softgym_envs  # noqa: F401 - registers the IDs
from softgym_envs import make_robot
from softgym_envs.envs.registration import ENVIRONMENTS
from softgym_envs.mechanics.solvers.statics import Statics


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


if __name__ == "__main__":
    main()
