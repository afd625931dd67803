"""The table of environment IDs. A new environment is one row."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

__all__ = ["ENVIRONMENTS", "EnvironmentRow", "register_environments"]


@dataclass(frozen=True)
class EnvironmentRow:
    """One environment ID: a robot, a task, a time limit, and what they are made with unless told otherwise.

    Attributes:
        robot: registry name of the robot.
        task: registry name of the task.
        max_episode_steps: time limit.
        backend: ``"surrogate"`` where weights ship for the robot, else ``"fem"``.
        backend_options: options of that backend.
        robot_options: options of the robot.
        task_options: options of the task.
    """

    robot: str
    task: str
    max_episode_steps: int
    backend: str = "surrogate"
    robot_options: dict[str, Any] = field(default_factory=dict)
    task_options: dict[str, Any] = field(default_factory=dict)
    backend_options: dict[str, Any] = field(default_factory=dict)


MOVING = {"dynamics": True}

ENVIRONMENTS: dict[str, EnvironmentRow] = {
    "SoftGym/FingerReach-v0": EnvironmentRow("finger", "reach", 50),
    "SoftGym/FingerTrack-v0": EnvironmentRow("finger", "track", 100),
    "SoftGym/DiamondReach-v0": EnvironmentRow("diamond", "reach", 50),
    # The published circle asks for cables that push back on their way out.
    "SoftGym/DiamondTrack-v0": EnvironmentRow("diamond", "track", 100, robot_options={"unilateral": False}),
    "SoftGym/CableTrunkReach-v0": EnvironmentRow("cable_trunk", "reach", 50),
    "SoftGym/CableTrunkTrack-v0": EnvironmentRow("cable_trunk", "track", 100),
    "SoftGym/TrunkReach-v0": EnvironmentRow("trunk", "reach", 50),
    "SoftGym/TrunkTrack-v0": EnvironmentRow("trunk", "track", 100),
    "SoftGym/FingerPress-v0": EnvironmentRow("press_finger", "track", 100),
    "SoftGym/GripperPinch-v0": EnvironmentRow("two_finger_gripper", "track", 100),
    "SoftGym/GripperManipulate-v0": EnvironmentRow("three_finger_gripper", "track", 100),
    "SoftGym/TetrapodReach-v0": EnvironmentRow("tetrapod", "reach", 100, backend="fem", backend_options=MOVING),
    "SoftGym/TetrapodTrack-v0": EnvironmentRow("tetrapod", "track", 100, backend="fem", backend_options=MOVING),
    "SoftGym/TetrapodCarry-v0": EnvironmentRow("tetrapod", "carry", 100, backend="fem", backend_options=MOVING),
}
"""All environment IDs."""


def register_environments() -> None:
    """Register every row of `ENVIRONMENTS` with Gymnasium."""
    import gymnasium

    for identifier, row in ENVIRONMENTS.items():
        if identifier not in gymnasium.registry:
            gymnasium.register(
                id=identifier,
                entry_point="softgym_envs.envs.env:SoftRobotEnv",
                # Only the surrogate is batched; without an entry point make_vec steps single environments in turn.
                vector_entry_point=(
                    "softgym_envs.envs.vector_env:SoftRobotVectorEnv" if row.backend == "surrogate" else None
                ),
                max_episode_steps=row.max_episode_steps,
                kwargs={
                    "robot": row.robot,
                    "task": row.task,
                    "backend": row.backend,
                    # Gymnasium replaces whole mappings; these stay under what the user gives.
                    "defaults": {
                        "backend": row.backend,
                        "robot_options": dict(row.robot_options),
                        "task_options": dict(row.task_options),
                        "backend_options": dict(row.backend_options),
                    },
                },
            )
