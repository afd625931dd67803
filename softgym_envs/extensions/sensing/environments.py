"""Environments of the sensorized finger."""

from softgym_envs.envs.registration import EnvironmentRow

ENVIRONMENTS = {
    "SoftGym/SensorizedFingerReach-v0": EnvironmentRow(
        "sensorized_finger", "sensed_reach", 50, "fem", plant={"noise": 0.01}
    ),
}
"""Rows by ID."""
