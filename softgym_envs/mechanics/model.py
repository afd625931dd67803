"""MechanicalModel: nodes, elements, boundary conditions, loads and constraints of one body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from softgym_envs.arguments import explained
from softgym_envs.mechanics.assembly import Assembly
from softgym_envs.mechanics.compilation import announce_compilation
from softgym_envs.mechanics.constraints.cable import Cable
from softgym_envs.mechanics.constraints.cavity import ATMOSPHERE, Cavity, SealedAir
from softgym_envs.mechanics.constraints.constraint import Constraint, add_constraint
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.elements.block import ElementBlock
from softgym_envs.mechanics.elements.quadratic import QuadraticTetrahedra, quadratic_triangles
from softgym_envs.mechanics.elements.tetrahedra import SolidBlock, check_nodes
from softgym_envs.mechanics.frames import Frames
from softgym_envs.mechanics.kinematics import Kinematics
from softgym_envs.mechanics.loads import Load, Shares, spread
from softgym_envs.mechanics.materials import Material
from softgym_envs.mechanics.mesh_checks import check_held
from softgym_envs.mechanics.solids import (
    DEFAULT_ELEMENT,
    Fixed,
    PerElement,
    are_rows,
    check_distance,
    check_guides,
    check_modulus,
    check_size,
    described,
    fixed_mask,
    nodes_in_box,
    solid_part,
)
from softgym_envs.quantities import check_quantity, finite_number, numbers

if TYPE_CHECKING:
    from softgym_envs.mechanics.contact.contact import Contact, ContactSettings
    from softgym_envs.mechanics.contact.obstacles import MeshObstacle, Obstacle
    from softgym_envs.mechanics.skins import Skin
    from softgym_envs.mechanics.warping import Warping

announce_compilation()


@explained
class MechanicalModel:
    """Soft bodies, beams and rigid parts with actuators, effectors, contact points, sensors and bonds.

    The model describes a body and is not changed by solving: `Statics` and `Dynamics` keep their own state, so several
    of them can share one model. The state of the body is one array ``x`` of rows (n, 3): a row for each mesh node, four
    for each frame (see `frames`). Fixed nodes are eliminated, carried ones follow their frame.

    Args:
        nodes: rest rows [m], shape (n, 3).
        blocks: element blocks.
        fixed: indices or boolean mask (n,) of the clamped nodes, or a mask (n, 3) by axis; for a frame, its origin.
        frames: first row of each frame, shape (f,).
        carried: mesh nodes that move with a frame: index of the frame -> rows.
        mounted: frames fixed to another one, and not among ``frames``: index of the frame -> their first rows.
        fixed_spin: boolean mask of spin components (about the axes of space) that frames do not have, shape (f,) or
            (f, 3); default none.
        floating: allow bodies without fixed nodes; in statics bonds must then hold them.
        gravity: acceleration [m/s2], shape (3,).
        solver: name of the linear solver, see `make_solver`.

    Attributes:
        constraints: constraint objects by role letter: ``"a"`` actuators, ``"e"`` effectors, ``"c"`` contacts,
            ``"s"`` sensors (measured, never loaded), ``"b"`` bonds (held at zero, not part of the condensed model).
        nodal_loads: dead loads on the rows besides gravity [N], shape (n, 3); change them in place.
        skins: surfaces of beams and rigid parts, for pictures and contact.
        named_loads: loads from `add_load` by name.
        contact: what the surface of the body touches, or None; see `set_contact`.
        gravity: acceleration [m/s2], shape (3,); see `set_gravity`.
        kinematics: degrees of freedom, and the motions that belong to them.
        solver: name of the linear solver.
    """

    def __init__(
        self,
        nodes: np.ndarray,
        blocks: Sequence[ElementBlock],
        *,
        fixed: np.ndarray,
        frames: Sequence[int] | np.ndarray = (),
        carried: Mapping[int, np.ndarray] | None = None,
        mounted: Mapping[int, np.ndarray] | None = None,
        fixed_spin: np.ndarray | None = None,
        floating: bool = False,
        gravity: Sequence[float] = (0.0, 0.0, 0.0),
        solver: str = "auto",
    ) -> None:
        self.nodes, self.blocks = check_nodes(nodes), list(blocks)
        n = len(self.nodes)
        body_frames = Frames(self.nodes, np.asarray(frames), carried, mounted)
        held = fixed_mask(fixed, n)
        held_spin = np.zeros((len(body_frames), 3), dtype=bool)
        if fixed_spin is not None:
            flags = np.asarray(fixed_spin, dtype=bool)
            held_spin[:] = flags[:, None] if flags.ndim == 1 else flags
        if not held.any() and not floating:
            raise ValueError("no node is fixed: the body could float away; pass the clamped nodes as 'fixed'")
        used = np.zeros(n, dtype=bool)
        for block in self.blocks:
            used[block.nodes_used] = True
        used[body_frames.rows] = True
        # Nodes without elements have no stiffness; holding them keeps the tangent regular.
        held |= ~used[:, None]
        self.kinematics = Kinematics(self.nodes, held, body_frames, held_spin)
        if not self.kinematics.equations:
            raise ValueError("every node is clamped, so that nothing can move; clamp only those where the body is held")
        self.floating, self._is_held, self.solver = floating, floating, solver
        self.constraints: dict[str, list[Constraint]] = {"a": [], "e": [], "c": [], "s": [], "b": []}
        self.skins: list[Skin] = []
        self.named_loads: dict[str, Load] = {}
        self.contact: Contact | None = None
        self.nodal_loads = np.zeros_like(self.nodes)
        self._gravity_forces = np.zeros_like(self.nodes)
        self._assembly: Assembly | None = None
        self._warping: Warping | None = None
        self.set_gravity(gravity)

    def __getstate__(self) -> dict[str, Any]:
        # The factorisations of warping cannot be copied and are recomputed when needed.
        return {**self.__dict__, "_warping": None}

    # -- construction -----------------------------------------------------------------------------------------------

    @classmethod
    def from_mesh(
        cls,
        nodes: np.ndarray,
        tetrahedra: np.ndarray,
        *,
        fixed: Fixed,
        element: str = DEFAULT_ELEMENT,
        material: str | Material = "corotational",
        young_modulus: PerElement = 3.0e6,
        poisson_ratio: PerElement = 0.3,
        density: float = 1100.0,
        total_mass: float | None = None,
        regions: Mapping[str, np.ndarray] | None = None,
        gravity: Sequence[float] = (0.0, 0.0, 0.0),
        solver: str = "auto",
        check: bool = True,
    ) -> MechanicalModel:
        """Make a model of one material from any tetrahedral mesh.

        Args:
            nodes: [m], shape (n, 3).
            tetrahedra: corner indices (m, 4), or with midside nodes (m, 10) for ``"quadratic"``. Otherwise these are
                added after the other nodes, fixed where both ends of the edge are.
            fixed: clamped nodes: indices, a mask (n,) or (n, 3) by axis, or a function of the nodes to one of them.
            element: ``"quadratic"``, or coarser ones that lock, with a warning how much: ``"linear"``, ``"averaged"``.
            material: a `Material` or its name.
            young_modulus: [Pa]; a number, an array (m,), numbers by region, or a function of centroids [m] (m, 3).
            poisson_ratio: inside (-1, 0.5), in the same forms.
            density: [kg/m3].
            total_mass: mass of the body [kg], instead of the density.
            regions: elements of each region by name, see `read_mesh`.
            gravity: acceleration [m/s2], shape (3,).
            solver: name of the linear solver, see `make_solver`.
            check: refuse meshes that are not one body: repeated, folded or overlapping elements, nodes that are not
                merged, and faces that lie on each other. False allows cuts of no width.

        Raises:
            ValueError: for a mesh that is no body, clamps that do not hold it, or wrong arguments.
        """
        part = solid_part(
            nodes,
            tetrahedra,
            fixed=fixed,
            element=element,
            material=material,
            young_modulus=young_modulus,
            poisson_ratio=poisson_ratio,
            density=density,
            total_mass=total_mass,
            regions=regions,
            check=check,
        )
        check_modulus(part.options["young_modulus"])
        block = part.kind(part.nodes, part.connectivity, **part.options)
        model = cls(part.nodes, [block], fixed=part.fixed, gravity=gravity, solver=solver)
        model._check_held()
        from softgym_envs.mechanics.locking import warn_of_locking

        warn_of_locking(model)
        return model

    @classmethod
    def from_file(
        cls,
        path: str | Path,
        *,
        fixed: Fixed | str | Sequence[str] | None = None,
        fixed_box: Sequence[float] | None = None,
        scale: float | None = None,
        unit: str | None = None,
        mesh_size: float | None = None,
        time_limit: float = 60.0,
        **options: Any,
    ) -> MechanicalModel:
        """Make a model from a file: a tetrahedral mesh, or a closed surface (STL) that gmsh fills with tetrahedra.

        Args:
            path: a mesh, a closed surface or a STEP file, see `read_mesh`.
            fixed: clamped nodes, as for `from_mesh`, or names of groups of the file; or
            fixed_box: nodes inside (xmin, xmax, ymin, ymax, zmin, zmax) [m] are clamped.
            scale: factor from the file's unit to metres, default 1.
            unit: unit of the file instead of ``scale``: ``"m"``, ``"cm"``, ``"mm"`` or ``"in"``.
            mesh_size: edge length [m] for filling a surface or shape; default: a twentieth of its diagonal.
            time_limit: time limit for meshing a surface or shape [s].
            **options: as for `from_mesh`.

        Raises:
            DataError: if the file is missing or unreadable, or its surface is open or intersects itself.
            MeshingError: if gmsh cannot be used, or takes too long.
            ValueError: if no node is fixed, or the size of the body is implausible.
        """
        from softgym_envs.mechanics.io import LARGEST_UNSTATED, read_mesh, states_unit

        mesh = read_mesh(path, scale=scale, unit=unit, mesh_size=mesh_size, time_limit=time_limit)
        stated = scale is not None or unit is not None or states_unit(path)
        hint = "for a file in millimetres pass unit='mm', in inches unit='in', in metres unit='m'"
        check_size(mesh.nodes, hint, high=None if stated else LARGEST_UNSTATED, example="a file that states no unit")
        if (fixed is None) == (fixed_box is None):
            raise ValueError("pass the clamped nodes as either 'fixed' or 'fixed_box'")
        if options.get("element", DEFAULT_ELEMENT) != "quadratic":
            mesh = mesh.corners_only()
        clamped = mesh.named(fixed) if fixed_box is None else nodes_in_box(mesh.nodes, fixed_box)
        return cls.from_mesh(mesh.nodes, mesh.tetrahedra, fixed=clamped, regions=mesh.regions, **options)

    @property
    def solids(self) -> list[SolidBlock]:
        """The blocks of solid elements."""
        return [block for block in self.blocks if isinstance(block, SolidBlock)]

    def embed(
        self,
        points: ArrayLike,
        hint: np.ndarray | None = None,
        *,
        block: int = 0,
        name: str = "point",
        radius: float = 0.0,
    ) -> EmbeddedPoints:
        """Embed points in a solid block.

        Args:
            points: [m], shape (p, 3).
            hint: elements from which points outside the mesh are extrapolated, shape (p,).
            block: its number among `solids`.
            name: what the points are, for messages.
            radius: of the part of the body on which a point acts [m], see `averaged_points`. With zero it acts on a
                single point, whose compliance grows with every refinement of the mesh.

        Raises:
            ValueError: if a point is farther from the body than the body's size, or the body does not reach into its
                radius.
        """
        solid, radius = self._solid(block), finite_number(radius, f"radius of {name}", "m")
        check_distance(points, self._solid_nodes, name, 1.0)
        at = np.asarray(points, dtype=float)
        return solid.embed_average(at, self.nodes, radius) if radius else solid.embed(at, self.nodes, hint)

    def _solid(self, block: int) -> SolidBlock:
        solids = self.solids
        if not 0 <= block < len(solids):
            raise ValueError(f"block = {block} is out of range: the model has {len(solids)} solids")
        return solids[block]

    @property
    def _solid_nodes(self) -> np.ndarray:
        """Corner nodes of all solids [m], shape (k, 3)."""
        return self.nodes[np.unique(np.concatenate([solid.corners.ravel() for solid in self.solids]))]

    def add(self, role: str, constraint: Constraint) -> Constraint:
        """Add a constraint under a role letter: a actuator, e effector, c contact, s sensor, b bond."""
        add_constraint(self.constraints, role, constraint)
        self._assembly = self._warping = None
        return constraint

    def add_cable(
        self,
        name: str,
        points: ArrayLike,
        pull_point: ArrayLike,
        *,
        unilateral: bool = True,
        hint: np.ndarray | None = None,
        block: int = 0,
        radius: float = 0.0,
    ) -> Cable:
        """Add a cable actuator.

        Args:
            name: identifier.
            points: guides in a solid [m], ordered from the pull point to the anchor, shape (p, 3).
            pull_point: fixed point where the cable leaves the body [m], shape (3,).
            unilateral: True for a real cable, which cannot push.
            hint: elements from which guides outside the mesh are extrapolated, shape (p,).
            block: its number among `solids`.
            radius: of the channel's part on which a guide acts [m], see `embed`.

        Raises:
            ValueError: if a guide without a hint lies an element's length outside the body, or the pull point ten times
                its size, or not at three finite numbers.
        """
        origin = numbers(pull_point, f"the pull point of cable '{name}'", "m")
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise ValueError(f"the pull point of cable '{name}' must be three finite numbers, got {origin.tolist()}")
        check_distance(origin, self._solid_nodes, f"the pull point of cable '{name}'", 10.0)
        embedding = self.embed(points, hint, block=block, name=f"a guide of cable '{name}'", radius=radius)
        if hint is None and not radius:
            check_guides(embedding, self.nodes, f"a guide of cable '{name}'")
        self.add("a", cable := Cable(name, embedding, origin, unilateral=unilateral))
        return cable

    def add_cavity(
        self,
        name: str,
        *,
        surface: np.ndarray | str | Path | None = None,
        inside: Sequence[float] | np.ndarray | None = None,
        unit: str | None = None,
        block: int = 0,
    ) -> Cavity:
        """Add a pneumatic actuator: a closed cavity of a solid, whose pressure follows the surface.

        Args:
            name: identifier.
            surface: triangles of corner nodes, shape (k, 3); quadratic elements add their midside nodes. Or a file with
                the surface of the chamber, as scenes of SOFA have it: the cavity that it fills is then found. Or
            inside: a point [m] (3,) within the cavity, whose surface is then found.
            unit: unit of the file, see `read_mesh`; by default the one in which it fills a cavity.
            block: number of the solid among `solids`.

        Raises:
            DataError: if the file cannot be read.
            ValueError: if no closed cavity encloses the point or is filled by the file's surface, or the surface is not
                closed.
        """
        if (surface is None) == (inside is None):
            raise ValueError(f"cavity '{name}' needs either its 'surface' or a point 'inside' it")
        from softgym_envs.mechanics.chambers import chamber_triangles

        if inside is not None:
            check_distance(inside, self._solid_nodes, f"the point inside cavity '{name}'", 1.0)
        corners = self._solid(block).corners
        cavity = self.cavity(name, chamber_triangles(name, self.nodes, corners, surface, inside, unit), block=block)
        self.add("a", cavity)
        return cavity

    def cavity(self, name: str, surface: np.ndarray, *, block: int = 0) -> Cavity:
        """Return the cavity within a closed surface of a solid, for any role.

        Args:
            name: identifier.
            surface: triangles of corner nodes, shape (k, 3); quadratic elements add their midside nodes.
            block: number of the solid among `solids`.

        Raises:
            ValueError: if the surface is not closed.
        """
        solid = self._solid(block)
        if isinstance(solid, QuadraticTetrahedra) and surface.ndim == 2 and surface.shape[1] == 3:
            surface = quadratic_triangles(surface, solid.connectivity)
        return Cavity(name, surface, self.nodes)

    def seal(self, cavity: Cavity, ambient: float = ATMOSPHERE) -> SealedAir:
        """Close a cavity: its air resists changes of volume by Boyle's law, isothermally (see `EnclosedGas`).

        Args:
            cavity: from `cavity`.
            ambient: absolute pressure around the body, and of the air at rest [Pa].

        Returns:
            The gauge pressure of the air [Pa], which may be added as a sensor (role s).

        Raises:
            ValueError: if the ambient pressure is not positive and finite.
        """
        from softgym_envs.mechanics.elements.gas import EnclosedGas

        air = SealedAir(cavity, ambient)
        self.blocks.append(EnclosedGas(air))
        self._assembly = self._warping = None
        return air

    def add_effector(
        self,
        name: str,
        point: ArrayLike | EmbeddedPoints,
        *,
        hint: np.ndarray | None = None,
        block: int = 0,
        radius: float = 0.0,
    ) -> Point:
        """Add an effector at a material point [m] (3,) of a solid, or averaged over a radius [m] (see `embed`).

        Or at a point that is embedded already, as one of a rod.
        """
        if not isinstance(point, EmbeddedPoints):
            point = self.embed(point, hint, block=block, name=f"effector '{name}'", radius=radius)
        self.add("e", effector := Point(name, point))
        return effector

    def add_contact(
        self, name: str, point: ArrayLike, *, hint: np.ndarray | None = None, block: int = 0, radius: float = 0.0
    ) -> Point:
        """Add a contact point at a material point [m] (3,) of a solid, or averaged over a radius [m] (see `embed`)."""
        contact = Point(name, self.embed(point, hint, block=block, name=f"contact '{name}'", radius=radius))
        self.add("c", contact)
        return contact

    def set_contact(
        self,
        *,
        obstacles: Sequence[Obstacle | MeshObstacle] = (),
        excluded: Sequence[int] | np.ndarray = (),
        settings: ContactSettings | None = None,
    ) -> Contact:
        """Let the surface of the body touch obstacles and, unless settings say no, itself.

        Call it when all parts and skins have been added; solvers made afterwards include it.

        Args:
            obstacles: what the body touches, each with its coefficient of friction.
            excluded: rows whose triangles touch nothing, e.g. nodes clamped inside a mount that is not modelled.
            settings: self-contact, and the law of contact; by default the body touches itself too.

        Raises:
            ValueError: if there is no Young's modulus to choose the stiffness of contact from, or for excluded rows
                that do not exist or are a mask.
        """
        excluded = np.asarray(excluded)
        if excluded.size and not are_rows(excluded, len(self.nodes)):
            raise ValueError(
                f"'excluded' must be numbers of rows from 0 to {len(self.nodes) - 1}, got {described(excluded)}"
            )
        from softgym_envs.mechanics.contact.contact import Contact, ContactSettings
        from softgym_envs.mechanics.contact.surface import surface_of

        settings = ContactSettings(self_contact=True) if settings is None else settings
        if settings.stiffness is None:
            stiffness = 0.1 * max((block.largest_young_modulus for block in self.blocks), default=0.0)
            if not stiffness:
                raise ValueError("a body without elastic parts needs the 'stiffness' [Pa] of its contact")
            settings = replace(settings, stiffness=stiffness)
        skins = [skin for skin in self.skins if skin.touches]
        self.contact = Contact(surface_of(self.nodes, self.blocks, skins, excluded), obstacles, settings)
        self.contact.check_near(self.nodes)
        return self.contact

    # -- loads ------------------------------------------------------------------------------------------------------

    def set_gravity(self, gravity: Sequence[float]) -> None:
        """Set the acceleration of gravity [m/s2], shape (3,). Masses come from the density of the blocks."""
        acceleration = np.asarray(gravity, dtype=float)
        if acceleration.shape != (3,) or not np.isfinite(acceleration).all():
            raise ValueError(f"gravity must be three finite numbers, got {gravity!r}")
        check_quantity("gravity", np.linalg.norm(acceleration), f"gravity {tuple(acceleration.tolist())}: length")
        self.gravity = acceleration
        self._gravity_forces[:] = 0.0
        if acceleration.any():
            for block in self.blocks:
                self._gravity_forces += block.nodal_masses(len(self.nodes))[:, None] * acceleration

    def add_load(self, name: str, force: ArrayLike, on: EmbeddedPoints | Shares | Fixed) -> None:
        """Add a force [N] (3,) that keeps its direction, or change the one of the same name.

        It acts on embedded points in equal parts, on the nodes of a straight edge, given as for ``fixed``, in
        proportion to its length, or on rows by their shares.

        Raises:
            ValueError: if the force is not three finite numbers, or acts on no node or on no straight edge.
        """
        total = np.asarray(force, dtype=float)
        if total.shape != (3,) or not np.isfinite(total).all():
            raise ValueError(f"the force of load '{name}' must be three finite numbers [N], got {force!r}")
        load = Load(total, *spread(name, on, self.nodes))
        if name in self.named_loads:
            self.named_loads[name].add_to(self.nodal_loads, -1.0)
        load.add_to(self.nodal_loads)
        self.named_loads[name] = load

    @property
    def loads(self) -> np.ndarray:
        """Dead loads on the rows [N], shape (n, 3): gravity and `nodal_loads`."""
        return self._gravity_forces + self.nodal_loads

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return float(sum(block.mass for block in self.blocks))

    @property
    def volume(self) -> float:
        """Rest volume [m3]."""
        return float(sum(block.volume for block in self.blocks))

    # -- constraints ------------------------------------------------------------------------------------------------

    @property
    def roles(self) -> tuple[tuple[str, int], ...]:
        """Role letters present and their row counts, in order; bonds come last."""
        sizes = ((letter, sum(c.size for c in group)) for letter, group in self.constraints.items())
        return tuple((letter, size) for letter, size in sizes if size)

    @property
    def rows(self) -> list[tuple[Constraint, slice]]:
        """All constraints with their rows in the condensed model."""
        everyone = [constraint for group in self.constraints.values() for constraint in group]
        ends = np.cumsum([0, *(constraint.size for constraint in everyone)]).tolist()
        return [(each, slice(*pair)) for each, pair in zip(everyone, pairwise(ends), strict=True)]

    # -- equations --------------------------------------------------------------------------------------------------

    @property
    def fixed(self) -> np.ndarray:
        """Rows that cannot move, boolean mask of shape (n,)."""
        return self.kinematics.fixed

    @property
    def frames(self) -> Frames:
        """Frames and the rows they carry."""
        return self.kinematics.frames

    @property
    def places(self) -> np.ndarray:
        """Rest positions of mesh nodes and of the origins of frames [m], shape (k, 3)."""
        directors = self.frames.carried[self.frames.moves == 0.0]
        return np.delete(self.nodes, directors, axis=0)

    @property
    def equations(self) -> int:
        """Number of independent degrees of freedom."""
        return self.kinematics.equations

    @property
    def assembly(self) -> Assembly:
        """The equilibrium equations with the current constraints; adding a constraint creates a new assembly."""
        if self._assembly is None:
            self._check_held()
            self._assembly = Assembly(self.nodes, self.kinematics, self.blocks, self.rows, self.constraints["b"])
        return self._assembly

    def _check_held(self) -> None:
        """Check once that clamps, frames and bonds leave no part of a solid loose; see `check_held`."""
        if self._is_held:
            return
        held = self.kinematics.held.copy()
        held[self.frames.carried] = True
        ties = [(bond.dofs, bond.jacobian(self.nodes)) for bond in self.constraints["b"]]
        check_held(self.nodes, held, [block.connectivity for block in self.solids], ties)
        self._is_held = True

    @property
    def warping(self) -> Warping:
        """Warping of Newton steps into large motions."""
        if self._warping is None:
            from softgym_envs.mechanics.warping import Warping

            floating = self.floating or bool(self.constraints["b"])
            self._warping = Warping(self.kinematics, self.blocks, solver=self.solver, floating=floating)
        return self._warping

    @property
    def elasticity_version(self) -> int:
        """A number that grows with every change of a block's elasticity."""
        return sum(block.elasticity_version for block in self.blocks)

    def elastic_energy(self, x: np.ndarray) -> float:
        """Elastic energy [J] at positions ``x`` (n, 3); inf if inverted."""
        gradient = np.zeros_like(self.nodes)
        return sum(block.add(x, gradient, None, None)[0] for block in self.blocks)

    def energy(self, x: np.ndarray) -> float:
        """Elastic energy plus potential of the dead loads [J] at positions ``x`` (n, 3); inf if inverted."""
        return self.elastic_energy(x) - float(np.vdot(self.loads, x - self.nodes))
