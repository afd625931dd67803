"""Grippers made from rotated and shifted copies of the Soft Finger (thesis, sec. 4.3.1 and 4.3.2).

The fingers and the object that they hold are one finite-element model. Contact is that of the thesis: contact points
are tied to the object by ball joints, which pull as well as push and transmit no moments.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.beams.skins import box_skin
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.bond import Bond
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.base import Actuator, Robot
from softgym_envs.robots.capabilities import Learning
from softgym_envs.robots.geometry.finger_shape import in_flange
from softgym_envs.robots.geometry.symmetry import Symmetry
from softgym_envs.robots.mesh_tiers import MeshTier
from softgym_envs.robots.soft_finger import FINGER_MESHES, TIP_RADIUS, SoftFinger

Placements = tuple[tuple[np.ndarray, tuple[float, float, float]], ...]
"""Rotation (3, 3) and shift [m] of each finger."""

STRAIGHT = np.eye(3)
TURNED = np.diag([-1.0, -1.0, 1.0])
"""Half a turn about z: the finger then bends towards -y."""

GRIPPER_MESHES = {
    "published": FINGER_MESHES["published"],
    "accurate": MeshTier(6.0e-3, "quadratic", feature_size=1.5e-3, guide_radius=3.0e-3, guide_size=1.8e-3),
    "reference": MeshTier(4.2e-3, "quadratic", feature_size=1.05e-3, guide_radius=3.0e-3, guide_size=1.26e-3),
}
"""Meshes of fingers in grippers. What they hold moves less than a free tip, so that the same error is more of its way,
and guides and contact points decide how far it goes: they act on larger parts, which the elements there resolve. No
source states the radius of these parts."""


class GripperFinger(SoftFinger):
    """The finger of a gripper, with meshes of its own."""

    meshes = GRIPPER_MESHES


class FingerRobot(Robot):
    """One or more two-cable fingers, and what they hold. Held objects have no mass.

    Args:
        mesh: name of one of `GRIPPER_MESHES`: ``"published"``, ``"accurate"`` or ``"reference"``.
        mesh_size: target edge length of a finger [m], instead of that of the mesh.
        element: name of the solid element, instead of that of the mesh.
        fillet: radius of the fingers' re-entrant edges [m], as for the finger.
        guide_radius: radius of the parts of the fingers on which cables and contact points act [m], instead of that of
            the mesh; 0 for single points. No source states it.
        meshing: ``"morph"`` or ``"remesh"``, as for the finger.
        material: name of a material.
        unilateral: whether cables cannot push (default).
        gravity: acceleration [m/s2].
        **options: options of `Robot`.
    """

    size = 0.12
    #: Rotation and shift [m] of each finger; where they depend on the design, as many as a body can have.
    placements: Placements
    #: Range of the cables and their largest change in a control step [m].
    cable_range = (0.0, 0.020)
    cable_rate = 0.001
    #: Nothing but contact holds the object.
    holds_by_contact = False
    learning = Learning(stiffness_variable="young_modulus")

    def __init__(
        self,
        *,
        mesh: str = "published",
        mesh_size: float | None = None,
        element: str | None = None,
        fillet: float | None = None,
        guide_radius: float | None = None,
        meshing: str = "morph",
        material: str = "corotational",
        unilateral: bool = True,
        gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        **options: Any,
    ) -> None:
        super().__init__(gravity=gravity, **options)
        self.finger = GripperFinger(
            cables=2,
            mesh=mesh,
            mesh_size=mesh_size,
            element=element,
            fillet=fillet,
            guide_radius=guide_radius,
            meshing=meshing,
            material=material,
            unilateral=unilateral,
            self_contact=False,
        )
        self.mesh_size, self.element, self.fillet = self.finger.mesh_size, self.finger.element, self.finger.fillet
        self.meshing = self.finger.meshing
        self.feature_size, self.guide_size = self.finger.feature_size, self.finger.guide_size
        self.guide_radius = self.finger.guide_radius
        self.reproduces_scene = self.finger.reproduces_scene and not self.holds_by_contact
        self.design_space = DesignSpace(*self.variables())
        self.actuators = tuple(
            Actuator(f"finger_{k + 1}_{cable.name}", *self.cable_range, self.cable_rate, unilateral=unilateral)
            for k in range(len(self.placements))
            for cable in self.finger.actuators
        )
        self.effort_scale = np.full(len(self.actuators), 20.0)
        self.effector_rest = self.object_rest(self.design_space.baseline)

    def variables(self) -> tuple[DesignVariable, ...]:
        """Return the design variables: first those of the finger, then those of the gripper."""
        return tuple(self.finger.design_space)

    @abstractmethod
    def object_rest(self, design: Mapping[str, float]) -> np.ndarray:
        """Return the effector at rest [m], shape (3,)."""

    @abstractmethod
    def attach_object(self, model: MechanicalModel, design: Mapping[str, float], frame: int | None) -> None:
        """Tie the fingers to each other, or to the object whose frame is given, and add the effector."""

    def object_frame(self, design: Mapping[str, float]) -> np.ndarray | None:
        """Return the position of the rigid object [m], shape (3,), or None if there is none."""
        return None

    def arrangement(self, design: Mapping[str, float]) -> Placements:
        """Return where the fingers of a design are."""
        return self.placements

    def add_object(self, assembly: ModelBuilder, design: Mapping[str, float]) -> int | None:
        """Add the rigid object and return the first row of its frame, or None if there is none."""
        position = self.object_frame(design)
        return None if position is None else assembly.add_frame(position)

    def assemble(self, design: Mapping[str, float]) -> MechanicalModel:
        """Place the fingers, route their cables, and tie them to the object."""
        names = self.finger.design_space.names
        self._shape = {name: design[name] for name in names}
        self._arranged = self.arrangement(design)
        mesh = self.finger.body(self._shape)
        fixed = in_flange(mesh.nodes)
        assembly = ModelBuilder(gravity=self.gravity, floating=self.holds_by_contact)
        for turn, shift in self._arranged:
            assembly.add_solid(
                mesh.nodes @ turn.T + shift,
                mesh.tetrahedra,
                fixed=fixed,
                element=self.element,
                material=self.finger.material,
                young_modulus=design["young_modulus"],
                poisson_ratio=design["poisson_ratio"],
            )
        frame = self.add_object(assembly, design)
        model = assembly.build()
        cables = iter(self.actuators)
        for k, (turn, shift) in enumerate(self._arranged):
            for pull_point, points in self.finger.routes(self._shape):
                cable = next(cables)
                model.add_cable(
                    cable.name,
                    points @ turn.T + shift,
                    turn @ pull_point + shift,
                    unilateral=cable.unilateral,
                    block=k,
                    radius=self.guide_radius,
                )
        self._mesh = mesh
        self.attach_object(model, design, frame)
        return model

    def material_point(
        self, model: MechanicalModel, finger: int, point: np.ndarray, reference: np.ndarray, *, radius: float
    ) -> EmbeddedPoints:
        """Embed a point [m] (3,), given in the finger's own axes, in one copy of the finger.

        Args:
            model: the gripper.
            finger: number of the copy.
            point: the point [m], shape (3,).
            reference: the same point of the reference body, which selects the element for points outside the mesh.
            radius: of the part of the finger on which the point acts [m], unless cables act on single points.
        """
        turn, shift = self._arranged[finger]
        hint = self.finger.reference_element(self._mesh, reference)
        radius = radius if self.guide_radius else 0.0
        return model.embed(turn @ point + shift, hint, block=finger, radius=radius)

    def tie_contacts(self, model: MechanicalModel, frame: int) -> None:
        """Tie the three contact points of each finger to the points of the object that they touch at rest."""
        reference = self.finger.contact_points(self.finger.reference_design)
        centre = model.nodes[frame]
        for k in range(len(self._arranged)):
            for i, point in enumerate(self.finger.contact_points(self._shape)):
                embedding = self.material_point(model, k, point, reference[i], radius=self.guide_radius)
                held = EmbeddedPoints.in_frame(frame, embedding.points[0] - centre, model.nodes)
                model.add("b", Bond(f"contact_{k + 1}_{i + 1}", embedding, held))


class PressFinger(FingerRobot):
    """A finger that presses a cube-shaped button, which resists with a constant force along -y.

    Args:
        button_force: force of the button [N]. The published "10 N" pushes this finger back by 66 mm with its cables
            held at zero, from where it cannot press the button stably; 2 N is well within its strength.
        **options: options of `FingerRobot`.
    """

    name = "press_finger"
    effectors = ("button",)
    placements = ((STRAIGHT, (0.0, 0.0, 0.0)),)
    half_extents = (13.75e-3, 13.75e-3, 13.75e-3)
    goal_axes = np.array([0.0, 1.0, 0.0])
    goal_tolerance = 5e-4
    learning = Learning()  # the force of the button does not scale with Young's modulus

    def __init__(self, *, button_force: float = 2.0, **options: Any) -> None:
        if not (np.isfinite(button_force) and button_force >= 0.0):
            raise ValueError(f"button_force = {button_force} N must be finite and not negative")
        self.button_force = float(button_force)
        super().__init__(**options)

    def variables(self) -> tuple[DesignVariable, ...]:
        """Return the variables of the finger, without moduli so low that the button folds the finger."""
        return tuple(
            replace(variable, low=2.0e6) if variable.name == "young_modulus" else variable
            for variable in super().variables()
        )

    def object_rest(self, design: Mapping[str, float]) -> np.ndarray:
        """Centre of the button, whose face lies on the front of the last segment."""
        return np.array([0.0, design["height"] + self.half_extents[1], -2.5 * design["length"]])

    object_frame = object_rest

    def reference_path(self, count: int = 9) -> np.ndarray:
        """Goals along y, starting where the button has pushed the finger, shape (count, 3); x and z do not count."""
        path = np.tile(self.effector_rest, (count, 1))
        path[:, 1] = np.linspace(0.020, 0.044, count)
        return path

    def attach_object(self, model: MechanicalModel, design: Mapping[str, float], frame: int | None) -> None:
        """Tie the contact points to the button and load it; the effector is its centre."""
        assert frame is not None
        self.tie_contacts(model, frame)
        model.nodal_loads[frame, 1] = -self.button_force
        model.add("e", Point("button", EmbeddedPoints.in_frame(frame, np.zeros(3), model.nodes)))
        model.skins.append(box_skin(frame, self.half_extents, model.nodes))


class TwoFingerGripper(FingerRobot):
    """Two fingers that face each other and hold a bar between their tips (thesis, eq. 4.6).

    The bar keeps the tips at a constant offset along y. It is shorter than the tips' distance at rest, so the fingers
    bend towards each other. The effector is the middle of the bar.

    Args: as for `FingerRobot`.
    """

    name = "two_finger_gripper"
    effectors = ("bar",)
    placements = ((STRAIGHT, (0.0, 0.0, 0.0)), (TURNED, (0.0, 0.080, 0.0)))
    goal_axes = np.array([1.0, 1.0, 0.0])
    goal_tolerance = 5e-4

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        if not (any(self.gravity[:2]) or self.obstacles):
            # Half a turn exchanges the fingers, which are copies of each other.
            half_turn = Symmetry(TURNED, np.array([2, 3, 0, 1]), 0.5 * np.array(self.placements[1][1]))
            self.learning = replace(self.learning, symmetries=(half_turn,))

    def variables(self) -> tuple[DesignVariable, ...]:
        """Return the variables of the finger and the length of the bar."""
        bar = DesignVariable("bar_length", 0.030, 0.055, 0.040, "m", "offset of the two tips along y")
        return (*super().variables(), bar)

    def object_rest(self, design: Mapping[str, float]) -> np.ndarray:
        """Middle of the bar, before the tips come together."""
        return np.array([0.0, 0.040, self.finger.tip(design)[2]])

    def reference_path(self, count: int = 25) -> np.ndarray:
        """Goals along x: from 0 to 30 mm, to -30 mm and back to 0, shape (count, 3); z does not count."""
        path = np.tile(self.effector_rest, (count, 1))
        path[:, 0] = np.interp(np.linspace(0.0, 4.0, count), [0.0, 1.0, 3.0, 4.0], [0.0, 0.030, -0.030, 0.0])
        return path

    def attach_object(self, model: MechanicalModel, design: Mapping[str, float], frame: int | None) -> None:
        """Tie the tips at the bar's length; the effector lies halfway between them."""
        tip, reference = self.finger.tip(design), self.finger.tip(self.finger.reference_design)
        first, second = (self.material_point(model, k, tip, reference, radius=TIP_RADIUS) for k in (0, 1))
        model.add("b", Bond("bar", first, second, np.array([0.0, -design["bar_length"], 0.0])))
        middle = EmbeddedPoints.from_weights(
            np.concatenate([first.node_ids, second.node_ids], axis=1),
            0.5 * np.concatenate([first.weights, second.weights], axis=1),
            model.nodes,
        )
        model.add("e", Point("bar", middle))


