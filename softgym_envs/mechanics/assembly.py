"""Assembly: the equilibrium equations of a body and their derivative, on a sparsity pattern computed once."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix

from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.constraints.constraint import Constraint
from softgym_envs.mechanics.elements.block import ElementBlock, StrainRates
from softgym_envs.mechanics.frames import KinematicMap
from softgym_envs.mechanics.kinematics import Kinematics


@njit(cache=True)
def _subtract_entries(values, places, entries):
    for k in range(places.shape[0]):
        if places[k] >= 0:
            values[places[k]] -= entries[k]


@njit(cache=True)
def _find_entries(keys, total, indptr, indices, out):
    """Write to ``out`` where keys ``column * total + row`` are in a CSC pattern; other keys leave it unchanged."""
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
    """Sorted distinct values, as `numpy.unique` returns them; for integers, sorting alone is far faster."""
    keys = np.sort(keys)
    return keys[np.append(True, keys[1:] != keys[:-1])] if len(keys) else keys


class Assembled(NamedTuple):
    """Equilibrium equations at one state.

    Attributes:
        residual: ``grad E - sum effort_i grad delta_i`` over the equations, shape (N,).
        tangent: lower-triangle values of its derivative, a buffer that the next call overwrites; None if it was not
            asked for.
        gradients: constraint gradients ``H``, shape (N, size), Fortran order.
        delta: constraint values, shape (size,).
        energy: elastic energy [J].
    """

    residual: np.ndarray
    tangent: np.ndarray | None
    gradients: np.ndarray
    delta: np.ndarray
    energy: float


class MassMatrix(NamedTuple):
    """Mass matrix of a body.

    Attributes:
        rows: masses between rows [kg], the same for every axis, shape (n, n).
        entries: the same masses in the layout of the tangent's values.
    """

    rows: csr_matrix
    entries: np.ndarray


class MassAndDamping(NamedTuple):
    """Mass and Rayleigh damping of a body.

    Attributes:
        mass: mass matrix.
        mass_damping: Rayleigh's alpha [1/s].
        stiffness_damping: Rayleigh's beta [s], see `ElementBlock.add_damping`.
    """

    mass: MassMatrix
    mass_damping: float = 0.0
    stiffness_damping: float = 0.0


class Inertia(ABC):
    """Terms that one implicit time step adds to the equilibrium: inertia and damping at its end.

    Attributes:
        body: mass and damping of the body.
        start: rows at the start of the step [m], shape (n, 3).
        acceleration_factor: derivative of accelerations with respect to displacements [1/s2].
        velocity_factor: derivative of velocities with respect to displacements [1/s].
    """

    body: MassAndDamping
    start: np.ndarray
    acceleration_factor: float
    velocity_factor: float

    @abstractmethod
    def motion(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return velocities [m/s] and accelerations [m/s2] of the rows (n, 3) if the step ends at rows ``x`` (n, 3)."""

    @abstractmethod
    def middle(self, x: np.ndarray) -> np.ndarray:
        """Return the rows (n, 3) at which the velocities strain the body if the step ends at rows ``x`` (n, 3)."""


