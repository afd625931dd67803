"""MechanicalModel: nodes, elements, boundary conditions, loads and constraints of one body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.mechanics.assembly import Assembly
from softgym_envs.mechanics.constraints import Cable, Constraint, EmbeddedPoints, Point
from softgym_envs.mechanics.elements.block import ElementBlock
from softgym_envs.mechanics.elements.tetrahedra import SolidBlock, Tetrahedra
from softgym_envs.mechanics.frames import Frames
from softgym_envs.mechanics.io import read_mesh
from softgym_envs.mechanics.kinematics import Kinematics
from softgym_envs.mechanics.materials import Material
from softgym_envs.mechanics.skins import Skin
from softgym_envs.mechanics.warping import Warping


def _check_nodes(nodes: np.ndarray) -> np.ndarray:
    nodes = np.ascontiguousarray(nodes, dtype=float)
    if nodes.ndim != 2 or nodes.shape[1] != 3 or not np.isfinite(nodes).all():
        raise ValueError(f"nodes must be finite with shape (n, 3), got shape {nodes.shape}")
    return nodes


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
        floating: allow bodies that nothing holds: in dynamics inertia does, in statics bonds must.
        gravity: acceleration [m/s2], shape (3,).
        solver: name of the linear solver, see `make_solver`.

    Attributes:
        constraints: constraint objects by role letter: ``"a"`` actuators, ``"e"`` effectors, ``"c"`` contacts,
            ``"s"`` sensors (measured, never loaded), ``"b"`` bonds (held at zero, not part of the condensed model).
        nodal_loads: dead loads on the rows besides gravity [N], shape (n, 3); change them in place.
        skins: surfaces of beams and rigid parts, for pictures only.
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
        self.nodes = _check_nodes(nodes)
        self.blocks = list(blocks)
        n = len(self.nodes)
        body_frames = Frames(self.nodes, np.asarray(frames), carried, mounted)
        held = np.zeros((n, 3), dtype=bool)
        chosen = np.asarray(fixed)
        held[chosen if chosen.size else chosen.astype(int)] = True
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
        self.floating = floating
        self.solver = solver
        self.constraints: dict[str, list[Constraint]] = {"a": [], "e": [], "c": [], "s": [], "b": []}
        self.skins: list[Skin] = []
        self.nodal_loads = np.zeros_like(self.nodes)
        self._gravity_forces = np.zeros_like(self.nodes)
        self._assembly: Assembly | None = None
        self._warping: Warping | None = None
        self.set_gravity(gravity)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the factorisations of warping, which cannot be copied and are made again when needed."""
        return {**self.__dict__, "_warping": None}

    # -- making one -------------------------------------------------------------------------------------------------

    @classmethod
    def from_mesh(
        cls,
        nodes: np.ndarray,
        tetrahedra: np.ndarray,
        *,
        fixed: np.ndarray,
        material: str | Material = "corotational",
        young_modulus: float = 3.0e6,
        poisson_ratio: float = 0.3,
        density: float = 1100.0,
        gravity: Sequence[float] = (0.0, 0.0, 0.0),
        solver: str = "auto",
    ) -> MechanicalModel:
        """Make a model of one material from any tetrahedral mesh: nodes [m] (n, 3), tetrahedra (m, 4)."""
        nodes = _check_nodes(nodes)
        block = Tetrahedra(
            nodes,
            tetrahedra,
            material=material,
            young_modulus=young_modulus,
            poisson_ratio=poisson_ratio,
            density=density,
        )
        return cls(nodes, [block], fixed=fixed, gravity=gravity, solver=solver)

    @classmethod
    def from_file(
        cls, path: str | Path, *, fixed_box: Sequence[float], scale: float = 1.0, **options
    ) -> MechanicalModel:
        """Make a model from a mesh file.

        Args:
            path: any file meshio reads.
            fixed_box: nodes inside (xmin, xmax, ymin, ymax, zmin, zmax) [m] are clamped.
            scale: factor from the file's unit to metres.
            **options: as for `from_mesh`.
        """
        nodes, tetrahedra = read_mesh(path, scale=scale)
        box = np.asarray(fixed_box, dtype=float)
        if box.shape != (6,):
            raise ValueError(f"fixed_box must be xmin, xmax, ymin, ymax, zmin, zmax, got {fixed_box!r}")
        box = box.reshape(3, 2)
        fixed = np.all((nodes >= box[:, 0]) & (nodes <= box[:, 1]), axis=1)
        return cls.from_mesh(nodes, tetrahedra, fixed=fixed, **options)

    @property
    def solids(self) -> list[SolidBlock]:
        """The blocks of solid elements."""
        return [block for block in self.blocks if isinstance(block, SolidBlock)]

    def embed(self, points: np.ndarray, hint: np.ndarray | None = None, *, block: int = 0) -> EmbeddedPoints:
        """Embed points [m], shape (p, 3), in a solid block (its number among `solids`)."""
        return self.solids[block].embed(points, self.nodes, hint)

    def add(self, role: str, constraint: Constraint) -> Constraint:
        """Add a constraint under a role letter: a actuator, e effector, c contact, s sensor, b bond."""
        if role not in self.constraints:
            raise ValueError(f"unknown role '{role}'; allowed: {', '.join(self.constraints)}")
        self.constraints[role].append(constraint)
        self._assembly = self._warping = None
        return constraint

    def add_cable(
        self,
        name: str,
        points: np.ndarray,
        pull_point: np.ndarray,
        *,
        unilateral: bool = True,
        hint: np.ndarray | None = None,
        block: int = 0,
    ) -> Cable:
        """Add a cable actuator through ``points`` [m] (p, 3) of a solid, ordered from the pull point to the anchor."""
        cable = Cable(name, self.embed(points, hint, block=block), pull_point, unilateral=unilateral)
        self.add("a", cable)
        return cable

    def add_effector(self, name: str, point: np.ndarray, *, hint: np.ndarray | None = None) -> Point:
        """Add an effector at a material point [m] (3,)."""
        effector = Point(name, self.embed(point, hint))
        self.add("e", effector)
        return effector

    # -- loads ------------------------------------------------------------------------------------------------------

    def set_gravity(self, gravity: Sequence[float]) -> None:
        """Set the acceleration of gravity [m/s2], shape (3,). Masses come from the density of the blocks."""
        acceleration = np.asarray(gravity, dtype=float)
        if acceleration.shape != (3,) or not np.isfinite(acceleration).all():
            raise ValueError(f"gravity must be three finite numbers, got {gravity!r}")
        self._gravity_forces[:] = 0.0
        if acceleration.any():
            for block in self.blocks:
                self._gravity_forces += block.nodal_masses(len(self.nodes))[:, None] * acceleration

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
        result, start = [], 0
        for group in self.constraints.values():
            for constraint in group:
                result.append((constraint, slice(start, start + constraint.size)))
                start += constraint.size
        return result

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
    def equations(self) -> int:
        """Number of independent degrees of freedom."""
        return self.kinematics.equations

    @property
    def assembly(self) -> Assembly:
        """The equilibrium equations with the present constraints; a new constraint makes a new assembly."""
        if self._assembly is None:
            self._assembly = Assembly(self.nodes, self.kinematics, self.blocks, self.rows, self.constraints["b"])
        return self._assembly

    @property
    def warping(self) -> Warping:
        """The bending of Newton steps into large motions."""
        if self._warping is None:
            floating = self.floating or bool(self.constraints["b"])
            self._warping = Warping(self.kinematics, self.blocks, solver=self.solver, floating=floating)
        return self._warping

    @property
    def elasticity_version(self) -> int:
        """A number that grows with every change of a block's elasticity."""
        return sum(block.elasticity_version for block in self.blocks)

    def energy(self, x: np.ndarray) -> float:
        """Elastic energy plus potential of the dead loads [J] at positions ``x`` (n, 3); inf if inverted."""
        gradient = np.zeros_like(self.nodes)
        total = sum(block.add(x, gradient, None, None)[0] for block in self.blocks)
        return total - float(np.vdot(self.loads, x - self.nodes))
