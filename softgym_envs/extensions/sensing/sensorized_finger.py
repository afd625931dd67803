"""The sensorized Soft Finger: one cable, and the volumes of its bellows' cavities as sensors (thesis, sec. 3.3).

The finger hangs along -z, is clamped by a flange at z = 0, and bends towards +y when its cable is pulled, which
squeezes the cavities. Seven lengths and angles shape its notches, bellows and cavities. With four cavities (thesis
3.3.6) a wall in the plane x = 0 splits each cavity in two, so that the sensors can distinguish a lateral force from a
pull. With sealed cavities the sensors measure the pressure of their air, which stiffens the finger.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.errors import InfeasibleDesign
from softgym_envs.extensions.sensing.walls import check_cavities
from softgym_envs.mechanics.constraints.cavity import Cavity, SealedAir
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.base import TOUCH_RADIUS, Actuator
from softgym_envs.robots.capabilities import LearnedTouch, Learning, Sensing
from softgym_envs.robots.geometry.finger_shape import (
    THICKNESS,
    check_finger,
    draw_finger,
    in_flange,
)
from softgym_envs.robots.geometry.graded_finger import (
    draw_rounded_finger,
    graded_features,
    mesh_finger,
    whole_finger,
)
from softgym_envs.robots.geometry.meshing import BodyMesh
from softgym_envs.robots.geometry.morphing import Feature
from softgym_envs.robots.gmsh_robot import GmshRobot
from softgym_envs.robots.mesh_tiers import MeshTier
from softgym_envs.robots.soft_finger import FINGER_MESHES

# Fixed dimensions [mm].
LENGTH = 40.0
HEIGHT = 20.0

LEARNED_BOX = {
    "slope": (0.42, 0.66),
    "outer_radius": (13.8e-3, 15.4e-3),
    "joint_height": (5.0e-3, 7.0e-3),
    "bellow_height": (7.0e-3, 10.0e-3),
    "wall_thickness": (2.8e-3, 3.4e-3),
    "cork_thickness": (2.6e-3, 4.0e-3),
    "plateau_height": (2.5e-3, 3.5e-3),
    "poisson_ratio": (0.30, 0.30 + 1e-10),  # a variable cannot have one value
}
"""Bodies that the shipped weights know: the mesh of the baseline moves to nearly all; Poisson's ratio is its own."""

_LATERAL_POINT = (-THICKNESS / 2, HEIGHT / 2, -1.5 * LENGTH)


