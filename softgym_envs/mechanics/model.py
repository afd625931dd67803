"""MechanicalModel: nodes, elements, boundary conditions, loads and constraints of one body."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix, tril
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from softgym_envs.errors import DataError
from softgym_envs.mechanics.constraints import Cable, Constraint, EmbeddedPoints, Point
from softgym_envs.mechanics.elements.block import ElementBlock
from softgym_envs.mechanics.elements.tetrahedra import SolidBlock, Tetrahedra
from softgym_envs.mechanics.frames import Frames, KinematicMap
from softgym_envs.mechanics.materials import Material
from softgym_envs.mechanics.skins import Skin
from softgym_envs.mechanics.solvers.linear import LinearSolver, make_solver

__all__ = ["Inertia", "MechanicalModel", "read_mesh"]


def read_mesh(path: str | Path, *, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Read nodes [m] (n, 3) and tetrahedra (m, 4) from any file meshio reads.

    Args:
        path: mesh file.
        scale: factor to metres, 1e-3 for a file in millimetres.

    Raises:
        DataError: if the file is missing, unreadable or holds no tetrahedra.
    """
    import meshio

    path = Path(path)
    if not path.is_file():
        raise DataError(f"mesh file '{path}' does not exist")
    suffix = path.suffix.lower()
    file_format = None
    if suffix == ".off":
        raise DataError(f"mesh file '{path}' holds no tetrahedra: the format .off is for surfaces")
    if suffix == ".msh":
        # Two programs use this suffix. meshio tries Ansys first, and looks for the end of a cut-off section for ever.
        content = path.read_bytes()
        file_format = "gmsh" if content.lstrip().startswith(b"$") else "ansys"
        if file_format == "ansys" and not content.rstrip().endswith(b")"):
            raise DataError(f"mesh file '{path}' is neither a Gmsh mesh nor a whole Ansys mesh")
    try:
        mesh = meshio.read(path, file_format=file_format)
    except (Exception, SystemExit) as error:  # meshio leaves with SystemExit on some malformed files
        raise DataError(f"mesh file '{path}' cannot be read: {error}") from error
    blocks = [block.data for block in mesh.cells if block.type == "tetra"]
    if not blocks:
        found = sorted({block.type for block in mesh.cells})
        raise DataError(f"mesh file '{path}' holds no tetrahedra (cell type 'tetra'); found {found}")
    tetrahedra = np.concatenate(blocks)
    if tetrahedra.size and not 0 <= tetrahedra.min() <= tetrahedra.max() < len(mesh.points):
        raise DataError(
            f"mesh file '{path}': tetrahedra refer to nodes {tetrahedra.min()}..{tetrahedra.max()}, "
            f"it has {len(mesh.points)}"
        )
    used, renumbered = np.unique(tetrahedra, return_inverse=True)
    return np.asarray(mesh.points, dtype=float)[used, :3] * scale, renumbered.reshape(tetrahedra.shape)


def _check_nodes(nodes: np.ndarray) -> np.ndarray:
    nodes = np.ascontiguousarray(nodes, dtype=float)
    if nodes.ndim != 2 or nodes.shape[1] != 3 or not np.isfinite(nodes).all():
        raise ValueError(f"nodes must be finite with shape (n, 3), got shape {nodes.shape}")
    return nodes


@njit(cache=True)
def _subtract_entries(values, places, entries):
    for k in range(places.shape[0]):
        if places[k] >= 0:
            values[places[k]] -= entries[k]


@njit(cache=True)
def _symmetric_product(low, high, values, vector):
    out = np.zeros_like(vector)
    for k in range(low.shape[0]):
        out[low[k]] += values[k] * vector[high[k]]
        if low[k] != high[k]:
            out[high[k]] += values[k] * vector[low[k]]
    return out


@dataclass(frozen=True)
class _Poisson:
    """The Poisson problem of warping along some axes: free rows, known rows, and what couples them."""

    axes: np.ndarray
    free: np.ndarray
    known: np.ndarray
    coupling: csc_matrix | None
    solver: LinearSolver


