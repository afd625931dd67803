"""The table of environment IDs. A new environment is one row."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

__all__ = ["ENVIRONMENTS", "EnvironmentRow", "register_environments"]


@dataclass(frozen=True)
class EnvironmentRow:
    """One environment ID: a robot, a task and a time limit."""

    robot: str
    task: str
    max_episode_steps: int
    robot_options: dict[str, Any] = field(default_factory=dict)


ENVIRONMENTS: dict[str, EnvironmentRow] = {
    "SoftGym/FingerReach-v0": EnvironmentRow("finger", "reach", 50),
    "SoftGym/FingerTrack-v0": EnvironmentRow("finger", "track", 100),
}
"""All environment IDs."""


def register_environments() -> None:
    """Register every row of `ENVIRONMENTS` with Gymnasium."""
    import gymnasium

    for identifier, row in ENVIRONMENTS.items():
        if identifier not in gymnasium.registry:
            gymnasium.register(
                id=identifier,
                entry_point="softgym_envs.envs.soft_robot_env:SoftRobotEnv",
                vector_entry_point="softgym_envs.envs.vector_env:SoftRobotVectorEnv",
                max_episode_steps=row.max_episode_steps,
                kwargs={"robot": row.robot, "task": row.task, "robot_options": dict(row.robot_options)},
            )
