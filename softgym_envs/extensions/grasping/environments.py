"""Environments of contact-aided fingers."""

from softgym_envs.envs.registration import EnvironmentRow

COARSE = {"mesh_size": 0.020}

ENVIRONMENTS = {
    "SoftGym/FingerGrasp-v0": EnvironmentRow("grasping_finger", "grasp", 25, "fem", backend_mesh=COARSE),
    "SoftGym/GripperLift-v0": EnvironmentRow(
        "contact_aided_gripper",
        "lift",
        30,
        "fem",
        backend_mesh=COARSE,
        # One implicit step per control step damps all vibrations, but objects fall.
        backend_options={"dynamics": True, "time_step": 0.05},
    ),
}
"""Rows by ID."""
