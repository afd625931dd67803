"""Environments of grippers of any number of fingers, and of contact-aided fingers."""

from softgym_envs.envs.registration import EnvironmentRow, environment_row

ENVIRONMENTS = {
    "SoftGym/FingerPress-v0": environment_row("press_finger", "track", 100),
    "SoftGym/GripperPinch-v0": environment_row("two_finger_gripper", "track", 100),
    "SoftGym/GripperManipulate-v0": environment_row("three_finger_gripper", "track", 100),
    # One learned finger serves all grippers, but with errors of three times the tolerance.
    "SoftGym/ComposedGripperManipulate-v0": EnvironmentRow("composed_gripper", "track", 100, "fem"),
    "SoftGym/FingerGrasp-v0": EnvironmentRow("grasping_finger", "grasp", 25, "surrogate"),
    "SoftGym/GripperLift-v0": EnvironmentRow(
        "contact_aided_gripper",
        "lift",
        30,
        "surrogate",
        # On finite elements. One implicit step per control step damps all vibrations, but objects fall.
        backend_options={"dynamics": True, "time_step": 0.05},
    ),
}
"""Rows by ID."""
