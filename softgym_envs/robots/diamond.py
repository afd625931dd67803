"""The Diamond: a soft parallel robot with four elbowed legs between a clamped base and a free top.

Dimensions are those of its public model (thesis, sec. 4.3.1). The legs lie in the planes xz and yz; a
cable pulls each elbow inwards, which lifts the top and tilts it away.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.robots.base import Actuator
from softgym_envs.robots.capabilities import Learning
from softgym_envs.robots.geometry.meshing import BodyMesh, mesh_geometry
from softgym_envs.robots.geometry.morphing import Feature, Plane
from softgym_envs.robots.geometry.symmetry import mirrored, square_symmetries
from softgym_envs.robots.gmsh_robot import GmshRobot
from softgym_envs.robots.mesh_tiers import MeshTier

if TYPE_CHECKING:
    from softgym_envs.mechanics.model import MechanicalModel

# Contours of one leg (r, z) from the base to the top [mm], inset by a few tenths to match the published volume.
OUTER = (
    *((0, -37), (35, -37), (50, -29.6), (62, -23.6), (70, -17.6), (76, -11.6), (81.6, 0), (86.6, 12), (94.7, 36)),
    *((97, 45), (93.7, 54), (87, 59.6), (73, 71.6), (43, 95.6), (29, 107.6), (14, 119.6), (0, 126)),
)
INNER = (
    *((0, -9.5), (33, -9.2), (40, -6.2), (48, -0.2), (86, 37.8), (89, 45), (87, 51)),
    *((84, 54.2), (71, 60.2), (56, 66.2), (44, 72.2), (38, 78.2), (32, 90.2), (25, 102.2), (18, 108.2), (0, 114)),
)
# Half-width of a leg at two radii, linear in between and beyond [mm].
WIDE, WIDE_RADIUS = 13.2, 40.0
NARROW, NARROW_RADIUS = 9.4, 95.0
# Two bevels fill the corner between two legs: from this radius on their sides to this x = y between them [mm].
FILLET_RADIUS, FILLET_DIAGONAL = 27.0, 18.7
# Up to this radius, and up to this height, the body is the same for all designs [mm].
HUB_RADIUS, BASE_HEIGHT = 33.0, -9.0
VOLUME = 394.557e-6  # of the baseline body; the published one has 392e-6 [m3]
MASS = 0.5  # of the baseline body, as published [kg]


def draw_eighth(**corners: float) -> None:
    """Draw the eighth of the body in 0 <= y <= x with gmsh, in mm: half a leg, and its share of base and top.

    Args:
        **corners: closed side view of the leg, ``r0, z0, r1, z1, ...``, and closed plan view of the eighth,
            ``x0, y0, x1, y1, ...``.
    """
    import gmsh

    occ = gmsh.model.occ

    def prism(points: list[tuple[float, float, float]], *direction: float) -> list[tuple[int, int]]:
        tags = [occ.addPoint(*point) for point in points]
        lines = [occ.addLine(a, b) for a, b in zip(tags, tags[1:] + tags[:1], strict=True)]
        face = occ.addPlaneSurface([occ.addCurveLoop(lines)])
        return [e for e in occ.extrude([(2, face)], *direction) if e[0] == 3]

    side, plan = (
        [(corners[f"{a}{k}"], corners[f"{b}{k}"]) for k in range(len(corners)) if f"{a}{k}" in corners]
        for a, b in (("r", "z"), ("x", "y"))
    )
    low, high = min(z for _, z in side) - 1.0, max(z for _, z in side) + 1.0
    wide = max(y for _, y in plan) + 1.0
    leg = prism([(r, -1.0, z) for r, z in side], 0.0, wide + 1.0, 0.0)
    eighth = prism([(x, y, low) for x, y in plan], 0.0, 0.0, high - low)
    occ.intersect(leg, eighth)


class Diamond(GmshRobot):
    """Four-legged parallel robot, pulled by four cables at its elbows.

    One eighth of the body is meshed and mirrored, so its response has the symmetry of its shape.

    Args:
        mesh: ``"published"`` (1529 nodes and 5272 linear tetrahedra), ``"accurate"`` or ``"reference"``.
        unilateral: whether cables cannot push (default). False reproduces published scenes, where they can.
        **options: options of `GmshRobot`. The condensed-model work of the thesis has no gravity; its
            reinforcement-learning scene is ``gravity=(0, 0, -9.81)`` with the design ``{"young_modulus": 1.8e5}``; the
            baseline body weighs 0.5 kg.
    """

    name = "diamond"
    effectors = ("top",)
    size = 0.16
    learning = Learning(stiffness_variable="young_modulus")
    #: Depth of the effector below the top, which is one millimetre in the published model [m].
    effector_depth = 1.0e-3
    meshes = {
        "published": MeshTier(17.0e-3),
        "accurate": MeshTier(17.0e-3, "quadratic", guide_radius=2.0e-3),
        "reference": MeshTier(8.0e-3, "quadratic", guide_radius=2.0e-3),
    }
    design_boxes = {
        # 30 % about the baseline; with legs 1.3 times as wide, the bevels between two legs nearly vanish.
        "wide": {
            "leg_width": (0.7, 1.3),
            "top_height": (0.0885, 0.164),
            "elbow_height": (0.0315, 0.0585),
            "elbow_radius": (0.068, 0.126),
        }
    }

    def __init__(
        self,
        *,
        mesh: str = "published",
        unilateral: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(mesh=mesh, **options)
        self.design_space = DesignSpace(
            DesignVariable("leg_width", 0.8, 1.2, 1.0, "1", "width of the legs over that of the published body"),
            DesignVariable("top_height", 0.115, 0.140, 0.126, "m", "height of the top above the origin"),
            DesignVariable("elbow_height", 0.036, 0.054, 0.045, "m", "height of the elbows above the origin"),
            DesignVariable("elbow_radius", 0.087, 0.107, 0.097, "m", "distance of the elbows from the axis"),
            DesignVariable("young_modulus", 1.0e5, 1.0e7, 3.0e6, "Pa", "stiffness of the silicone", log=True),
            DesignVariable("poisson_ratio", 0.40, 0.499, 0.45, "1", "0.5 is incompressible"),
        )
        self.effector_rest = self._top(self.design_space.baseline)
        self.effort_scale = np.full(4, 40.0)
        if not any(self.gravity[:2]) and not self.obstacles:
            self.learning = replace(self.learning, symmetries=square_symmetries())
        self.actuators = tuple(
            # The published range is 0 to 30 mm. Unless the antagonists are paid out, the top stays 6 mm above the
            # published circle.
            Actuator(name, -0.010, 0.030, 0.0015, unilateral=unilateral)
            for name in ("north", "west", "south", "east")
        )

    @staticmethod
    def _top(design: Mapping[str, float]) -> np.ndarray:
        return np.array([0.0, 0.0, design["top_height"] - Diamond.effector_depth])

    # -- shape ------------------------------------------------------------------------------------------------------

    @staticmethod
    def side_view(design: Mapping[str, float]) -> np.ndarray:
        """Closed contour (r, z) of a leg [m], shape (k, 2): the published one, stretched piece by piece.

        Radii are stretched between the hub and the elbow, heights between base and elbow and between elbow and top.
        The contour ends a little beyond the axis, where the legs intersect.
        """
        contour = []
        for points in (OUTER, INNER[::-1]):
            r, z = np.array(points, dtype=float).T
            r = np.interp(r, [0.0, HUB_RADIUS, 97.0], [0.0, HUB_RADIUS, design["elbow_radius"] * 1e3])
            heights = [-37.0, BASE_HEIGHT, design["elbow_height"] * 1e3, design["top_height"] * 1e3]
            z = np.interp(z, [-37.0, BASE_HEIGHT, 45.0, 126.0], heights)
            for end, inner in ((0, 1), (-1, -2)):  # both ends lie on the axis
                slope = (z[end] - z[inner]) / (r[end] - r[inner])
                r[end], z[end] = -10.0, z[end] - 10.0 * slope
            contour.append(np.column_stack([r, z]) * 1e-3)
        return np.concatenate(contour)

    @staticmethod
    def plan_view(design: Mapping[str, float]) -> np.ndarray:
        """Closed contour (x, y) of the eighth [m], shape (5, 2): axis, leg (beyond its end), side, bevel, diagonal."""
        end = design["elbow_radius"] * 1e3 + 1.0
        taper = design["leg_width"] * (WIDE - NARROW) / (NARROW_RADIUS - WIDE_RADIUS)
        axis_width = design["leg_width"] * WIDE + taper * WIDE_RADIUS
        return 1e-3 * np.array(
            [
                (0.0, 0.0),
                (end, 0.0),
                (end, axis_width - taper * end),
                (FILLET_RADIUS, axis_width - taper * FILLET_RADIUS),
                (FILLET_DIAGONAL, FILLET_DIAGONAL),
            ]
        )

    def mesh(self, design: Mapping[str, float]) -> BodyMesh:
        """Mesh one eighth of a complete design."""
        corners: dict[str, float] = {}
        for names, contour in (("rz", self.side_view(design)), ("xy", self.plan_view(design))):
            for k, point in enumerate(contour):
                corners |= {f"{name}{k}": round(1e3 * float(v), 9) for name, v in zip(names, point, strict=True)}
        return mesh_geometry(draw_eighth, corners, mesh_size=self.mesh_size)

    def features(self, design: Mapping[str, float]) -> dict[str, Feature]:
        """Planes: one for each edge of the side view and of the plan view."""
        features: dict[str, Feature] = {}
        contour = self.side_view(design)
        for k, ((r, z), (dr, dz)) in enumerate(zip(contour, np.diff(contour, axis=0), strict=False)):
            features[f"edge {k}"] = Plane((r, 0, z), (dz, 0, -dr))
        plan = self.plan_view(design)
        for k, name in ((0, "middle of the leg"), (2, "side"), (3, "bevel"), (4, "diagonal")):
            (x, y), (dx, dy) = plan[k], plan[(k + 1) % len(plan)] - plan[k]
            features[name] = Plane((x, y, 0), (dy, -dx, 0))
        return features

    def mirror(self, part: BodyMesh) -> BodyMesh:
        """Mirror the eighth to a quarter, a half and the whole."""
        for normal in ((1, -1, 0), (0, 1, 0), (1, 0, 0)):
            part = mirrored(part, normal)
        return part

    def initial_motion(self, nodes: np.ndarray, design: Mapping[str, float]) -> np.ndarray:
        """Return displacements that stretch the legs with the elbow, and the upper half with the top."""
        base, mm = self.reference_design, 1e-3
        x, y, z = nodes.T
        moved = np.column_stack(
            [
                np.interp(x, [0, HUB_RADIUS * mm, base["elbow_radius"]], [0, HUB_RADIUS * mm, design["elbow_radius"]]),
                y,
                np.interp(
                    z,
                    [-37 * mm, BASE_HEIGHT * mm, base["elbow_height"], base["top_height"]],
                    [-37 * mm, BASE_HEIGHT * mm, design["elbow_height"], design["top_height"]],
                ),
            ]
        )
        return moved - nodes

    # -- mechanics --------------------------------------------------------------------------------------------------

    def build_model(self, mesh: BodyMesh, design: Mapping[str, float]) -> MechanicalModel:
        """Clamp the middle of the base, tie a cable to each elbow, put the effector just below the top."""
        # Chosen by the reference positions: the same nodes are clamped however far the mesh has moved.
        nodes = self.reference_nodes(mesh)
        fixed = (np.abs(nodes[:, :2]) <= 15.0e-3).all(axis=1) & (nodes[:, 2] <= 10.0e-3)
        model = self.solid(mesh, design, fixed=fixed, density=MASS / VOLUME)
        elbow, height = design["elbow_radius"], design["elbow_height"]
        for actuator, (x, y) in zip(self.actuators, ((0, 1), (-1, 0), (0, -1), (1, 0)), strict=True):
            # The elbow's outermost point is a node of every mesh.
            anchor = np.array([[x * elbow, y * elbow, height]])
            pull_point = np.array([x * 10.0e-3, y * 10.0e-3, 30.0e-3])
            model.add_cable(actuator.name, anchor, pull_point, unilateral=actuator.unilateral, radius=self.guide_radius)
        model.add_effector("top", self._top(design), radius=self.guide_radius)
        return model

    def reference_path(self, count: int = 30) -> np.ndarray:
        """Circle of radius 20 mm in the plane z = 133 mm, as published; the same for every body.

        With cables that cannot push, the top of the baseline body stays within 1.2 mm of it; with cables that can, it
        follows exactly.
        """
        angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
        return np.column_stack([0.020 * np.cos(angle), 0.020 * np.sin(angle), np.full(count, 0.133)])
