"""What all compliant modules share: two rigid ports, a solid body between them, and its compliance."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.beams.pose import Pose
from softgym_envs.extensions.deployment.cad import write_drawing
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.cavity import Cavity
from softgym_envs.mechanics.elements.quadratic import add_midside_nodes, quadratic_triangles
from softgym_envs.mechanics.elements.tetrahedra import Tetrahedra
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.mechanics.surfaces import cavity_around
from softgym_envs.robots.base import Drawing
from softgym_envs.robots.geometry.meshing import BodyMesh, mesh_geometry

POSE = ("x", "y", "z", "rx", "ry", "rz")
"""Motion of a port: displacement of its middle [m] and rotation [rad]; the wrench has forces [N] and torques [N m]."""

DENSITY = 1100.0
"""Of the printed material [kg/m3]."""

MATERIAL = (
    DesignVariable("young_modulus", 1.0e5, 3.0e9, 1.0e7, "Pa", "stiffness of the printed material", log=True),
    DesignVariable("poisson_ratio", 0.0, 0.49, 0.40, "1", "0.5 is incompressible"),
)
"""Variables that all modules have."""


class Placed(NamedTuple):
    """A body that `Module.add_to` has added to a model.

    Attributes:
        far: first row of the frame that carries the far port.
        cavity: quadratic triangles (k, 6) around the cavity of a closed module, else None.
    """

    far: int
    cavity: np.ndarray | None


class Module(ABC):
    """A compliant mechanism between two rigid ports, along z.

    The near port is the face of the body at z = 0, the far one the face at z = ``length``. Both faces stay plane: what
    is attached there is much stiffer than the module.

    Attributes:
        name: in `MODULES`.
        design_space: dimensions and material.
        symmetry: reflections about its middle that map any body onto itself: the axes that each of them reverses.
            ``"x"`` is the plane normal to x, ``"xz"`` half a turn about y.
        closed: whether the middle of the body is a closed cavity, which takes a pressure.
        helpers: functions that the drawing calls, whose meshes are made anew when they are edited.
    """

    name: ClassVar[str]
    design_space: ClassVar[DesignSpace]
    symmetry: ClassVar[tuple[str, ...]] = ("x", "y", "z")
    closed: ClassVar[bool] = False
    helpers: ClassVar[tuple[Callable[..., object], ...]] = ()

    @abstractmethod
    def drawing(self, design: Mapping[str, float]) -> Drawing:
        """Return the function that draws a complete design with gmsh in millimetres, and its parameters."""

    @abstractmethod
    def length(self, design: Mapping[str, float]) -> float:
        """Return the distance between the ports [m] of a complete design."""

    @abstractmethod
    def thinnest(self, design: Mapping[str, float]) -> float:
        """Return the smallest thickness [m] that bends, which decides the size of the elements."""

    def body(self, design: Mapping[str, float] | None = None, *, refine: float = 1.0) -> BodyMesh:
        """Return the mesh of a design; edges are twice the smallest thickness, over ``refine``.

        Raises:
            DesignError: for a malformed design.
            InfeasibleDesign: if the body cannot be drawn or meshed.
        """
        complete = self.design_space.complete(design)
        draw, parameters = self.drawing(complete)
        return mesh_geometry(draw, parameters, mesh_size=2.0 * self.thinnest(complete) / refine, uses=self.helpers)

    def add_to(
        self,
        builder: ModelBuilder,
        design: Mapping[str, float] | None = None,
        *,
        near: int | None = None,
        far: int | None = None,
        origin: np.ndarray | None = None,
        rotation: np.ndarray | None = None,
        refine: float = 1.0,
    ) -> Placed:
        """Add the body, of quadratic tetrahedra, to a model that is being built.

        Args:
            builder: of the model.
            design: the body; missing variables take their baseline.
            near: first row of the frame that carries the near port; without it, the near port is clamped.
            far: first row of the frame that carries the far port; default a new one.
            origin: middle of the near port [m], shape (3,); default the origin of space.
            rotation: matrix whose columns are the axes of the module, shape (3, 3); default those of space.
            refine: see `body`.
        """
        complete = self.design_space.complete(design)
        origin = np.zeros(3) if origin is None else np.asarray(origin, dtype=float)
        rotation = np.eye(3) if rotation is None else np.asarray(rotation, dtype=float)
        mesh, length = self.body(complete, refine=refine), self.length(complete)

        def heights(nodes: np.ndarray) -> np.ndarray:
            return (nodes - origin) @ rotation[:, 2]

        def clamped(nodes: np.ndarray) -> np.ndarray:
            return (heights(nodes) < 1e-6 * length) & (near is None)

        start = builder.add_solid(
            origin + mesh.nodes @ rotation.T,
            mesh.tetrahedra,
            fixed=clamped,
            element="quadratic",
            young_modulus=complete["young_modulus"],
            poisson_ratio=complete["poisson_ratio"],
            density=DENSITY,
        )
        height = heights(builder.nodes[start:])
        if near is not None:
            builder.carry(near, start + np.flatnonzero(height < 1e-6 * length))
        if far is None:
            far = builder.add_frame(origin + length * rotation[:, 2])
        builder.carry(far, start + np.flatnonzero(height > (1.0 - 1e-6) * length))
        cavity = None
        if self.closed:
            inside = cavity_around(mesh.nodes, mesh.tetrahedra, np.array([0.0, 0.0, 0.5 * length]), self.name)
            _, quadratic = add_midside_nodes(mesh.nodes, mesh.tetrahedra)
            cavity = start + quadratic_triangles(inside, quadratic)
        return Placed(far, cavity)

    def model(self, design: Mapping[str, float] | None = None, *, refine: float = 1.0) -> MechanicalModel:
        """Return the model of a design with the near port clamped.

        Its first six actuators drive the pose of the far port. A closed module has a seventh, the volume of its cavity.
        """
        builder = ModelBuilder()
        placed = self.add_to(builder, design, refine=refine)
        model = builder.build()
        for component, name in enumerate(POSE):
            model.add("a", Pose(name, placed.far, component, model.nodes))
        if placed.cavity is not None:
            model.add("a", Cavity("cavity", placed.cavity, model.nodes))
        return model

    def mass(self, design: Mapping[str, float] | None = None) -> float:
        """Return the mass of a body [kg], from its mesh; for the exceptions see `body`."""
        mesh = self.body(design)
        return DENSITY * float(Tetrahedra(mesh.nodes, mesh.tetrahedra).volume)

    def write(self, path: str | Path, design: Mapping[str, float] | None = None) -> Path:
        """Write the exact shape as ``.step`` or ``.stl`` [mm] and return the path.

        Raises:
            DesignError: for a malformed design.
            InfeasibleDesign: if the body cannot be drawn.
            ValueError: for another ending.
        """
        return write_drawing(self.drawing(self.design_space.complete(design)), path)

    def compliance(self, design: Mapping[str, float] | None = None, *, refine: float = 1.0) -> np.ndarray:
        """Return the motion of the far port by a wrench on it, near port clamped, small motions: shape (6, 6), `POSE`.

        Raises:
            DesignError: for a malformed design.
            InfeasibleDesign: if the body cannot be drawn or meshed.
        """
        rest = Statics(self.model(design, refine=refine)).solve(np.zeros(6 + self.closed), "effort")
        return rest.condensed.W.aa[:6, :6]
