"""Environments of the modular arm."""

from softgym_envs.envs.registration import EnvironmentRow

ENVIRONMENTS = {"SoftGym/ModularReach-v0": EnvironmentRow("modular_arm", "reach", 50, "fem")}
"""Rows by ID."""
