"""The Soft Finger: three silicone segments joined by notches with pneumatic sensing bellows, bent by cables.

Dimensions are those of the thesis (sections 4.3 and 4.5) and its public models. The finger hangs along -z, is
clamped by a flange at z = 0, and bends towards +y when its cables are pulled.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.mechanics.constraints import Point
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.meshing import BodyMesh, mesh_geometry
from softgym_envs.robots.morphing import Cone, Cylinder, Feature, Plane
from softgym_envs.robots.robot import Actuator, MeshedRobot

__all__ = ["SoftFinger"]

# Fixed dimensions [mm].
THICKNESS = 17.5
FLANGE = 3.0
OUTER_RADIUS = 14.75
TEETH_RADIUS = 8.75
BELLOW_HEIGHT = 8.0
PLATEAU_HEIGHT = 3.0
WALL_THICKNESS = 3.0
CORK_THICKNESS = 3.0
# Not part of the shape: no upper-case constant of the drawing, by which meshes are known.
_contact_radius = 2.0


def draw_finger(length: float, height: float, joint_height: float, slope: float) -> None:
    """Draw the finger with gmsh: lengths in mm, slope of the notches in rad."""
    import gmsh

    occ = gmsh.model.occ
    run = (height - joint_height) * math.tan(slope)
    if 2.0 * run >= length:
        raise ValueError(f"the notches meet: 2 x {run:.2f} mm does not fit in a segment of {length:.2f} mm")

    def half_turned(inner: float, outer: float, z: float) -> tuple[int, int]:
        """A trapezoid profile (full height up to ``inner``, plateau at ``outer``) turned by 180 degrees about z."""
        full, flat = BELLOW_HEIGHT / 2, PLATEAU_HEIGHT / 2
        profile = [(0.0, -full), (inner, -full), (outer, -flat), (outer, flat), (inner, full), (0.0, full)]
        points = [occ.addPoint(r, 0, z + h) for r, h in profile]
        lines = [occ.addLine(a, b) for a, b in zip(points, points[1:] + points[:1], strict=True)]
        face = occ.addPlaneSurface([occ.addCurveLoop(lines)])
        return next(e for e in occ.revolve([(2, face)], 0, 0, 0, 0, 0, 1, math.pi) if e[0] == 3)

    # Side view (y, z): a bar with a notch at each joint; the base half of the first segment is filled.
    outline = [(0.0, 0.0), (0.0, -3.0 * length), (joint_height, -3.0 * length), (height, -3.0 * length + run)]
    for joint in (2, 1):
        z = -joint * length
        outline += [(height, z - run), (joint_height, z), (height, z + run)]
    outline.append((height, 0.0))
    points = [occ.addPoint(-THICKNESS / 2, y, z) for y, z in outline]
    lines = [occ.addLine(a, b) for a, b in zip(points, points[1:] + points[:1], strict=True)]
    face = occ.addPlaneSurface([occ.addCurveLoop(lines)])
    bar = [e for e in occ.extrude([(2, face)], THICKNESS, 0, 0) if e[0] == 3]
    flange = (3, occ.addBox(-THICKNESS / 2 - FLANGE, 0, -FLANGE, THICKNESS + 2 * FLANGE, height + FLANGE, FLANGE))
    bellows = [half_turned(TEETH_RADIUS, OUTER_RADIUS, -joint * length) for joint in (1, 2)]
    body, _ = occ.fuse(bar, [flange, *bellows])
    cavities = [half_turned(TEETH_RADIUS - WALL_THICKNESS, OUTER_RADIUS - WALL_THICKNESS, -j * length) for j in (1, 2)]
    corks = [
        (
            3,
            occ.addBox(
                -OUTER_RADIUS, -1, -j * length - BELLOW_HEIGHT, 2 * OUTER_RADIUS, 1 + CORK_THICKNESS, 2 * BELLOW_HEIGHT
            ),
        )
        for j in (1, 2)
    ]
    hollows, _ = occ.cut(cavities, corks)
    occ.cut(body, hollows)


class SoftFinger(MeshedRobot):
    """Cable-driven soft finger.

    Args:
        cables: 2 (thesis 4.3: x = -5 and 5 mm, y = 15.33 mm, notch slope 45 degrees, nu 0.3) or
            1 (thesis 4.5: x = 0, y = 17.75 mm, notch slope 30 degrees, nu 0.47).
        mesh_size: target edge length [m]; default 8 mm (485 nodes, 1572 tetrahedra) with two cables, 7.9 mm (520
            nodes, 1721 tetrahedra) with one: sizes whose mesh moves to every body of the box without remeshing.
        meshing: ``"morph"`` moves the baseline mesh, ``"remesh"`` meshes every design anew.
        material: name of a material of `softgym_envs.mechanics.materials`.
        unilateral: cables cannot push (default). False reproduces scenes whose cables can.
        gravity: acceleration [m/s2]; the condensed-model work of the thesis has none.
        contacts: add three contact points (role ``c``) on the front of the last segment (thesis 4.3.2).
    """

    name = "finger"
    effectors = ("tip",)
    size = 0.12

    def __init__(
        self,
        *,
        cables: int = 2,
        mesh_size: float | None = None,
        meshing: str = "morph",
        material: str = "corotational",
        unilateral: bool = True,
        gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        contacts: bool = False,
    ) -> None:
        if cables not in (1, 2):
            raise ValueError(f"cables = {cables!r} is unknown; allowed: 1, 2")
        if mesh_size is None:
            mesh_size = 8.0e-3 if cables == 2 else 7.9e-3
        super().__init__(mesh_size=mesh_size, meshing=meshing, material=material, gravity=gravity)
        self.cables = cables
        self.unilateral = unilateral
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
        self.stiffness_variable = None if any(gravity) else "young_modulus"
        self.effector_rest = self.tip(self.design_space.baseline)
        self.effort_scale = np.full(cables, 20.0)
        self.actuators = tuple(
            Actuator(f"cable_{i + 1}", 0.0, 0.020, 0.001, unilateral=unilateral) for i in range(cables)
        )

    @property
    def variant(self) -> str:
        """``finger_1cable`` or ``finger_2cables``."""
        return "finger_1cable" if self.cables == 1 else "finger_2cables"

    @property
    def signature(self) -> dict[str, object]:
        """Options that change the condensed model (a cable that may push has the same one)."""
        return {
            "cables": self.cables,
            "mesh_size": self.mesh_size,
            "meshing": self.meshing,
            "material": self.material,
            "gravity": list(self.gravity),
            # Weights from before there were contacts hold no such key.
            **({"contacts": True} if self.contacts else {}),
        }

    def mesh(self, design: Mapping[str, float]) -> BodyMesh:
        """Mesh the body of a complete design."""
        lengths = {name: round(design[name] * 1e3, 9) for name in ("length", "height", "joint_height")}
        return mesh_geometry(draw_finger, {**lengths, "slope": self.slope}, mesh_size=self.mesh_size)

    def features(self, design: Mapping[str, float]) -> dict[str, Feature]:
        """Planes of the bar, the flange and the notches; cones and cylinders of bellows and cavities."""
        length, height, joint = design["length"], design["height"], design["joint_height"]
        mm = 1e-3
        x, y, z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
        side = THICKNESS / 2 * mm
        flange = FLANGE * mm
        features: dict[str, Feature] = {
            "left": Plane((-side, 0, 0), x),
            "right": Plane((side, 0, 0), x),
            "bottom": Plane((0, 0, 0), y),
            "top": Plane((0, height, 0), y),
            "base": Plane((0, 0, 0), z),
            "tip": Plane((0, 0, -3 * length), z),
            "flange left": Plane((-side - flange, 0, 0), x),
            "flange right": Plane((side + flange, 0, 0), x),
            "flange top": Plane((0, height + flange, 0), y),
            "flange face": Plane((0, 0, -flange), z),
            "bellow rim": Cylinder(OUTER_RADIUS * mm),
            "cavity rim": Cylinder((OUTER_RADIUS - WALL_THICKNESS) * mm),
            "cork": Plane((0, CORK_THICKNESS * mm, 0), y),
            "notch 3 base": Plane((0, joint, -3 * length), (0.0, -math.tan(self.slope), 1.0)),
        }
        # Radius lost per height between full height and plateau.
        taper = (OUTER_RADIUS - TEETH_RADIUS) / ((BELLOW_HEIGHT - PLATEAU_HEIGHT) / 2)
        full = BELLOW_HEIGHT / 2 * mm
        for k in (1, 2):
            centre = -k * length
            for word, sign in (("base", 1.0), ("tip", -1.0)):
                features[f"notch {k} {word}"] = Plane((0, joint, centre), (0.0, -sign * math.tan(self.slope), 1.0))
                features[f"flat {k} {word}"] = Plane((0, 0, centre + sign * full), z)
                for part, radius in (("bellow", TEETH_RADIUS), ("cavity", TEETH_RADIUS - WALL_THICKNESS)):
                    features[f"{part} {k} {word}"] = Cone(radius * mm, centre + sign * full, -sign * taper)
        return features

    @staticmethod
    def clamped(mesh: BodyMesh) -> np.ndarray:
        """Nodes of the flange, shape (n,)."""
        return mesh.nodes[:, 2] >= -(FLANGE + 1e-3) * 1e-3

    @staticmethod
    def tip(design: Mapping[str, float]) -> np.ndarray:
        """Return the middle of the tip at rest [m], shape (3,)."""
        return np.array([0.0, design["height"] / 2, -3.0 * design["length"]])

    def routes(self, design: Mapping[str, float]) -> list[tuple[np.ndarray, np.ndarray]]:
        """Pull point (3,) and guides (6, 3) [m] of each cable: past the two notches, at both of their edges."""
        length = design["length"]
        offset = (self.cable_height - design["joint_height"]) * math.tan(self.slope)
        stations = [s for k in range(3) for s in (-k * length - offset, -(k + 1) * length + offset)]
        return [
            (np.array([x, self.cable_height, 0.0]), np.array([[x, self.cable_height, z] for z in stations]))
            for x in self.cable_offsets
        ]

    @staticmethod
    def contact_points(design: Mapping[str, float]) -> np.ndarray:
        """Three points on a circle in the middle of the last segment's front [m], shape (3, 3)."""
        angles = math.pi / 2 + 2.0 * math.pi / 3 * np.arange(3)
        circle = _contact_radius * 1e-3 * np.column_stack([np.cos(angles), np.zeros(3), np.sin(angles)])
        return np.array([0.0, design["height"], -2.5 * design["length"]]) + circle

    def guess(self, nodes: np.ndarray, design: Mapping[str, float]) -> np.ndarray:
        """Stretch along z with the segment length."""
        displacement = np.zeros_like(nodes)
        displacement[:, 2] = nodes[:, 2] * (design["length"] / self.reference_design["length"] - 1.0)
        return displacement

    def equip(self, mesh: BodyMesh, design: Mapping[str, float]) -> MechanicalModel:
        """Clamp the flange, route the cables past the notches, put the effector at the middle of the tip."""
        model = MechanicalModel.from_mesh(
            mesh.nodes,
            mesh.tetrahedra,
            fixed=self.clamped(mesh),
            material=self.material,
            young_modulus=design["young_modulus"],
            poisson_ratio=design["poisson_ratio"],
            density=1100.0,
            gravity=self.gravity,
        )
        for actuator, (pull_point, points) in zip(self.actuators, self.routes(design), strict=True):
            model.add_cable(actuator.name, points, pull_point, unilateral=self.unilateral)
        # The effector floats in front of the slanted tip, outside the body.
        hint = self.reference_element(mesh, self.tip(self.reference_design))
        model.add_effector("tip", self.tip(design), hint=hint)
        if self.contacts:
            reference = self.contact_points(self.reference_design)
            for i, point in enumerate(self.contact_points(design)):
                embedding = model.embed(point, self.reference_element(mesh, reference[i]))
                model.add("c", Point(f"contact_{i + 1}", embedding))
        return model

    def reference_path(self, count: int = 25) -> np.ndarray:
        """Closing motion of the thesis (Fig. 4.3): the tip bends about the base by up to 60 degrees, shape (count, 3).

        The radius shrinks as that of the bending finger does, ``1 - 0.7 (theta / 90 deg)^2`` of the rest length (within
        2 mm of the baseline's workspace up to 45 degrees); the end of the path is outside the workspace, as in the
        thesis.
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
