"""The contact-aided finger: two legs and a top wall; the zigzag of one leg stiffens when it touches itself.

Shape, servo and material are those of the thesis (section 3.4) and its public model. The finger lies in the plane of x
and y and is symmetric about z = 0. Its left leg stands on the servo, its right leg is held in space at its foot and
faces the object, which is at larger x.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.beams.servo import Servo
from softgym_envs.extensions.grasping.robots.zigzag_shape import (
    LEFT_FOOT,
    check_outline,
    draw_extrusion,
    draw_published,
    zigzag_outline,
)
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.contact.obstacles import Obstacle
from softgym_envs.mechanics.elements.quadratic import add_midside_nodes
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.base import Actuator, Drawing
from softgym_envs.robots.capabilities import Learning, View
from softgym_envs.robots.geometry.meshing import BodyMesh, mesh_geometry
from softgym_envs.robots.geometry.morphing import Feature
from softgym_envs.robots.gmsh_robot import GmshRobot
from softgym_envs.robots.mesh_tiers import MeshTier

SERVO_AXIS = np.array([30.0e-3, -18.0e-3, 0.0])
"""A point of the servo's axis, which is parallel to z [m]."""

ON_SERVO, HELD = -3.0e-3, -1.0e-3
"""Heights [m] up to which the left foot moves with the servo, and the right foot is held."""

IN_PLACE = np.eye(3)

CONTROL_POINTS = (7, 12)
"""Allowed numbers of control points: of the initial design of the thesis, and of its recorded studies."""