class Assembly:
    """Evaluates the equilibrium equations of a body on a fixed sparsity pattern.

    Values of the tangent are stored in the order of its lower triangle (CSC, see `indptr` and `indices`). During
    assembly, entries that involve carried rows are appended at the end; the kinematic map then adds them to those of
    the equations.

    Args:
        nodes: rest rows [m], shape (n, 3).
        kinematics: degrees of freedom.
        blocks: element blocks.
        rows: constraints and their rows.
        bonds: the bonds among the constraints.

    Attributes:
        size: number of constraint rows.
        indptr: CSC column pointers of the tangent's lower triangle over the equations, shape (N + 1,).
        indices: its row indices.
        bond_stiffness: stiffness [N/m] of the term ``bond_stiffness H_b H_b^T`` that bonds add to the tangent. Without
            it, a part held only by bonds would make the tangent singular. It has no effect on motions that satisfy the
            bonds, so any positive value gives the same equilibrium. It is much stiffer than the elements, so the
            tangent is positive definite wherever the bonded body is stable.
    """

    def __init__(
        self,
        nodes: np.ndarray,
        kinematics: Kinematics,
        blocks: Sequence[ElementBlock],
        rows: Sequence[tuple[Constraint, slice]],
        bonds: Sequence[Constraint],
    ) -> None:
        self.kinematics = kinematics
        self.blocks = list(blocks)
        self._rows = list(rows)
        self._bonds = list(bonds)
        self.size = sum(constraint.size for constraint, _ in self._rows)
        stiffness = [block.stiffness for block in self.blocks if block.stiffness > 0.0]
        self.bond_stiffness = 100.0 * float(np.mean(stiffness)) if stiffness else 1.0
        self._targets = []
        for constraint, _ in self._rows:
            equations = kinematics.number[constraint.dofs]
            keep = np.flatnonzero(equations >= 0)
            self._targets.append((keep, equations[keep]))
        self._make_pattern()
        self._values = np.empty(len(self.keys))
        self._gradient = np.empty_like(nodes)

    def _make_pattern(self) -> None:
        """Find the sparsity pattern and, for each block and constraint, where its entries go."""
        kinematics = self.kinematics
        number, n, total = kinematics.number, kinematics.equations, kinematics.total
        stencils = [block.stencils() for block in self.blocks]
        curved = [c for c, _ in self._rows if type(c).hessian is not Constraint.hessian]
        # Constraints list both halves; drop the upper one.
        halves = [c.hessian_pattern() for c in curved]
        halves += [(np.repeat(c.dofs, len(c.dofs)), np.tile(c.dofs, len(c.dofs))) for c in self._bonds]
        # Keys of entries: column-major in the lower triangle; those that involve a carried row come last.
        keys = []
        for pairs, lower_only in ((sum(stencils, []), False), (halves, True)):
            for rows, columns in pairs:
                first, second = number[rows], number[columns]
                key = np.minimum(first, second) * total + np.maximum(first, second)
                key[(first < 0) | (second < 0) | (lower_only & (first < second))] = -1
                keys.append(key)
        seen = _distinct(np.concatenate([key.ravel() for key in keys] + [np.arange(n) * (total + 1)]))
        seen = seen[seen >= 0]
        high = seen % total
        direct, extra = seen[high < n], seen[high >= n]
        if kinematics.map is not None:
            direct = self._plan_expansion(kinematics.map, direct, extra)
        self._entries = len(direct)
        self.indptr = np.searchsorted(direct, np.arange(n + 1, dtype=np.int64) * total)
        self.indices = direct % total
        maps: list[np.ndarray] = []
        for key in keys:
            place = np.full(key.shape, -1, dtype=np.int32)
            _find_entries(key.ravel(), total, self.indptr, self.indices, place.reshape(-1))
            if len(extra):
                touches = (key >= 0) & (key % total >= n)
                place[touches] = self._entries + np.searchsorted(extra, key[touches])
            maps.append(place)
        following = iter(maps)
        self._block_maps = [[next(following) for _ in parts] for parts in stencils]
        self._hessian_maps = [next(following) if c in curved else None for c, _ in self._rows]
        self._bond_maps = [next(following) for _ in self._bonds]
        self.keys = np.concatenate([direct, extra])

    def _plan_expansion(self, kinematic_map: KinematicMap, direct: np.ndarray, extra: np.ndarray) -> np.ndarray:
        """Return the keys of direct entries and of those to which carried rows contribute; keep where the latter go."""
        total = self.kinematics.total
        self._expansion = kinematic_map.plan(extra // total, extra % total)
        spins = kinematic_map.spin_pairs
        expanded_keys, spin_keys = (pairs @ [total, 1] for pairs in (self._expansion.pairs, spins))
        held = spins[:, 0] < 0
        direct = _distinct(np.concatenate([direct, expanded_keys, spin_keys[~held]]))
        self._expansion_target = np.searchsorted(direct, expanded_keys)
        self.spin_target = np.where(held, -1, np.searchsorted(direct, spin_keys))
        return direct

    def evaluate(
        self,
        x: np.ndarray,
        effort: np.ndarray,
        loads: np.ndarray,
        inertia: Inertia | None = None,
        *,
        tangent: bool = True,
    ) -> Assembled | None:
        """Return the equilibrium equations at one state, or None if an element is inverted there.

        Args:
            x: positions of the rows [m], shape (n, 3).
            effort: efforts of all constraint rows, shape (size,).
            loads: dead loads [N], shape (n, 3).
            inertia: terms that a time step adds; None in statics.
            tangent: compute the tangent too.
        """
        gradient, values = self._gradient, self._values if tangent else None
        np.negative(loads, out=gradient)
        if values is not None:
            values[:] = 0.0
        energy = 0.0
        for block, scatter in zip(self.blocks, self._block_maps, strict=True):
            stored, inverted = block.add(x, gradient, values, scatter)
            if inverted:
                return None
            energy += stored
        if inertia is not None:
            self._add_inertia(inertia, x, gradient, values)
        kinematics = self.kinematics
        n, carried = kinematics.equations, kinematics.frames.carried
        H = np.zeros((kinematics.total, self.size), order="F")
        delta = np.empty(self.size)
        for (constraint, rows), (keep, equations), mapping in zip(
            self._rows, self._targets, self._hessian_maps, strict=True
        ):
            part = effort[rows]
            if values is not None and mapping is not None and part.any():
                hessian = constraint.hessian(x, part)
                assert hessian is not None
                _subtract_entries(values, mapping, hessian.ravel())
            delta[rows], jacobian = constraint.linearise(x)
            H[equations, rows] = jacobian[:, keep].T
        residual = np.zeros(n)
        residual[: len(kinematics.free_dofs)] = gradient.ravel()[kinematics.free_dofs]
        for bond, places in zip(self._bonds, self._bond_maps, strict=True) if values is not None else ():
            jacobian = bond.jacobian(x)
            _subtract_entries(values, places, (-self.bond_stiffness * (jacobian.T @ jacobian)).ravel())
        if kinematics.map is not None:
            arms = kinematics.map.linearise(x)
            pull = gradient[carried]
            if effort.any():
                pull = pull - (H[n:] @ effort).reshape(-1, 3)
            turning = kinematics.map.transposed
            residual += turning @ gradient[carried].ravel()
            H = np.asfortranarray(H[:n] + turning @ H[n:])
            if values is not None:
                kinematics.map.expand(values, self._entries, self._expansion, self._expansion_target)
                kinematics.map.add_curvature(values, arms, pull, self.spin_target)
        if effort.any():
            residual -= H @ effort
        return Assembled(residual, None if values is None else values[: self._entries], H, delta, energy)

    # -- dynamics ---------------------------------------------------------------------------------------------------

    def mass_matrix(self, lumped: bool = False) -> MassMatrix:
        """Return the mass matrix, consistent or lumped."""
        parts = [block.mass_entries(lumped) for block in self.blocks]
        rows, columns, values = (np.concatenate(part) for part in zip(*parts, strict=True))
        off = rows != columns
        n = len(self._gradient)
        matrix = coo_matrix(
            (
                np.concatenate([values, values[off]]),
                (np.concatenate([rows, columns[off]]), np.concatenate([columns, rows[off]])),
            ),
            shape=(n, n),
        ).tocsr()
        number, total = self.kinematics.number, self.kinematics.total
        entries = np.zeros(len(self._values))
        for axis in range(3):
            first, second = number[3 * rows + axis], number[3 * columns + axis]
            keep = (first >= 0) & (second >= 0)
            low, high = np.minimum(first, second)[keep], np.maximum(first, second)[keep]
            key, direct = low * total + high, self.keys[: self._entries]
            place = np.where(
                high < self.kinematics.equations,
                np.searchsorted(direct, key),
                self._entries + np.searchsorted(self.keys[self._entries :], key),
            )
            entries += np.bincount(place, weights=values[keep], minlength=len(entries))
        return MassMatrix(matrix, entries)

    def inertial_work(self, inertia: Inertia, start: np.ndarray, end: np.ndarray) -> float:
        """Return the work [J] against the forces that a time step adds, from rows ``start`` to ``end`` (n, 3).

        It is exact for implicit Euler without rotating frames.
        """
        body, work, power = inertia.body, 0.0, 0.0
        for x, sign in ((start, -1.0), (end, 1.0)):
            velocity, acceleration = inertia.motion(x)
            force = body.mass.rows @ (acceleration + body.mass_damping * velocity)
            work += 0.5 * float(np.vdot(force, end - start))
            power += sign * self._add_damping(inertia, x, velocity, np.zeros_like(x), None)
        return work + (0.5 * power / inertia.velocity_factor if power else 0.0)

    def dissipated_power(self, inertia: Inertia, x: np.ndarray) -> float:
        """Return the power [W] that damping takes at the end of a time step at rows ``x`` (n, 3)."""
        velocity, _ = inertia.motion(x)
        drag = inertia.body.mass_damping * float(np.vdot(velocity, inertia.body.mass.rows @ velocity))
        return drag + self._add_damping(inertia, x, velocity, np.zeros_like(x), None)

    def _add_inertia(self, inertia: Inertia, x: np.ndarray, gradient: np.ndarray, values: np.ndarray | None) -> None:
        body = inertia.body
        velocity, acceleration = inertia.motion(x)
        gradient += body.mass.rows @ (acceleration + body.mass_damping * velocity)
        if values is not None:
            values += (inertia.acceleration_factor + body.mass_damping * inertia.velocity_factor) * body.mass.entries
        self._add_damping(inertia, x, velocity, gradient, values)

    def _add_damping(
        self, inertia: Inertia, x: np.ndarray, velocity: np.ndarray, gradient: np.ndarray, values: np.ndarray | None
    ) -> float:
        """Add the forces against strain rates and return their power [W]."""
        beta = inertia.body.stiffness_damping
        if not beta and not any(block.damped for block in self.blocks):
            return 0.0
        rates = StrainRates(inertia.start, inertia.middle(x), velocity, inertia.velocity_factor, beta)
        return sum(
            block.add_damping(x, rates, gradient, values, None if values is None else scatter)
            for block, scatter in zip(self.blocks, self._block_maps, strict=True)
            if beta or block.damped
        )
