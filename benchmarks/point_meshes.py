"""Fingers with small elements where cables leave and enter segments, and where fingers touch a held object.

The meshes of `benchmarks.convergence` are refined in proportion, and on all of them the elements there are larger than
the parts on which those forces act. So their sequence hardly shows the compliance of these parts. Here it is added.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from benchmarks.convergence import MM, STUDIES, measure
from benchmarks.recorded import results
from softgym_envs.robots.base import Robot
from softgym_envs.robots.geometry.finger_shape import draw_finger
from softgym_envs.robots.geometry.graded_finger import draw_half_finger
from softgym_envs.robots.geometry.meshing import BodyMesh, mesh_geometry
from softgym_envs.robots.registry import make_robot
from softgym_envs.robots.soft_finger import CONTACT_RADIUS, SoftFinger

SIZE = 1.0 * MM
"""Edge length of the small elements: the radius of the parts on which guides and contact points act."""

CASES = (
    ("finger", "guides"),
    ("finger_sideways", "guides"),
    ("finger_1cable", "guides"),
    ("two_finger_gripper", "guides"),
    ("two_finger_gripper_taut", "guides"),
    ("three_finger_gripper", "contacts"),
    ("three_finger_gripper", "guides, contacts"),
)
"""Studies, and the points with small elements."""


def draw_with_points(*, point_size: float, count: float, **options: float) -> None:
    """Draw half a finger with gmsh, with small elements around points.

    Args:
        point_size: edge length around the points [mm].
        count: number of points.
        **options: coordinates ``x0``, ``y0``, ``z0``, ``x1``, ... of the points and radii ``r0``, ``r1``, ... within
            which elements have this size [mm]; and those of `draw_half_finger`.
    """
    import gmsh

    points = [[options.pop(f"{letter}{k}") for letter in "xyzr"] for k in range(int(count))]
    draw_half_finger(**options)
    field = gmsh.model.mesh.field
    sizes = [int(max(field.list()))]  # the sizes that were set already
    for x, y, z, radius in points:
        sizes.append(field.add("MathEval"))
        away = f"max(0, sqrt((x - ({x}))^2 + (y - ({y}))^2 + (z - ({z}))^2) - {radius})"
        field.setString(sizes[-1], "F", f"{point_size} + {away}")
    smallest = field.add("Min")
    field.setNumbers(smallest, "FieldsList", sizes)
    field.setAsBackgroundMesh(smallest)


class PointFinger(SoftFinger):
    """The accurate finger with small elements at its ``guides``, its ``contacts``, or both."""

    points = "guides"

    def mesh(self, design: Mapping[str, float]) -> BodyMesh:
        """Mesh the half of a complete design."""
        middles, radii, tier = [], [], self.tier
        if "guides" in self.points:
            middles = [point for _, points in self.routes(design) for point in points if point[0] >= 0.0]
            radii = [self.guide_radius] * len(middles)
        if "contacts" in self.points:
            middles.append(self.contact_points(design).mean(axis=0))
            radii.append(CONTACT_RADIUS + self.guide_radius)
        parameters = {"point_size": SIZE, "size": tier.size, "feature_size": tier.feature_size or tier.size}
        for k, (middle, radius) in enumerate(zip(middles, radii, strict=True)):
            parameters |= {f"{letter}{k}": float(x) for letter, x in zip("xyzr", [*middle, radius], strict=True)}
        parameters = {name: round(1e3 * value, 9) for name, value in parameters.items()}
        parameters |= {**self.lengths(design), "count": len(middles), "fillet": 0.0}
        return mesh_geometry(
            draw_with_points, parameters, mesh_size=tier.size, uses=(draw_finger, draw_half_finger), time_limit=300.0
        )


def robot_of(name: str, points: str) -> Robot:
    """Return the accurate robot of a study, with small elements at these points of its fingers."""
    study = STUDIES[name]
    robot = make_robot(study.robot, mesh="accurate", **study.options)
    finger = PointFinger(cables=study.options.get("cables", 2), mesh="accurate", self_contact=False)
    finger.points = points
    if study.robot == "finger":
        return finger
    robot.finger = finger  # type: ignore[attr-defined]
    return robot


def point_meshes() -> dict[str, object]:
    """Tips and efforts of baselines with small elements at guides and contact points, beside those without them."""
    rows = []
    for name, points in CASES:
        known = results(f"convergence_{name}")["rows"]
        plain = next(row for row in known if row["body"] == "baseline" and row["mesh"] == "accurate")
        robot = robot_of(name, points)
        level = measure(robot, robot.design_space.baseline, "baseline", "accurate", STUDIES[name])
        before = np.array(plain["tip"])
        rows.append(
            {
                "study": name,
                "points": points,
                **asdict(level),
                "tip before": plain["tip"],
                "tip moved": float(np.linalg.norm(level.tip - before) / np.linalg.norm(before)),
                "effort changed": level.effort / plain["effort"] - 1.0,
            }
        )
        print(f"  {rows[-1]}", flush=True)
    return {"size [m]": SIZE, "rows": rows}