class Inertia(ABC):
    """What one implicit time step adds to the equilibrium: inertia and Rayleigh damping at its end.

    Attributes:
        acceleration_factor: derivative of accelerations with respect to displacements [1/s2].
        velocity_factor: derivative of velocities with respect to displacements [1/s].
        mass_damping: Rayleigh's alpha [1/s].
        stiffness_damping: Rayleigh's beta [s].
        stiffness: values that beta acts on, see `MechanicalModel.viscosity`.
    """

    acceleration_factor: float
    velocity_factor: float
    mass_damping: float = 0.0
    stiffness_damping: float = 0.0
    stiffness: np.ndarray | None = None

    @abstractmethod
    def motion(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return velocities [m/s] and accelerations [m/s2] of the rows (n, 3) if the step ends at rows ``x`` (n, 3)."""


@njit(cache=True)
def _find_entries(keys, total, indptr, indices, out):
    """Places of keys ``column * total + row`` in a CSC pattern; other keys than those in it keep their place."""
    for k in range(keys.shape[0]):
        column = keys[k] // total
        if keys[k] < 0 or column >= indptr.shape[0] - 1:
            continue
        row = keys[k] - column * total
        low, high = indptr[column], indptr[column + 1]
        while low < high:
            middle = (low + high) // 2
            if indices[middle] < row:
                low = middle + 1
            else:
                high = middle
        if low < indptr[column + 1] and indices[low] == row:
            out[k] = low


def _distinct(keys: np.ndarray) -> np.ndarray:
    """Sorted distinct values, as `numpy.unique` returns them; for integers sorting alone is far faster."""
    keys = np.sort(keys)
    return keys[np.append(True, keys[1:] != keys[:-1])] if len(keys) else keys


class MechanicalModel:
    """Soft bodies, beams and rigid parts with actuators, effectors, contact points, sensors and bonds.

    The state is one array ``x`` of rows (n, 3): a row for each mesh node, four for each frame (see `frames`). Fixed
    nodes are eliminated, carried ones follow their frame. The sparsity pattern, the scatter map and the symbolic
    factorisation are made once.

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
        applied_loads: dead loads that `assemble` applies [N], shape (n, 3); a solver may bring them on in steps.
        skins: surfaces of beams and rigid parts, for pictures only.
        equations: number of independent degrees of freedom.
        free_dofs: rows' degrees of freedom (3 * row + axis) that are equations of their own; spins come after them.
        dof_scale: length [m] that a unit of each equation moves: 1 for nodes, an arm for spins, shape (equations,).
        inertia: what a time step adds to the energy, see `Inertia`; None in statics.
        version: grows with every change of loads or constraints.
        factor_owner: who factorised ``solver`` last; several solvers may share a model.
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
        self.frames = Frames(self.nodes, np.asarray(frames), carried, mounted)
        mask = np.zeros((n, 3), dtype=bool)
        chosen = np.asarray(fixed)
        mask[chosen if chosen.size else chosen.astype(int)] = True
        spin_mask = np.zeros((len(self.frames), 3), dtype=bool)
        if fixed_spin is not None:
            flags = np.asarray(fixed_spin, dtype=bool)
            spin_mask[:] = flags[:, None] if flags.ndim == 1 else flags
        self.floating = floating
        if not mask.any() and not floating:
            raise ValueError("no node is fixed: the body could float away; pass the clamped nodes as 'fixed'")
        used = np.zeros(n, dtype=bool)
        for block in self.blocks:
            used[block.nodes_used] = True
        used[self.frames.rows] = True
        # Nodes without elements have no stiffness; holding them keeps the tangent regular.
        mask |= ~used[:, None]
        is_carried = np.zeros(n, dtype=bool)
        is_carried[self.frames.carried] = True
        self.fixed = mask.all(axis=1) & ~is_carried
        self.free_dofs = np.flatnonzero(~(mask | is_carried[:, None]).ravel())
        free_spins = np.flatnonzero(~spin_mask.ravel())
        self.equations = len(self.free_dofs) + len(free_spins)
        #: Number of each degree of freedom of the rows: equations first, then components of carried rows; -1 if fixed.
        self._equation = np.full(3 * n, -1, dtype=np.int64)
        self._equation[self.free_dofs] = np.arange(len(self.free_dofs))
        carried_dofs = (3 * self.frames.carried[:, None] + np.arange(3)).ravel()
        self._equation[carried_dofs] = self.equations + np.arange(len(carried_dofs))
        spin = np.full(spin_mask.size, -1, dtype=np.int64)
        spin[free_spins] = len(self.free_dofs) + np.arange(len(free_spins))
        self._spin_equation = spin.reshape(-1, 3)
        self._map: KinematicMap | None = None
        if len(self.frames):
            origin = self._equation[3 * self.frames.rows[:, None] + np.arange(3)]
            self._map = KinematicMap(self.frames, origin, self._spin_equation, self.equations)
        points = np.ones(n, dtype=bool)
        points[self.frames.carried[self.frames.moves == 0.0]] = False
        extent = float(np.linalg.norm(np.ptp(self.nodes[points], axis=0))) or 1.0
        self.dof_scale = np.ones(self.equations)
        self.dof_scale[len(self.free_dofs) :] = 0.1 * extent
        self._fixed_components = mask & ~is_carried[:, None]
        self.constraints: dict[str, list[Constraint]] = {"a": [], "e": [], "c": [], "s": [], "b": []}
        self.skins: list[Skin] = []
        self._solver_name = solver
        self._solver: LinearSolver | None = None
        self._poisson: list[_Poisson] | None = None
        self._bond_stiffness: float | None = None
        self.inertia: Inertia | None = None
        self.version = 0
        self.factor_owner: object | None = None
        self.nodal_loads = np.zeros_like(self.nodes)
        self.gravity_forces = np.zeros_like(self.nodes)
        self.set_gravity(gravity)

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
        self._solver = None
        self.version += 1
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
        """Set the acceleration of gravity [m/s2], shape (3,). Masses come from the density of the blocks.

        A `Statics` in use notices. After a change of ``nodal_loads`` call `refresh_loads`.
        """
        acceleration = np.asarray(gravity, dtype=float)
        if acceleration.shape != (3,) or not np.isfinite(acceleration).all():
            raise ValueError(f"gravity must be three finite numbers, got {gravity!r}")
        self.gravity_forces[:] = 0.0
        if acceleration.any():
            for block in self.blocks:
                self.gravity_forces += block.nodal_masses(len(self.nodes))[:, None] * acceleration
        self.refresh_loads()

    @property
    def loads(self) -> np.ndarray:
        """Dead loads on the nodes [N], shape (n, 3)."""
        return self.gravity_forces + self.nodal_loads

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

    # -- assembly ---------------------------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Build sparsity pattern, scatter maps and the symbolic factorisation; called when first needed."""
        if self._solver is not None:
            return
        self._rows = self.rows
        self.size = sum(size for _, size in self.roles)
        self._bonds = [(c, rows) for c, rows in self._rows if c in self.constraints["b"]]
        n = self.equations
        stencils, shares = [], []
        for block in self.blocks:
            shares.append(len(block.stencils()))
            for rows, columns in block.stencils():
                first, second = self._equation[rows], self._equation[columns]
                stencils.append((first, second, (first >= 0) & (second >= 0)))
        curved = [c for c, _ in self._rows if type(c).hessian is not Constraint.hessian]
        for constraint in curved:
            first, second = (self._equation[dofs] for dofs in constraint.hessian_pattern())
            # Both halves are listed, the upper one is left out.
            stencils.append((first, second, (second >= 0) & (first >= second)))
        for constraint, _ in self._bonds:
            k = len(constraint.dofs)
            first, second = (self._equation[d] for d in (np.repeat(constraint.dofs, k), np.tile(constraint.dofs, k)))
            stencils.append((first, second, (second >= 0) & (first >= second)))
        # Keys of entries: column-major in the lower triangle; those that touch a carried row come later.
        total = n + 3 * len(self.frames.carried)
        keys = []
        for first, second, valid in stencils:
            key = np.minimum(first, second) * total + np.maximum(first, second)
            key[~valid] = -1
            keys.append(key)
        seen = _distinct(np.concatenate([key.ravel() for key in keys] + [np.arange(n) * (total + 1)]))
        seen = seen[seen >= 0]
        high = seen % total
        direct, extra = seen[high < n], seen[high >= n]
        expanded = spins = np.empty((0, 2), dtype=np.int64)
        if self._map is not None:
            expanded = self._map.plan(extra // total, extra % total)
            spins = self._map.spin_pairs
        pairs = np.concatenate([expanded, spins[spins[:, 0] >= 0]])
        direct = _distinct(np.concatenate([direct, pairs[:, 0] * total + pairs[:, 1]]))
        self._entries = len(direct)
        if self._map is not None:
            spin_target = np.searchsorted(direct, spins[:, 0] * total + spins[:, 1])
            self._map.set_targets(
                np.searchsorted(direct, expanded[:, 0] * total + expanded[:, 1]),
                np.where(spins[:, 0] >= 0, spin_target, -1),
            )
        indptr = np.searchsorted(direct, np.arange(n + 1, dtype=np.int64) * total)
        indices = direct % total
        maps: list[np.ndarray] = []
        for key in keys:
            place = np.full(key.shape, -1, dtype=np.int32)
            _find_entries(key.ravel(), total, indptr, indices, place.reshape(-1))
            if len(extra):
                touches = (key >= 0) & (key % total >= n)
                place[touches] = self._entries + np.searchsorted(extra, key[touches])
            maps.append(place)
        following = iter(maps)
        self._block_maps = [[next(following) for _ in range(share)] for share in shares]
        self._hessian_maps = [next(following) if c in curved else None for c, _ in self._rows]
        self._bond_maps = [next(following) for _ in self._bonds]
        self._keys = np.concatenate([direct, extra])
        self._low, self._high = self._keys // total, self._keys % total
        self._known_dofs = np.flatnonzero(self._equation >= 0)
        self._masses: tuple[bool, csr_matrix, np.ndarray] | None = None
        self._values = np.empty(self._entries + len(extra))
        self._gradient = np.empty_like(self.nodes)
        self._targets = []
        for constraint, _ in self._rows:
            equations = self._equation[constraint.dofs]
            keep = np.flatnonzero(equations >= 0)
            self._targets.append((keep, equations[keep]))
        self._solver = make_solver(self._solver_name, indptr, indices)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the factorisations, which cannot be copied and are made again when needed."""
        return {**self.__dict__, "_solver": None, "_poisson": None, "factor_owner": None}

    @property
    def solver(self) -> LinearSolver:
        """The linear solver of the tangent's pattern."""
        self.prepare()
        assert self._solver is not None
        return self._solver

    @property
    def tangent_pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """CSC (indptr, indices) of the lower triangle over the free degrees of freedom."""
        return self.solver.indptr, self.solver.indices

    def energy(self, x: np.ndarray) -> float:
        """Elastic energy plus potential of the dead loads [J] at positions ``x`` (n, 3); inf if inverted."""
        gradient = np.zeros_like(self.nodes)
        total = sum(block.add(x, gradient, None, None)[0] for block in self.blocks)
        return total - float(np.vdot(self.loads, x - self.nodes))

    def assemble(
        self, x: np.ndarray, effort: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
        """Evaluate the equilibrium at positions ``x`` (n, 3) under the efforts (size,) of all constraint rows.

        Returns:
            residual: ``grad E - sum effort_i grad delta_i`` over the equations, shape (N,);
            tangent: lower-triangle values of its derivative (a buffer, overwritten by the next call), to which
                `bond_stiffness` times ``H_b H_b^T`` of the bonds is added: without it a part that only bonds hold
                would make it singular, and on motions that keep the bonds it changes nothing;
            H: constraint gradients, shape (N, size), Fortran order;
            delta: constraint values, shape (size,);
            or None if an element is inverted.
        """
        self.prepare()
        gradient, values = self._gradient, self._values
        np.negative(self.applied_loads, out=gradient)
        values[:] = 0.0
        for block, scatter in zip(self.blocks, self._block_maps, strict=True):
            if block.add(x, gradient, values, scatter)[1]:
                return None
        if self.inertia is not None:
            self._add_inertia(x, gradient, values)
        n = self.equations
        H = np.zeros((n + 3 * len(self.frames.carried), self.size), order="F")
        delta = np.empty(self.size)
        for (constraint, rows), (keep, equations), mapping in zip(
            self._rows, self._targets, self._hessian_maps, strict=True
        ):
            part = effort[rows]
            if mapping is not None and part.any():
                hessian = constraint.hessian(x, part)
                assert hessian is not None
                _subtract_entries(values, mapping, hessian.ravel())
            delta[rows], jacobian = constraint.linearise(x)
            H[equations, rows] = jacobian[:, keep].T
        residual = np.zeros(n)
        residual[: len(self.free_dofs)] = gradient.ravel()[self.free_dofs]
        if self._map is not None:
            arms = self._map.linearise(x)
            pull = gradient[self.frames.carried]
            if effort.any():
                pull = pull - (H[n:] @ effort).reshape(-1, 3)
            turning = self._map.transposed
            residual += turning @ gradient[self.frames.carried].ravel()
            H = np.asfortranarray(H[:n] + turning @ H[n:])
            self._add_bonds(x, values)
            self._map.expand(values, self._entries)
            self._map.add_curvature(values, arms, pull)
        else:
            self._add_bonds(x, values)
        if effort.any():
            residual -= H @ effort
        return residual, values[: self._entries], H, delta

    # -- dynamics ---------------------------------------------------------------------------------------------------

    def mass_matrix(self, lumped: bool = False) -> csr_matrix:
        """Mass matrix between rows [kg], shape (n, n), the same for every axis."""
        return self._mass_terms(lumped)[0]

    def _mass_terms(self, lumped: bool) -> tuple[csr_matrix, np.ndarray]:
        """The mass matrix, and its entries in the layout of the tangent's values."""
        self.prepare()
        if self._masses is None or self._masses[0] != lumped:
            parts = [block.mass_entries(lumped) for block in self.blocks]
            rows, columns, values = (np.concatenate(part) for part in zip(*parts, strict=True))
            off = rows != columns
            n = len(self.nodes)
            matrix = coo_matrix(
                (
                    np.concatenate([values, values[off]]),
                    (np.concatenate([rows, columns[off]]), np.concatenate([columns, rows[off]])),
                ),
                shape=(n, n),
            ).tocsr()
            total = self.equations + 3 * len(self.frames.carried)
            entries = np.zeros(len(self._values))
            for axis in range(3):
                first, second = self._equation[3 * rows + axis], self._equation[3 * columns + axis]
                keep = (first >= 0) & (second >= 0)
                low, high = np.minimum(first, second)[keep], np.maximum(first, second)[keep]
                key, direct = low * total + high, self._keys[: self._entries]
                place = np.where(
                    high < self.equations,
                    np.searchsorted(direct, key),
                    self._entries + np.searchsorted(self._keys[self._entries :], key),
                )
                entries += np.bincount(place, weights=values[keep], minlength=len(entries))
            self._masses = (lumped, matrix, entries)
        return self._masses[1], self._masses[2]

    def viscosity(self, x: np.ndarray) -> np.ndarray:
        """Values of the elements' stiffness against strain rates at rows ``x`` (n, 3), in the layout of assembly.

        See `ElementBlock.add_viscosity`; before what frames carry is brought to equations.
        """
        self.prepare()
        values = np.zeros_like(self._values)
        for block, scatter in zip(self.blocks, self._block_maps, strict=True):
            block.add_viscosity(x, values, scatter)
        return values

    def _add_inertia(self, x: np.ndarray, gradient: np.ndarray, values: np.ndarray) -> None:
        terms = self.inertia
        assert terms is not None and self._masses is not None, "a time step needs the mass matrix"
        _, matrix, entries = self._masses
        velocity, acceleration = terms.motion(x)
        gradient += matrix @ (acceleration + terms.mass_damping * velocity)
        values += (terms.acceleration_factor + terms.mass_damping * terms.velocity_factor) * entries
        if terms.stiffness_damping:
            assert terms.stiffness is not None
            values += (terms.stiffness_damping * terms.velocity_factor) * terms.stiffness
            gradient += self.damping_force(terms, velocity)

    def damping_force(self, terms: Inertia, velocity: np.ndarray) -> np.ndarray:
        """Force [N] (n, 3) of the stiffness-proportional damping of a step at velocities of the rows (n, 3)."""
        assert terms.stiffness is not None
        moved = np.zeros(self.equations + 3 * len(self.frames.carried))
        equations = self._equation[self._known_dofs]
        moved[equations] = velocity.ravel()[self._known_dofs]
        force = _symmetric_product(self._low, self._high, terms.stiffness, moved)
        out = np.zeros_like(self.nodes)
        out.ravel()[self._known_dofs] = terms.stiffness_damping * force[equations]
        return out

    def row_velocity(self, x: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Velocity of all rows (n, 3) that velocities of the equations (N,) give at rows ``x`` (n, 3)."""
        out = np.zeros_like(self.nodes)
        out.ravel()[self.free_dofs] = velocity[: len(self.free_dofs)]
        if self._map is not None:
            self._map.linearise(x)
            out[self.frames.carried] = (self._map.matrix @ velocity).reshape(-1, 3)
        return out

    def row_acceleration(self, x: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
        """Acceleration of all rows (n, 3) under velocities and accelerations of the equations (N,) at ``x`` (n, 3)."""
        out = self.row_velocity(x, acceleration)
        if self._map is not None:
            spin = self._spins(velocity)[self.frames.owner]
            # w x (w x r)
            out[self.frames.carried] += np.cross(spin, np.cross(spin, self.frames.arms(x)))
        return out

    def equation_velocity(self, x: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Velocities of the equations (N,) behind velocities of the rows (n, 3) at ``x`` (n, 3)."""
        out = np.zeros(self.equations)
        out[: len(self.free_dofs)] = velocity.ravel()[self.free_dofs]
        if self._map is not None:
            directors = self.frames.rows[:, None] + np.arange(1, 4)
            spin = 0.5 * np.cross(x[directors], velocity[directors]).sum(axis=1)
            free = self._spin_equation >= 0
            out[self._spin_equation[free]] = spin[free]
        return out

    def increment(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Displacements and rotation vectors of the equations (N,) that lead from rows ``start`` to ``end``, (n, 3)."""
        out = np.zeros(self.equations)
        out[: len(self.free_dofs)] = (end - start).ravel()[self.free_dofs]
        if self._map is not None:
            directors = self.frames.rows[:, None] + np.arange(1, 4)
            turn = np.einsum("fki,fkj->fij", end[directors], start[directors])
            spin = Rotation.from_matrix(turn).as_rotvec()
            free = self._spin_equation >= 0
            out[self._spin_equation[free]] = spin[free]
        return out

    def _spins(self, step: np.ndarray) -> np.ndarray:
        """Spin part of a vector of the equations (N,), shape (f, 3)."""
        spins = np.zeros_like(self._spin_equation, dtype=float)
        free = self._spin_equation >= 0
        spins[free] = step[self._spin_equation[free]]
        return spins

    @property
    def bond_stiffness(self) -> float:
        """Stiffness [N/m] of the term that bonds add to the tangent; any positive one gives the same equilibrium.

        It is high beside that of elements, so that the tangent is positive definite where the bonded body is stable.
        """
        if self._bond_stiffness is None:
            stiffness = [block.stiffness for block in self.blocks if block.stiffness > 0.0]
            self._bond_stiffness = 100.0 * float(np.mean(stiffness)) if stiffness else 1.0
        return self._bond_stiffness

    def _add_bonds(self, x: np.ndarray, values: np.ndarray) -> None:
        for (bond, _), places in zip(self._bonds, self._bond_maps, strict=True):
            jacobian = bond.jacobian(x)
            _subtract_entries(values, places, (-self.bond_stiffness * (jacobian.T @ jacobian)).ravel())

    def warp(self, x: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Bend a linear ``step`` of the equations (N,) from ``x`` (n, 3) into a displacement of all rows, shape (n, 3).

        Frames turn by the exponential of their spin, and what they carry follows. For solids, rotation-strain warping
        (Huang et al. 2011): every element is turned by the exponential of the step's spin and strained by its
        symmetric part, and the nodes follow in the least-squares sense (a Poisson problem factorised once); beams
        alike, along their axis. It equals the linear step to first order, so Newton's method keeps its quadratic
        convergence, and takes far larger steps in bending.
        """
        self.prepare()
        full = self.displace(x, step)
        linear = full.copy()
        if self._map is not None:
            self._map.linearise(x)
            linear[self.frames.carried] = (self._map.matrix @ step).reshape(-1, 3)
        rhs = np.zeros_like(self.nodes)
        for block in self.blocks:
            block.add_warped(x, linear, rhs)
        if self._poisson is None:
            self._poisson = self._make_poisson()
        for problem in self._poisson:
            right = rhs[problem.free, problem.axes]
            if problem.coupling is not None:
                right = right - problem.coupling @ full[problem.known, problem.axes]
            full[problem.free, problem.axes] = problem.solver.solve(right)
        return full

    def displace(self, x: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Displacement of all rows (n, 3) by a step of the equations (N,): frames turn, all else goes straight."""
        full = np.zeros_like(self.nodes)
        full.ravel()[self.free_dofs] = step[: len(self.free_dofs)]
        if self._map is not None:
            self.frames.displace(x, full[self.frames.rows], self._spins(step), full)
        return full

    def _make_poisson(self) -> list[_Poisson]:
        entries = [block.laplacian_entries() for block in self.blocks]
        rows, columns, values = (np.concatenate(parts) for parts in zip(*entries, strict=True))
        n = len(self.nodes)
        laplacian = csc_matrix((values, (rows, columns)), shape=(n, n))
        touched = np.zeros(n, dtype=bool)
        touched[rows] = True
        carried = np.zeros(n, dtype=bool)
        carried[self.frames.carried] = True
        # A rigid part moves as a whole: its origin is not warped apart from what it carries.
        carried[self.frames.rows[self.frames.owner[self.frames.moves > 0.0]]] = True
        _, part = connected_components(laplacian, directed=False)
        problems = []
        # Nodes may be held along some axes only; axes along which the same nodes are held share a factorisation.
        patterns, group = np.unique(self._fixed_components | carried[:, None], axis=1, return_inverse=True)
        for number, held in enumerate(patterns.T):
            anchored = np.isin(part, part[held & touched])
            if not (self._bonds or self.floating) and not anchored[touched].all():
                raise ValueError("the mesh has a part that is not connected to a fixed node")
            # A part that only bonds hold keeps its linear step.
            free = np.flatnonzero(touched & anchored & ~held)
            if not len(free):
                continue
            known = np.flatnonzero(carried & touched)
            lower = tril(laplacian[free][:, free], format="csc")
            lower.sort_indices()
            solver = make_solver(self._solver_name, lower.indptr, lower.indices)
            if not solver.factorise(lower.data):
                raise ValueError("the Laplacian of the mesh cannot be factorised")
            coupling = laplacian[free][:, known] if len(known) else None
            axes = np.flatnonzero(group.ravel() == number)
            problems.append(_Poisson(axes, free[:, None], known[:, None], coupling, solver))
        return problems

    def refresh_loads(self) -> None:
        """Take over changed ``nodal_loads``, or a changed elasticity of a block."""
        self.applied_loads = self.loads
        self._bond_stiffness = None
        self.version += 1