class ThreeFingerGripper(FingerRobot):
    """Three fingers that hold a cube (thesis, sec. 4.3.2): one pushes along +y, two along -y.

    Args: as for `FingerRobot`.
    """

    name = "three_finger_gripper"
    effectors = ("cube",)
    placements: Placements = (
        (STRAIGHT, (0.0, 0.0, 0.0)),
        (TURNED, (-0.030, 0.070, 0.0)),
        (TURNED, (0.030, 0.070, 0.0)),
    )
    half_extents = (35.0e-3, 13.75e-3, 13.75e-3)
    cable_range = (-0.002, 0.020)
    workspace_scale = 0.004
    goal_tolerance = 1e-4

    def object_rest(self, design: Mapping[str, float]) -> np.ndarray:
        """Centre of the cube, between the fingers."""
        return np.array([0.0, 0.035, -2.5 * design["length"] + 0.005])

    object_frame = object_rest

    def attach_object(self, model: MechanicalModel, design: Mapping[str, float], frame: int | None) -> None:
        """Tie nine contact points to the cube; the effector is its centre."""
        assert frame is not None
        self.tie_contacts(model, frame)
        model.add("e", Point("cube", EmbeddedPoints.in_frame(frame, np.zeros(3), model.nodes)))
        model.skins.append(box_skin(frame, self.half_extents, model.nodes))

    def reference_path(self, count: int = 20) -> np.ndarray:
        """Horizontal circle of the cube's centre, shape (count, 3).

        With cables that can push it is the published one, of radius 1.5 mm about the rest position. Cables that cannot
        push can only lift the cube: then the radius is 1 mm, and the centre 4 mm higher.
        """
        angle = 2.0 * np.pi * np.arange(count) / count
        circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
        if not self.unilateral.any():
            return self.effector_rest + 1.5e-3 * circle
        return self.effector_rest + np.array([0.0, -0.7e-3, 4.0e-3]) + 1.0e-3 * circle
