"""The clock that budgets are measured with."""

import time

import numba

from softgym_envs.extensions.leaderboard.clock import working_seconds


def test_compilation_does_not_count():
    @numba.njit
    def inner(x):
        return x + 1.0

    @numba.njit
    def outer(x):
        return inner(x) * 2.0

    spent, worked = time.process_time(), working_seconds()
    assert outer(1.0) == 4.0  # compiles both
    compiled = (time.process_time() - spent) - (working_seconds() - worked)
    assert compiled > 0.0 and working_seconds() >= worked
    left_out = time.process_time() - working_seconds()
    outer(2.0)
    assert time.process_time() - working_seconds() < left_out + 0.5 * compiled  # the second call compiles nothing
