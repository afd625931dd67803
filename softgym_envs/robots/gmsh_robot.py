"""Robots of one solid body that gmsh draws and meshes."""

from __future__ import annotations

import ast
import json
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.designs import Design
from softgym_envs.mechanics.materials import resolve_material
from softgym_envs.robots.base import Drawing, Robot
from softgym_envs.robots.geometry.following import ShapeFollower
from softgym_envs.robots.geometry.meshing import BodyMesh, mesh_geometry
from softgym_envs.robots.geometry.morphing import Feature, Morpher
from softgym_envs.robots.mesh_tiers import MeshTier, choose_mesh

if TYPE_CHECKING:
    from softgym_envs.mechanics.model import MechanicalModel

FIXED = "fixed"
"""Name of the faces that are clamped."""

Interval = float | tuple[float, float]
"""A coordinate [m], or the lower and upper one."""

ANYWHERE = (-1e3, 1e3)
"""Interval of coordinates that leaves out no face [m]."""

FACE_TOLERANCE = 1e-6
"""How far outside a box its faces may reach [m]; gmsh's boxes of faces are too large by a tenth of this."""


class GmshRobot(Robot):
    """A robot whose body is one solid, drawn and meshed by gmsh; by default, one mesh is moved from design to design.

    A robot of your own defines `draw`, which gives its mesh, its motion between designs, its STEP file and its moulds,
    and `equip`, which adds cables and effectors. Faces that `draw` names `FIXED` are clamped. Those under the name of
    an actuator are the closed surface of its chamber.

    Args:
        mesh: name of one of the robot's `meshes`.
        mesh_size: target edge length [m], instead of that of the mesh; other sizes change in proportion.
        element: name of the solid element (`softgym_envs.mechanics.solids.SOLIDS`), instead of that of the mesh.
        fillet: radius of re-entrant edges [m], instead of that of the mesh; only for robots that can be drawn with it.
        guide_radius: of the parts on which cables and contact points act [m], instead of that of the mesh; 0: points.
        meshing: ``"morph"`` moves the reference mesh, ``"remesh"`` creates a new mesh for every design.
        material: name of a material of `softgym_envs.mechanics.materials`.
        **options: options of `Robot`.

    Attributes:
        mesh_size: target edge length of a robot without `meshes` [m]; its elements are quadratic.
        young_modulus: [Pa], unless it is a design variable.
        poisson_ratio: unless it is a design variable.
        density: [kg/m3], unless it is a design variable; the default is that of silicone.
        meshes: the robot's meshes by name (see `mesh_tiers`).
        rounded: whether it can be drawn with fillets.
    """

    mesh_size: float
    young_modulus: float
    poisson_ratio: float = 0.45
    density: float = 1100.0
    meshes: Mapping[str, MeshTier] = {}
    rounded: bool = False
    #: Smallest element quality, relative to the reference mesh, that a moved mesh may have before it is remeshed.
    quality_bound = 0.3

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
        **options: Any,
    ) -> None:
        if meshing not in ("morph", "remesh"):
            raise ValueError(f"meshing = {meshing!r} is unknown; allowed: 'morph', 'remesh'")
        own = getattr(type(self), "mesh_size", None)
        if not self.meshes and mesh_size is None and own is None:
            raise TypeError(f"robot '{self.name}' has no meshes by name: it needs a mesh_size [m]")
        tier = choose_mesh(self.meshes or {"published": MeshTier(own or 1.0, "quadratic")}, mesh)
        given: dict[str, Any] = {"size": mesh_size, "element": element, "fillet": fillet, "guide_radius": guide_radius}
        self.tier = tier.changed(self.name, **given, largest=getattr(self, "size", np.inf))
        self.reproduces_scene = self.tier == self.meshes.get("published")
        if self.tier.fillet and not self.rounded:
            raise ValueError(f"robot '{self.name}' cannot be drawn with a fillet: fillet = {fillet!r} m must be zero")
        resolve_material(material)
        super().__init__(**options)
        self.material = material
        self.mesh_size, self.element, self.fillet = self.tier.size, self.tier.element, self.tier.fillet
        self.feature_size, self.guide_size = self.tier.feature_size, self.tier.guide_size
        self.guide_radius = self.tier.guide_radius
        # Surfaces of fillets are not among the features that a mesh is moved with.
        self.meshing = "remesh" if self.fillet else meshing
        self._morpher: Morpher | ShapeFollower | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_morpher": None}  # holds a factorisation; it is made again when it is needed

    # -- what a robot defines ---------------------------------------------------------------------------------------

    def draw(self, design: Mapping[str, float]) -> None:
        """Draw one volume with ``gmsh.model.occ`` in metres, and name its faces with `name_faces`.

        gmsh works in a process of its own, with a copy of this robot. Bodies of the same drawing with other numbers
        share one mesh, which is moved; where a design has other faces, it is meshed anew.
        """
        raise NotImplementedError(f"robot '{self.name}' defines neither draw nor mesh")

    def equip(self, model: MechanicalModel, design: Mapping[str, float]) -> None:
        """Add cables and effectors to the clamped body of a design, which has its chambers already."""
        raise NotImplementedError(f"robot '{self.name}' defines neither equip nor build_model")

    def features(self, design: Mapping[str, float]) -> dict[str, Feature]:
        """Return the planes, cylinders and cones on which the surface of a mesh lies, by name.

        Without any, a mesh follows the faces of `drawing`, which takes a few times as long.
        """
        return {}

    def mesh(self, design: Mapping[str, float]) -> BodyMesh:
        """Return a new or cached mesh of a complete design: the whole body, or the part that `mirror` completes."""
        function, parameters = self.drawing(design)
        key = {"code": code, **parameters} if (code := self._code()) else None
        return mesh_geometry(function, parameters, mesh_size=self.mesh_size, key=key)

    def mirror(self, part: BodyMesh) -> BodyMesh:
        """Return the whole body. A symmetric robot meshes a part of it and mirrors that part here."""
        return part

    def build_model(self, mesh: BodyMesh, design: Mapping[str, float]) -> MechanicalModel:
        """Return the model of a meshed body: material, boundary conditions, actuators, effectors, contacts."""
        model = self.solid(mesh, design, fixed=mesh.nodes_on(FIXED))
        for actuator in self.actuators:
            if actuator.name in mesh.groups:
                model.add_cavity(actuator.name, surface=mesh.faces_of(actuator.name))
        self.equip(model, design)
        return model

    @property
    def reference_design(self) -> Design:
        """The design whose mesh is moved to all others: the baseline, or one nearer the centre of the design space."""
        return self.design_space.baseline

    def initial_motion(self, nodes: np.ndarray, design: Mapping[str, float]) -> np.ndarray:
        """Return rough displacements [m] (n, 3) of the reference nodes, from which the mesh motion starts."""
        return np.zeros_like(nodes)

    # -- what follows from it ---------------------------------------------------------------------------------------

    @staticmethod
    def name_faces(name: str, *, x: Interval = ANYWHERE, y: Interval = ANYWHERE, z: Interval = ANYWHERE) -> None:
        """Name the faces of the body drawn so far that lie in a plane or a box, as a physical group of gmsh.

        Args:
            name: `FIXED`, an actuator whose chamber they bound, or any other.
            x: coordinate of the faces [m], or the interval that they lie in.
            y: likewise.
            z: likewise.

        Raises:
            ValueError: if there is no such face.
        """
        import gmsh

        gmsh.model.occ.synchronize()
        low, high = np.array([each if isinstance(each, tuple) else (each, each) for each in (x, y, z)], dtype=float).T
        faces = gmsh.model.getEntitiesInBoundingBox(*(low - FACE_TOLERANCE), *(high + FACE_TOLERANCE), 2)
        if not faces:
            raise ValueError(f"no face for '{name}' lies in x, y, z from {low.tolist()} to {high.tolist()} m")
        gmsh.model.addPhysicalGroup(2, [tag for _, tag in faces], name=name)

    def drawing(self, design: Mapping[str, float]) -> Drawing:
        if type(self).draw is GmshRobot.draw:
            return super().drawing(design)
        return self._draw_in_metres, {"design": {name: float(value) for name, value in design.items()}}

    def _draw_in_metres(self, design: dict[str, float]) -> None:
        import gmsh

        gmsh.option.setString("Geometry.OCCTargetUnit", "M")
        self.draw(design)

    def _code(self) -> str:
        """Return what a mesh follows from besides its design: the module of the robot and its options.

        It is empty for code that is in no file, such as that of a notebook, whose meshes are not kept.
        """
        modules = {base.__module__ for base in type(self).__mro__ if issubclass(base, GmshRobot)} - {__name__}
        files = [getattr(sys.modules.get(name), "__file__", None) for name in sorted(modules)]
        if not all(files):
            return ""
        code = [ast.unparse(ast.parse(Path(str(file)).read_text(encoding="utf-8"))) for file in files]
        return json.dumps([*code, type(self).__qualname__, self.mechanics_key], sort_keys=True)

    def assemble(self, design: Mapping[str, float]) -> MechanicalModel:
        return self.build_model(self.body(design), design)

    def body(self, design: Mapping[str, float] | None = None) -> BodyMesh:
        """Return the mesh of a design: the reference mesh moved, or a new one when its quality falls too low.

        Raises:
            DesignError: for a malformed design.
            InfeasibleDesign: if the geometry cannot exist.
        """
        complete = self.design_space.complete(design)
        if self.meshing == "remesh":
            return self.mirror(self.mesh(complete))
        if self._morpher is None:
            reference = self.reference_design
            mesh, features = self.mesh(reference), self.features(reference)
            self._morpher = Morpher(mesh, features) if features else ShapeFollower(mesh, self.drawing(reference))
        base = self._morpher.mesh
        if isinstance(self._morpher, ShapeFollower):
            nodes = self._morpher.move(self.drawing(complete))
        else:
            nodes = self._morpher.move(self.features(complete), self.initial_motion(base.nodes, complete))
        if nodes is not None and self._morpher.quality(nodes) >= self.quality_bound:
            return self.mirror(replace(base, nodes=nodes, origin="morphed"))
        return self.mirror(replace(self.mesh(complete), origin="remeshed"))

    def solid(
        self, mesh: BodyMesh, design: Mapping[str, float], *, fixed: np.ndarray, density: float | None = None
    ) -> MechanicalModel:
        """Return the clamped body of a design, without actuators and effectors.

        Args:
            mesh: the meshed body.
            design: a complete design.
            fixed: clamped nodes of the mesh, boolean, shape (n,).
            density: [kg/m3]; default: that of the robot.
        """
        from softgym_envs.mechanics.builder import ModelBuilder

        builder = ModelBuilder(gravity=self.gravity)
        builder.add_solid(
            mesh.nodes,
            mesh.tetrahedra,
            fixed=fixed,
            element=self.element,
            material=self.material,
            young_modulus=self._of("young_modulus", design),
            poisson_ratio=self._of("poisson_ratio", design),
            density=self._of("density", design) if density is None else density,
        )
        return builder.build()

    def _of(self, name: str, design: Mapping[str, float]) -> float:
        """Return a property of the material: a design variable, or else an attribute."""
        if name in design:
            return design[name]
        if not hasattr(self, name):
            raise TypeError(f"robot '{self.name}' defines no {name}, neither as an attribute nor as a design variable")
        return float(getattr(self, name))

    def reference_nodes(self, mesh: BodyMesh) -> np.ndarray:
        """Positions [m] (n, 3) of the nodes in the reference body if ``mesh`` was moved from it, else in ``mesh``.

        A set of nodes selected by these positions stays the same as the mesh moves.
        """
        if mesh.origin != "morphed" or self._morpher is None:
            return mesh.nodes
        return self.mirror(self._morpher.mesh).nodes

    def reference_element(self, mesh: BodyMesh, point: np.ndarray) -> np.ndarray | None:
        """Element nearest to a point [m] (3,) of the reference body, as a hint for points outside a moved mesh.

        Returns:
            Its index, shape (1,), or None if ``mesh`` was not moved from the reference mesh.
        """
        if mesh.origin != "morphed" or self._morpher is None:
            return None
        base = self.mirror(self._morpher.mesh)
        from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints

        return EmbeddedPoints(point, base.nodes, base.tetrahedra).elements
