"""Hands of contact-aided fingers, and what they hold: one finger that closes on an object, two that lift one.

Objects are part of the scene, so their place, size, mass and friction are design variables like the moduli of the
body: environments can draw them at each reset and show them to the agent, and a study can average over them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.errors import unknown_name
from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.extensions.beams.servo import Servo
from softgym_envs.extensions.beams.slide import Slide
from softgym_envs.extensions.grasping.grasps import KINDS, GraspObject
from softgym_envs.extensions.grasping.robots.carried_objects import CARRIED, ROUNDING, Shape
from softgym_envs.extensions.grasping.robots.contact_aided_finger import ContactAidedFinger
from softgym_envs.extensions.grasping.robots.lifting import Lifting
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.contact.obstacles import Obstacle, Plane
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.base import Actuator, Robot
from softgym_envs.robots.capabilities import Learning, View

CLOSING_RATE = math.radians(2.0)
"""Largest change of a servo's angle in a control step [rad]."""

ON_TABLE = 2.0e-4
"""Gap between box and table in the drawing [m]: within the distance of contact, so that the table carries the box."""

TABLE_STIFFNESS, TABLE_HEIGHT, TABLE_MODULUS, TABLE_DENSITY = 100.0, 0.2, 1.0e6, 1000.0
"""Column below the table: stiffness along z [N/m], height [m], Young's modulus [Pa] and density [kg/m3]."""

TABLE_MASS = 0.5 * TABLE_DENSITY * TABLE_STIFFNESS * TABLE_HEIGHT**2 / TABLE_MODULUS
"""Part of the column's mass whose weight the table carries [kg]."""

UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Turns a finger so that it points down (-z) and closes along +x."""


class GraspingFinger(ContactAidedFinger):
    """A contact-aided finger that closes on an object that stands still (thesis, sec. 3.4).

    Args:
        object: a kind of `GraspObject`: ``"plane"``, ``"hexagon"``, ``"horizontal_hexagon"`` or ``"sphere"``; or
            ``"any"``, which makes the kind a variable.
        self_contact: whether the zigzag touches itself and the other leg.
        **options: options of `ContactAidedFinger`.
    """

    name = "grasping_finger"

    def __init__(self, *, object: str = "plane", self_contact: bool = True, **options: Any) -> None:
        if object not in (*KINDS, "any"):
            raise ValueError(f"object = {object!r} is unknown; allowed: {', '.join(KINDS)}, any")
        super().__init__(self_contact=self_contact, **options)
        self.object = object
        scene = [
            DesignVariable("object_gap", 0.010, 0.040, 0.0301, "m", "distance of the object from the finger, along x"),
            DesignVariable("friction", 0.10, 1.0, 0.85, "1", "coefficient of friction of the object"),
        ]
        if object != "plane":
            scene.append(
                DesignVariable("object_height", 0.030, 0.100, 0.050, "m", "middle of the object above the foot")
            )
            scene.append(DesignVariable("object_size", 0.030, 0.080, 0.060, "m", "width of the object along x"))
        if object == "any":
            kinds = ", ".join(f"{k} {kind}" for k, kind in enumerate(KINDS))
            scene.append(DesignVariable("object_kind", 0.0, 4.0, 0.0, "1", f"rounded down: {kinds}"))
        self.scene = tuple(variable.name for variable in scene)
        self.design_space = DesignSpace(*self.design_space, *scene)
        (servo,) = self.actuators
        self.actuators = (
            Actuator(servo.name, servo.low, servo.high, CLOSING_RATE, servo.unit, False, servo.max_effort),
        )

    def own_obstacles(self, model: MechanicalModel, design: Mapping[str, float]) -> tuple[Obstacle, ...]:
        """Return the object in front of the finger."""
        return (self.target(design).obstacle(self.width),)

    def surroundings(self, design: Mapping[str, float]) -> tuple[Obstacle, ...]:
        return (self.target(design).obstacle(self.width), *super().surroundings(design))

    def target(self, design: Mapping[str, float]) -> GraspObject:
        """Return the object of a complete design."""
        kind = self.object if self.object != "any" else KINDS[min(int(design["object_kind"]), len(KINDS) - 1)]
        place = {"distance": design["object_gap"], "friction": design["friction"]}
        if self.object != "plane":
            place |= {"height": design["object_height"], "size": design["object_size"]}
        return GraspObject(kind, **place)


class ContactAidedGripper(Robot):
    """Two contact-aided fingers that point down and close along x on a free box, which they lift off a table.

    The hand stands still and the table goes down, which is the same in the frame of the hand. Heights are therefore
    measured from the table: the effector is the middle of the box relative to it. Gravity acts along -z.

    Args:
        clearance: height of the finger tips at rest above the table [m].
        object: what is lifted, a name of `CARRIED`: ``"box"``, ``"hexagon"`` (an upright prism) or ``"ball"``.
        box: width (x), depth (y) and height (z) of the object [m]; a hexagon has no depth of its own, a ball only a
            width.
        control_points: as for `ContactAidedFinger`.
        mesh: as for `ContactAidedFinger`.
        mesh_size: target edge length [m], instead of that of the mesh.
        element: kind of element, instead of that of the mesh.
        self_contact: whether each zigzag touches itself and the other leg.
        gravity: acceleration [m/s2].
        **options: options of `Robot`.
    """

    name = "contact_aided_gripper"
    effectors = ("box",)
    size = 0.1
    learning = Learning(convex=False)
    view = View(at_rest=True)
    lifting = Lifting(drive=2, mass="object_mass", friction="friction")
    backends = {
        "surrogate": "softgym_envs.extensions.grasping.backends.chain_hand:ChainHandBackend",
        "hybrid": "softgym_envs.extensions.grasping.backends.chain_hand:HybridHandBackend",
    }
    goal_axes = np.array([0.0, 0.0, 1.0])
    goal_tolerance = 1.0e-3
    workspace_scale = 0.010

    def __init__(
        self,
        *,
        clearance: float = 0.010,
        object: str = "box",
        box: tuple[float, float, float] = (0.040, 0.030, 0.050),
        control_points: int = 12,
        mesh: str = "accurate",
        mesh_size: float | None = None,
        element: str | None = None,
        self_contact: bool = True,
        gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
        **options: Any,
    ) -> None:
        super().__init__(gravity=gravity, self_contact=self_contact, **options)
        for name, value in {
            "clearance": clearance,
            **dict(zip(("box[0]", "box[1]", "box[2]"), box, strict=True)),
        }.items():
            if not 2.0 * ROUNDING < value < 0.2:
                raise ValueError(f"robot '{self.name}': {name} = {value} m must be inside (0.002, 0.2)")
        self.finger = ContactAidedFinger(control_points=control_points, mesh=mesh, mesh_size=mesh_size, element=element)
        if object not in CARRIED:
            raise ValueError(f"robot '{self.name}': " + unknown_name("object", object, CARRIED))
        self.clearance, self.object, self.box = clearance, object, box
        self.design_space = DesignSpace(
            *self.finger.design_space,
            DesignVariable("object_gap", 0.005, 0.030, 0.015, "m", "distance of each finger from the box, along x"),
            DesignVariable("object_mass", 0.005, 1.0, 0.020, "kg", "mass of the box", log=True),
            DesignVariable("friction", 0.10, 1.0, 0.85, "1", "coefficient of friction of the box"),
        )
        (servo,) = self.finger.actuators
        self.actuators = (
            *(
                Actuator(f"servo_{k + 1}", 0.0, servo.high, CLOSING_RATE, "rad", False, servo.max_effort)
                for k in range(2)
            ),
            Actuator("lift", 0.0, 0.020, 0.001, "m", unilateral=False),
        )
        self.effort_scale = np.array([0.3, 0.3, 1.0])
        self.effector_rest = np.array([0.0, 0.0, self._shape.half_height])

    @property
    def _shape(self) -> Shape:
        """The object; not kept, because its functions cannot be pickled."""
        return CARRIED[self.object](self.box)

    def assemble(self, design: Mapping[str, float]) -> MechanicalModel:
        """Place both fingers, the table and the box, which rests on it.

        Raises:
            InfeasibleDesign: if the outline of a finger crosses itself.
        """
        own = {name: design[name] for name in self.finger.design_space.names}
        mesh = self.finger.body(own)
        builder = ModelBuilder(gravity=self.gravity, floating=True)
        shape = self._shape
        reach = self.finger.width + design["object_gap"] + shape.half_width
        height = self.clearance + self.finger.length
        servos = []
        for turn in (np.eye(3), np.diag([-1.0, -1.0, 1.0])):
            shift = turn @ np.array([-reach, 0.0, height])
            servos.append((self.finger.add_to(builder, mesh, own, turn=turn @ UPRIGHT, shift=shift), turn @ UPRIGHT))
        table = _add_table(builder)
        frame = builder.add_frame([0.0, 0.0, shape.half_height + ON_TABLE])
        builder.add_mass(frame, design["object_mass"], design["object_mass"] * shape.inertia)
        model = builder.build()
        for actuator, (servo, turn) in zip(self.actuators, servos, strict=False):
            axis = turn @ np.array([0.0, 0.0, -1.0])
            model.add("a", Servo(actuator.name, servo, axis, model.nodes))
        model.add("a", Slide("lift", EmbeddedPoints.in_frame(table, np.zeros(3), model.nodes), [0.0, 0.0, -1.0]))
        above_table = EmbeddedPoints.from_weights(np.array([[frame, table]]), np.array([[1.0, -1.0]]), model.nodes)
        model.add("e", Point("box", above_table))
        # The table acts on this skin; for the fingers, the obstacle of `own_obstacles` stands for it.
        model.skins.append(shape.skin(frame, model.nodes))
        return model

    def own_obstacles(self, model: MechanicalModel, design: Mapping[str, float]) -> tuple[Obstacle, ...]:
        """Return the table and the object, whose contact is called ``"box"`` whatever its shape."""
        box = len(model.nodes) - 4  # frames of four rows each: that of the table comes before that of the box
        friction = design["friction"]
        return (
            Plane((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), name="table", friction=friction, frame=box - 4),
            self._shape.obstacle("box", friction, box),
        )


def _add_table(builder: ModelBuilder) -> int:
    """Add the frame of a table at z = 0 that can only move along z, on a soft column.

    Its first director points up. Without the column nothing but the drive would hold the table, and a condensed model
    needs a body that is held without its drives.
    """
    up = np.column_stack([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    foot = builder.add_frame([0.0, 0.0, -TABLE_HEIGHT], up, fixed=True, fixed_spin=True)
    middle = builder.add_frame([0.0, 0.0, -0.5 * TABLE_HEIGHT], up)
    table = builder.add_frame(np.zeros(3), up, fixed=(True, True, False), fixed_spin=True)
    side = math.sqrt(TABLE_STIFFNESS * TABLE_HEIGHT / TABLE_MODULUS)
    builder.add_element(
        Beam,
        [foot, middle, table],
        section=Section.rectangle(side, side),
        young_modulus=TABLE_MODULUS,
        poisson_ratio=0.3,
        density=TABLE_DENSITY,
    )
    return table
