"""Guide radii, and elements that are small where cables leave and enter segments and where fingers touch an object.

Where elements are larger than the parts on which guides and contact points act, meshes refined in proportion hardly
show the compliance of these parts. Here it is added, on meshes whose other elements are those of the accurate finger.
"""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np

from benchmarks.convergence import MM, STUDIES, Study, measure
from softgym_envs.robots.base import Robot
from softgym_envs.robots.registry import make_robot

SIZE = 10.0 * MM
"""Elements of the accurate finger. In a gripper of this size, those where loads act have 3 mm."""

SMALLEST = 1.0 * MM
"""Smallest edge length of the small elements; otherwise it is half the guide radius."""

STUDIED: dict[str, Study] = STUDIES | {
    "two_finger_gripper_taut": replace(
        STUDIES["two_finger_gripper"], command=(10.0 * MM, 8.0 * MM, 8.0 * MM, 10.0 * MM)
    )
}
"""Studies of convergence, and one whose finer mesh takes too long."""

CASES = (
    ("finger", 1.0 * MM),
    ("finger", 3.0 * MM),
    ("finger_sideways", 1.0 * MM),
    ("finger_sideways", 3.0 * MM),
    ("finger_1cable", 1.0 * MM),
    ("finger_1cable", 3.0 * MM),
    ("two_finger_gripper", 1.0 * MM),
    ("two_finger_gripper", 2.0 * MM),
    ("two_finger_gripper", 3.0 * MM),
    ("two_finger_gripper_taut", 3.0 * MM),
    ("three_finger_gripper", 3.0 * MM),
)
"""Studies and guide radii [m]."""


def robots_of(name: str, radius: float) -> tuple[Robot, Robot]:
    """Return the robot of a study with a guide radius [m], and the same with smaller elements where loads act."""
    study = STUDIED[name]
    options = {"mesh": "accurate", "mesh_size": SIZE, "guide_radius": radius, **study.options}
    plain, small = (make_robot(study.robot, **options) for _ in range(2))
    finger = getattr(small, "finger", small)
    finger.tier = replace(finger.tier, guide_size=max(SMALLEST, 0.5 * radius))
    return plain, small


def point_meshes() -> dict[str, object]:
    """Tips and efforts of baselines with smaller elements at guides and contact points, beside those without them."""
    rows = []
    for name, radius in CASES:
        before, level = (
            measure(robot, robot.design_space.baseline, "baseline", "accurate", STUDIED[name])
            for robot in robots_of(name, radius)
        )
        tip = np.array(before.tip)
        rows.append(
            {
                "study": name,
                "radius [m]": radius,
                **asdict(level),
                "tip before": before.tip,
                "effort before": before.effort,
                "tip moved": float(np.linalg.norm(level.tip - tip) / np.linalg.norm(tip)),
                "effort changed": level.effort / before.effort - 1.0,
            }
        )
        print(f"  {rows[-1]}", flush=True)
    return {"smallest [m]": SMALLEST, "rows": rows}
