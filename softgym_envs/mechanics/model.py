"""MechanicalModel: nodes, elements, boundary conditions, loads and constraints of one body."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csc_matrix, tril

from softgym_envs.errors import DataError
from softgym_envs.mechanics.constraints import Cable, Constraint, EmbeddedPoints, Point
from softgym_envs.mechanics.linear_solver import LinearSolver, make_solver
from softgym_envs.mechanics.materials import Material
from softgym_envs.mechanics.tetrahedra import Tetrahedra

__all__ = ["MechanicalModel", "read_mesh"]


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


class MechanicalModel:
    """A soft body with actuators, effectors and contact points.

    Fixed nodes are eliminated. The sparsity pattern, the scatter map and the symbolic factorisation are made once.

    Args:
        nodes: rest positions [m], shape (n, 3).
        blocks: element blocks.
        fixed: indices or boolean mask of the clamped nodes.
        gravity: acceleration [m/s2], shape (3,).
        solver: name of the linear solver, see `make_solver`.

    Attributes:
        constraints: constraint objects by role letter: ``"a"`` actuators, ``"e"`` effectors, ``"c"`` contacts.
        applied_loads: dead loads that `assemble` applies [N], shape (n, 3); a solver may bring them on in steps.
        version: grows with every change of loads or constraints.
        factor_owner: who factorised ``solver`` last; several solvers may share a model.
    """

    def __init__(
        self,
        nodes: np.ndarray,
        blocks: Sequence[Tetrahedra],
        *,
        fixed: np.ndarray,
        gravity: Sequence[float] = (0.0, 0.0, 0.0),
        solver: str = "auto",
    ) -> None:
        self.nodes = _check_nodes(nodes)
        self.blocks = list(blocks)
        mask = np.zeros(len(self.nodes), dtype=bool)
        chosen = np.asarray(fixed)
        mask[chosen if chosen.size else chosen.astype(int)] = True
        if not mask.any():
            raise ValueError("no node is fixed: the body could float away; pass the clamped nodes as 'fixed'")
        used = np.zeros(len(self.nodes), dtype=bool)
        for block in self.blocks:
            used[block.connectivity] = True
        # Nodes without elements have no stiffness; holding them keeps the tangent regular.
        self.fixed = mask | ~used
        self.free_dofs = np.flatnonzero(np.repeat(~self.fixed, 3))
        self._equation = np.full(3 * len(self.nodes), -1, dtype=np.int64)
        self._equation[self.free_dofs] = np.arange(len(self.free_dofs))
        self.constraints: dict[str, list[Constraint]] = {"a": [], "e": [], "c": []}
        self._solver_name = solver
        self._solver: LinearSolver | None = None
        self._poisson: LinearSolver | None = None
        self._free_nodes = np.flatnonzero(~self.fixed)
        self.version = 0
        self.factor_owner: object | None = None
        self.nodal_loads = np.zeros_like(self.nodes)
        self.gravity_forces = np.zeros_like(self.nodes)
        self._block_masses = [block.density * block.volumes for block in self.blocks]
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

    def embed(self, points: np.ndarray, hint: np.ndarray | None = None) -> EmbeddedPoints:
        """Embed points [m], shape (p, 3), in the first element block."""
        return EmbeddedPoints(points, self.nodes, self.blocks[0].connectivity, hint)

    def add(self, role: str, constraint: Constraint) -> Constraint:
        """Add a constraint under a role letter: a (actuator), e (effector), c (contact)."""
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
    ) -> Cable:
        """Add a cable actuator through ``points`` [m] (p, 3), ordered from the pull point to the anchor."""
        cable = Cable(name, self.embed(points, hint), pull_point, unilateral=unilateral)
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
            for block, masses in zip(self.blocks, self._block_masses, strict=True):
                share = np.repeat(masses / 4.0, 4)
                nodal = np.bincount(block.connectivity.ravel(), weights=share, minlength=len(self.nodes))
                self.gravity_forces += nodal[:, None] * acceleration
        self.refresh_loads()

    @property
    def loads(self) -> np.ndarray:
        """Dead loads on the nodes [N], shape (n, 3)."""
        return self.gravity_forces + self.nodal_loads

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return float(sum(masses.sum() for masses in self._block_masses))

    @property
    def volume(self) -> float:
        """Rest volume [m3]."""
        return float(sum(block.volumes.sum() for block in self.blocks))

    # -- constraints ------------------------------------------------------------------------------------------------

    @property
    def roles(self) -> tuple[tuple[str, int], ...]:
        """Role letters present and their row counts, in order."""
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
        n = len(self.free_dofs)
        stencils = []
        for block in self.blocks:
            dofs = (3 * block.connectivity[:, :, None] + np.arange(3)).reshape(len(block.connectivity), 12)
            r, s = np.tril_indices(12)
            stencils.append((self._equation[dofs[:, r]], self._equation[dofs[:, s]]))
        curved = [c for c, _ in self._rows if type(c).hessian is not Constraint.hessian]
        for constraint in curved:
            equations = self._equation[constraint.dofs]
            stencils.append((np.repeat(equations, len(equations))[None], np.tile(equations, len(equations))[None]))
        keys = []
        for k, (rows, columns) in enumerate(stencils):
            low, high = np.minimum(rows, columns), np.maximum(rows, columns)
            valid = low >= 0
            if k >= len(self.blocks):
                # Constraint hessians are stored whole; their upper half is left out.
                valid &= rows >= columns
            key = low * n + high  # column-major key of the lower triangle
            key[~valid] = -1
            keys.append(key)
        unique = np.unique(np.concatenate([key.ravel() for key in keys] + [np.arange(n) * (n + 1)]))
        unique = unique[unique >= 0]
        maps: list[np.ndarray] = []
        for key in keys:
            position = np.searchsorted(unique, key)
            maps.append(np.where(key < 0, -1, position).astype(np.int32))
        indptr = np.searchsorted(unique, np.arange(n + 1, dtype=np.int64) * n)
        indices = unique % n
        self._block_maps = maps[: len(self.blocks)]
        hessian_maps = iter(maps[len(self.blocks) :])
        self._hessian_maps: list[tuple[np.ndarray, np.ndarray] | None] = []
        for constraint, _ in self._rows:
            if constraint in curved:
                places = next(hessian_maps)[0]
                keep = np.flatnonzero(places >= 0)
                self._hessian_maps.append((keep, places[keep]))
            else:
                self._hessian_maps.append(None)
        self._values = np.empty(len(indices))
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
            residual: ``grad E - sum effort_i grad delta_i`` over the free dofs, shape (N,);
            tangent: lower-triangle values of its derivative (a buffer, overwritten by the next call);
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
        H = np.zeros((len(self.free_dofs), self.size), order="F")
        delta = np.empty(self.size)
        for (constraint, rows), (keep, equations), mapping in zip(
            self._rows, self._targets, self._hessian_maps, strict=True
        ):
            part = effort[rows]
            if mapping is not None and part.any():
                hessian = constraint.hessian(x, part)
                assert hessian is not None
                # Within one constraint every entry of the stencil has its own place.
                values[mapping[1]] -= hessian.ravel()[mapping[0]]
            H[equations, rows] = constraint.jacobian(x)[:, keep].T
            delta[rows] = constraint.value(x)
        residual = gradient.ravel()[self.free_dofs]
        if effort.any():
            residual = residual - H @ effort
        return residual, values, H, delta

    def warp(self, x: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Bend a linear ``step`` of the free dofs (N,) from ``x`` (n, 3) into one that turns elements, shape (n, 3).

        Rotation-strain warping (Huang et al. 2011): every element is turned by the exponential of the step's spin
        and strained by its symmetric part, and the nodes follow in the least-squares sense (a Poisson problem
        factorised once). It equals the linear step to first order, so Newton's method keeps its quadratic
        convergence, and takes far larger steps in bending.
        """
        self.prepare()
        full = np.zeros_like(self.nodes)
        full.ravel()[self.free_dofs] = step
        rhs = np.zeros_like(self.nodes)
        for block in self.blocks:
            block.add_warped(x, full, rhs)
        if self._poisson is None:
            self._poisson = self._make_poisson()
        free = self._free_nodes
        full[free] = self._poisson.solve(rhs[free])
        return full

    def _make_poisson(self) -> LinearSolver:
        entries = [block.laplacian_entries() for block in self.blocks]
        rows, columns, values = (np.concatenate(parts) for parts in zip(*entries, strict=True))
        n = len(self.nodes)
        free = self._free_nodes
        lower = tril(csc_matrix((values, (rows, columns)), shape=(n, n))[free][:, free], format="csc")
        lower.sort_indices()
        solver = make_solver(self._solver_name, lower.indptr, lower.indices)
        if not solver.factorise(lower.data):
            raise ValueError("the mesh has a part that is not connected to a fixed node")
        return solver

    def refresh_loads(self) -> None:
        """Take over changed ``nodal_loads``."""
        self.applied_loads = self.loads
        self.version += 1