class ContactAidedFinger(GmshRobot):
    """Servo-driven finger whose zigzag leg touches itself as the finger closes.

    A positive angle of the servo lifts the left foot and bends the finger towards the object. Every design gets a mesh
    of its own: outlines differ too much to move one mesh from design to design.

    Args:
        control_points: 7 (initial design of the thesis) or 12 (its optimised designs) distances shape the zigzag.
        mesh: ``"accurate"``, ``"reference"`` or ``"published"``: linear tetrahedra of 3 mm, made as by the public
            model. They are too stiff (see the page of this robot) but needed to compare with published values.
        mesh_size: target edge length [m], instead of that of the mesh.
        element: name of the solid element, instead of that of the mesh.
        length: height of the finger above its feet [m].
        width: distance between the outer sides of its feet [m].
        thickness: of the finger, along the servo's axis [m].
        density: [kg/m3].
        material: name of a material of `softgym_envs.mechanics.materials`.
        gravity: acceleration [m/s2].
        **options: options of `Robot`.
    """

    name = "contact_aided_finger"
    effectors: tuple[str, ...] = ("tip",)
    size = 0.1
    view = View(axes=(2, 0, 1))  # it stands along y and closes along x
    goal_axes = np.array([1.0, 1.0, 0.0])
    learning = Learning(stiffness_variable="young_modulus", convex=False)
    backends = {
        "surrogate": "softgym_envs.extensions.grasping.backends.chain:ChainBackend",
        "hybrid": "softgym_envs.extensions.grasping.backends.chain:HybridChainBackend",
    }
    may_touch = True  # `evaluate_grasp` adds the object
    meshes = {
        "published": MeshTier(3.0e-3),
        "accurate": MeshTier(8.0e-3, "quadratic"),
        "reference": MeshTier(4.0e-3, "quadratic"),
    }

    def __init__(
        self,
        *,
        control_points: int = 12,
        mesh: str = "accurate",
        mesh_size: float | None = None,
        element: str | None = None,
        length: float = 0.100,
        width: float = 0.033,
        thickness: float = 0.020,
        density: float = 500.0,
        material: str = "corotational",
        gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        **options: Any,
    ) -> None:
        if control_points not in CONTROL_POINTS:
            raise ValueError(f"control_points = {control_points!r} is unknown; allowed: 7, 12")
        sizes = {"length": length, "width": width, "thickness": thickness, "density": density}
        for name, value in sizes.items():
            if not (isinstance(value, int | float) and 0.0 < value < math.inf):
                raise ValueError(f"robot '{self.name}': {name} = {value!r} must be positive and finite")
        super().__init__(
            mesh=mesh,
            mesh_size=mesh_size,
            element=element,
            meshing="remesh",
            material=material,
            gravity=gravity,
            **options,
        )
        self.published_mesh = mesh == "published"
        self.control_points = control_points
        self.length, self.width, self.thickness, self.density = (float(value) for value in sizes.values())
        self.design_space = DesignSpace(
            DesignVariable("e1", 0.001, 0.015, 0.008, "m", "thickness of the left leg at its top"),
            DesignVariable("e2", 0.001, 0.015, 0.005, "m", "thickness of the top wall"),
            DesignVariable("e3", 0.001, 0.010, 0.004, "m", "thickness of the right leg, along x"),
            *(
                DesignVariable(f"d{k}", 0.008, 0.028, 0.021, "m", f"distance of the legs at point {k} from the top")
                for k in range(control_points)
            ),
            DesignVariable("young_modulus", 1.0e6, 1.0e7, 3.62e6, "Pa", "stiffness of the print", log=True),
            DesignVariable("poisson_ratio", 0.40, 0.499, 0.452, "1", "0.5 is incompressible"),
        )
        self.effector_rest = self.tip(self.design_space.baseline)
        self.effort_scale = np.array([0.3])
        self.actuators = (
            Actuator("servo", 0.0, math.radians(40.0), math.radians(1.0), "rad", unilateral=False, max_effort=1.2),
        )

    # -- what it touches --------------------------------------------------------------------------------------------

    @property
    def alone(self) -> ContactAidedFinger:
        """The same finger without anything to touch: the robot that chain surrogates approximate."""
        own = inspect.signature(ContactAidedFinger).parameters
        return ContactAidedFinger(**{name: value for name, value in self.mechanics_key.items() if name in own})

    def surroundings(self, design: Mapping[str, float]) -> tuple[Obstacle, ...]:
        """Return the obstacles of a complete design, those among the options included, for a learned chain.

        Raises:
            ValueError: for meshed obstacles, which chains cannot touch.
        """
        solid = tuple(each for each in self.obstacles if isinstance(each, Obstacle))
        if len(solid) < len(self.obstacles):
            raise ValueError(f"robot '{self.name}' touches meshed obstacles, which needs backend='fem'")
        return solid

    # -- shape ------------------------------------------------------------------------------------------------------

    def outline(self, design: Mapping[str, float]) -> np.ndarray:
        """Return the corners of the outline of a complete design [m], shape (2 n + 12, 2).

        Raises:
            InfeasibleDesign: if the outline crosses itself.
        """
        corners = zigzag_outline(
            1e3 * design["e1"],
            1e3 * design["e2"],
            1e3 * design["e3"],
            [1e3 * design[f"d{k}"] for k in range(self.control_points)],
            length=1e3 * self.length,
            width=1e3 * self.width,
        )
        check_outline(corners)
        return 1e-3 * corners

    def drawing(self, design: Mapping[str, float]) -> Drawing:
        half = 500.0 * self.thickness
        corners = {f"{a}{k}": 1e3 * p[i] for k, p in enumerate(self.outline(design)) for i, a in enumerate("xy")}
        lengths = {"low": -half, "high": half} | corners
        return draw_extrusion, {name: round(float(value), 9) for name, value in lengths.items()}

    def mesh(self, design: Mapping[str, float]) -> BodyMesh:
        """Mesh the body of a complete design."""
        draw, lengths = self.drawing(design)
        if self.published_mesh:
            draw, lengths = draw_published, lengths | {"size": round(1e3 * self.mesh_size, 9)}
        return mesh_geometry(draw, lengths, mesh_size=self.mesh_size)

    def features(self, design: Mapping[str, float]) -> dict[str, Feature]:
        """Return no surfaces: the mesh is never moved."""
        return {}

    def tip(self, design: Mapping[str, float]) -> np.ndarray:
        """Return the middle of the end of the top wall at rest [m], shape (3,)."""
        return np.array([self.width, self.length - 0.5 * design["e2"], 0.0])

    # -- mechanics --------------------------------------------------------------------------------------------------

    def build_model(self, mesh: BodyMesh, design: Mapping[str, float]) -> MechanicalModel:
        """Hold the right foot, put the left one on the servo; the effector is the middle of the tip."""
        assembly = ModelBuilder(gravity=self.gravity)
        frame = self.add_to(assembly, mesh, design)
        model = assembly.build()
        model.add("a", Servo("servo", frame, np.array([0.0, 0.0, -1.0]), model.nodes))
        model.add("e", Point("tip", model.embed(self.tip(design))))
        return model

    def add_to(
        self,
        assembly: ModelBuilder,
        mesh: BodyMesh,
        design: Mapping[str, float],
        *,
        turn: np.ndarray = IN_PLACE,
        shift: np.ndarray | Sequence[float] = (0.0, 0.0, 0.0),
    ) -> int:
        """Add the finger to an assembly and return the first row of the frame of its servo.

        Args:
            assembly: collects the parts.
            mesh: the meshed body, from `body`.
            design: a complete design.
            turn: rotation of the finger by multiples of 90 degrees, shape (3, 3).
            shift: displacement of the turned finger [m], shape (3,).
        """
        nodes, elements = mesh.nodes, mesh.tetrahedra
        if self.element == "quadratic":
            nodes, elements = add_midside_nodes(nodes, elements)
        x, y, _ = nodes.T
        left = x < LEFT_FOOT * 1e-3 + 1e-9
        on_servo = left & (y < ON_SERVO + 1e-9)
        held = ~left & (y < HELD + 1e-9)
        start = assembly.add_solid(
            nodes @ turn.T + shift,
            elements,
            fixed=held,
            element=self.element,
            material=self.material,
            young_modulus=design["young_modulus"],
            poisson_ratio=design["poisson_ratio"],
            density=self.density,
        )
        frame = assembly.add_frame(turn @ SERVO_AXIS + shift, fixed=True, fixed_spin=np.abs(turn[:, 2]) < 0.5)
        assembly.carry(frame, start + np.flatnonzero(on_servo))
        return frame
