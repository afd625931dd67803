"""The Soft Finger: three silicone segments joined by notches with pneumatic sensing bellows, bent by cables.

Dimensions are those of the thesis (sections 4.3 and 4.5) and its public models. The finger hangs along -z, is
clamped by a flange at z = 0, and bends towards +y when its cables are pulled.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.designs import Design, DesignSpace, DesignVariable
from softgym_envs.robots.base import Actuator, Drawing
from softgym_envs.robots.capabilities import Learning
from softgym_envs.robots.geometry.finger_shape import check_finger, draw_finger, in_flange
from softgym_envs.robots.geometry.graded_finger import (
    draw_rounded_finger,
    graded_features,
    is_half,
    mesh_finger,
    whole_finger,
)
from softgym_envs.robots.geometry.meshing import BodyMesh
from softgym_envs.robots.geometry.morphing import Feature
from softgym_envs.robots.geometry.symmetry import left_right
from softgym_envs.robots.gmsh_robot import GmshRobot
from softgym_envs.robots.mesh_tiers import MeshTier

if TYPE_CHECKING:
    from softgym_envs.mechanics.model import MechanicalModel

BELLOWS = {
    "outer_radius": 14.75,
    "bellow_height": 8.0,
    "plateau_height": 3.0,
    "wall_thickness": 3.0,
    "cork_thickness": 3.0,
}
"""Fixed dimensions of the bellows and their cavities [mm], named as in `draw_finger`."""

CONTACT_RADIUS = 2.0e-3
"""Radius of the circle of contact points [m]."""

TIP_RADIUS = 8.0e-3
"""Part of the last segment over which the tip is averaged, unless cables act on single points [m]."""

CONTACT_DISTANCE = 0.015
"""Gap below which there are contact forces, relative to the size of the elements. Vertices on both sides of a sharp
edge are as far apart as the elements there are large, and must not touch at rest."""

FINGER_MESHES = {
    "published": MeshTier(8.0e-3),
    "accurate": MeshTier(10.0e-3, "quadratic", feature_size=2.5e-3, guide_radius=3.0e-3),
    "reference": MeshTier(6.0e-3, "quadratic", feature_size=1.5e-3, guide_radius=3.0e-3),
}
"""Meshes of the fingers. No source states the radius of the parts where guides act. With 3 mm, smaller elements there
hardly move the tip; with 1 mm, they move that of the finger with one cable by 6 % of its way."""

WIDE_BOXES = {
    1: {"length": (0.028, 0.052), "height": (0.0195, 0.027), "joint_height": (0.0042, 0.008)},
    2: {"length": (0.037, 0.052), "height": (0.017, 0.022), "joint_height": (0.0042, 0.008)},
}
"""Wide design boxes by the number of cables [m]. Every body in them exists.

