"""The sensorized Soft Finger: one cable, and the volumes of its bellows' cavities as sensors (thesis, section 3.3).

The finger hangs along -z, is clamped by a flange at z = 0, and bends towards +y when its cable is pulled, which
squeezes the cavities. Seven lengths and angles shape its notches, bellows and cavities. With four cavities (thesis
3.3.6) a wall in the plane x = 0 splits each cavity in two, so that the sensors tell a lateral force from a pull.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.errors import InfeasibleDesign
from softgym_envs.mechanics.constraints import Cavity
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.statics import Statics
from softgym_envs.robots.meshing import BodyMesh, mesh_geometry
from softgym_envs.robots.morphing import Cone, Cylinder, Feature, Plane
from softgym_envs.robots.robot import Actuator, MeshedRobot

__all__ = ["SensorReadings", "SensorizedFinger", "check_finger", "draw_bellow_finger"]

# Fixed dimensions [mm]. Where bellows end along z they are as wide as the segments: TEETH_RADIUS = THICKNESS / 2.
LENGTH = 40.0
HEIGHT = 20.0
THICKNESS = 17.5
FLANGE = 3.0
TEETH_RADIUS = 8.75

_LATERAL_POINT = (-THICKNESS / 2, HEIGHT / 2, -1.5 * LENGTH)


def draw_bellow_finger(
    length: float,
    height: float,
    joint_height: float,
    slope: float,
    outer_radius: float,
    bellow_height: float,
    plateau_height: float,
    wall_thickness: float,
    cork_thickness: float,
    split: float = 0.0,
    part: str = "body",
) -> None:
    """Draw a finger of three segments and two bellows with gmsh: lengths in mm, slope of the notches in rad.

    Args:
        length: of one segment, along -z.
        height: of the segments, along y.
        joint_height: thickness left under the notches.
        slope: angle of the notch faces from the cross-section.
        outer_radius: of the bellows, at their plateau.
        bellow_height: of bellows and cavities along z, where they are widest in z.
        plateau_height: of their cylindrical part.
        wall_thickness: radius of the bellow minus radius of the cavity.
        cork_thickness: height of the slab under the cavities.
        split: half the thickness of a wall in the plane x = 0 through the cavities; 0 for none.
        part: ``"body"``, ``"filled"`` (the body without its cavities) or ``"cavities"`` (what was left out).
    """
    import gmsh

    occ = gmsh.model.occ
    run = (height - joint_height) * math.tan(slope)

    def half_turned(inner: float, outer: float, z: float) -> tuple[int, int]:
        """A trapezoid profile (full height up to ``inner``, plateau at ``outer``) turned by 180 degrees about z."""
        full, flat = bellow_height / 2, plateau_height / 2
        profile = [(0.0, -full), (inner, -full), (outer, -flat), (outer, flat), (inner, full), (0.0, full)]
        points = [occ.addPoint(r, 0, z + h) for r, h in profile]
        lines = [occ.addLine(a, b) for a, b in zip(points, points[1:] + points[:1], strict=True)]
        face = occ.addPlaneSurface([occ.addCurveLoop(lines)])
        return next(e for e in occ.revolve([(2, face)], 0, 0, 0, 0, 0, 1, math.pi) if e[0] == 3)

    hollows = []
    if part != "filled":
        cavities = [
            half_turned(TEETH_RADIUS - wall_thickness, outer_radius - wall_thickness, -j * length) for j in (1, 2)
        ]
        solid = []
        for joint in (1, 2):
            low = -joint * length - bellow_height
            solid.append(
                (3, occ.addBox(-outer_radius, -1, low, 2 * outer_radius, 1 + cork_thickness, 2 * bellow_height))
            )
            if split:
                solid.append((3, occ.addBox(-split, -1, low, 2 * split, 1 + outer_radius, 2 * bellow_height)))
        hollows, _ = occ.cut(cavities, solid)
    if part == "cavities":
        return

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
    bellows = [half_turned(TEETH_RADIUS, outer_radius, -joint * length) for joint in (1, 2)]
    body, _ = occ.fuse(bar, [flange, *bellows])
    if hollows:
        occ.cut(body, hollows)


def check_finger(lengths: Mapping[str, float]) -> None:
    """Check that the shape of `draw_bellow_finger` exists.

    Args:
        lengths: its parameters [mm, rad].

    Raises:
        InfeasibleDesign: naming what does not fit.
    """
    length, height, joint_height = lengths["length"], lengths["height"], lengths["joint_height"]
    tangent = math.tan(lengths["slope"])
    outer, inner = lengths["outer_radius"] - lengths["wall_thickness"], TEETH_RADIUS - lengths["wall_thickness"]
    half, cork, split = lengths["bellow_height"] / 2, lengths["cork_thickness"], lengths.get("split", 0.0)
    run = (height - joint_height) * tangent
    if not run > 0.0:
        raise InfeasibleDesign(
            f"there is no notch: joint height {joint_height:.2f} mm, height {height:.2f} mm, tan(slope) {tangent:.3g}"
        )
    if 2.0 * run >= length:
        raise InfeasibleDesign(
            f"the notches meet: 2 x {run:.2f} mm does not fit in a segment of {length:.2f} mm; "
            "lower the slope or raise the joints"
        )
    if lengths["plateau_height"] >= 2.0 * half:
        raise InfeasibleDesign(f"a plateau of {lengths['plateau_height']:.2f} mm on a bellow of {2.0 * half:.2f} mm")
    if math.hypot(cork, split) >= outer:
        raise InfeasibleDesign(
            f"the cavity vanishes: the cork ends at {cork:.2f} mm, the cavity at a radius of {outer:.2f} mm"
        )
    # Where the cavity is widest along z, only the segment beside it closes it.
    closed = joint_height + half / tangent
    if inner > cork and inner >= closed:
        raise InfeasibleDesign(
            f"the cavity opens into the notch: it is {inner:.2f} mm high at its ends, the segment beside it "
            f"{closed:.2f} mm"
        )


@dataclass(frozen=True)
class SensorReadings:
    """What the sensors and the tip of one design do (thesis eq. 3.3 and 3.4, and section 3.3.6).

    Attributes:
        volume_change: ``f1 = |V(pull) - V(0)|`` of the first cavity [m3].
        bending_angle: ``f2 = acos(|p_z| / |p|)`` of the tip point p under the pull [rad].
        relative_volume_change: ``f3 = f1 / V(pull)``, the relative change of pressure of a closed cavity.
        initial_volume: ``f4 = V(0)`` of the first cavity [m3].
        pressure_sensitivity: the smaller of ``f3`` under the pull and under the lateral force; None with two cavities.
        volumes: of all cavities at rest [m3].
        pulled_volumes: of all cavities under the pull [m3].
        pushed_volumes: of all cavities under the lateral force [m3]; None with two cavities.
        tension: of the cable under the pull [N].
        stable: the equilibrium under the pull is stable.
    """

    volume_change: float
    bending_angle: float
    relative_volume_change: float
    initial_volume: float
    pressure_sensitivity: float | None
    volumes: tuple[float, ...]
    pulled_volumes: tuple[float, ...]
    pushed_volumes: tuple[float, ...] | None
    tension: float
    stable: bool


class SensorizedFinger(MeshedRobot):
    """Cable-driven soft finger that senses the volumes of its cavities.

    The condensed model has the actuator (the cable), the effector (the tip point) and the sensors: one row of role
    ``s`` per cavity, whose delta is the change of its volume [m3], from the base to the tip and from -x to +x.

    Args:
        cavities: 2 (one in each bellow) or 4 (two in each, with a wall between; its thickness is then a variable).
        mesh_size: target edge length [m].
        meshing: ``"remesh"`` (default) meshes every design anew, as the published study does. ``"morph"`` moves the
            baseline mesh where its elements stay good: in about a quarter of this large box.
        material: name of a material of `softgym_envs.mechanics.materials`.
        unilateral: the cable cannot push (default).
        gravity: acceleration [m/s2].
        tip_height: height of the effector over the bottom [m]: 0 as published, 10 mm as in the `SoftFinger`.
        cable_clearance: height of the cable over the bellows [m]: 0.8 mm in the published study, 1 mm as built.
    """

    name = "sensorized_finger"
    effectors = ("tip",)
    size = 0.12

    def __init__(
        self,
        *,
        cavities: int = 2,
        mesh_size: float = 7.0e-3,
        meshing: str = "remesh",
        material: str = "corotational",
        unilateral: bool = True,
        gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        tip_height: float = 0.0,
        cable_clearance: float = 0.8e-3,
    ) -> None:
        if cavities not in (2, 4):
            raise ValueError(f"cavities = {cavities!r} is unknown; allowed: 2, 4")
        super().__init__(mesh_size=mesh_size, meshing=meshing, material=material, gravity=gravity)
        self.cavities = cavities
        self.unilateral = unilateral
        mm = 1e-3
        shape = [
            DesignVariable(
                "slope", math.radians(10), math.radians(60), math.radians(30), "rad", "slope of the notches"
            ),
            DesignVariable("outer_radius", 8.75 * mm, 17.75 * mm, 14.75 * mm, "m", "radius of the bellows"),
            DesignVariable("joint_height", 5 * mm, 8 * mm, 6 * mm, "m", "thickness of the hinges under the notches"),
            # The published box ends at 10 mm; the finger that was built ("large") has 13 mm.
            DesignVariable("bellow_height", 6 * mm, 13 * mm, 8 * mm, "m", "length of the bellows and cavities"),
            DesignVariable("wall_thickness", 2 * mm, 4 * mm, 3 * mm, "m", "radius of the bellow minus the cavity's"),
            DesignVariable("cork_thickness", 2 * mm, 5 * mm, 3 * mm, "m", "thickness of the slab under the cavities"),
            DesignVariable("plateau_height", 2 * mm, 4 * mm, 3 * mm, "m", "length of the bellows' cylindrical part"),
        ]
        if cavities == 4:
            shape.append(
                DesignVariable("split", 0.75 * mm, 3 * mm, 0.75 * mm, "m", "half the wall between paired cavities")
            )
        self.design_space = DesignSpace(
            *shape,
            DesignVariable("young_modulus", 1.0e6, 1.0e7, 3.0e6, "Pa", "stiffness of the silicone", log=True),
            DesignVariable("poisson_ratio", 0.30, 0.499, 0.30, "1", "0.5 is incompressible"),
        )
        self.stiffness_variable = None if any(gravity) else "young_modulus"
        self.tip_height = float(tip_height)
        self.cable_clearance = float(cable_clearance)
        self.effector_rest = np.array([0.0, self.tip_height, -3.0 * LENGTH * mm])
        self.effort_scale = np.array([20.0])
        self.actuators = (Actuator("cable", 0.0, 0.015, 0.001, unilateral=unilateral),)

    @property
    def variant(self) -> str:
        """``sensorized_finger_2cavities`` or ``sensorized_finger_4cavities``."""
        return f"sensorized_finger_{self.cavities}cavities"

    @property
    def signature(self) -> dict[str, object]:
        """Options that change the condensed model (a cable that may push has the same one)."""
        return {
            "cavities": self.cavities,
            "mesh_size": self.mesh_size,
            "meshing": self.meshing,
            "material": self.material,
            "gravity": list(self.gravity),
            "tip_height": self.tip_height,
            "cable_clearance": self.cable_clearance,
        }

    # -- shape ------------------------------------------------------------------------------------------------------

    def lengths(self, design: Mapping[str, float]) -> dict[str, float]:
        """Return the parameters of `draw_bellow_finger` [mm, rad] for a complete design."""
        names = ("joint_height", "outer_radius", "bellow_height", "plateau_height", "wall_thickness", "cork_thickness")
        lengths = {name: round(design[name] * 1e3, 9) for name in names}
        lengths |= {"length": LENGTH, "height": HEIGHT, "slope": round(design["slope"], 12)}
        if self.cavities == 4:
            lengths["split"] = round(design["split"] * 1e3, 9)
        return lengths

    def drawing(self, design: Mapping[str, float]) -> tuple[Callable[..., None], dict[str, float]]:
        """Return the function that draws a complete design with gmsh and its parameters [mm, rad].

        Raises:
            InfeasibleDesign: if the shape cannot exist.
        """
        lengths = self.lengths(design)
        check_finger(lengths)
        cable = 1e3 * self.cable_height(design)
        if not lengths["joint_height"] < cable < HEIGHT:
            raise InfeasibleDesign(
                f"the cable does not pass through the segments and over the joints: it is {cable:.2f} mm above the "
                f"bottom, the joints end at {lengths['joint_height']:.2f} mm and the segments at {HEIGHT:.2f} mm"
            )
        return draw_bellow_finger, lengths

    def cable_height(self, design: Mapping[str, float]) -> float:
        """Return the height of the cable over the bottom of a complete design [m]."""
        return design["outer_radius"] + self.cable_clearance

    def mesh(self, design: Mapping[str, float]) -> BodyMesh:
        """Mesh the body of a complete design.

        Raises:
            InfeasibleDesign: if the shape cannot exist or cannot be meshed in time.
        """
        draw, lengths = self.drawing(design)
        mesh = mesh_geometry(draw, lengths, mesh_size=self.mesh_size)
        found = len(mesh.cavities())
        if found != self.cavities:
            raise InfeasibleDesign(f"the mesh has {found} closed cavities, expected {self.cavities}, for {lengths}")
        return mesh

    def features(self, design: Mapping[str, float]) -> dict[str, Feature]:
        """Planes of the bar, the flange and the notches; cones and cylinders of bellows and cavities."""
        mm = 1e-3
        x, y, z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
        side, flange, height, length = THICKNESS / 2 * mm, FLANGE * mm, HEIGHT * mm, LENGTH * mm
        joint, tangent = design["joint_height"], math.tan(design["slope"])
        outer, wall, full = design["outer_radius"], design["wall_thickness"], design["bellow_height"] / 2
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
            "bellow rim": Cylinder(outer),
            "cavity rim": Cylinder(outer - wall),
            "cork": Plane((0, design["cork_thickness"], 0), y),
            "notch 3 base": Plane((0, joint, -3 * length), (0.0, -tangent, 1.0)),
        }
        if self.cavities == 4:
            features["split left"] = Plane((-design["split"], 0, 0), x)
            features["split right"] = Plane((design["split"], 0, 0), x)
        # Radius lost per height between full height and plateau.
        taper = (outer - TEETH_RADIUS * mm) / (full - design["plateau_height"] / 2)
        for k in (1, 2):
            centre = -k * length
            for word, sign in (("base", 1.0), ("tip", -1.0)):
                features[f"notch {k} {word}"] = Plane((0, joint, centre), (0.0, -sign * tangent, 1.0))
                features[f"flat {k} {word}"] = Plane((0, 0, centre + sign * full), z)
                for part, radius in (("bellow", TEETH_RADIUS * mm), ("cavity", TEETH_RADIUS * mm - wall)):
                    features[f"{part} {k} {word}"] = Cone(radius, centre + sign * full, -sign * taper)
        return features

    # -- mechanics --------------------------------------------------------------------------------------------------

    def equip(self, mesh: BodyMesh, design: Mapping[str, float]) -> MechanicalModel:
        """Clamp the flange, route the cable past the notches, put the effector at the tip, make cavities sensors."""
        model = MechanicalModel.from_mesh(
            mesh.nodes,
            mesh.tetrahedra,
            fixed=mesh.nodes[:, 2] >= -(FLANGE + 1e-3) * 1e-3,
            material=self.material,
            young_modulus=design["young_modulus"],
            poisson_ratio=design["poisson_ratio"],
            density=1100.0,
            gravity=self.gravity,
        )
        length = LENGTH * 1e-3
        height = self.cable_height(design)
        offset = (height - design["joint_height"]) * math.tan(design["slope"])
        stations = [s for k in range(3) for s in (-k * length - offset, -(k + 1) * length + offset)]
        points = np.array([[0.0, height, s] for s in stations])
        model.add_cable("cable", points, np.array([0.0, height, 0.0]), unilateral=self.unilateral)
        # Above the joint's height the effector floats in front of the slanted end.
        hint = self.reference_element(mesh, self.effector_rest)
        model.add_effector("tip", self.effector_rest, hint=hint)
        for number, triangles in enumerate(mesh.cavities(), start=1):
            model.add("s", Cavity(f"cavity_{number}", triangles, mesh.nodes))
        return model

    def readings(
        self, design: Mapping[str, float] | None = None, *, pull: float = 0.010, lateral_force: float = 5.0
    ) -> SensorReadings:
        """Solve the equilibria that the published objectives are made of.

        Args:
            design: the body; missing variables take their baseline.
            pull: displacement of the cable [m].
            lateral_force: force along x on the side of the middle segment, with the cable held [N]; only with four
                cavities. 5 N at 3 MPa is the published ratio of force to stiffness.

        Raises:
            DesignError: for a malformed design.
            InfeasibleDesign: if the geometry cannot exist.
            ConvergenceError: if there is no equilibrium.
        """
        model = self.build(design)
        volumes = np.array([sensor.rest_volume for sensor in model.constraints["s"] if isinstance(sensor, Cavity)])
        statics = Statics(model)
        rest = volumes + statics.solve([0.0]).condensed.delta.s if model.loads.any() else volumes
        state = statics.solve([pull])
        pulled = volumes + state.condensed.delta.s
        tip = state.condensed.delta.e
        change = abs(float(pulled[0] - rest[0]))
        pushed, sensitivity = None, None
        if self.cavities == 4:
            point = model.embed(np.array(_LATERAL_POINT) * 1e-3)
            model.nodal_loads[point.node_ids[0], 0] += lateral_force * point.weights[0]
            model.refresh_loads()
            statics.reset()
            pushed = volumes + statics.solve([0.0]).condensed.delta.s
            sensitivity = min(change / float(pulled[0]), abs(float(pushed[0] - rest[0])) / float(pushed[0]))
        return SensorReadings(
            volume_change=change,
            bending_angle=math.acos(min(1.0, abs(tip[2]) / float(np.linalg.norm(tip)))),
            relative_volume_change=change / float(pulled[0]),
            initial_volume=float(rest[0]),
            pressure_sensitivity=sensitivity,
            volumes=tuple(map(float, rest)),
            pulled_volumes=tuple(map(float, pulled)),
            pushed_volumes=None if pushed is None else tuple(map(float, pushed)),
            tension=float(state.effort[0]),
            stable=state.stable,
        )
