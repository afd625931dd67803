"""The Robot base class: a family of bodies over a design space."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from softgym_envs.designs import DesignSpace
from softgym_envs.errors import InfeasibleDesign
from softgym_envs.mechanics.constraints import EmbeddedPoints
from softgym_envs.mechanics.materials import MATERIALS
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.geometry.meshing import BodyMesh
from softgym_envs.robots.geometry.morphing import Feature, Morpher

__all__ = ["Actuator", "Drawing", "MeshedRobot", "Robot"]

Drawing = tuple[Callable[..., None], dict]
"""A module-level function that draws one volume with gmsh in millimetres, and its parameters (JSON-serialisable)."""


@dataclass(frozen=True)
class Actuator:
    """One actuator of a robot.

    Args:
        name: identifier.
        low: smallest commanded displacement [unit].
        high: largest commanded displacement [unit].
        rate: largest change of the command per control step [unit].
        unit: unit of displacement.
        unilateral: cannot push.
        max_effort: largest effort either way; beyond it a commanded displacement is not reached.
    """

    name: str
    low: float
    high: float
    rate: float
    unit: str = "m"
    unilateral: bool = True
    max_effort: float = np.inf


class Robot(ABC):
    """A family of bodies; one file per robot.

    Attributes:
        name: registry name, also of its options when weights or meshes are looked up.
        design_space: variables of the body with bounds and baseline.
        actuators: in the order of the commands.
        effectors: names, in the order of the effector rows of the condensed model.
        size: a characteristic length [m], for scaling.
        effector_rest: nominal effector of the baseline body at rest [m], before loads, shape (3,).
        effort_scale: typical effort of each actuator of the baseline body [N, ...], shape (n_a,).
        goal_axes: which coordinates of the first effector a goal is about, 1 or 0, shape (3,).
        goal_tolerance: distance at which a goal counts as reached [m].
        workspace_scale: distance over which the effector typically moves [m], by default a quarter of the size; scales
            rewards and errors.
        rest_mode: how actuators are held at rest: ``"effort"`` (without effort) or ``"displacement"`` (at zero).
        stiffness_variable: design variable that scales all efforts and nothing else (Young's modulus without dead
            loads), or None. Surrogates use it exactly instead of learning it.
        convex: the elastic energy is convex in the displacements of the actuators: the body keeps its state also when
            they are driven by efforts. Surrogates are built so; where it is False they learn unstable states too.
    """

    name: str
    design_space: DesignSpace
    actuators: tuple[Actuator, ...]
    effectors: tuple[str, ...]
    size: float
    effector_rest: np.ndarray
    effort_scale: np.ndarray
    goal_axes: np.ndarray = np.ones(3)
    goal_tolerance: float = 0.002
    workspace_scale: float
    rest_mode: str = "effort"
    stiffness_variable: str | None = None
    convex: bool = True

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        if "size" in vars(cls) and "workspace_scale" not in vars(cls):
            cls.workspace_scale = 0.25 * cls.size

    def __init__(self, *, gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        if len(gravity) != 3 or not np.isfinite(gravity).all():
            raise ValueError(f"gravity must be three finite numbers [m/s2], got {gravity!r}")
        self.gravity = gravity

    # -- what a robot defines ---------------------------------------------------------------------------------------

    @property
    @abstractmethod
    def weights_name(self) -> str:
        """Name of this kind of the robot, as used for pretrained weights."""

    @property
    @abstractmethod
    def mechanics_key(self) -> dict[str, object]:
        """The options that change its mechanics, JSON-serialisable; weights are valid for one signature."""

    @abstractmethod
    def assemble(self, design: Mapping[str, float]) -> MechanicalModel:
        """Make the model of a complete design: bodies, boundary conditions, actuators, effectors, contacts."""

    def drawing(self, design: Mapping[str, float]) -> Drawing:
        """Return what draws the exact shape of a complete design.

        Raises:
            InfeasibleDesign: if the shape cannot exist.
            ValueError: if the body is not drawn with gmsh as a whole.
        """
        raise ValueError(f"robot '{self.name}' has no exact shape to write as STEP; write its triangles: .stl")

    def reference_path(self, count: int = 30) -> np.ndarray:
        """Published trajectory of the first effector [m], shape (count, 3), where tracking is compared.

        Raises:
            ValueError: if the robot has none.
        """
        raise ValueError(f"robot '{self.name}' has no reference path: give a path of your own")

    def displacements(self, fractions: np.ndarray) -> np.ndarray:
        """Commands that points of the unit cube (N, n_a) stand for when states are sampled, shape (N, n_a).

        A robot whose actuators never move independently keeps to what occurs.
        """
        return self.lower + fractions * (self.upper - self.lower)

    # -- what follows from it ---------------------------------------------------------------------------------------

    def build(self, design: Mapping[str, float] | None = None) -> MechanicalModel:
        """Return the mechanical model of a design; missing variables take their baseline.

        Raises:
            DesignError: for a malformed design.
            InfeasibleDesign: if the geometry cannot exist.
        """
        complete = self.design_space.complete(design)
        try:
            return self.assemble(complete)
        except ValueError as error:
            shown = {name: round(value, 9) for name, value in complete.items()}
            raise InfeasibleDesign(f"robot '{self.name}' cannot be built for {shown}: {error}") from error

    @property
    def lower(self) -> np.ndarray:
        """Smallest commanded displacements, shape (n_a,)."""
        return np.array([actuator.low for actuator in self.actuators])

    @property
    def upper(self) -> np.ndarray:
        """Largest commanded displacements, shape (n_a,)."""
        return np.array([actuator.high for actuator in self.actuators])

    @property
    def rates(self) -> np.ndarray:
        """Largest change of the command per control step, shape (n_a,)."""
        return np.array([actuator.rate for actuator in self.actuators])


class MeshedRobot(Robot):
    """A robot whose body is one solid from gmsh; its mesh is moved over the design space.

    Args:
        mesh_size: target edge length [m].
        meshing: ``"morph"`` moves the reference mesh, ``"remesh"`` meshes every design anew.
        material: name of a material of `softgym_envs.mechanics.materials`.
        gravity: acceleration [m/s2], shape (3,).
    """

    #: Smallest element quality, relative to the reference mesh, that a moved mesh may have before it is remeshed.
    quality_bound = 0.3

    def __init__(
        self,
        *,
        mesh_size: float,
        meshing: str = "morph",
        material: str = "corotational",
        gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        if meshing not in ("morph", "remesh"):
            raise ValueError(f"meshing = {meshing!r} is unknown; allowed: 'morph', 'remesh'")
        if not (isinstance(mesh_size, int | float) and 0.0 < mesh_size < np.inf):
            raise ValueError(f"robot '{self.name}': mesh_size = {mesh_size!r} m must be positive: a finite number")
        if material not in MATERIALS:
            raise ValueError(f"unknown material '{material}'; allowed: {', '.join(MATERIALS)}")
        super().__init__(gravity=gravity)
        self.material = material
        self.mesh_size = float(mesh_size)
        self.meshing = meshing
        self._morpher: Morpher | None = None

    # -- what a robot defines ---------------------------------------------------------------------------------------

    @abstractmethod
    def mesh(self, design: Mapping[str, float]) -> BodyMesh:
        """Mesh the body of a complete design, or the part of it that `unfold` completes, anew (or from the cache)."""

    @abstractmethod
    def features(self, design: Mapping[str, float]) -> dict[str, Feature]:
        """Geometric features that carry the boundary of what `mesh` returns, by name."""

    def unfold(self, part: BodyMesh) -> BodyMesh:
        """Return the whole body; a symmetric robot meshes a part of it and mirrors that."""
        return part

    @abstractmethod
    def equip(self, mesh: BodyMesh, design: Mapping[str, float]) -> MechanicalModel:
        """Make the model of a meshed body: material, boundary conditions, actuators, effectors, contacts."""

    @property
    def reference_design(self) -> dict[str, float]:
        """The design whose mesh is moved to all others: the baseline, or one nearer the middle of the box."""
        return self.design_space.baseline

    def guess(self, nodes: np.ndarray, design: Mapping[str, float]) -> np.ndarray:
        """Rough displacement [m] (n, 3) of the reference nodes to a design; it only starts the mesh motion."""
        return np.zeros_like(nodes)

    # -- what follows from it ---------------------------------------------------------------------------------------

    def assemble(self, design: Mapping[str, float]) -> MechanicalModel:
        return self.equip(self.body(design), design)

    def body(self, design: Mapping[str, float] | None = None) -> BodyMesh:
        """Return the mesh of a design: the reference mesh moved, or a new one when its quality falls too low.

        Raises:
            DesignError: for a malformed design.
            InfeasibleDesign: if the geometry cannot exist.
        """
        complete = self.design_space.complete(design)
        if self.meshing == "remesh":
            return self.unfold(self.mesh(complete))
        if self._morpher is None:
            reference = self.reference_design
            self._morpher = Morpher(self.mesh(reference), self.features(reference))
        base = self._morpher.mesh
        nodes = self._morpher.move(self.features(complete), self.guess(base.nodes, complete))
        if self._morpher.quality(nodes) >= self.quality_bound:
            return self.unfold(replace(base, nodes=nodes, origin="morphed"))
        return self.unfold(replace(self.mesh(complete), origin="remeshed"))

    def reference_nodes(self, mesh: BodyMesh) -> np.ndarray:
        """Positions [m] (n, 3) that the nodes have in the reference body, or in ``mesh`` if it is no moved one.

        What is chosen by them stays the same as the mesh moves.
        """
        if mesh.origin != "morphed" or self._morpher is None:
            return mesh.nodes
        return self.unfold(self._morpher.mesh).nodes

    def reference_element(self, mesh: BodyMesh, point: np.ndarray) -> np.ndarray | None:
        """Element nearest to a point [m] (3,) of the reference body, as a hint for points outside a moved mesh.

        Returns:
            Its index, shape (1,), or None if ``mesh`` is not the reference mesh moved.
        """
        if mesh.origin != "morphed" or self._morpher is None:
            return None
        base = self.unfold(self._morpher.mesh)
        return EmbeddedPoints(point, base.nodes, base.tetrahedra).elements