They reach 30 % from the baseline, except where notches would meet (with two cables, in segments shorter than 35.6 mm or
higher than 22 mm) or cables would leave the body.
"""


class SoftFinger(GmshRobot):
    """Cable-driven soft finger.

    The design box ``"wide"`` has other lengths, heights and hinges than the published one (`WIDE_BOXES`).

    Args:
        cables: 2 (thesis, sec. 4.3: x = -5 and 5 mm, y = 15.33 mm, notch slope 45 degrees, nu 0.3) or
            1 (thesis, sec. 4.5: x = 0, y = 17.75 mm, notch slope 30 degrees, nu 0.47).
        mesh: ``"published"``, ``"accurate"`` or ``"reference"``; the published one has 485 nodes and 1572 linear
            tetrahedra with two cables, 520 and 1721 with one.
        mesh_size: target edge length [m], instead of that of the mesh.
        fillet: radius of the re-entrant edges at the joints [m], which no source states; by default they are sharp, as
            drawn. A fillet makes the finger stiffer, see its page.
        guide_radius: radius of the parts of the body on which cables and contact points act [m], instead of that of the
            mesh; 0 for single points. No source states it.
        unilateral: whether cables cannot push (default). False reproduces published scenes, where they can.
        contacts: whether to add three contact points (role ``c``) to the front of the last segment (sec. 4.3.2).
        self_contact: whether surfaces of the finger touch each other, as the faces of its notches do from about 10 mm
            of pull on. By default they do on all meshes but the published one, whose scene has no contact, and without
            fillets, whose narrow elements would touch at rest.
        contact_distance: gap below which there are forces [m]; default 0.5 mm on the published mesh, 0.15 mm on the
            accurate one and in proportion to the ``mesh_size`` on finer ones, so that elements at the edges of the
            joints do not touch at rest.
        **options: options of `GmshRobot`.
    """

    name = "finger"
    effectors = ("tip",)
    size = 0.12
    rounded = True
    learning = Learning(stiffness_variable="young_modulus")
    meshes: Mapping[str, MeshTier] = FINGER_MESHES

    def __init__(
        self,
        *,
        cables: int = 2,
        mesh: str = "published",
        mesh_size: float | None = None,
        fillet: float | None = None,
        guide_radius: float | None = None,
        unilateral: bool = True,
        contacts: bool = False,
        self_contact: bool | None = None,
        contact_distance: float | None = None,
        **options: Any,
    ) -> None:
        if cables not in (1, 2):
            raise ValueError(f"cables = {cables!r} is unknown; allowed: 1, 2")
        if cables == 1:
            # The largest size at which the mesh of this shape can be moved to every design without remeshing.
            self.meshes = {**FINGER_MESHES, "published": MeshTier(7.9e-3)}
        touching = mesh != "published" and not fillet if self_contact is None else self_contact
        if contact_distance is None:
            size = self.meshes[mesh].size if mesh_size is None and mesh in self.meshes else mesh_size
            contact_distance = CONTACT_DISTANCE * size if touching and mesh != "published" and size else 5.0e-4
        super().__init__(
            mesh=mesh,
            mesh_size=mesh_size,
            fillet=fillet,
            guide_radius=guide_radius,
            self_contact=touching,
            contact_distance=contact_distance,
            **options,
        )
        self.cables = cables
        self.contacts = contacts
        self.slope = math.radians(45.0 if cables == 2 else 30.0)
        self.cable_height = 15.33e-3 if cables == 2 else 17.75e-3
        self.cable_offsets = (-5.0e-3, 5.0e-3) if cables == 2 else (0.0,)
        self.design_space = DesignSpace(
            DesignVariable("length", 0.038, 0.042, 0.040, "m", "length of one of the three segments"),
            DesignVariable(
                "height",
                0.020,
                0.022,
                0.020 if cables == 2 else 0.021,
                "m",
                "height of the segments across the bending axis",
            ),
            DesignVariable("joint_height", 0.005, 0.008, 0.006, "m", "thickness of the hinges under the notches"),
            DesignVariable("young_modulus", 1.0e6, 1.0e7, 3.0e6, "Pa", "stiffness of the silicone", log=True),
            DesignVariable("poisson_ratio", 0.30, 0.499, 0.30 if cables == 2 else 0.47, "1", "0.5 is incompressible"),
        )
        self.design_boxes = {"wide": WIDE_BOXES[cables]}
        # The mesh of a design does not depend on the design box.
        self._middle = {v.name: 0.5 * (v.low + v.high) for v in self.design_space if v.unit == "m"}
        self.effector_rest = self.tip(self.design_space.baseline)
        self.effort_scale = np.full(cables, 20.0)
        mirrored = is_half(self.tier) and not (self.gravity[0] or self.obstacles)
        self.learning = replace(
            self.learning,
            weights=f"{self.name}_{cables}cable{'s' if cables > 1 else ''}",
            symmetries=left_right(range(cables)[::-1]) if mirrored else (),
        )
        self.actuators = tuple(
            Actuator(f"cable_{i + 1}", 0.0, 0.020, 0.001, unilateral=unilateral) for i in range(cables)
        )

    def lengths(self, design: Mapping[str, float]) -> dict[str, float]:
        """Return the parameters of `draw_finger` [mm, rad] for a complete design."""
        lengths = {name: round(design[name] * 1e3, 9) for name in ("length", "height", "joint_height")}
        return {**lengths, "slope": self.slope, **BELLOWS}

    def drawing(self, design: Mapping[str, float]) -> Drawing:
        lengths = self.lengths(design)
        check_finger(lengths)
        if self.fillet:
            return draw_rounded_finger, {**lengths, "fillet": round(1e3 * self.fillet, 9)}
        return draw_finger, lengths

    @property
    def reference_design(self) -> Design:
        """The baseline; for graded meshes the middle of the published box, from where its designs can be reached."""
        return self.design_space.complete(self._middle) if is_half(self.tier) else super().reference_design

    def mesh(self, design: Mapping[str, float]) -> BodyMesh:
        """Mesh the body of a complete design, or the half that `mirror` completes."""
        lengths = self.lengths(design)
        check_finger(lengths)
        return mesh_finger(lengths, self.tier, self.loaded_parts(design).tolist())

    def mirror(self, part: BodyMesh) -> BodyMesh:
        """Complete the body of a graded mesh."""
        return whole_finger(part, self.tier)

    def features(self, design: Mapping[str, float]) -> dict[str, Feature]:
        """Return the surfaces of the shape of a complete design."""
        return graded_features(self.lengths(design), self.tier)

    @staticmethod
    def tip(design: Mapping[str, float]) -> np.ndarray:
        """Return the middle of the tip at rest [m], shape (3,)."""
        return np.array([0.0, design["height"] / 2, -3.0 * design["length"]])

    def routes(self, design: Mapping[str, float]) -> list[tuple[np.ndarray, np.ndarray]]:
        """Pull point (3,) and guides (6, 3) [m] of each cable. Guides are where it leaves and enters a segment."""
        length = design["length"]
        offset = (self.cable_height - design["joint_height"]) * math.tan(self.slope)
        stations = [s for k in range(3) for s in (-k * length - offset, -(k + 1) * length + offset)]
        return [
            (np.array([x, self.cable_height, 0.0]), np.array([[x, self.cable_height, z] for z in stations]))
            for x in self.cable_offsets
        ]

    @staticmethod
    def contact_points(design: Mapping[str, float]) -> np.ndarray:
        """Return three points on a circle in the middle of the front of the last segment [m], shape (3, 3)."""
        angles = math.pi / 2 + 2.0 * math.pi / 3 * np.arange(3)
        circle = CONTACT_RADIUS * np.column_stack([np.cos(angles), np.zeros(3), np.sin(angles)])
        return np.array([0.0, design["height"], -2.5 * design["length"]]) + circle

    def loaded_parts(self, design: Mapping[str, float]) -> np.ndarray:
        """Return balls around guides and contact points of the half x >= 0, rows of middle and radius [m], (k, 4)."""
        guides = np.concatenate([points for _, points in self.routes(design)])
        contact = [*self.contact_points(design).mean(axis=0), CONTACT_RADIUS + self.guide_radius]
        balls = np.column_stack([guides, np.full(len(guides), self.guide_radius)])
        return np.vstack([balls[guides[:, 0] >= 0.0], contact])

    def initial_motion(self, nodes: np.ndarray, design: Mapping[str, float]) -> np.ndarray:
        """Return displacements that stretch the body along z with the segment length."""
        displacement = np.zeros_like(nodes)
        displacement[:, 2] = nodes[:, 2] * (design["length"] / self.reference_design["length"] - 1.0)
        return displacement

    def build_model(self, mesh: BodyMesh, design: Mapping[str, float]) -> MechanicalModel:
        """Clamp the flange, route the cables past the notches, put the effector at the middle of the tip."""
        model = self.solid(mesh, design, fixed=in_flange(mesh.nodes))
        for actuator, (pull_point, points) in zip(self.actuators, self.routes(design), strict=True):
            model.add_cable(actuator.name, points, pull_point, unilateral=actuator.unilateral, radius=self.guide_radius)
        # The effector lies in front of the slanted tip, outside the body.
        hint = self.reference_element(mesh, self.tip(self.reference_design))
        model.add_effector("tip", self.tip(design), hint=hint, radius=TIP_RADIUS if self.guide_radius else 0.0)
        if self.contacts:
            from softgym_envs.mechanics.constraints.point import Point

            reference = self.contact_points(self.reference_design)
            for i, point in enumerate(self.contact_points(design)):
                embedding = model.embed(point, self.reference_element(mesh, reference[i]), radius=self.guide_radius)
                model.add("c", Point(f"contact_{i + 1}", embedding))
        return model

    def reference_path(self, count: int = 25) -> np.ndarray:
        """Closing motion (thesis, fig. 4.3): the tip bends about the base by up to 60 degrees, shape (count, 3).

        The distance from the base shrinks like that of the bending finger, to ``1 - 0.7 (theta / 90 deg)^2`` of the
        rest length. Up to 45 degrees the path stays within 2 mm of the baseline's workspace; its end is out of reach,
        as in the thesis.
        """
        theta = np.linspace(0.0, np.pi / 3, count)
        radius = self.size * (1.0 - 0.7 * (theta / (0.5 * np.pi)) ** 2)
        offset = self.effector_rest[1]
        return np.column_stack(
            [
                np.zeros(count),
                offset * np.cos(theta) + radius * np.sin(theta),
                -radius * np.cos(theta) + offset * np.sin(theta),
            ]
        )