@dataclass(frozen=True)
class SensorReadings:
    """Sensor readings and tip under a pull and a lateral force (thesis, eq. 3.3 and 3.4, sec. 3.3.6).

    Attributes:
        volume_change: ``f1 = |V(pull) - V(0)|`` of the first cavity [m3].
        bending_angle: ``f2 = acos(|p_z| / |p|)`` of the tip point p under the pull [rad].
        relative_volume_change: ``f3 = f1 / V(pull)`` (eq. 3.4); if the cavity is sealed, its gauge pressure over the
            ambient one.
        initial_volume: ``f4 = V(0)`` of the first cavity [m3].
        pressure_sensitivity: change of the first cavity's volume over its volume at rest (sec. 3.3.6), the smaller of
            that under the pull and that under the lateral force; None with two cavities.
        volumes: of all cavities at rest [m3].
        pulled_volumes: of all cavities under the pull [m3].
        pushed_volumes: of all cavities under the lateral force [m3]; None with two cavities.
        tension: of the cable under the pull [N].
        stable: whether the equilibrium under the pull is stable.
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


class SensorizedFinger(GmshRobot):
    """Cable-driven soft finger that senses the volumes of its cavities, or the pressures if they are sealed.

    The design box ``"learned"`` is that of the shipped weights (`LEARNED_BOX`), a small part of the published one.

    The condensed model has the actuator (the cable), the effector (the tip point) and the sensors: one row of role
    ``s`` per cavity, whose delta is the change of its volume [m3] or its gauge pressure [Pa], from the base to the tip
    and from -x to +x.

    Args:
        cavities: 2 (one in each bellow) or 4 (two in each, with a wall between; its thickness is then a variable).
        mesh: ``"published"``, ``"local"`` (linear elements, small at the cavities; thesis, fig. 3.10), ``"accurate"``
            or ``"reference"``. Volume changes and Poisson's ratios above 0.45 need an accurate mesh: see the page.
        meshing: ``"remesh"`` (default) creates a new mesh for every design, as in the published study. ``"morph"``
            moves the baseline mesh if its elements stay good, which holds in about a quarter of this large space.
        unilateral: whether the cable cannot push (default).
        tip_height: height of the effector over the bottom [m]: 0 as published, 10 mm as in the `SoftFinger`.
        cable_clearance: height of the cable over the bellows [m]: 0.8 mm in the published study, 1 mm as built.
        sealed: whether the cavities are closed. Their air then follows Boyle's law at constant temperature, from
            101,325 Pa in the undeformed body and outside of it.
        touch: whether a touch on the flat back is part of the design: its force along +y, and its place. The force
            grows with Young's modulus, so that this still scales all efforts and nothing else. The touched point is a
            second effector. This is the robot that is learned, with ``meshing="morph"``: to a network, a touch is an
            input like any other.
        **options: options of `GmshRobot`.
    """

    name = "sensorized_finger"
    backends = {"hybrid": "softgym_envs.extensions.sensing.hybrid:SensorizedHybridBackend"}
    effectors: tuple[str, ...] = ("tip",)
    size = 0.12
    rounded = True
    # The cable passes the bellows at 0.8 mm, so the parts where guides act are small. "local": elements of 2 mm at the
    # cavities, with which the thesis computed the fingers that were built (fig. 3.10).
    meshes = {
        **{name: replace(FINGER_MESHES[name], guide_radius=1.0e-3) for name in ("accurate", "reference")},
        "published": MeshTier(7.0e-3),
        "local": MeshTier(10.0e-3, feature_size=2.0e-3),
    }

    def __init__(
        self,
        *,
        cavities: int = 2,
        mesh: str = "published",
        meshing: str = "remesh",
        unilateral: bool = True,
        tip_height: float = 0.0,
        cable_clearance: float = 0.8e-3,
        sealed: bool = False,
        touch: bool = False,
        **options: Any,
    ) -> None:
        if cavities not in (2, 4):
            raise ValueError(f"cavities = {cavities!r} is unknown; allowed: 2, 4")
        super().__init__(mesh=mesh, meshing=meshing, **options)
        self.reproduces_scene = self.tier in (self.meshes["published"], self.meshes["local"])
        self.cavities, self.touch = cavities, touch
        self.design_boxes = {"learned": LEARNED_BOX | {"split": (0.75e-3, 1.5e-3)} if cavities == 4 else LEARNED_BOX}
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
        touched: list[DesignVariable] = []
        if touch:
            self.effectors = ("tip", "touched")
            touched = [
                DesignVariable("touch_force", 0.0, 2.0, 0.0, "N", "of a touch, at the baseline's stiffness"),
                DesignVariable("touch_below", 15 * mm, 115 * mm, 65 * mm, "m", "distance of the touch to the flange"),
                DesignVariable("touch_beside", -7.5 * mm, 7.5 * mm, 0.0, "m", "x of the touch"),
            ]
        self.design_space = DesignSpace(
            *shape,
            *touched,
            DesignVariable("young_modulus", 1.0e6, 1.0e7, 3.0e6, "Pa", "stiffness of the silicone", log=True),
            DesignVariable("poisson_ratio", 0.30, 0.499, 0.30, "1", "0.5 is incompressible"),
        )
        self.learning = Learning(
            weights=f"{self.name}_{cavities}cavities" + "_sealed" * sealed + "_touched" * touch,
            stiffness_variable="young_modulus",
            loads=("touch_force", "touch_below", "touch_beside") if touch else (),
            touch=None if touch else TouchOnBack(self),
        )
        self.tip_height = float(tip_height)
        self.cable_clearance = float(cable_clearance)
        self.effector_rest = np.array([0.0, self.tip_height, -3.0 * LENGTH * mm])
        self.effort_scale = np.array([20.0])
        # What a pull of 10 mm does to each cavity of the baseline body: its volume [m3] or its pressure [Pa] changes.
        volume, pressure = (57e-9, 7.4e3) if cavities == 2 else (23e-9, 6.5e3)
        self.sensing = Sensing(np.full(cavities, pressure if sealed else volume), "Pa" if sealed else "m3", sealed)
        self.actuators = (Actuator("cable", 0.0, 0.015, 0.001, unilateral=unilateral),)

    # -- shape ------------------------------------------------------------------------------------------------------

    def lengths(self, design: Mapping[str, float]) -> dict[str, float]:
        """Return the parameters of `draw_finger` [mm, rad] for a complete design."""
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
        lengths = self._checked(design)
        if self.fillet:
            return draw_rounded_finger, {**lengths, "fillet": round(1e3 * self.fillet, 9)}
        return draw_finger, lengths

    def _checked(self, design: Mapping[str, float]) -> dict[str, float]:
        """Return `lengths` after checking that the shape can exist."""
        lengths = self.lengths(design)
        check_finger(lengths)
        cable = 1e3 * self.cable_height(design)
        if not lengths["joint_height"] < cable < HEIGHT:
            raise InfeasibleDesign(
                f"the cable must pass through the segments and over the joints: it is {cable:.2f} mm above the "
                f"bottom, the joints end at {lengths['joint_height']:.2f} mm and the segments at {HEIGHT:.2f} mm"
            )
        return lengths

    def cable_height(self, design: Mapping[str, float]) -> float:
        """Return the height of the cable over the bottom of a complete design [m]."""
        return design["outer_radius"] + self.cable_clearance

    def mesh(self, design: Mapping[str, float]) -> BodyMesh:
        """Mesh the body of a complete design, or the half that `mirror` completes.

        Raises:
            InfeasibleDesign: if the shape cannot exist or cannot be meshed in time.
        """
        lengths = self._checked(design)
        mesh = mesh_finger(lengths, self.tier)
        found = len(self.mirror(mesh).cavities())
        if found != self.cavities:
            raise InfeasibleDesign(f"the mesh has {found} closed cavities, expected {self.cavities}, for {lengths}")
        return mesh

    def features(self, design: Mapping[str, float]) -> dict[str, Feature]:
        """Return the surfaces of the shape of a complete design."""
        return graded_features(self.lengths(design), self.tier)

    def mirror(self, part: BodyMesh) -> BodyMesh:
        """Complete the body of a graded mesh."""
        return whole_finger(part, self.tier)

    def build_model(self, mesh: BodyMesh, design: Mapping[str, float]) -> MechanicalModel:
        """Clamp the flange, route the cable past the notches, put the effector at the tip, make cavities sensors."""
        model = self.solid(mesh, design, fixed=in_flange(mesh.nodes))
        length = LENGTH * 1e-3
        height = self.cable_height(design)
        offset = (height - design["joint_height"]) * math.tan(design["slope"])
        stations = [s for k in range(3) for s in (-k * length - offset, -(k + 1) * length + offset)]
        points = np.array([[0.0, height, s] for s in stations])
        (cable,) = self.actuators
        pull_point = np.array([0.0, height, 0.0])
        model.add_cable(cable.name, points, pull_point, unilateral=cable.unilateral, radius=self.guide_radius)
        # Above the height of the joints the effector lies in front of the slanted end, outside the body.
        hint = self.reference_element(mesh, self.effector_rest)
        model.add_effector("tip", self.effector_rest, hint=hint)
        if self.touch:
            place = np.array([design["touch_beside"], 0.0, -design["touch_below"]])
            force = design["touch_force"] * design["young_modulus"] / self.design_space["young_modulus"].baseline
            touched = model.add_effector("touched", place, radius=TOUCH_RADIUS).embedding
            np.add.at(model.nodal_loads[:, 1], touched.node_ids[0], force * touched.weights[0])
        for number, triangles in enumerate(mesh.cavities(), start=1):
            cavity = model.cavity(f"cavity_{number}", triangles)
            model.add("s", model.seal(cavity) if self.sensing.sealed else cavity)
        return model

    def readings(
        self, design: Mapping[str, float] | None = None, *, pull: float = 0.010, lateral_force: float = 5.0
    ) -> SensorReadings:
        """Return the quantities of the published objectives, computed from equilibria.

        Args:
            design: the body; missing variables take their baseline.
            pull: displacement of the cable [m].
            lateral_force: force along x on the side of the middle segment, with the cable held [N]; only with four
                cavities. 5 N at 3 MPa is the published ratio of force to stiffness.

        Raises:
            DesignError: for a malformed design.
            InfeasibleDesign: if the geometry cannot exist, or walls of a cavity pass through each other.
            ConvergenceError: if there is no equilibrium.
        """
        model = self.build(design)
        statics = Statics(model)
        rest = _volumes(model, statics.solve([0.0]).condensed.delta.s if model.loads.any() else np.zeros(self.cavities))
        # One step of the whole pull takes fine meshes through shapes with an indefinite tangent, which costs more.
        increments = 1 if self.tier.element == "linear" else 4
        for share in range(1, increments + 1):
            state = statics.solve([pull * share / increments])
        check_cavities(model.constraints["s"], state.x)
        pulled = _volumes(model, state.condensed.delta.s)
        tip = state.condensed.delta.e
        change = abs(float(pulled[0] - rest[0]))
        pushed, sensitivity = None, None
        if self.cavities == 4:
            point = model.embed(np.array(_LATERAL_POINT) * 1e-3, radius=self.guide_radius)
            np.add.at(model.nodal_loads[:, 0], point.node_ids[0], lateral_force * point.weights[0])
            statics.reset()
            aside = statics.solve([0.0])
            check_cavities(model.constraints["s"], aside.x)
            pushed = _volumes(model, aside.condensed.delta.s)
            sensitivity = min(change, abs(float(pushed[0] - rest[0]))) / float(rest[0])
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


class TouchOnBack(LearnedTouch):
    """A force on the flat back of a `SensorizedFinger`.

    Args:
        robot: the finger without a touch among its design variables.
    """

    def __init__(self, robot: SensorizedFinger) -> None:
        self._robot = robot

    def variant(self) -> SensorizedFinger:
        # A network is smooth in the design, so it learns a mesh that moves with it. At the baseline both are one.
        options: dict[str, Any] = {**self._robot._options, "touch": True, "meshing": "morph"}
        return SensorizedFinger(**options)

    def design(self, design: Mapping[str, float], point: np.ndarray, force: np.ndarray) -> dict[str, float]:
        x, y, z = map(float, point)
        if abs(y) > 1e-6 or force[0] != 0.0 or force[2] != 0.0:
            raise ValueError(
                f"a learned touch is a force along y on the back (y = 0), got {list(force)} N at {list(point)} m"
            )
        share = self._robot.design_space["young_modulus"].baseline / design["young_modulus"]
        return {"touch_force": float(force[1]) * share, "touch_below": -z, "touch_beside": x}


def _volumes(model: MechanicalModel, readings: np.ndarray) -> np.ndarray:
    """Return the volumes [m3] of the cavities for values of the sensor rows, shape (n_s,)."""
    found = []
    for sensor, reading in zip(model.constraints["s"], readings, strict=True):
        assert isinstance(sensor, Cavity | SealedAir)
        found.append(sensor.volume_at(float(reading)))
    return np.array(found)
