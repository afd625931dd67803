"""Environments of held bodies of beams."""

from softgym_envs.envs.registration import DYNAMIC, environment_row

ENVIRONMENTS = {
    "SoftGym/TrunkReach-v0": environment_row("trunk", "reach", 50),
    "SoftGym/TrunkTrack-v0": environment_row("trunk", "track", 100),
    "SoftGym/TetrapodReach-v0": environment_row("tetrapod", "reach", 100, backend="fem", backend_options=DYNAMIC),
    "SoftGym/TetrapodTrack-v0": environment_row("tetrapod", "track", 100, backend="fem", backend_options=DYNAMIC),
    # The goal is beyond the reach of servos that turn by 90 degrees, and coarse legs fold on the way to it.
    "SoftGym/TetrapodCarry-v0": environment_row(
        "tetrapod",
        "carry",
        100,
        backend="fem",
        backend_options=DYNAMIC,
        robot_options={"mesh": "accurate", "servo_range": 2.8},
    ),
}
"""Rows by ID."""
