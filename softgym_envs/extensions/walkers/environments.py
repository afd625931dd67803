"""Environments of bodies that move."""

from softgym_envs.envs.registration import DYNAMIC, environment_row

ENVIRONMENTS = {
    "SoftGym/QuadrupedWalk-v0": environment_row("quadruped", "walk", 100, backend="fem", backend_options=DYNAMIC),
    "SoftGym/QuadrupedClimb-v0": environment_row(
        "quadruped",
        "walk",
        100,
        backend="fem",
        backend_options=DYNAMIC,
        task_options={"friction": [0.4, 1.2], "slope": [-0.1, 0.2], "payload": 0.03, "push": 0.4, "push_steps": 10},
    ),
    "SoftGym/QuadrupedFollow-v0": environment_row(
        "quadruped",
        "follow",
        200,
        backend="fem",
        backend_options=DYNAMIC,
        task_options={"friction": [0.4, 1.2], "push": 0.4, "push_steps": 10},
    ),
    "SoftGym/CrawlerWalk-v0": environment_row(
        "crawler",
        "walk",
        100,
        backend="fem",
        backend_options=DYNAMIC,
        task_options={"pace": 0.08, "slip": 0.1, "work": 0.02},
    ),
    "SoftGym/SwimmerSwim-v0": environment_row("swimmer", "swim", 100, backend="fem", backend_options=DYNAMIC),
    # Shorter time steps than elsewhere: implicit Euler with the usual ones damps the swing.
    "SoftGym/WhipThrow-v0": environment_row(
        "whip",
        "throw",
        30,
        backend="fem",
        backend_options=DYNAMIC | {"time_step": 0.002},
        task_options={"payload": [0.015, 0.025]},
    ),
}
"""Rows by ID."""
